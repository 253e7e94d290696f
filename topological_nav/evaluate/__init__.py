"""Navigators in, rows of episodes out."""
