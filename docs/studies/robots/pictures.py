"""Robots in, pictures out: one PNG each.

Pictures come from MuJoCo's renderer where OpenGL is found (EGL, no display needed), else from rays against the same
geoms.
"""

from __future__ import annotations

import math
from pathlib import Path

import mujoco
import numpy as np

from interactive_nav.pictures.gl import GlPainter
from interactive_nav.pictures.scene_model import trace
from interactive_nav.robots import get_robot
from interactive_nav.robots.build import stand
from interactive_nav.robots.spec import RobotSpec
from interactive_nav.sensing.base import CameraPose, Lens, look_along
from interactive_nav.sensing.shading import lambert
from interactive_nav_common.errors import UserError

_SIZE = (480, 480)
_VIEW_AZIMUTH_DEG, _VIEW_ELEVATION_DEG = 145.0, -22.0


def stage(robot: RobotSpec) -> tuple[mujoco.MjModel, mujoco.MjData]:
    """The robot alone on a floor, standing in its home pose."""
    spec = mujoco.MjSpec()
    spec.visual.global_.offwidth, spec.visual.global_.offheight = _SIZE
    spec.visual.headlight.ambient = [0.3, 0.3, 0.3]
    spec.visual.headlight.diffuse = [0.35, 0.35, 0.35]
    spec.add_texture(
        name="sky",
        type=mujoco.mjtTexture.mjTEXTURE_SKYBOX,
        builtin=mujoco.mjtBuiltin.mjBUILTIN_FLAT,
        rgb1=[1, 1, 1],
        rgb2=[1, 1, 1],
        width=8,
        height=48,
    )
    floor = spec.worldbody.add_geom(name="floor", type=mujoco.mjtGeom.mjGEOM_PLANE, size=[9, 9, 0.1])
    floor.rgba = [0.93, 0.93, 0.95, 1]
    spec.worldbody.add_light(pos=[1, 2, 4], dir=[-0.2, -0.45, -0.9])
    model, data = stand(robot, spec)
    mujoco.mj_forward(model, data)
    return model, data


def _shown(model: mujoco.MjModel) -> list[int]:
    """Geoms to draw: visual ones, or the collision geoms of a robot that has none."""
    own = [g for g in range(model.ngeom) if model.geom_type[g] != mujoco.mjtGeom.mjGEOM_PLANE]
    visual = [g for g in own if model.geom_group[g] == 2]
    if not visual:
        return own
    # A wheel's sphere is not drawn where a visual tyre is.
    bare = set(model.geom_bodyid[g] for g in own) - set(model.geom_bodyid[g] for g in visual)
    return visual + [g for g in own if model.geom_bodyid[g] in bare]


def _span(model: mujoco.MjModel, data: mujoco.MjData) -> tuple[np.ndarray, float]:
    """Centre and half diagonal of the drawn geoms."""
    low, high = np.full(3, np.inf), np.full(3, -np.inf)
    for g in _shown(model):
        radius = model.geom_rbound[g]
        half = np.minimum(radius, np.abs(data.geom_xmat[g].reshape(3, 3)) @ model.geom_aabb[g, 3:])
        low, high = np.minimum(low, data.geom_xpos[g] - half), np.maximum(high, data.geom_xpos[g] + half)
    return (low + high) / 2, float(np.linalg.norm(high - low) / 2)


def _camera(model: mujoco.MjModel, data: mujoco.MjData) -> tuple[CameraPose, Lens]:
    """A camera that holds what is drawn; leaves nothing else in geom group 0."""
    shown = set(_shown(model))
    for g in range(model.ngeom):
        if model.geom_type[g] != mujoco.mjtGeom.mjGEOM_PLANE:
            model.geom_group[g] = 0 if g in shown else 5
    centre, half = _span(model, data)
    azimuth, elevation = math.radians(_VIEW_AZIMUTH_DEG), math.radians(_VIEW_ELEVATION_DEG)
    level = math.cos(elevation)
    forward = np.array([level * math.cos(azimuth), level * math.sin(azimuth), math.sin(elevation)])
    return look_along(centre - 2.9 * half * forward, forward), Lens(*_SIZE, model.vis.global_.fovy)


def _with_gl(model: mujoco.MjModel, data: mujoco.MjData) -> np.ndarray:
    pose, lens = _camera(model, data)
    one = CameraPose(pose.pos_w[None], pose.axes_w[None])
    return GlPainter(model, lens.width, lens.height, sky=None).draw(data, one, lens.fov_deg, [0])[0]


def _with_rays(model: mujoco.MjModel, data: mujoco.MjData) -> np.ndarray:
    pose, lens = _camera(model, data)
    _, geom, _, normal = trace(model, data, pose, lens, [0])
    met = geom >= 0
    base = np.where(met[..., None], model.geom_rgba[geom, :3], 1.0)
    return lambert(base, normal * met[..., None], pose.axes_w[:, 0], met, np)


def picture(robot: RobotSpec, renderer: str = "auto") -> np.ndarray:
    """[480, 480, 3] uint8 image of the robot in its home pose.

    Args:
        robot: its spec.
        renderer: `gl`, `rays`, or `auto`: OpenGL where there is one.
    """
    model, data = stage(robot)
    if renderer != "rays":
        try:
            return _with_gl(model, data)
        except UserError:
            if renderer == "gl":
                raise
    return _with_rays(model, data)


def save_pictures(names: tuple[str, ...], folder: Path) -> list[Path]:
    """Writes one PNG per robot; returns their paths."""
    from PIL import Image

    folder.mkdir(parents=True, exist_ok=True)
    paths = []
    for name in names:
        path = folder / f"{name}.png"
        Image.fromarray(picture(get_robot(name))).save(path)
        paths.append(path)
    return paths
