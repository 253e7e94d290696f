"""Design floor plans and furnish them sparsely."""
