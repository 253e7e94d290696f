"""Find the floor that walls enclose, and the floor around a home, such as a ground plane, that they do not."""

import numpy as np
from scipy import ndimage
from scipy.spatial import ConvexHull, QhullError

BEYOND_M = 0.5
"""Floor farther than this outside of the convex hull of all obstacles lies outside of the home."""
LEAST_BEYOND_M2 = 1.0
"""A home with less floor beyond its obstacles has no floor around it: scans end between walls."""
OPENINGS_M = (1.3, 2.0, 2.8)
"""Widths of discs that roll around a home and do not fit through its doorways, tried in order."""
LEAST_INSIDE_M2 = 3.0
"""Least floor of a home."""
RIGHT_SHARE, HOME_SHARE = 0.5, 0.25
"""Least share of the floor within the hull that lies inside: for a width to be right at once, and for a home without
furniture."""


def beyond_obstacles(occupied: np.ndarray, resolution_m: float) -> np.ndarray:
    """Return (rows, columns) bool: cells over `BEYOND_M` outside of the convex hull of the occupied cells."""
    cells = np.argwhere(occupied)
    try:
        sides = ConvexHull(cells).equations
    except (QhullError, ValueError):  # all on one line, or none
        return np.zeros(occupied.shape, bool)
    rows, columns = np.indices(occupied.shape)
    far = np.full(occupied.shape, -np.inf)
    for row, column, offset in sides:
        np.maximum(far, row * rows + column * columns + offset, out=far)
    return far * resolution_m > BEYOND_M


def floor_outside(floor: np.ndarray, occupied: np.ndarray, furniture: np.ndarray, resolution_m: float) -> np.ndarray:
    """Return the part of a floor that lies outside of the walls of a home; all masks are (rows, columns) bool.

    Outside is what a disc that comes from beyond all obstacles covers, if it does not fit through doorways. Nothing is
    outside where no floor lies beyond the obstacles, or where the walls enclose no home: too little floor, or less
    than half of the furniture, which is the footprints of movable objects.
    """
    cell_m2 = resolution_m**2
    beyond = beyond_obstacles(occupied, resolution_m)
    if (floor & beyond).sum() * cell_m2 < LEAST_BEYOND_M2:
        return np.zeros_like(floor)
    best, within = np.zeros_like(floor), (floor & ~beyond).sum()
    for width_m in OPENINGS_M:
        inside = _inside(floor, occupied, beyond, width_m / resolution_m)
        best = max(best, inside, key=np.count_nonzero)
        if inside.sum() >= RIGHT_SHARE * within:
            break
    under = floor & furniture
    is_home = 2 * (under & best).sum() >= under.sum() if under.any() else best.sum() >= HOME_SHARE * within
    return floor & ~best if is_home and best.sum() * cell_m2 >= LEAST_INSIDE_M2 else np.zeros_like(floor)


def _inside(floor: np.ndarray, occupied: np.ndarray, beyond: np.ndarray, width: float) -> np.ndarray:
    """Return the floor that a disc of `width` cells, which comes from beyond, does not cover nor cut off."""
    pad, radius = int(width) + 2, width / 2
    around = np.pad(beyond, pad, constant_values=True)
    fits = np.asarray(ndimage.distance_transform_edt(~np.pad(occupied, pad))) > radius
    middles = np.asarray(ndimage.binary_propagation(around & fits, mask=fits), bool)
    outside = np.asarray(ndimage.distance_transform_edt(~middles)) <= radius
    core = np.pad(floor, pad) & fits & ~outside & ~around
    inside = np.asarray(ndimage.binary_propagation(core, mask=np.pad(floor, pad) & ~outside), bool)
    return inside[pad:-pad, pad:-pad]
