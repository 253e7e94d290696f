"""Use a scene at rest: its free space, rooms and images, and a robot that drives in it."""
