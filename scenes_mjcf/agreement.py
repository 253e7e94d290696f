"""Compare what `scene.json` states with a compiled `scene.xml`, and read what only the latter says."""

from collections.abc import Sequence

import mujoco
import numpy as np

from scenes_mjcf.schema import SceneObject

TOLERANCE = 1e-3
"""Largest relative difference of two numbers that mean the same."""
LIT_AMBIENT = 0.25
"""Ambient headlight of scenes whose structure is lit in its own image; others have MuJoCo's 0.1."""


def light_evenly(spec: mujoco.MjSpec) -> None:
    """Light a scene whose structure is lit in its own image."""
    light = spec.light("light")
    light.dir, light.diffuse, light.ambient = [0.25, 0.35, -0.9], [0.25] * 3, [0.5] * 3
    spec.visual.headlight.diffuse, spec.visual.headlight.ambient = [0.15] * 3, [LIT_AMBIENT] * 3


def is_lit(model: mujoco.MjModel) -> bool:
    """Return whether the structure is lit in its own image, so that it needs no shading.

    It is inferred from the headlight: scenes on disk have no field for it, and its absence could mean either.
    """
    return bool(model.vis.headlight.ambient[0] > 0.8 * LIT_AMBIENT)


def sliding_friction(model: mujoco.MjModel, body: int) -> list[float]:
    """Return the sliding coefficients of a body's geoms, without those that only show it."""
    solid = [g for g in np.flatnonzero(model.geom_bodyid == body) if not model.geom(g).name.endswith("_visual")]
    return [float(model.geom_friction[g, 0]) for g in solid]


def differences(model: mujoco.MjModel, objects: Sequence[SceneObject]) -> tuple[str, ...]:
    """Return a line for each mass or friction in which `scene.xml` and `scene.json` differ, for objects in both."""
    lines = []
    for item in objects:
        body = mujoco.mj_name2id(model, mujoco.mjtObj.mjOBJ_BODY, item.name)
        if body < 0:
            continue
        pairs = [("mass_kg", float(model.body_mass[body]), item.mass_kg)]
        pairs += [("friction", value, item.friction) for value in sorted(set(sliding_friction(model, body)))]
        for what, value, stated in pairs:
            if not abs(value - stated) <= TOLERANCE * max(abs(stated), 1e-3):
                lines.append(f"{item.name}: {what} is {value:g} in scene.xml, {stated:g} in scene.json")
    return tuple(lines)
