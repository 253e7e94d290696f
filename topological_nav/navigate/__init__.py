"""Command velocities by images."""
