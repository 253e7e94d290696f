"""Images in, velocities out."""
