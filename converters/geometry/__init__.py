"""Pure functions of points, faces and rotations that several stages share."""
