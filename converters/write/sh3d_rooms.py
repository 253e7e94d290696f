"""Find the walls of a scene's drawing from its wall boxes, their gaps, and from its map the rooms."""

import math
from typing import Any, NamedTuple

import numpy as np
import shapely
from scipy import ndimage

from converters.structure.walls import cover_rectangles
from interactive_nav_common.grids import clearance, label
from interactive_nav_common.rotations import yaw_matrix
from scenes_mjcf.schema import SceneMaps

DOORWAY_M = 1.3
"""Floor that is narrower parts two rooms."""
CORE_M2 = 0.1
"""What is wide enough for a room, and smaller than this, is a bay of one."""
GAP_M = 0.6
"""A doorway may be so much wider than its leaf."""
BESIDE_M = 0.08
"""A leaf may hang so far beside the middle of its wall."""
BEYOND_M, THICK_M = (0.01, 0.06, 0.11), (0.04, 0.4)
"""So far beyond a gap's ends it is measured how thick the wall is, within these bounds; else it is `INNER_M`."""
INNER_M = 0.1
SIDE_M = 0.08
"""What shows a wall's face or a floor lies so near to it."""


class Wall(NamedTuple):
    """A straight wall, m."""

    ends: np.ndarray  # (2, 2) of its middle line
    thickness: float
    height: float

    def polygon(self) -> Any:
        """Return its footprint."""
        return shapely.LineString(self.ends).buffer(self.thickness / 2, cap_style="flat")

    def side(self, out: np.ndarray) -> Any:
        """Return in plan what is nearest to the face that looks along (2,) unit `out`."""
        return shapely.LineString(self.ends + self.thickness / 2 * out).buffer(SIDE_M, cap_style="flat")


def merged_walls(boxes: list[tuple[np.ndarray, np.ndarray, float]]) -> list[Wall]:
    """Merge boxes into walls side by side: (3,) centres, (3,) half sizes, m, and yaws, rad; high ones first."""
    walls, groups = [], {}
    for centre, half, yaw in boxes:
        turn = round(yaw, 3)
        at, flat = centre[:2] @ yaw_matrix(turn)[:2, :2], half[:2]
        groups.setdefault(turn, []).append(np.round([*(at - flat), *(at + flat), centre[2] + half[2]], 4))
    for turn, edges in groups.items():
        x0, y0, x1, y1, top = np.array(edges).T
        xs, ys = np.unique([x0, x1]), np.unique([y0, y1])
        taken = np.zeros((len(ys) - 1, len(xs) - 1), bool)
        for height in np.unique(top)[::-1]:
            level = np.zeros_like(taken)
            for k in np.flatnonzero(top == height):
                rows, columns = ys.searchsorted([y0[k], y1[k]]), xs.searchsorted([x0[k], x1[k]])
                level[slice(*rows), slice(*columns)] = True
            level &= ~taken
            taken |= level
            while level.any():
                r0, r1, c0, c1 = next(cover_rectangles(level, level))
                level[r0:r1, c0:c1] = False
                low, high = np.array([xs[c0], ys[r0]]), np.array([xs[c1], ys[r1]])
                along = int(np.argmax(high - low))
                ends = np.tile((low + high) / 2, (2, 1))
                ends[:, along] = low[along], high[along]
                ends = ends @ yaw_matrix(turn)[:2, :2].T
                walls.append(Wall(ends, float((high - low)[1 - along]), float(height)))
    return walls


def gap_around(stands: Any, middle: np.ndarray, along: np.ndarray, length: float) -> np.ndarray | None:
    """Return (2, 2) ends, in its direction, of the gap between walls around a shut leaf; None where there is none."""
    reach = along * (length + GAP_M)
    band = shapely.LineString([middle - reach, middle + reach]).buffer(BESIDE_M, cap_style="flat")
    parts = shapely.get_parts(shapely.intersection(band, stands))
    runs = [(shapely.get_coordinates(part) - middle) @ along for part in parts]
    start = max((r.max() for r in runs if r.mean() < 0), default=-math.inf)
    end = min((r.min() for r in runs if r.mean() > 0), default=math.inf)
    if not 0.8 * length < end - start < length + GAP_M:
        return None
    return middle + np.outer([start, end], along)


def _crossed(stands: Any, at: np.ndarray, across: np.ndarray, near_m: float = BESIDE_M) -> list[np.ndarray]:
    """Return (2,) m along (2,) unit `across` from (2,) `at`: where each wall that the line meets begins and ends."""
    parts = shapely.get_parts(shapely.intersection(shapely.LineString([at - across, at + across]), stands))
    ends = [np.sort((shapely.get_coordinates(p)[[0, -1]] - at) @ across) for p in parts if not p.is_empty]
    return [end for end in ends if end[0] < near_m and end[1] > -near_m]


def half_wall(stands: Any, at: np.ndarray, across: np.ndarray, deep_m: float) -> float | None:
    """Return how far the wall about a window, so deep to either side of (2,) `at`, reaches; None without one."""
    ends = _crossed(stands, at, across, deep_m + BESIDE_M)
    return min(float(np.abs(ends).max()), THICK_M[1]) if ends else None


def wall_between(stands: Any, ends: np.ndarray, height: float) -> Wall:
    """Build the wall from (2,) end to (2,) end of a gap, as thick as the thicker one beside it."""
    along = (ends[1] - ends[0]) / np.linalg.norm(ends[1] - ends[0])
    across, crossed = along[::-1] * [-1.0, 1.0], []
    for end, out in ((ends[0], -along), (ends[1], along)):
        for at in end + np.outer(BEYOND_M, out):
            for low, high in _crossed(stands, at, across):
                if THICK_M[0] <= high - low <= THICK_M[1]:
                    crossed.append((high - low, float((low + high) / 2 + (at - end) @ across)))
    thick, off = max(crossed, default=(INNER_M, 0.0))
    return Wall(ends + off * across, thick, height)


def rooms_of(maps: SceneMaps, low: Any, high: Any, least_m2: float, slack_m: float) -> list[Any]:
    """Return (k) room outlines, the largest first; `slack_m` is the gap between diagonal walls and the map's cells."""
    res, (x0, y0) = maps.resolution_m, maps.origin_w
    rows, columns = (np.arange(n) for n in maps.traversable.shape)
    x, y = np.meshgrid(x0 + (columns + 0.5) * res, y0 + (rows + 0.5) * res)
    floor = (maps.traversable | shapely.contains_xy(low, x, y)) & ~shapely.contains_xy(high, x, y)
    wide = clearance(floor, res) > (DOORWAY_M - res) / 2
    room, count = label(wide)
    small = 1 + np.flatnonzero(np.bincount(room.ravel(), minlength=count + 1)[1:] * res**2 < CORE_M2)
    room[np.isin(room, small)] = 0
    pieces, many = label(floor)
    for k in range(1, many + 1):  # a room that is narrow everywhere
        if not room[pieces == k].any():
            room[pieces == k] = room.max() + 1
    while (grown := np.where(floor & (room == 0), ndimage.grey_dilation(room, size=3), room)).sum() > room.sum():
        room = grown
    plans = []
    for k in range(1, room.max() + 1):
        r, c = np.nonzero(room == k)
        cells: Any = shapely.box(x0 + c * res, y0 + r * res, x0 + (c + 1) * res, y0 + (r + 1) * res)
        whole = shapely.union_all(cells).buffer(slack_m, join_style="mitre").difference(high)
        parts = shapely.get_parts(whole.buffer(-slack_m / 4).buffer(slack_m / 4, join_style="mitre"))
        plans += [p for p in parts if p.area > least_m2]
    return sorted((shapely.Polygon(p.exterior).simplify(1e-3) for p in plans), key=lambda p: -p.area)
