"""A scene at rest: free space, rooms, images, a robot that drives in it."""
