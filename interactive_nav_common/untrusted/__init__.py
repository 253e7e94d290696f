"""Keep input from others within bounds: files that they wrote, and requests that they send."""
