"""A CAD model, a scale and a pose in, a piece of furniture out: where each of its points lies.

Frame: scan x, y; heights above the floor; metres.
"""

import dataclasses
import math

import numpy as np
import shapely

from converters.generate.models.cad import CadModel
from interactive_nav_common.rotations import Y_UP_TO_Z_UP, transform, transformed, yaw_matrix


@dataclasses.dataclass(frozen=True)
class LeafHinge:
    """How a door leaf turns; CAD frame, angle 0 is the pose as placed."""

    axis: tuple[float, float, float]
    origin: tuple[float, float, float]
    range_rad: tuple[float, float]


@dataclasses.dataclass(frozen=True)
class Instance:
    """One piece of furniture."""

    model: CadModel
    scale: np.ndarray
    """(3,) CAD units -> metres along the CAD's x, y, z."""
    yaw_rad: float
    """About the vertical; at 0 the CAD's +z shows along -y of the scan frame."""
    position: np.ndarray
    """(3,) of the CAD origin; z above the floor."""
    hinge: LeafHinge | None = None

    @property
    def matrix(self) -> np.ndarray:
        """(4, 4) CAD frame (y up) -> scan x, y and height above the floor (z up)."""
        return transform(yaw_matrix(self.yaw_rad) @ Y_UP_TO_Z_UP @ np.diag(self.scale), self.position)

    def to_floor(self, points_cad: np.ndarray) -> np.ndarray:
        """Moves (n, 3) points of the CAD frame into scan x, y and height above the floor."""
        return transformed(points_cad, self.matrix)

    @property
    def footprint(self) -> shapely.Polygon:
        """The rectangle it stands on."""
        (x0, _, z0), (x1, _, z1) = self.model.bounds
        return shapely.Polygon(self.to_floor(np.array([[x0, 0, z0], [x1, 0, z0], [x1, 0, z1], [x0, 0, z1]]))[:, :2])

    def outlines(self, band_m: tuple[float, float] = (-math.inf, math.inf)) -> list[shapely.Geometry]:
        """What is seen of each of its convex parts from above, of those that reach into a band of heights."""
        placed = [self.to_floor(part.vertices) for part in self.model.parts]
        inside = [p for p in placed if p[:, 2].min() < band_m[1] and p[:, 2].max() > band_m[0]]
        return [shapely.MultiPoint(p[:, :2]).convex_hull for p in inside]


def place(model: CadModel, scale: np.ndarray, xy: np.ndarray, facing_rad: float, lift_m: float = 0.0) -> Instance:
    """Stands a model on the floor: centre of the footprint at `xy`, front towards `facing_rad` (from +x)."""
    yaw = facing_rad + math.pi / 2 + (math.pi if model.front < 0 else 0.0)
    yaw = math.atan2(math.sin(yaw), math.cos(yaw))
    at_origin = Instance(model, scale, yaw, np.zeros(3))
    centre = at_origin.to_floor(model.center[None])[0]
    lift = lift_m - scale[1] * model.bounds[0, 1]
    return Instance(model, scale, yaw, np.array([xy[0] - centre[0], xy[1] - centre[1], lift]))
