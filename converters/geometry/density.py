"""Rasters of floor in, numbers of how full a home is and how much of it is behind furniture out.

Rasters are (rows, columns) bool, True where free, of square cells.
"""

from __future__ import annotations

import dataclasses

import numpy as np
from scipy import ndimage

ROBOT_RADIUS_M = {"turtlebot": 0.18, "fetch": 0.31}
"""Robot -> radius of the disc that it needs, as its specification has it; shares that must be pushed are theirs."""


def clearance_m(free: np.ndarray, cell_m: float) -> np.ndarray:
    """Distance in metres from each free cell's middle to the nearest cell that is not free; 0 where it is not.

    What lies beyond the raster is not free.
    """
    padded = np.pad(free, 1)
    distance = np.asarray(ndimage.distance_transform_edt(padded))[1:-1, 1:-1]
    return distance * cell_m - cell_m / 2 * free


def regions(mask: np.ndarray) -> np.ndarray:
    """Connected regions, numbered from 1; 0 where the mask is False."""
    out = np.zeros(mask.shape, np.int32)
    ndimage.label(mask, output=out)
    return out


@dataclasses.dataclass(frozen=True)
class Ways:
    """Where a disc gets on a floor without movables."""

    cell_m: float
    radius_m: float
    region: np.ndarray
    """(rows, columns) int: region that the disc's middle may be in, from 1; 0 where it does not fit."""

    @classmethod
    def of(cls, static_free: np.ndarray, cell_m: float, radius_m: float) -> Ways:
        """Of a floor with nothing on it but what is fixed."""
        return cls(cell_m, radius_m, regions(clearance_m(static_free, cell_m) >= radius_m))

    def must_push_share(self, room_m: np.ndarray) -> float:
        """Share of the pairs of places between which the disc finds no way that avoids everything.

        Counted are all pairs of places where the disc touches nothing and that it gets between with the movables away.

        Args:
            room_m: clearance with the movables as they stand.

        Returns:
            0 where nothing is in the way; 0 too where the disc fits nowhere.
        """
        now = regions((room_m >= self.radius_m) & (self.region > 0))
        here = now > 0
        with_movables = np.bincount(now[here]).astype(float)
        without = np.bincount(self.region[here]).astype(float)
        pairs = float((without**2).sum())
        return 1.0 - float((with_movables**2).sum()) / pairs if pairs else 0.0


def must_push_shares(static_free: np.ndarray, free: np.ndarray, cell_m: float) -> dict[str, float]:
    """Robot -> `Ways.must_push_share`, of a floor with and without its movables."""
    room_m = clearance_m(free & static_free, cell_m)
    return {
        robot: Ways.of(static_free, cell_m, radius_m).must_push_share(room_m)
        for robot, radius_m in ROBOT_RADIUS_M.items()
    }
