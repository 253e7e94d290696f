"""A plan in, the light in it out: daylight through the windows, a lamp in each room, dark corners."""

import dataclasses

import numpy as np
from scipy import ndimage

from converters.generate.design.plan import Plan
from converters.generate.surface.scan import building_solids
from converters.generate.surface.volume import fuse, solid_from_box

VOXEL_M = 0.05
AROUND_M = ((0.06, 0.2), (0.13, 0.25), (0.27, 0.25), (0.55, 0.2), (0.9, 0.1))
"""How far from a surface it is looked whether something is near, and the weight of each."""
AMBIENT, LAMP, DAY = (np.array(c) for c in ([0.65, 0.65, 0.66], [0.32, 0.30, 0.27], [0.50, 0.51, 0.53]))
"""Brightness of each channel: of all around, of a lamp and of a window at one metre."""

BRIGHT = 0.8
"""From here on more light makes things less and less brighter."""


@dataclasses.dataclass(frozen=True)
class Space:
    """Distance to the nearest surface, of the structure alone."""

    distance: np.ndarray
    """(nx, ny, nz) m, negative inside."""
    low: np.ndarray
    """(3,) place of [0, 0, 0]."""

    def at(self, points: np.ndarray) -> np.ndarray:
        """(n, 3) -> (n,) between the grid's values."""
        return ndimage.map_coordinates(self.distance, ((points - self.low) / VOXEL_M).T, order=1, mode="nearest")

    def seen(self, start: np.ndarray, end: np.ndarray) -> np.ndarray:
        """(n,) 0..1: how freely a small lamp at `end` (n, 3) is seen; softer the nearer the way passes something."""
        way = end - start
        length = np.linalg.norm(way, axis=1)
        out, index = np.ones(len(start)), np.arange(len(start))
        gone = np.full(len(start), 0.03)
        for _ in range(40):
            share = gone[index] / length[index]
            near = self.at(start[index] + way[index] * share[:, None])
            # Half shadows are widest half way: what is beside the lamp, or beside the place, hides all or nothing.
            out[index] = np.minimum(out[index], np.clip(near / (0.08 * gone[index] * (1 - share) + 0.02), 0, 1))
            gone[index] += np.maximum(near, 0.04)
            index = index[(out[index] > 0) & (gone[index] < length[index] - 0.08)]
            if not len(index):
                break
        return out


def space_of(plan: Plan) -> Space:
    """The structure's distances, windows open."""
    o, pad = plan.outer, 4 * VOXEL_M
    low = np.array([o.x0, o.y0, 0.0]) - pad
    top = plan.wall_height_m
    lid = solid_from_box((o.x0, o.y0, top), (o.x1, o.y1, top + 0.4), 0, "paint")
    near = fuse([*building_solids(plan, []), lid], low, np.array([o.x1, o.y1, top]) + pad, VOXEL_M).sdf
    for w in plan.windows:
        i0 = np.maximum(np.floor((np.array(w.low) - 0.3 - low) / VOXEL_M).astype(int), 0)
        i1 = np.ceil((np.array(w.high) + 0.3 - low) / VOXEL_M).astype(int) + 1
        part = near[tuple(slice(a, b) for a, b in zip(i0, i1, strict=True))]
        points = low + VOXEL_M * (i0 + np.indices(part.shape).reshape(3, -1).T)
        hole = solid_from_box(w.low, w.high, 0, "paint").distance(points)
        np.maximum(part, -hole.reshape(part.shape), out=part)
    # Farther away: how far the nearest place beside a surface is, and what is left from there.
    steps, nearest = ndimage.distance_transform_edt(near > 1.4 * VOXEL_M, return_indices=True)  # pyright: ignore
    far = np.asarray(steps) * VOXEL_M + near[tuple(nearest)]
    return Space(np.where(near < 2.8 * VOXEL_M, near, np.maximum(far, 2.8 * VOXEL_M)).astype(np.float32), low)


@dataclasses.dataclass(frozen=True)
class Daylight:
    """Light in a home."""

    space: Space
    lamps: np.ndarray
    """(n, 3)."""
    panes: np.ndarray
    """(m, 3) places on panes."""
    inwards: np.ndarray
    """(m, 3) unit, from each into its room."""

    def __call__(self, points: np.ndarray, normals: np.ndarray) -> np.ndarray:
        """(n, 3) places and normals -> (n, 3) brightness."""
        hidden = np.zeros(len(points))
        for d, weight in AROUND_M:
            hidden += weight * np.clip(1 - self.space.at(points + d * normals) / d, 0, 1)
        light = AMBIENT * (1 - 0.5 * hidden)[:, None]
        start = points + 0.05 * normals
        for source in self.lamps:
            light += LAMP * self._from(source, None, start, normals, 7.0)[:, None]
        for source, inward in zip(self.panes, self.inwards, strict=True):
            light += DAY / 2 * self._from(source, inward, start, normals, 7.0)[:, None]
        return np.where(light > BRIGHT, BRIGHT + 0.3 * (1 - np.exp((BRIGHT - light) / 0.3)), light)

    def _from(self, source: np.ndarray, inward: np.ndarray | None, start: np.ndarray, normals: np.ndarray,
              reach_m: float) -> np.ndarray:  # fmt: skip
        """(n,) of one source: a lamp where it has no direction, else a part of a window."""
        away = source - start
        far = np.linalg.norm(away, axis=1)
        value = np.clip((normals * away).sum(axis=1) / far, 0, 1) / (0.55 + 0.3 * far**2)
        if inward is not None:
            value *= np.clip(-(away * inward).sum(axis=1) / far, 0, 1) * 2
        index = np.flatnonzero((value > 0.004) & (far < reach_m))
        out = np.zeros(len(start))
        out[index] = value[index] * self.space.seen(start[index], np.broadcast_to(source, (len(index), 3)))
        return out
