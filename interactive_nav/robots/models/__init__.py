"""One module a robot."""
