"""Build a robot that `make` accepts from a user's MJCF or URDF and a few facts (see `docs/add-a-robot.md`).

`repair.py` adds what physics needs, each with a warning. Refused are colliding meshes, links without inertia or shape,
and joints without torque limits. Control modes come from `build.py`.
"""

import functools
import re
from collections.abc import Callable, Mapping
from pathlib import Path

import mujoco
import numpy as np

from interactive_nav.robots.build import FLOOR, Joint, WheeledBase, half_extents, solid_geoms, stand, wheeled_robot
from interactive_nav.robots.files import compiled, read_file
from interactive_nav.robots.repair import Wheel, complete, find, strip
from interactive_nav.robots.spec import RobotCamera, RobotSpec
from interactive_nav_common.config import Positive, check
from interactive_nav_common.errors import ConfigError

_GEOM = mujoco.mjtGeom
_SPHERE_WIDTH = 0.25
"""Half width of a wheel that the file gives as a sphere or capsule, over its radius."""
_LARGEST_WHEEL_M = 2.0
"""Radius above which a file is taken to be in other units than metres."""


def _read_wheels(child: mujoco.MjSpec, path: Path, base_body: str, wheels: Mapping[str, int]) -> list[Wheel]:
    model = compiled(child, path)
    data = mujoco.MjData(model)
    mujoco.mj_kinematics(model, data)
    read = []
    for name, side in wheels.items():
        joint = model.joint(name)
        body = model.jnt_bodyid[joint.id]
        rotation = data.xmat[body].reshape(3, 3)
        axis = rotation @ model.jnt_axis[joint.id]
        if abs(axis[1]) < 0.95:
            raise ConfigError(
                f"robot file {path}: wheel joint '{name}' turns about {np.round(axis, 2).tolist()} of the base, "
                "expected its y axis (x forward, y left, z up)"
            )
        geoms = solid_geoms(model, body)
        if not geoms:
            raise ConfigError(f"robot file {path}: wheel body '{model.body(body).name}' has no collision geom")
        geom = geoms[0]
        kind = _GEOM(int(model.geom_type[geom]))
        round_kinds = (_GEOM.mjGEOM_CYLINDER, _GEOM.mjGEOM_SPHERE, _GEOM.mjGEOM_CAPSULE)
        if len(geoms) > 1 or kind not in round_kinds:
            raise ConfigError(
                f"robot file {path}: wheel body '{model.body(body).name}' collides as {len(geoms)} geoms or as no "
                "round one, expected one cylinder, capsule or sphere"
            )
        radius = float(model.geom_size[geom, 0])
        thin = kind == _GEOM.mjGEOM_CYLINDER
        half_width = float(model.geom_size[geom, 1]) if thin else _SPHERE_WIDTH * radius
        pos = data.geom_xpos[geom] - data.xpos[model.body(base_body).id]
        read.append(Wheel(name, side, model.body(body).name, pos, radius, half_width, bool(axis[1] < 0)))
    return read


def _outline(robot: RobotSpec) -> tuple[np.ndarray, np.ndarray, float, float]:
    """Return the lower and upper corner above the floor, radius about the base frame and mass, at home."""
    world = mujoco.MjSpec()
    world.worldbody.add_geom(name=FLOOR, type=_GEOM.mjGEOM_PLANE, size=[0, 0, 0.1])
    model, data = stand(robot, world)
    low, high, radius = np.full(3, np.inf), np.full(3, -np.inf), 0.0
    signs = np.array([[x, y, z] for x in (-1, 1) for y in (-1, 1) for z in (-1, 1)])
    for geom in range(model.ngeom):
        if model.geom_group[geom] == 3 and model.geom_contype[geom]:
            points = data.geom_xpos[geom] + (signs * half_extents(model, geom)) @ data.geom_xmat[geom].reshape(3, 3).T
            low, high = np.minimum(low, points.min(0)), np.maximum(high, points.max(0))
            radius = max(radius, float(np.hypot(*points[:, :2].T).max()))
    return low, high, radius, float(model.body_subtreemass[model.body(robot.base_body).id])


def _sides(left_wheels: tuple[str, ...], right_wheels: tuple[str, ...]) -> dict[str, int]:
    """Return wheel joint -> -1 on the left, 1 on the right."""
    for side, names in (("left_wheels", left_wheels), ("right_wheels", right_wheels)):
        if isinstance(names, str):
            raise ConfigError(f"{side} is the text '{names}', expected a tuple: ('{names}',)")
    if not left_wheels or len(left_wheels) != len(right_wheels):
        raise ConfigError(
            f"left_wheels has {len(left_wheels)} and right_wheels {len(right_wheels)} joints, expected as many on both"
        )
    for joint in left_wheels:
        if joint in right_wheels:
            raise ConfigError(f"wheel joint '{joint}' is on both sides, expected it in left_wheels or in right_wheels")
    return dict.fromkeys(left_wheels, -1) | dict.fromkeys(right_wheels, 1)


def _base(
    name: str,
    path: Path,
    wheels: list[Wheel],
    wheel_speed_rad_s: float,
    others: tuple[Joint, ...],
    track_m: float | None,
    max_linear_m_s: float | None,
    max_angular_rad_s: float | None,
) -> WheeledBase:
    """Return the driven joints and commands; what is None follows from the wheels."""
    radii = [w.radius_m for w in wheels]
    if max(radii) - min(radii) > 1e-3:
        raise ConfigError(f"robot file {path}: its driven wheels differ in radius, expected one radius")
    if radii[0] > _LARGEST_WHEEL_M:
        raise ConfigError(
            f"robot file {path}: its wheels have a radius of {radii[0]:g} m, expected at most {_LARGEST_WHEEL_M:g}; "
            "is the file in millimetres? Give lengths in metres"
        )
    left, right = (float(np.mean([w.pos_m[1] for w in wheels if w.side == side])) for side in (-1, 1))
    if left <= right:
        raise ConfigError(
            f"robot file {path}: the left wheels lie at y = {left:.3g} m, the right ones at {right:.3g} m, expected "
            "the left ones at the larger y (x forward, y left); swap left_wheels and right_wheels, or turn the robot"
        )
    if track_m is None:
        across = float(np.ptp([w.pos_m[1] for w in wheels]))
        along = float(np.ptp([w.pos_m[0] for w in wheels]))
        track_m = across + along**2 / across
    fastest = wheel_speed_rad_s * radii[0]
    return WheeledBase(
        name=name,
        joints=(*(Joint(w.joint, wheel_speed_rad_s, side=w.side) for w in wheels), *others),
        wheel_radius_m=radii[0],
        track_m=track_m,
        native=(-wheel_speed_rad_s, wheel_speed_rad_s),
        max_linear_m_s=max_linear_m_s or fastest,
        max_angular_rad_s=max_angular_rad_s or 2 * fastest / track_m,
        yaw_gain=1.0 if len(wheels) > 2 else 0.0,
        whole_body=tuple(joint.name for joint in others),
    )


def from_file(
    path: str | Path,
    *,
    name: str,
    base_body: str,
    left_wheels: tuple[str, ...],
    right_wheels: tuple[str, ...],
    max_wheel_speed_rad_s: float,
    casters: tuple[str, ...] = (),
    joints: Mapping[str, float] | None = None,
    home: Mapping[str, float] | None = None,
    torque_limits: Mapping[str, float] | None = None,
    camera: RobotCamera | None = None,
    body_width_m: float | None = None,
    track_m: float | None = None,
    max_linear_m_s: float | None = None,
    max_angular_rad_s: float | None = None,
) -> Callable[[str], RobotSpec]:
    """Return (control mode) -> spec, for `register`, of a wheeled robot's MJCF or URDF. Frame: x forward, y left, z up.

    Args:
        max_wheel_speed_rad_s: of every driven wheel; the native action's range.
        joints: other driven joints -> largest speed, rad/s (m/s for a slide); modes `whole_body`, `velocity`,
            `position`, `torque` drive them, others hold them at home.
        torque_limits: joint -> N m (N) where the file has no limit or a wrong one.
        camera: by default at the middle of the base's top, looking ahead.
        body_width_m: success distance; by default the model's width.
        track_m: effective distance of left and right wheels; by default theirs, or for several wheels a side
            (skid steer) track + wheelbase^2 / track, the value for Coulomb friction.

    Raises:
        ConfigError: an impossible argument, or a file that cannot be read.
        FileError: a file that lacks a named part, or whose parts do not fit.
    """
    if not re.fullmatch(r"[A-Za-z0-9][\w-]*", name, re.ASCII):
        raise ConfigError(f"name is {name!r}, expected letters, digits, _ and -, such as 'my_robot'")
    figures = {"max_wheel_speed_rad_s": max_wheel_speed_rad_s, "body_width_m": body_width_m, "track_m": track_m}
    figures |= {"max_linear_m_s": max_linear_m_s, "max_angular_rad_s": max_angular_rad_s}
    check(figures, dict.fromkeys(figures, Positive | None))
    sides = _sides(left_wheels, right_wheels)
    driven, limits, path = dict(joints or {}), dict(torque_limits or {}), Path(path).resolve()
    child = read_file(path, base_body)
    for joint in (*sides, *driven, *(home or {}), *limits):
        find(child, path, "joint", joint)
    strip(child, path, base_body)
    wheels = _read_wheels(child, path, base_body, sides)
    bottom_m = min(float(w.pos_m[2] - w.radius_m) for w in wheels)
    units = {j.name: "m" if j.type == mujoco.mjtJoint.mjJNT_SLIDE else "rad" for j in child.joints}
    others = tuple(Joint(j, speed, dict(home or {}).get(j, 0.0), unit=units[j]) for j, speed in driven.items())
    base = _base(name, path, wheels, max_wheel_speed_rad_s, others, track_m, max_linear_m_s, max_angular_rad_s)
    complete(path, wheels, bottom_m, base, base_body, casters, limits, dict(home or {}), child)
    rolling = (*(w.body for w in wheels), *casters)
    build = functools.partial(wheeled_robot, base=base, parsed=child, base_body=base_body, rolling=rolling)
    unknown = dict.fromkeys(("body_width_m", "footprint_radius_m", "height_m"), 0.0)
    plain = build("native", spawn_height_m=-bottom_m, camera=RobotCamera(base_body, (0, 0, 0)), **unknown)
    low, high, reach_m, mass_kg = _outline(plain)
    length_m, width_m, height_m = float(high[0] - low[0]), float(high[1] - low[1]), float(high[2])
    build = functools.partial(
        build,
        spawn_height_m=-bottom_m,
        camera=camera or RobotCamera(base_body, (0.0, 0.0, height_m + bottom_m + 0.02)),
        body_width_m=body_width_m or width_m,
        footprint_radius_m=reach_m,
        height_m=height_m,
        mass_kg=mass_kg,
        size_m=(length_m, width_m, height_m),
        drive_type="skid steer" if base.yaw_gain else "differential",
        source=path.name,
    )
    build("native")
    return build
