"""Design furnished homes: rooms, furniture as people arrange it, and how much of it must be pushed."""
