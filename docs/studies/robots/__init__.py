"""What robots really do, measured and drawn."""
