"""Input from others, kept within bounds: files that they wrote, and requests that they send."""
