"""Define the builtin robots, one module per kind."""
