"""Check a loaded scene for what no converter writes and no environment can use."""

import warnings
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import mujoco
import numpy as np
from scipy import ndimage

from interactive_nav_common.grids import clearance, largest_component, value_near
from scenes_mjcf.agreement import differences
from scenes_mjcf.robot_facts import SMALLEST
from scenes_mjcf.schema import SceneError, SceneManifest, SceneMaps

MASS_KG = (1e-3, 1e4)
FRICTION = (1e-3, 10.0)
"""Least and greatest sliding coefficient."""
BASE_M = (-0.5, 3.0)
"""Least and greatest height of an object's lowest point above the floor."""
BESIDE_M = 1.0
"""Objects may stand, and free floor may reach, so far beyond the map and the walls."""


def check_scene(
    path: Path,
    manifest: SceneManifest,
    maps: SceneMaps,
    walls: np.ndarray,
    movables: Sequence[Any],
    model: mujoco.MjModel,
) -> None:
    """Raise for a scene with absurd poses, masses, walls or maps; warn where most furniture is out of reach.

    Args:
        walls: [n, 10] world centre, quaternion, half sizes, m.

    Raises:
        SceneError: the first fault, with its remedy.
    """
    faults = [*_wall_faults(maps, walls), *_object_faults(maps, movables, model), *differences(model, manifest.objects)]
    if faults:
        more = f" (and {len(faults) - 1} more faults)" if len(faults) > 1 else ""
        raise SceneError(f"{path}: {faults[0]}{more}; convert the scene again")
    apart = objects_apart(maps, movables)
    if 2 * len(apart) > len(movables):
        warnings.warn(
            f"{path}: {len(apart)} of {len(movables)} movable objects stand on floor that no robot can reach from the "
            f"largest piece, such as {apart[0]}; look at the map with 'python -m converters preview'",
            stacklevel=3,
        )


def objects_apart(maps: SceneMaps, movables: Sequence[Any]) -> list[str]:
    """Return the objects more than `BESIDE_M` away from the largest piece of floor that a small robot fits on."""
    piece = largest_component(clearance(maps.traversable, maps.resolution_m) >= SMALLEST.radius_m)
    away_m = np.asarray(ndimage.distance_transform_edt(~piece, sampling=maps.resolution_m))
    xy_w = np.array([movable.pos_w[:2] for movable in movables]).reshape(-1, 2)
    apart = value_near(away_m, maps.resolution_m, maps.origin_w, xy_w) > BESIDE_M
    return [movable.name for movable, is_apart in zip(movables, apart, strict=True) if is_apart]


def _wall_faults(maps: SceneMaps, walls: np.ndarray) -> list[str]:
    if not len(walls):
        return ["scene.xml has no wall: 'structure' has no geom that collides"]
    if not np.isfinite(walls).all():
        return ["a wall of scene.xml has a position or size that is not finite"]
    reach = np.linalg.norm(walls[:, 7:], axis=1, keepdims=True)
    low, high = (walls[:, :3] - reach).min(axis=0), (walls[:, :3] + reach).max(axis=0)
    x0, x1, y0, y1 = _free_extent(maps)
    if min(x0 - low[0], y0 - low[1], high[0] - x1, high[1] - y1) > -BESIDE_M:
        return []
    return [
        f"the free floor of maps.npz reaches from ({x0:.4g}, {y0:.4g}) to ({x1:.4g}, {y1:.4g}) m, expected it within "
        f"the walls of scene.xml, ({low[0]:.4g}, {low[1]:.4g}) to ({high[0]:.4g}, {high[1]:.4g}) m"
    ]


def _object_faults(maps: SceneMaps, movables: Sequence[Any], model: mujoco.MjModel) -> list[str]:
    data, faults, (x0, x1, y0, y1) = mujoco.MjData(model), [], _free_extent(maps)
    mujoco.mj_kinematics(model, data)
    for movable in movables:
        name = f"object {movable.name}"
        body = model.body(movable.name).id
        if not all(np.isfinite(n).all() for n in (data.xpos[body], data.xquat[body], movable.inertia, movable.boxes)):
            faults.append(f"{name} of scene.xml has numbers that are not finite")
            continue
        boxes = np.flatnonzero((model.geom_bodyid == body) & (model.geom_type == mujoco.mjtGeom.mjGEOM_BOX))
        down_m = np.einsum("nk,nk->n", np.abs(data.geom_xmat[boxes, 6:]), model.geom_size[boxes])
        base_m, (x, y) = float((data.geom_xpos[boxes, 2] - down_m).min()), movable.pos_w[:2]
        if not (x0 - BESIDE_M < x < x1 + BESIDE_M and y0 - BESIDE_M < y < y1 + BESIDE_M):
            faults.append(f"{name} stands at ({x:.4g}, {y:.4g}) m, expected it on the map's floor")
        if not BASE_M[0] <= base_m <= BASE_M[1]:
            faults.append(f"the base of {name} is at a height of {base_m:.4g} m, expected it on the floor")
        for key, (least, most) in (("mass_kg", MASS_KG), ("friction", FRICTION)):
            if not least <= getattr(movable, key) <= most:
                faults.append(f"{name}: {key} is {getattr(movable, key):g}, expected {least:g} to {most:g}")
    return faults


def _free_extent(maps: SceneMaps) -> tuple[float, float, float, float]:
    """Return the least and largest x, then y, of the free cells, m."""
    rows, columns = np.nonzero(maps.traversable)
    (x, y), side = maps.origin_w, maps.resolution_m
    return x + columns.min() * side, x + (columns.max() + 1) * side, y + rows.min() * side, y + (rows.max() + 1) * side
