"""Compute the light that falls on a building's surfaces: lamps, daylight through windows, dark corners and shade."""

import dataclasses
from collections.abc import Callable, Sequence

import numpy as np
from scipy import ndimage
from scipy.spatial import KDTree

from converters.records.raw import Lamp, Window
from interactive_nav_common.rotations import yaw_matrix

VOXEL_M = 0.05
AROUND_M = ((0.06, 0.2), (0.13, 0.25), (0.27, 0.25), (0.55, 0.2), (0.9, 0.1))
"""How far from a surface it is looked whether something is near, and the weight of each."""
AMBIENT, LAMP, DAY = (np.array(c) for c in ([0.65, 0.65, 0.66], [0.32, 0.30, 0.27], [0.50, 0.51, 0.53]))
"""Brightness of each channel: of all around, of a lamp and of a window at one metre."""
REACH_M = 7.0
"""How far a lamp or window shines."""
BRIGHT = 0.8
"""From here on, more light adds less and less brightness."""
SHADE_M = 0.2
"""Around a lamp, what is its own shade and hides nothing."""
LIGHT_M = 0.1
"""Between places at which light is worked out."""
GAIN = 1.4
"""Of the light in drawn homes, whose colours are darker and which have fewer lamps than generated ones."""
POWER = 0.5
"""Of a drawing's lamp that says nothing, and shines as one of a generated home does."""


@dataclasses.dataclass(frozen=True)
class Space:
    """Hold the distance to the nearest surface."""

    distance: np.ndarray
    """(nx, ny, nz) m, negative inside."""
    low: np.ndarray
    """(3,) place of [0, 0, 0]."""

    def at(self, points: np.ndarray) -> np.ndarray:
        """Interpolate the distance at points: (n, 3) -> (n,)."""
        return ndimage.map_coordinates(self.distance, ((points - self.low) / VOXEL_M).T, order=1, mode="nearest")

    def visible(self, start: np.ndarray, end: np.ndarray) -> np.ndarray:
        """Return (n,) 0..1: how much of a small lamp at `end` (n, 3) is visible; softer the nearer an obstacle is."""
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


@dataclasses.dataclass(frozen=True)
class Daylight:
    """Compute the light in a home."""

    space: Space
    lamps: np.ndarray
    """(n, 3)."""
    panes: np.ndarray
    """(m, 3) places on panes."""
    inwards: np.ndarray
    """(m, 3) unit, from each into its room."""
    colours: np.ndarray | float = 1.0
    """(n, 3) of the lamps, times their power."""
    gain: float = 1.0
    off_m: float = 0.05
    """How far before a surface its light is looked for: beyond the steps of its distances."""

    def __call__(self, points: np.ndarray, normals: np.ndarray) -> np.ndarray:
        """Return the brightness (n, 3) at places and normals (n, 3)."""
        hidden = np.zeros(len(points))
        for d, weight in AROUND_M:
            hidden += weight * np.clip(1 - self.space.at(points + d * normals) / d, 0, 1)
        light = AMBIENT * (1 - 0.5 * hidden)[:, None]
        start = points + self.off_m * normals
        shine = np.broadcast_to(LAMP * self.colours, (len(self.lamps), 3))
        sources = [(colour, lamp, None) for colour, lamp in zip(shine, self.lamps, strict=True)]
        sources += [(DAY / 2, pane, inward) for pane, inward in zip(self.panes, self.inwards, strict=True)]
        for brightness, source, inward in sources:
            away = source - start
            far = np.linalg.norm(away, axis=1)
            value = np.clip((normals * away).sum(axis=1) / far, 0, 1) / (0.55 + 0.3 * far**2)
            if inward is not None:
                value *= np.clip(-(away * inward).sum(axis=1) / far, 0, 1) * 2
            index = np.flatnonzero((value > 0.004) & (far < REACH_M))
            share = np.zeros(len(start))
            ends = np.broadcast_to(source, (len(index), 3))
            share[index] = value[index] * self.space.visible(start[index], ends)
            light += brightness * share[:, None]
        light = light * self.gain
        return np.where(light > BRIGHT, BRIGHT + 0.3 * (1 - np.exp((BRIGHT - light) / 0.3)), light)


def daylight(points: np.ndarray, lamps: Sequence[Lamp], windows: Sequence[Window]) -> Daylight:
    """Return the light among surfaces, on which points (n, 3) lie less than a voxel apart; windows are open."""
    low = points.min(axis=0) - 4 * VOXEL_M
    index = np.round((points - low) / VOXEL_M).astype(int)
    solid = np.zeros(index.max(axis=0) + 5, bool)
    solid[tuple(index.T)] = True
    index = np.argwhere(solid)
    places, open_ = low + VOXEL_M * index, np.zeros(len(index), bool)
    panes, inwards = [], []
    for window in windows:
        axes = yaw_matrix(window.yaw)
        open_ |= (np.abs((places - window.middle) @ axes) < window.half + [-0.02, 0.1, -0.02]).all(axis=1)
        for way in (1.0, -1.0):  # which side is the room's, nobody says: on the other one it shines outdoors
            panes += [window.middle + axes @ (window.half * [share, way, 0.0]) for share in (0.5, -0.5)]
            inwards += [way * axes[:, 1]] * 2
    for lamp in lamps:
        open_ |= np.linalg.norm(places - lamp.at, axis=1) < SHADE_M
    solid[tuple(index[open_].T)] = False
    distance = (np.asarray(ndimage.distance_transform_edt(~solid)) - 0.2) * VOXEL_M  # a thin wall still hides
    at, shine = (np.reshape(some, (-1, 3)) for some in ([lamp.at for lamp in lamps], [lamp.colour for lamp in lamps]))
    space, beside = Space(distance.astype(np.float32), low), (np.reshape(panes, (-1, 3)), np.reshape(inwards, (-1, 3)))
    return Daylight(space, at, *beside, shine / POWER, GAIN, 2 * VOXEL_M)


def light_on(
    points: np.ndarray, normals: np.ndarray, light: Callable[[np.ndarray, np.ndarray], np.ndarray]
) -> np.ndarray:
    """Return the brightness (n, 3) at close places (n, 3) on surfaces, interpolated between some of these."""
    places = np.hstack([points, LIGHT_M * normals])
    _, first = np.unique(np.round(places / LIGHT_M).astype(int), axis=0, return_index=True)
    bright = light(points[first], normals[first])
    distance, index = KDTree(places[first]).query(places, k=min(12, len(first)))
    distance = np.reshape(distance, (len(places), -1))
    weight = np.exp(-(distance**2 - distance[:, :1] ** 2) / LIGHT_M**2)  # smooth: others show where these places are
    share = weight / weight.sum(axis=1, keepdims=True)
    return np.einsum("nk,nkc->nc", share, bright[np.reshape(index, share.shape)])
