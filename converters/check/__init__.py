"""Does a scene hold: settling, gates, a picture of the conversion."""
