"""Draw rows, maps and paths."""
