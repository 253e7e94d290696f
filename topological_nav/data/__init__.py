"""Make datasets of images of rooms and passages."""
