"""Rows, maps and paths in, pictures out."""
