"""A scene in, its free space out: where a robot may stand, and whether a straight way is free.

Obstacles are the walls and everything movable where it stands at rest, up to the robot's height, doors included.
"""

import dataclasses

import numpy as np
import shapely

from interactive_nav.scenes.scene import Scene
from interactive_nav.topdown import shadow
from interactive_nav_common.grids import cell_centres, clearance
from topological_nav.errors import SpaceError

_FREE_M = 1e-6
"""Clearance of a cell that is free at all."""


@dataclasses.dataclass(frozen=True)
class FreeSpace:
    """A grid of distances to the nearest obstacle."""

    clearance_m: np.ndarray
    """[rows along y, columns along x] from a cell's centre; 0 where blocked."""
    resolution_m: float
    origin_w: tuple[float, float]
    """World x, y of the outer corner of cell [0, 0]."""

    def free(self, least_m: float) -> np.ndarray:
        """Return which cells have at least this clearance, [rows, columns] bool."""
        return self.clearance_m >= max(least_m, _FREE_M)

    def centres(self, least_m: float) -> np.ndarray:
        """Return the centres of the cells with at least this clearance, row by row: [n, 2] m, world."""
        return cell_centres(self.free(least_m), self.resolution_m, self.origin_w)

    def cells(self, xy_w: np.ndarray) -> np.ndarray:
        """[..., 2] int, column and row of the cells that hold points [..., 2], inside the map or not."""
        return np.floor((np.asarray(xy_w, float) - self.origin_w) / self.resolution_m).astype(int)

    def inner_cells(self, xy_w: np.ndarray) -> np.ndarray:
        """The same, of the map's cells nearest to them."""
        rows, columns = self.clearance_m.shape
        return np.clip(self.cells(xy_w), 0, (columns - 1, rows - 1))

    def at(self, xy_w: np.ndarray) -> np.ndarray:
        """[...] m: clearance of the cells that hold points [..., 2]; 0 outside the map."""
        cell = self.inner_cells(xy_w)
        inside = (cell == self.cells(xy_w)).all(-1)
        return np.where(inside, self.clearance_m[cell[..., 1], cell[..., 0]], 0.0)

    def segment_free(self, start_w: np.ndarray, end_w: np.ndarray, points: int, margin_m: float) -> np.ndarray:
        """Return whether straight ways between points [..., 2] (m) are free, [...] bool.

        Every looked-up point has the margin as its clearance; 0: its cell is free.
        """
        share = np.linspace(0.0, 1.0, points)[:, None]
        start_w, end_w = np.asarray(start_w, float), np.asarray(end_w, float)
        along = start_w[..., None, :] + share * (end_w - start_w)[..., None, :]
        # A point on the border of two cells belongs to either: a hair of slack keeps the answer the same both ways.
        return np.asarray((self.at(along) >= max(margin_m, _FREE_M) - 1e-9).all(-1))

    def sample(self, rng: np.random.Generator, count: int, least_m: float) -> np.ndarray:
        """[count, 2] m: different cell centres with at least this clearance, uniform over them."""
        centres = self.centres(least_m)
        if len(centres) < count:
            raise SpaceError(
                f"{len(centres)} cells are at least {least_m} m from obstacles, expected {count}; "
                "ask for fewer positions or less clearance"
            )
        return centres[np.sort(rng.choice(len(centres), count, replace=False))]


def free_space(scene: Scene, height_m: float) -> FreeSpace:
    """Return the free space of a scene."""
    maps = scene.maps
    free = maps.traversable.copy()
    x, y = cell_centres(np.ones_like(free), maps.resolution_m, maps.origin_w).T
    for body in scene.movables:
        # A box's lowest point is at least its centre less its half diagonal.
        low = body.pos_w[2] + body.boxes[:, 2] - np.linalg.norm(body.boxes[:, 7:10], axis=1)
        boxes = body.boxes[low < height_m]
        if len(boxes):
            free &= ~shapely.contains_xy(shadow(boxes, body.pos_w, body.quat_w), x, y).reshape(free.shape)
    return FreeSpace(clearance(free, maps.resolution_m), maps.resolution_m, maps.origin_w)


def spread(points: np.ndarray, count: int, rng: np.random.Generator) -> np.ndarray:
    """Return the indices of `count` points of [n, 2] (all, where there are fewer): each next one is the farthest."""
    if count <= 0 or not len(points):
        return np.zeros(0, int)
    picked = [int(rng.integers(len(points)))]
    away = np.linalg.norm(points - points[picked[0]], axis=1)
    while len(picked) < min(count, len(points)):
        nearest = int(np.argmax(away))
        picked.append(nearest)
        away = np.minimum(away, np.linalg.norm(points - points[nearest], axis=1))
    return np.asarray(picked)
