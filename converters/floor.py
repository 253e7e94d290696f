"""Scan in; scan with a level floor out."""

from __future__ import annotations

import numpy as np

from converters.raw import FLOOR

LIFT_M = 0.004
"""The picture's floor lies this far above the collision plane, so that the two do not flicker into one
another."""
LEVEL_M = 0.12
"""Floor-labelled vertices within this of z = 0 are put on the level."""


def level_floor(vertices_w: np.ndarray, labels: np.ndarray) -> np.ndarray:
    """(n, 3) vertices with the waves of the reconstructed floor taken out: the collision floor is a plane."""
    result = vertices_w.copy()
    result[(labels == FLOOR) & (np.abs(vertices_w[:, 2]) < LEVEL_M), 2] = LIFT_M
    return result
