"""What kind of home in; its rooms, their furniture as people arrange it, and how much of it must be pushed, out."""
