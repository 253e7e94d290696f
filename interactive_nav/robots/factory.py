"""Build a robot that `make` accepts from a user's MJCF or URDF and a few facts (see `docs/add-a-robot.md`).

Missing facts are inferred from the file's shapes. `repair.py` adds what physics needs, with a warning for each change.
Refused are links without inertia or shape, and joints of arms without torque limits. Control modes come from
`build.py`.
"""

import dataclasses
import functools
import re
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import Any
from xml.etree import ElementTree

import mujoco
import numpy as np

from interactive_nav.robots.build import FLOOR, Joint, WheeledBase, half_extents, stand, wheeled_robot
from interactive_nav.robots.files import read_file, warn
from interactive_nav.robots.repair import FLOOR_M, Round, complete, find, read_rounds, strip
from interactive_nav.robots.spec import RobotCamera, RobotSpec
from interactive_nav_common.config import Positive, Settings
from interactive_nav_common.errors import ConfigError

_GEOM = mujoco.mjtGeom
_LARGEST_WHEEL_M = 2.0
"""Radius above which a file is taken to be in other units than metres."""
_FASTEST_M_S, _DEFAULT_M_S = 3.0, 1.0
"""Of wheels: a limit in the file above the first is taken for a placeholder, and the second instead."""


@dataclasses.dataclass(frozen=True)
class Facts(Settings):
    """Describe a wheeled robot beyond its file; the keys of `porter.yaml` beside `porter.urdf`, all optional."""

    name: str | None = None
    """By default the file's."""
    base_body: str = ""
    """Body that carries everything else; by default the root."""
    left_wheels: tuple[str, ...] = ()
    """Joints of the driven wheels; by default of the largest round links that stand on the floor and turn about y."""
    right_wheels: tuple[str, ...] = ()
    max_wheel_speed_rad_s: Positive | None = None
    """Of every driven wheel: the native action's range; by default the file's limit, or 1 m/s where that exceeds 3."""
    casters: tuple[str, ...] | None = None
    """Bodies that slide on the floor; by default the spheres that stand on it."""
    joints: Mapping[str, Positive] = dataclasses.field(default_factory=dict)
    """Other driven joints -> largest speed, rad/s (m/s for a slide); modes `whole_body`, `velocity`, `position` and
    `torque` drive them, others hold them at home."""
    home: Mapping[str, float] = dataclasses.field(default_factory=dict)
    """Joint -> position at the start, rad (m)."""
    torque_limits: Mapping[str, Positive] = dataclasses.field(default_factory=dict)
    """Joint -> N m (N) where the file has no limit or a wrong one."""
    camera: RobotCamera | None = None
    """By default at the middle of the base's top, looking ahead."""
    body_width_m: Positive | None = None
    """Success distance; by default the model's width."""
    track_m: Positive | None = None
    """Effective distance of left and right wheels; by default theirs, or for several wheels a side (skid steer)
    track + wheelbase^2 / track, the value for Coulomb friction."""
    max_linear_m_s: Positive | None = None
    max_angular_rad_s: Positive | None = None

    def __post_init__(self) -> None:
        super().__post_init__()
        if self.name is not None and not re.fullmatch(r"[A-Za-z0-9][\w-]*", self.name, re.ASCII):
            raise ConfigError(f"name is {self.name!r}, expected letters, digits, _ and -, such as 'my_robot'")


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


def _wheels(facts: Facts, child: mujoco.MjSpec, path: Path, base: str, rounds: Sequence[Round]) -> dict[str, Round]:
    """Return the driven wheels by joint, those on the left first; `rounds` stand on the floor or are named."""
    standing = [r for r in rounds if r.rolls]
    standing = [r for r in standing if r.effort > 0] or standing
    standing = [r for r in standing if r.radius_m > max(r.radius_m for r in standing) - 1e-3]
    ahead = sorted(standing, key=lambda r: -r.pos_m[0])
    left = facts.left_wheels or tuple(r.joint for r in ahead if r.pos_m[1] > 0)
    right = facts.right_wheels or tuple(r.joint for r in ahead if r.pos_m[1] < 0)
    if not left or len(left) != len(right):
        hinges = [j.name for j in child.joints if j.type == mujoco.mjtJoint.mjJNT_HINGE] or ["left_joint"]
        raise ConfigError(
            f"robot file {path}: {len(left)} wheels on the left and {len(right)} on the right are named, or stand on "
            f"the floor and turn about y, expected as many; name them in {path.stem}.yaml beside it, such as: "
            f"{{base_body: {base}, left_wheels: ['{hinges[0]}'], right_wheels: ['{hinges[-1]}'], "
            "max_wheel_speed_rad_s: 10}"
        )
    for joint in {*left} & {*right}:
        raise ConfigError(f"wheel joint '{joint}' is on both sides, expected it in left_wheels or in right_wheels")
    wheels = {r.joint: r for r in rounds}
    for joint in (*left, *right):
        if joint not in wheels:
            raise ConfigError(
                f"robot file {path}: wheel body '{child.joint(joint).parent.name}' collides as several geoms, as none "
                "or as no round one, expected one cylinder, capsule or sphere"
            )
        if abs(wheels[joint].axis[1]) < 0.95:
            raise ConfigError(
                f"robot file {path}: wheel joint '{joint}' turns about {np.round(wheels[joint].axis, 2).tolist()} of "
                "the base, expected its y axis (x forward, y left, z up)"
            )
    y_m = [float(np.mean([wheels[joint].pos_m[1] for joint in side])) for side in (left, right)]
    if y_m[0] <= y_m[1]:
        raise ConfigError(
            f"robot file {path}: the left wheels lie at y = {y_m[0]:.3g} m, the right ones at {y_m[1]:.3g} m, expected "
            "the left ones at the larger y (x forward, y left); swap left_wheels and right_wheels, or turn the robot"
        )
    radii = [wheels[joint].radius_m for joint in (*left, *right)]
    if max(radii) - min(radii) > 1e-3:
        raise ConfigError(f"robot file {path}: its driven wheels differ in radius, expected one radius")
    if radii[0] > _LARGEST_WHEEL_M:
        raise ConfigError(
            f"robot file {path}: its wheels have a radius of {radii[0]:g} m, expected at most {_LARGEST_WHEEL_M:g}; "
            "is the file in millimetres? Give lengths in metres"
        )
    return {joint: wheels[joint] for joint in (*left, *right)}


def _base(facts: Facts, name: str, wheels: Mapping[str, Round], speed_rad_s: float, units: Mapping) -> WheeledBase:
    """Return the driven joints and commands; what the facts leave out follows from the wheels. `units`: of joints."""
    count, radius_m, pos_m = len(wheels) // 2, next(iter(wheels.values())).radius_m, [w.pos_m for w in wheels.values()]
    along, across = (float(x) for x in np.ptp(pos_m, axis=0)[:2])
    track_m, fastest = facts.track_m or across + along**2 / across, speed_rad_s * radius_m
    driven = (Joint(joint, speed_rad_s, side=-1 if k < count else 1) for k, joint in enumerate(wheels))
    others = (Joint(j, speed, facts.home.get(j, 0.0), unit=units[j]) for j, speed in facts.joints.items())
    return WheeledBase(
        name=name,
        joints=(*driven, *others),
        wheel_radius_m=radius_m,
        track_m=track_m,
        native=(-speed_rad_s, speed_rad_s),
        max_linear_m_s=facts.max_linear_m_s or fastest,
        max_angular_rad_s=facts.max_angular_rad_s or 2 * fastest / track_m,
        yaw_gain=1.0 if count > 1 else 0.0,
        whole_body=tuple(facts.joints),
    )


def from_file(path: str | Path, **facts: Any) -> Callable[[str], RobotSpec]:
    """Return (control mode) -> spec, for `register`, of a wheeled robot's MJCF or URDF. Frame: x forward, y left, z up.

    `facts` are fields of `Facts`. Raise `ConfigError` for an impossible fact or a file that cannot be read, and
    `FileError` for a file that lacks a named part, or whose parts do not fit.
    """
    path, given = Path(path).resolve(), Facts.of(**facts)
    name = given.name or re.sub(r"[^A-Za-z0-9_-]", "_", path.stem).lstrip("_-") or "robot"
    child = read_file(path, given.base_body)
    tops = child.worldbody.bodies
    tops = [b for b in tops if any(j.type == mujoco.mjtJoint.mjJNT_FREE for j in b.joints)] or tops
    base_body = given.base_body or (tops[0].name if len(tops) == 1 else "")
    for joint in (*given.left_wheels, *given.right_wheels, *given.joints, *given.home, *given.torque_limits):
        find(child, path, "joint", joint)
    # The largest speeds of joints, rad/s, as velocity servos or a URDF's limits declare them.
    speeds = {a.target: float(a.ctrlrange[1]) for a in child.actuators if a.biasprm[2] < 0 and not a.biasprm[1]}
    limits = {j.get("name", ""): j.find("limit") for j in ElementTree.parse(path).getroot().iter("joint")}
    speeds |= {name: float(x.get("velocity", 0)) for name, x in limits.items() if x is not None}
    strip(child, path, base_body)
    for joint, limit in given.torque_limits.items():
        child.joint(joint).actfrcrange = [-limit, limit]
    rounds = read_rounds(child, path, base_body)
    floor_m = min((r.low_m for r in rounds if r.rolls), default=-np.inf)
    standing, named = [r for r in rounds if abs(r.low_m - floor_m) < FLOOR_M], {*given.left_wheels, *given.right_wheels}
    wheels = _wheels(given, child, path, base_body, standing + [r for r in rounds if r.joint in named])
    spheres = dict.fromkeys(r.body for r in standing if r.sphere and r.joint not in wheels)
    casters = tuple(spheres) if given.casters is None else given.casters
    speed_rad_s = given.max_wheel_speed_rad_s
    if speed_rad_s is None:
        radius_m = next(iter(wheels.values())).radius_m
        speed_rad_s = min((speeds[joint] for joint in wheels if speeds.get(joint, 0.0) > 0), default=np.inf)
        if speed_rad_s * radius_m > _FASTEST_M_S:
            warn(path, f"its wheels have no limit below {_FASTEST_M_S:g} m/s; {_DEFAULT_M_S:g} m/s is taken")
            speed_rad_s = _DEFAULT_M_S / radius_m
    units = {j.name: "m" if j.type == mujoco.mjtJoint.mjJNT_SLIDE else "rad" for j in child.joints}
    base = _base(given, name, wheels, float(speed_rad_s), units)
    complete(child, path, wheels, base, base_body, casters, given.home)
    spawn_height_m = -min(w.low_m for w in wheels.values())
    rolling = (*(w.body for w in wheels.values()), *casters)
    build = functools.partial(wheeled_robot, base=base, parsed=child, base_body=base_body, rolling=rolling)
    build = functools.partial(build, spawn_height_m=spawn_height_m)
    unknown = dict.fromkeys(("body_width_m", "footprint_radius_m", "height_m"), 0.0)
    low, high, reach_m, mass_kg = _outline(build("native", camera=RobotCamera(base_body, (0, 0, 0)), **unknown))
    length_m, width_m, height_m = float(high[0] - low[0]), float(high[1] - low[1]), float(high[2])
    build = functools.partial(
        build,
        camera=given.camera or RobotCamera(base_body, (0.0, 0.0, height_m - spawn_height_m + 0.02)),
        body_width_m=given.body_width_m or width_m,
        footprint_radius_m=reach_m,
        height_m=height_m,
        mass_kg=mass_kg,
        size_m=(length_m, width_m, height_m),
        drive_type="skid steer" if base.yaw_gain else "differential",
        source=path.name,
    )
    build("native")
    return build
