"""The map of a scene in, the rooms of its drawing out: what doorways part."""

from __future__ import annotations

from typing import Any

import numpy as np
import shapely
from scipy import ndimage

from scenes_mjcf.schema import SceneMaps

DOORWAY_M = 1.3
"""Floor that is narrower parts two rooms."""
CORE_M2 = 0.1
"""What is wide enough for a room, and smaller than this, is a bay of one."""


def rooms_of(maps: SceneMaps, low: Any, high: Any, least_m2: float, slack_m: float) -> list[Any]:
    """(k) outlines of rooms, the largest first.

    Args:
        maps: of the scene.
        low: footprint of built-in furniture, which stands in rooms.
        high: footprint of walls and of doors, which do not.
        least_m2: of a room.
        slack_m: how far walls that lie across the map's axes leave free between its cells and themselves.
    """
    res, (x0, y0) = maps.resolution_m, maps.origin_w
    rows, columns = (np.arange(n) for n in maps.traversable.shape)
    x, y = np.meshgrid(x0 + (columns + 0.5) * res, y0 + (rows + 0.5) * res)
    floor = (maps.traversable | shapely.contains_xy(low, x, y)) & ~shapely.contains_xy(high, x, y)
    wide = np.asarray(ndimage.distance_transform_edt(np.pad(floor, 1)))[1:-1, 1:-1] * res > DOORWAY_M / 2
    label, count = ndimage.label(wide)  # pyright: ignore[reportGeneralTypeIssues]
    small = 1 + np.flatnonzero(np.bincount(label.ravel(), minlength=count + 1)[1:] * res**2 < CORE_M2)
    label[np.isin(label, small)] = 0
    pieces, many = ndimage.label(floor)  # pyright: ignore[reportGeneralTypeIssues]
    for k in range(1, many + 1):  # a room that is narrow everywhere
        if not label[pieces == k].any():
            label[pieces == k] = label.max() + 1
    while (grown := np.where(floor & (label == 0), ndimage.grey_dilation(label, size=3), label)).sum() > label.sum():
        label = grown
    plans = []
    for k in range(1, label.max() + 1):
        r, c = np.nonzero(label == k)
        cells: Any = shapely.box(x0 + c * res, y0 + r * res, x0 + (c + 1) * res, y0 + (r + 1) * res)
        whole = shapely.union_all(cells).buffer(slack_m, join_style="mitre").difference(high)
        parts = shapely.get_parts(whole.buffer(-slack_m / 4).buffer(slack_m / 4, join_style="mitre"))
        plans += [p for p in parts if p.area > least_m2]
    return sorted((shapely.Polygon(p.exterior).simplify(1e-3) for p in plans), key=lambda p: -p.area)
