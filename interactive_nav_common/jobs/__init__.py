"""Commands in, exit codes out: side by side on this machine (`processes`) or on a Ray cluster (`on_ray`)."""
