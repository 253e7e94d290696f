"""Angles and axes in, rotation matrices out."""

import numpy as np

Y_UP_TO_Z_UP = np.array([[1.0, 0.0, 0.0], [0.0, 0.0, -1.0], [0.0, 1.0, 0.0]])
"""Turns a y-up vector into a z-up one: x stays, y becomes z, z becomes -y."""
