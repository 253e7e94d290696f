"""Run commands and return their exit codes, side by side on this machine (`processes`) or on Ray (`on_ray`)."""
