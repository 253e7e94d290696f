"""Networks and maps carried to another domain."""
