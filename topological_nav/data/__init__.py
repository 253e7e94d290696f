"""Rooms and passages as datasets of images."""
