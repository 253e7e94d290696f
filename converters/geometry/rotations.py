"""Angles and axes in, rotation matrices out."""

from __future__ import annotations

import math

import numpy as np


def yaw_matrix(yaw: float) -> np.ndarray:
    """(3, 3) rotation about z."""
    c, s = math.cos(yaw), math.sin(yaw)
    return np.array([[c, -s, 0.0], [s, c, 0.0], [0.0, 0.0, 1.0]])


def wrap_angle(angle: float, period: float = 2 * math.pi) -> float:
    """The angle's representative in [-period/2, period/2)."""
    return (angle + period / 2) % period - period / 2


Y_UP_TO_Z_UP = np.array([[1.0, 0.0, 0.0], [0.0, 0.0, -1.0], [0.0, 1.0, 0.0]])
"""Turns a y-up vector into a z-up one: x stays, y becomes z, z becomes -y."""
