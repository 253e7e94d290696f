"""Topological maps: built, planned on, asked where an image is."""
