"""What furniture hid of floor and walls, covered by patches."""
