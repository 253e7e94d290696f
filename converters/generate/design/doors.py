"""A doorway and a door model in, an open leaf on its hinge out, with the floor that it sweeps."""

import math

import numpy as np
import shapely

from converters.generate.design.instance import Instance, LeafHinge
from converters.generate.design.plan import Doorway, Plan
from converters.generate.models.cad import CadModel

DOOR_GAP_M = 0.02
"""Between leaf and jamb, each side."""
DOOR_BOTTOM_M = (0.006, 0.010)
"""Between leaf and floor."""
AJAR_RAD = math.radians(3.0)
"""A leaf stands at least this far from the end of its swing."""


def door_leaf(
    doorway: Doorway,
    model: CadModel,
    high_side: bool,
    high_jamb: bool,
    open_rad: float,
    plan: Plan,
    lift_m: float,
    wall_gap_m: float = 0.08,
    proud_m: float = 0.0,
) -> tuple[Instance, shapely.Polygon]:
    """Hangs an open leaf into a doorway.

    The hinge line is the leaf's edge at the jamb, flush with the wall's face on the side it opens to. Closed,
    the leaf lies inside the opening.

    Args:
        high_side: it opens into the room on the high side of the doorway's axis.
        proud_m: how far before the wall's face the hinge line stands.

    Returns:
        The leaf as it stands, and the floor area that it sweeps from closed to fully open.
    """
    axis, along = doorway.axis, 1 - doorway.axis
    r = doorway.rect
    low, high = np.array([r.x0, r.y0]), np.array([r.x1, r.y1])
    hinge = np.empty(2)
    hinge[axis] = (high if high_side else low)[axis]
    hinge[along] = high[along] - DOOR_GAP_M if high_jamb else low[along] + DOOR_GAP_M
    closed = np.zeros(2)
    closed[along] = -1.0 if high_jamb else 1.0
    into = np.zeros(2)
    into[axis] = 1.0 if high_side else -1.0
    hinge += proud_m * into
    # Opening turns `closed` towards `into`; the sign says which way round that is, seen from above.
    sign = float(np.sign(closed[0] * into[1] - closed[1] * into[0]))
    width, height = doorway.width_m - 2 * DOOR_GAP_M, doorway.height_m - 0.02 - lift_m
    extents = 2 * model.half_extents
    scale = np.array([width / extents[0], height / extents[1], model.unit_m])
    room = plan.rooms[doorway.rooms[int(high_side)]]
    corner = (room.x1, room.y1)[along] if high_jamb else (room.x0, room.y0)[along]
    most = _widest_rad(abs(corner - hinge[along]) - wall_gap_m, width)
    open_rad = min(open_rad, most - AJAR_RAD)
    face_z = float(_leaf_centre_z(model) - sign * _leaf_half_thickness(model))
    origin = (float(model.bounds[0, 0]), float(model.bounds[0, 1]), face_z)
    yaw = math.atan2(closed[1], closed[0]) + sign * open_rad
    yaw = math.atan2(math.sin(yaw), math.cos(yaw))
    swing = (-open_rad, most - open_rad) if sign > 0 else (-(most - open_rad), open_rad)
    at_origin = Instance(model, scale, yaw, np.zeros(3))
    offset = at_origin.to_floor(np.array([origin]))[0]
    position = np.array([hinge[0] - offset[0], hinge[1] - offset[1], lift_m - scale[1] * model.bounds[0, 1]])
    leaf = Instance(model, scale, yaw, position, LeafHinge((0.0, 1.0, 0.0), origin, swing))
    return leaf, _swept_floor(hinge, math.atan2(closed[1], closed[0]) + sign * np.linspace(0.0, most, 24), width)


def _widest_rad(behind_m: float, width_m: float) -> float:
    """How far a leaf opens: the wall beside the hinge stops it, behind which only the margin to the corner is left."""
    return math.pi / 2 + math.asin(min(max(behind_m, 0.0) / width_m, 0.5))


def _swept_floor(hinge: np.ndarray, angles: np.ndarray, width_m: float) -> shapely.Polygon:
    """The fan of a leaf that turns through the angles, with a margin."""
    fan = hinge + (width_m + 0.04) * np.stack([np.cos(angles), np.sin(angles)], axis=1)
    return shapely.Polygon([hinge, *fan]).buffer(0.03)


def wall_behind_m(doorway: Doorway, high_side: bool, high_jamb: bool, plan: Plan) -> float:
    """Distance from the jamb to the room's side wall behind the hinge."""
    along = 1 - doorway.axis
    room, r = plan.rooms[doorway.rooms[int(high_side)]], doorway.rect
    return (room.x1 - r.x1, room.y1 - r.y1)[along] if high_jamb else (r.x0 - room.x0, r.y0 - room.y0)[along]


def _leaf_slab(model: CadModel) -> np.ndarray:
    return model.parts[0].vertices[:, 2]


def _leaf_half_thickness(model: CadModel) -> float:
    """Half thickness of the leaf itself, CAD units: the bounding box has the handles in it."""
    return float(np.ptp(_leaf_slab(model)) / 2)


def _leaf_centre_z(model: CadModel) -> float:
    return float(_leaf_slab(model).mean())
