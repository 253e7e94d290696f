"""What furniture hid of floor and walls, closed without cracks."""
