"""Robots in, pictures out: one PNG each, or all on one.

Pictures come from MuJoCo's renderer where OpenGL is found (EGL, no display needed), else from rays against the same
geoms.
"""

from __future__ import annotations

import math
from pathlib import Path

import mujoco
import numpy as np
from matplotlib.figure import Figure

from interactive_nav.robots import get_robot
from interactive_nav.robots.build import stand
from interactive_nav.robots.spec import RobotSpec
from interactive_nav.sensing.base import lit
from interactive_nav_common.errors import UserError
from scenes_mjcf.look import CameraPose, GlPainter, Lens, look_along, trace

_SIZE = (480, 480)
_VIEW_AZIMUTH_DEG, _VIEW_ELEVATION_DEG = 145.0, -22.0
_SPAN_M, _FAR_M = 2.4, 20.0
"""Of pictures to scale: what each shows from edge to edge, and from how far."""
_PAGE_M, _LINE_M, _GAP_M = 5.1, 0.34, 0.16
"""Of the gallery: its width, the height of names below a row, and what lies between two robots."""


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


def _show(model: mujoco.MjModel, floor: bool) -> None:
    """Leaves nothing but what is drawn in geom group 0."""
    shown = set(_shown(model))
    for g in range(model.ngeom):
        if not floor or model.geom_type[g] != mujoco.mjtGeom.mjGEOM_PLANE:
            model.geom_group[g] = 0 if g in shown else 5


def _camera(centre: np.ndarray, away_m: float, fov_deg: float) -> tuple[CameraPose, Lens]:
    """A camera that looks at a place from the side and above."""
    azimuth, elevation = math.radians(_VIEW_AZIMUTH_DEG), math.radians(_VIEW_ELEVATION_DEG)
    level = math.cos(elevation)
    forward = np.array([level * math.cos(azimuth), level * math.sin(azimuth), math.sin(elevation)])
    return look_along(centre - away_m * forward, forward), Lens(*_SIZE, fov_deg)


def _with_gl(model: mujoco.MjModel, data: mujoco.MjData, pose: CameraPose, lens: Lens) -> np.ndarray:
    one = CameraPose(pose.pos_w[None], pose.axes_w[None])
    return GlPainter(model, lens.width, lens.height, sky=None).draw(data, one, lens.fov_deg, [0])[0]


def _with_rays(model: mujoco.MjModel, data: mujoco.MjData, pose: CameraPose, lens: Lens) -> np.ndarray:
    _, geom, _, normal = trace(model, data, pose, lens, [0])
    met = geom >= 0
    base = np.where(met[..., None], model.geom_rgba[geom, :3], 1.0)
    return np.round(255.0 * lit(base, normal * met[..., None], pose.axes_w[:, 0], met, np)).astype(np.uint8)


def picture(robot: RobotSpec, renderer: str = "auto", to_scale: bool = False) -> np.ndarray:
    """[480, 480, 3] uint8 image of the robot in its home pose.

    Args:
        robot: its spec.
        renderer: `gl`, `rays`, or `auto`: OpenGL where there is one.
        to_scale: 200 pixels a metre from afar and without the floor, not as large as the image holds.
    """
    model, data = stage(robot)
    _show(model, floor=not to_scale)
    centre, half = _span(model, data)
    fov_deg = math.degrees(2 * math.atan(_SPAN_M / 2 / _FAR_M)) if to_scale else model.vis.global_.fovy
    pose, lens = _camera(centre, _FAR_M if to_scale else 2.9 * half, fov_deg)
    if renderer != "rays":
        try:
            return _with_gl(model, data, pose, lens)
        except UserError:
            if renderer == "gl":
                raise
    return _with_rays(model, data, pose, lens)


def cut_out(image: np.ndarray) -> np.ndarray:
    """What of an image [rows, columns, 3] is not as its upper left pixel, the rest white."""
    drawn = (image != image[0, 0]).any(-1)
    rows, columns = np.flatnonzero(drawn.any(1)), np.flatnonzero(drawn.any(0))
    whole = np.where(drawn[..., None], image, 255).astype(np.uint8)
    return whole[rows[0] : rows[-1] + 1, columns[0] : columns[-1] + 1]


def gallery(names: tuple[str, ...], renderer: str = "auto") -> Figure:
    """All robots to one scale, on lines as on a shelf, with names, masses and a bar of half a metre."""
    images = {name: cut_out(picture(get_robot(name), renderer, to_scale=True)) for name in names}
    step_m = _SPAN_M / _SIZE[0]
    lines: list[list[str]] = [[]]
    room_m = _PAGE_M
    wide = {name: max(step_m * image.shape[1], 0.55) + _GAP_M for name, image in images.items()}
    for name in names:
        if wide[name] > room_m:
            lines, room_m = [*lines, []], _PAGE_M
        lines[-1].append(name)
        room_m -= wide[name]
    places, y = [], 0.0
    for line in lines:
        y -= step_m * max(images[name].shape[0] for name in line)
        more = (_PAGE_M - sum(wide[name] for name in line)) / len(line)
        x = 0.0
        for name in line:
            places.append((name, x + (wide[name] + more) / 2, y))
            x += wide[name] + more
        y -= _LINE_M
    return _on_shelves(images, places, step_m, y - 0.1)


def _on_shelves(
    images: dict[str, np.ndarray], places: list[tuple[str, float, float]], step_m: float, low: float
) -> Figure:
    figure = Figure(figsize=(7.2, 7.2 * -low / _PAGE_M))
    axis = figure.add_axes((0, 0, 1, 1))
    for name, x, y in places:
        high, wide = (step_m * n for n in images[name].shape[:2])
        axis.imshow(images[name], extent=(x - wide / 2, x + wide / 2, y, y + high), interpolation="antialiased")
        mass_kg = get_robot(name).mass_kg
        axis.text(x, y - 0.04, f"{name}\n{mass_kg:.3g} kg" if mass_kg else name, ha="center", va="top", fontsize=9)
    axis.plot([0.06, 0.56], [low + 0.08] * 2, color="k", linewidth=2, solid_capstyle="butt")
    axis.text(0.61, low + 0.08, "0.5 m", va="center", fontsize=9)
    axis.set(xlim=(0, _PAGE_M), ylim=(low, 0.02), aspect="equal")
    axis.set_axis_off()
    return figure


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
