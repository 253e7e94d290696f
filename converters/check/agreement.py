"""Check that a scene's files agree: map with walls, `scene.json` with `scene.xml`, masses with what is usual."""

import math
from collections.abc import Sequence

import mujoco
import numpy as np

from converters.structure.walls import border_cells
from scenes_mjcf.agreement import differences, sliding_friction
from scenes_mjcf.categories import ANY_MASS_KG, TABLE
from scenes_mjcf.schema import SceneMaps, SceneObject

USUAL = {category.name: category.material.mass_range_kg for category in TABLE if category.material is not None}
GRAVITY = (0.0, 0.0, -9.81)


def wall_values(model: mujoco.MjModel, maps: SceneMaps) -> dict[str, float]:
    """Return the shares of the free floor's rim that no wall box bounds, and of the free floor within one.

    A cell is bounded where a box comes within a cell's diagonal of its middle; it lies within a box one cell deep,
    for the map's cells are turned against the boxes'. The rim within reach of a hinge is not required: where a door's
    leaf turns no wall stands.
    """
    side, pad = maps.resolution_m, 2
    free = np.pad(maps.traversable, pad)
    rows, columns = np.indices(free.shape)
    points = np.stack([columns, rows], axis=-1) + 0.5 - pad
    points = points * side + np.asarray(maps.origin_w)
    outside = np.full(free.shape, np.inf)
    structure = mujoco.mj_name2id(model, mujoco.mjtObj.mjOBJ_BODY, "structure")
    for geom in np.flatnonzero(model.geom_bodyid == structure):
        if model.geom_type[geom] == mujoco.mjtGeom.mjGEOM_BOX and model.geom_contype[geom]:
            turn = np.zeros(9)
            mujoco.mju_quat2Mat(turn, model.geom_quat[geom])
            level, middle, size = turn.reshape(3, 3)[:2, :2], model.geom_pos[geom, :2], model.geom_size[geom, :2]
            # Only cells about the box; about a tilted one, all.
            reach = np.abs(level) @ (size + 2 * side) if turn[8] > 1 - 1e-9 else np.inf
            ends = (np.stack([middle - reach, middle + reach]) - maps.origin_w) / side + pad
            (c0, r0), (c1, r1) = np.clip(ends + [[0], [1]], 0, free.shape[::-1]).astype(int)
            beyond = np.abs((points[r0:r1, c0:c1] - middle) @ level) - size
            outside[r0:r1, c0:c1] = np.minimum(outside[r0:r1, c0:c1], beyond.max(axis=-1))
    rim = border_cells(free)
    for joint in np.flatnonzero(model.jnt_type == mujoco.mjtJoint.mjJNT_HINGE):
        body = model.jnt_bodyid[joint]
        far = np.linalg.norm(points - model.body_pos[body, :2], axis=-1)
        leaf = max((float(np.linalg.norm(model.geom_pos[g]) + model.geom_rbound[g])
                    for g in np.flatnonzero(model.geom_bodyid == body)), default=0.0)  # fmt: skip
        rim &= far > leaf + side
    return {
        "rim_without_wall": float((rim & (outside > math.sqrt(2) * side)).sum() / max(rim.sum(), 1)),
        "walls_in_floor": float((free & (outside < -side)).sum() / max(free.sum(), 1)),
    }


def manifest_values(
    model: mujoco.MjModel, objects: Sequence[SceneObject]
) -> tuple[dict[str, float], dict[str, tuple[str, ...]]]:
    """Return values of the gates on masses, friction and physics, and by gate the lines that name what is off.

    `objects`: as `scene.json` lists them; one that the model lacks is another gate's matter.
    """
    ratios, friction, differs = [1.0], [1.0], differences(model, objects)
    for item in objects:
        body = mujoco.mj_name2id(model, mujoco.mjtObj.mjOBJ_BODY, item.name)
        if body < 0:
            continue
        mass_kg = float(model.body_mass[body])
        low, high = USUAL.get(item.category, ANY_MASS_KG)
        ratios.append(max(mass_kg / high, low / max(mass_kg, 1e-9)))
        friction += sliding_friction(model, body) or [item.friction]
    changed = [f"{name} is {got}, expected {expected}" for name, got, expected in _physics(model) if got != expected]
    values = {
        "manifest_differs": float(len(differs)),
        "mass_ratio": max(ratios),
        "least_friction": min(friction),
        "physics_changed": float(len(changed)),
    }
    return values, {"manifest_differs": differs, "physics_changed": tuple(changed)}


def _physics(model: mujoco.MjModel) -> list[tuple[str, object, object]]:
    """Return name, value and expected value of what every scene has alike."""
    floor = mujoco.mj_name2id(model, mujoco.mjtObj.mjOBJ_GEOM, "floor")
    solid = floor >= 0 and bool(model.geom_contype[floor]) and model.geom_pos[floor, 2] == 0
    return [
        ("gravity", tuple(np.round(model.opt.gravity, 6).tolist()), GRAVITY),
        ("wind", tuple(model.opt.wind.tolist()), (0.0, 0.0, 0.0)),
        *((name, float(getattr(model.opt, name)), 0.0) for name in ("density", "viscosity")),
        ("disableflags", int(model.opt.disableflags), 0),
        ("floor at z = 0", solid, True),
    ]
