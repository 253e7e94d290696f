"""Rasters of floor in, numbers of how full a home is and how much of it is behind furniture out.

Rasters are (rows, columns) bool, True where free, of square cells.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Mapping

import numpy as np

from interactive_nav_common.grids import clearance, label


@dataclasses.dataclass(frozen=True)
class Disc:
    """What a robot needs of the floor."""

    radius_m: float
    height_m: float
    """What is above is not in its way."""


ROBOTS = {"turtlebot": Disc(0.18, 0.41), "fetch": Disc(0.31, 1.12)}
"""Robots whose shares that must be pushed are told, as their specifications have them."""


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
        return cls(cell_m, radius_m, label(clearance(static_free, cell_m) >= radius_m)[0])

    def must_push_share(self, room_m: np.ndarray) -> float:
        """Share of the pairs of places between which the disc finds no way that avoids everything.

        Counted are all pairs of places where the disc touches nothing and that it gets between with the movables away.

        Returns:
            0 where nothing is in the way; 0 too where the disc fits nowhere.
        """
        now = label((room_m >= self.radius_m) & (self.region > 0))[0]
        here = now > 0
        with_movables = np.bincount(now[here]).astype(float)
        without = np.bincount(self.region[here]).astype(float)
        pairs = float((without**2).sum())
        return 1.0 - float((with_movables**2).sum()) / pairs if pairs else 0.0


def must_push_shares(static_free: np.ndarray, free: Mapping[str, np.ndarray], cell_m: float) -> dict[str, float]:
    """Robot -> `Ways.must_push_share`, of a floor with and without its movables.

    Args:
        static_free: (rows, columns) bool, without movables.
    """
    return {
        robot: Ways.of(static_free, cell_m, disc.radius_m).must_push_share(clearance(free[robot] & static_free, cell_m))
        for robot, disc in ROBOTS.items()
    }
