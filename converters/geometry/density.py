"""Measure how much of a home is behind furniture, on rasters of square cells: (rows, columns) bool, True if free."""

from collections.abc import Mapping
from typing import NamedTuple

import numpy as np

from interactive_nav_common.grids import clearance, label
from scenes_mjcf import robot_facts

ROBOTS = {name: robot_facts.ROBOTS[name] for name in ("turtlebot", "fetch")}
"""Robots whose shares that must be pushed are measured."""


class Ways(NamedTuple):
    """Where a disc gets on a floor without movables."""

    radius_m: float
    region: np.ndarray
    """(rows, columns) int: region that the disc's middle may be in, from 1; 0 where it does not fit."""

    @classmethod
    def of(cls, static_free: np.ndarray, cell_m: float, radius_m: float) -> "Ways":
        """Return those of a floor with nothing on it but what is fixed."""
        return cls(radius_m, label(clearance(static_free, cell_m) >= radius_m)[0])

    def must_push_share(self, room_m: np.ndarray) -> float:
        """Return the share of connected pairs of places between which every path of the disc hits a movable.

        A pair counts if the disc gets between the two without movables; the result is 0 if the disc fits nowhere.
        """
        here = (room_m >= self.radius_m) & (self.region > 0)
        now, cells = label(here)[0], np.flatnonzero(here)
        with_movables = np.bincount(now.ravel()[cells]).astype(float)
        without = np.bincount(self.region.ravel()[cells]).astype(float)
        pairs = float((without**2).sum())
        return 1.0 - float((with_movables**2).sum()) / pairs if pairs else 0.0


def must_push_shares(static_free: np.ndarray, free: Mapping[str, np.ndarray], cell_m: float) -> dict[str, float]:
    """Return `Ways.must_push_share` by robot; `static_free` (rows, columns) bool is the floor without movables."""
    return {
        robot: Ways.of(static_free, cell_m, disc.radius_m).must_push_share(clearance(free[robot] & static_free, cell_m))
        for robot, disc in ROBOTS.items()
    }
