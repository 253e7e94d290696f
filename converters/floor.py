"""Cleaned scan and floor plan in; scan with a level floor, and flat patches where furniture hid it, out."""

from __future__ import annotations

import numpy as np
from scipy import ndimage
from scipy.spatial import KDTree

from converters.alignment import yaw_matrix
from converters.maps import FloorPlan
from converters.raw import FLOOR
from converters.texture import ColourCloud
from converters.walls import cover_rectangles

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


def floor_patch(
    plan: FloorPlan, cloud: ColourCloud, floor_points: np.ndarray
) -> tuple[np.ndarray, np.ndarray, ColourCloud]:
    """Rectangles over the floor that the scan does not show, coloured from the seen floor around them.

    Args:
        plan: where floor is, and where it was seen.
        cloud: coloured points of the cleaned scan.
        floor_points: (k,) indices of the cloud's points that show floor.

    Returns:
        vertices (n, 3), faces (m, 3), and coloured points on them. All empty where nothing is hidden.
    """
    hidden = plan.floor & ~plan.floor_whole
    needed = ndimage.binary_dilation(hidden, np.ones((3, 3))) & plan.floor  # one cell of overlap: no cracks
    empty = ColourCloud(np.zeros((0, 3)), np.zeros((0, 3)), np.zeros((0, 3)))
    if not needed.any() or len(floor_points) == 0:
        return np.zeros((0, 3)), np.zeros((0, 3), np.int64), empty
    side, turn = plan.grid.resolution_m, yaw_matrix(plan.grid.yaw)
    corners = []
    for r0, r1, c0, c1 in cover_rectangles(needed, needed, disjoint=True):
        corners += [(c0, r0), (c1, r0), (c1, r1), (c0, r1)]
    flat = np.array(corners, float) * side + plan.grid.origin
    # A shade below the seen floor, which covers the overlap.
    vertices = np.column_stack([flat, np.full(len(flat), LIFT_M * 0.75)]) @ turn.T
    first = np.arange(0, len(vertices), 4)[:, None]
    faces = np.vstack([first + [0, 1, 2], first + [0, 2, 3]])

    row, column = np.nonzero(needed)
    offsets = np.array([(0.25, 0.25), (0.75, 0.25), (0.25, 0.75), (0.75, 0.75)])
    spots = (np.stack([column, row], axis=1)[:, None] + offsets).reshape(-1, 2) * side + plan.grid.origin
    points = np.column_stack([spots, np.full(len(spots), LIFT_M * 0.75)]) @ turn.T
    count = min(48, len(floor_points))
    seen = cloud.points[floor_points]
    distance, index = KDTree(seen[:, :2]).query(points[:, :2], k=count)
    distance, index = distance.reshape(-1, count), index.reshape(-1, count)
    weight = 1.0 / (distance + 0.05)
    shade = (cloud.colours[floor_points][index] * weight[..., None]).sum(axis=1) / weight.sum(axis=1, keepdims=True)
    return vertices, faces, ColourCloud(points, np.tile([0.0, 0.0, 1.0], (len(points), 1)), shade)
