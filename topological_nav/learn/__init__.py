"""Images and labels in, trained networks out."""
