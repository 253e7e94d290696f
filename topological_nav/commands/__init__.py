"""Words in, files and pictures out: what `python -m topological_nav` runs."""
