"""Policies in, rows of episodes out."""
