"""A seed in; a floor plan and its furniture out."""
