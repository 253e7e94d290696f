"""A user's MJCF or URDF and a few facts in, a robot that `make` accepts out (see `docs/add-a-robot.md`).

What the task's physics needs and a file may lack is put right, each with a warning that says what was
done: wheels become spheres that roll on the floor only, with a box in front of furniture; cylinders become
boxes; meshes that collide, links without inertia and joints without torque limits are refused or
completed. Actuators, sensors and options of the file are left out: control modes come from `build.py`.
"""

from __future__ import annotations

import dataclasses
import functools
import math
import warnings
from collections.abc import Callable, Mapping
from pathlib import Path

import mujoco
import numpy as np

from interactive_nav.robots.build import Joint, WheeledBase, half_extents, read_file, wheeled_robot
from interactive_nav.robots.spec import Camera, RobotSpec

_GEOM = mujoco.mjtGeom
_STIFFNESS_PER_EFFORT = 10.0
"""Position servo of a joint: its torque limit is reached at an error of 0.1 rad (m)."""
_WHEEL_FRICTION = 1.0
_SPHERE_WIDTH = 0.25
"""Half width of a wheel that the file gives as a sphere or capsule, over its radius."""


@dataclasses.dataclass(frozen=True)
class _Wheel:
    joint: str
    side: int
    body: str
    pos_m: np.ndarray
    """In the base's frame."""
    radius_m: float
    half_width_m: float
    backwards: bool
    """The joint's axis points right: its positive speed rolls backwards."""


@dataclasses.dataclass(frozen=True)
class _Facts:
    """What the file itself says, at its zero pose, in the base's frame."""

    wheels: tuple[_Wheel, ...]
    bottom_m: float
    """Lowest point of the wheels."""


def _warn(message: str) -> None:
    warnings.warn(message, UserWarning, stacklevel=2)


def _solid(geom) -> bool:
    return bool(geom.contype or geom.conaffinity)


def _in_subtree(body, base) -> bool:
    while body is not None and body.name != "world":
        if body.name == base.name:
            return True
        body = body.parent
    return False


def _find(child: mujoco.MjSpec, path: Path, kind: str, name: str):
    found = child.body(name) if kind == "body" else child.joint(name)
    if found is None:
        known = [x.name for x in (child.bodies if kind == "body" else child.joints) if x.name not in ("world", "")]
        raise ValueError(f"robot file {path} has no {kind} named '{name}'; it has {', '.join(known)}")
    return found


def _strip(child: mujoco.MjSpec, path: Path, base_body: str) -> None:
    """Leaves bodies, joints, geoms, sites and cameras; gives the base its free joint, geoms their groups."""
    child.compiler.fusestatic = False
    child.compiler.balanceinertia = True
    child.compiler.boundmass, child.compiler.boundinertia = 1e-4, 1e-7
    for kind in (child.actuators, child.sensors, child.keys, child.pairs, child.tendons, child.lights):
        for element in list(kind):
            child.delete(element)
    base = _find(child, path, "body", base_body)
    for geom in list(child.worldbody.geoms):
        child.delete(geom)
    for other in list(child.worldbody.bodies):
        if other.name != base.name:
            raise ValueError(f"robot file {path}: body '{other.name}' is no part of '{base_body}', expected one tree")
    free = [j for j in base.joints if j.type == mujoco.mjtJoint.mjJNT_FREE]
    if not free:
        if base.joints:
            raise ValueError(f"robot file {path}: base body '{base_body}' hangs on a joint, expected it free")
        base.add_freejoint(name="free")
    elif not free[0].name:
        free[0].name = "free"
    base.pos, base.quat = [0, 0, 0], [1, 0, 0, 0]
    for k, geom in enumerate(list(child.geoms)):
        if not geom.name:
            geom.name = f"{geom.parent.name}_geom_{k}"
        if _solid(geom) and geom.type == _GEOM.mjGEOM_MESH:
            raise ValueError(
                f"robot file {path}: geom '{geom.name}' of body '{geom.parent.name}' collides as a mesh, expected "
                "boxes, capsules, spheres or cylinders; replace it (meshes may stay as visuals)"
            )
        if _solid(geom):
            geom.group, geom.contype, geom.conaffinity = 3, 1, 0
        else:
            geom.group, geom.mass = 2, 0.0


def _read_facts(child: mujoco.MjSpec, path: Path, base_body: str, wheels: Mapping[str, int]) -> _Facts:
    model = child.copy().compile()
    data = mujoco.MjData(model)
    mujoco.mj_kinematics(model, data)
    found = []
    for name, side in wheels.items():
        joint = model.joint(name)
        body = model.jnt_bodyid[joint.id]
        rotation = data.xmat[body].reshape(3, 3)
        axis = rotation @ model.jnt_axis[joint.id]
        if abs(axis[1]) < 0.95:
            raise ValueError(
                f"robot file {path}: wheel joint '{name}' turns about {np.round(axis, 2).tolist()} of the base, "
                "expected its y axis (x forward, y left, z up)"
            )
        geoms = [g for g in range(model.ngeom) if model.geom_bodyid[g] == body and model.geom_group[g] == 3]
        if not geoms:
            raise ValueError(f"robot file {path}: wheel body '{model.body(body).name}' has no collision geom")
        geom = geoms[0]
        kind = _GEOM(int(model.geom_type[geom]))
        round_kinds = (_GEOM.mjGEOM_CYLINDER, _GEOM.mjGEOM_SPHERE, _GEOM.mjGEOM_CAPSULE)
        if len(geoms) > 1 or kind not in round_kinds:
            raise ValueError(
                f"robot file {path}: wheel body '{model.body(body).name}' collides as {len(geoms)} geoms or as no "
                "round one, expected one cylinder, capsule or sphere"
            )
        radius = float(model.geom_size[geom, 0])
        thin = kind == _GEOM.mjGEOM_CYLINDER
        half_width = float(model.geom_size[geom, 1]) if thin else _SPHERE_WIDTH * radius
        pos = data.geom_xpos[geom] - data.xpos[model.body(base_body).id]
        found.append(_Wheel(name, side, model.body(body).name, pos, radius, half_width, bool(axis[1] < 0)))
    return _Facts(tuple(found), min(float(w.pos_m[2] - w.radius_m) for w in found))


def _replace_wheel(child: mujoco.MjSpec, wheel: _Wheel, base_body: str) -> None:
    body = child.body(wheel.body)
    old = next(g for g in body.geoms if g.group == 3)
    centre = list(old.pos)
    child.delete(old)
    sphere = body.add_geom(name=f"{wheel.body}_roll", type=_GEOM.mjGEOM_SPHERE, size=[wheel.radius_m, 0, 0], pos=centre)
    sphere.group, sphere.contype, sphere.conaffinity, sphere.mass = 3, 0, 0, 0.0
    sphere.condim, sphere.friction = 3, [_WHEEL_FRICTION, 0.005, 0.0001]
    guard = child.body(base_body).add_geom(name=f"{wheel.body}_guard", type=_GEOM.mjGEOM_BOX, pos=wheel.pos_m)
    guard.size = [0.7 * wheel.radius_m, wheel.half_width_m, 0.7 * wheel.radius_m]
    guard.group, guard.contype, guard.conaffinity, guard.mass = 3, 1, 0, 0.0
    guard.friction = [0.3, 0.005, 0.0001]


def _replace_cylinder(child: mujoco.MjSpec, geom) -> None:
    """A regular octagon of four boxes instead."""
    radius, half, name = float(geom.size[0]), float(geom.size[1]), geom.name
    body, pos, quat = geom.parent, np.array(geom.pos), np.array(geom.quat)
    quat = quat / np.linalg.norm(quat)
    child.delete(geom)
    for k in range(4):
        turned = np.zeros(4)
        angle = k * math.pi / 8
        mujoco.mju_mulQuat(turned, quat, np.array([math.cos(angle), 0, 0, math.sin(angle)]))
        box = body.add_geom(name=f"{name}_{k}", type=_GEOM.mjGEOM_BOX, pos=pos, quat=turned)
        box.size = [radius * math.cos(math.pi / 8), radius * math.sin(math.pi / 8), half]
        box.group, box.contype, box.conaffinity, box.mass = 3, 1, 0, 0.0


def _complete(child: mujoco.MjSpec, path: Path, facts: _Facts, base: WheeledBase, base_body: str, casters) -> None:
    """Every change to the file, in order; warns of each."""
    _strip(child, path, base_body)
    for body in child.bodies:
        if body.name == "world" or body.explicitinertial:
            continue
        if any(g.group == 3 for g in body.geoms):
            _warn(f"{path}: body '{body.name}' has no inertia; taken from its shapes at 1000 kg/m3")
        elif body.joints and body.name != base_body:
            raise ValueError(f"robot file {path}: moving body '{body.name}' has neither inertia nor collision shapes")
    # Masses stand now: what is put in for collision weighs nothing.
    model = child.copy().compile()
    for body in child.bodies:
        if body.name == "world":
            continue
        own = model.body(body.name)
        body.explicitinertial = True
        body.mass, body.ipos, body.iquat, body.inertia = own.mass[0], own.ipos, own.iquat, own.inertia
        body.fullinertia = [math.nan] * 6
    for wheel in facts.wheels:
        _warn(
            f"{path}: wheel '{wheel.body}' now rolls on the floor as a sphere of radius {wheel.radius_m:g} m and "
            "meets furniture as a box"
        )
        _replace_wheel(child, wheel, base_body)
        if wheel.backwards:
            joint = child.joint(wheel.joint)
            joint.axis = [-v for v in joint.axis]
    for name in casters:
        for geom in [g for g in _find(child, path, "body", name).geoms if g.group == 3]:
            if geom.type != _GEOM.mjGEOM_SPHERE:
                raise ValueError(f"robot file {path}: caster '{name}' is no sphere, expected one")
            geom.contype, geom.condim, geom.friction = 0, 1, [0.0, 0.0, 0.0]
    for geom in [g for g in child.geoms if g.group == 3 and g.type == _GEOM.mjGEOM_CYLINDER]:
        _warn(f"{path}: cylinder '{geom.name}' now collides as four boxes, an octagon")
        _replace_cylinder(child, geom)
    for joint in base.joints:
        _add_servo(child, path, joint)


def _add_servo(child: mujoco.MjSpec, path: Path, joint: Joint) -> None:
    """The joint's native actuator; gains from its torque limit and speed."""
    own = child.joint(joint.name)
    effort = float(own.actfrcrange[1])
    if not effort > 0:
        raise ValueError(
            f"robot file {path}: joint '{joint.name}' has no torque limit; give one (URDF: <limit effort>, "
            f"MJCF: actuatorfrcrange, or torque_limits={{'{joint.name}': ...}})"
        )
    own.actfrclimited = True
    if joint.side:
        stiff, damp = 0.0, 5.0 * effort / joint.max_speed
        # Wheels much lighter than their servo is stiff chatter at the environment's timestep of 0.02 s.
        least = 0.01 * damp
    else:
        stiff = _STIFFNESS_PER_EFFORT * effort
        damp = 0.12 * stiff
        least = 2e-4 * stiff
    if own.armature < least:
        own.armature = least
    actuator = child.add_actuator(name=joint.name, target=joint.name, trntype=mujoco.mjtTrn.mjTRN_JOINT)
    actuator.gainprm = [stiff or damp] + [0.0] * 9
    actuator.biasprm = [0.0, -stiff, -damp] + [0.0] * 7


def _outline(robot: RobotSpec) -> tuple[np.ndarray, np.ndarray, float, float]:
    """Lower and upper corner above the floor, radius about the base frame and mass, at home."""
    spec = mujoco.MjSpec()
    spec.compiler.degree = False
    spec.worldbody.add_geom(name="floor", type=_GEOM.mjGEOM_PLANE, size=[0, 0, 0.1])
    robot.add_to(spec)
    model = spec.compile()
    data = mujoco.MjData(model)
    data.qpos[:7] = [0, 0, robot.spawn_height_m, 1, 0, 0, 0]
    for name, value in robot.home_qpos:
        data.qpos[model.joint(name).qposadr[0]] = value
    mujoco.mj_kinematics(model, data)
    low, high, radius = np.full(3, np.inf), np.full(3, -np.inf), 0.0
    signs = np.array([[x, y, z] for x in (-1, 1) for y in (-1, 1) for z in (-1, 1)])
    for geom in range(model.ngeom):
        if model.geom_group[geom] == 3 and model.geom_contype[geom]:
            points = data.geom_xpos[geom] + (signs * half_extents(model, geom)) @ data.geom_xmat[geom].reshape(3, 3).T
            low, high = np.minimum(low, points.min(0)), np.maximum(high, points.max(0))
            radius = max(radius, float(np.hypot(*points[:, :2].T).max()))
    return low, high, radius, float(model.body_subtreemass[model.body(robot.base_body).id])


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
    camera: Camera | None = None,
    body_width_m: float | None = None,
    track_m: float | None = None,
    max_linear_m_s: float | None = None,
    max_angular_rad_s: float | None = None,
) -> Callable[[str], RobotSpec]:
    """A factory for `register` from a wheeled robot's own MJCF or URDF. Frame: x forward, y left, z up.

    Args:
        path: MJCF (.xml) or URDF (.urdf) file; collision shapes are boxes, capsules, spheres, cylinders.
        name: what `make` will call it; put in front of all its names.
        base_body: the body (link) that carries everything else.
        left_wheels: names of the driven wheel joints on the left.
        right_wheels: and on the right, in the same order from front to back.
        max_wheel_speed_rad_s: of every driven wheel; the native action's range.
        casters: bodies (links) that are spheres without friction on the floor.
        joints: other driven joints -> largest speed, rad/s (m/s for a slide); modes `whole_body`, `velocity`,
            `position`, `torque` drive them, others hold them at home.
        home: joint -> position at the start of an episode.
        torque_limits: joint -> N m (N) where the file has no limit or a wrong one.
        camera: by default at the middle of the base's top, looking ahead.
        body_width_m: success distance; by default the model's width.
        track_m: effective distance of left and right wheels; by default theirs, or for several wheels a side
            (skid steer) track + wheelbase^2 / track, the value for Coulomb friction.
        max_linear_m_s: of mode `twist`; by default what the wheels give.
        max_angular_rad_s: likewise.

    Returns:
        control mode -> `RobotSpec`.

    Raises:
        ValueError: a file that cannot be used; the message says what to change.
    """
    path = Path(path).resolve()
    joints, home, torque_limits = dict(joints or {}), dict(home or {}), dict(torque_limits or {})
    if not left_wheels or len(left_wheels) != len(right_wheels):
        raise ValueError(
            f"left_wheels has {len(left_wheels)} and right_wheels {len(right_wheels)} joints, expected as many on both"
        )
    sides = {j: -1 for j in left_wheels} | {j: 1 for j in right_wheels}
    child = read_file(path)
    for joint in (*sides, *joints, *home, *torque_limits):
        _find(child, path, "joint", joint)
    _strip(child, path, base_body)
    facts = _read_facts(child, path, base_body, sides)
    if max(w.radius_m for w in facts.wheels) - min(w.radius_m for w in facts.wheels) > 1e-3:
        raise ValueError(f"robot file {path}: its driven wheels differ in radius, expected one radius")
    radius = facts.wheels[0].radius_m
    if track_m is None:
        across = float(np.ptp([w.pos_m[1] for w in facts.wheels]))
        along = float(np.ptp([w.pos_m[0] for w in facts.wheels]))
        track_m = across + along**2 / across
    fastest = max_wheel_speed_rad_s * radius
    base = WheeledBase(
        name=name,
        joints=(
            *(Joint(j, max_wheel_speed_rad_s, side=side) for j, side in sides.items()),
            *(
                Joint(
                    j,
                    speed,
                    home.get(j, 0.0),
                    unit="m" if child.joint(j).type == mujoco.mjtJoint.mjJNT_SLIDE else "rad",
                )
                for j, speed in joints.items()
            ),
        ),
        wheel_radius_m=radius,
        track_m=track_m,
        native=(-max_wheel_speed_rad_s, max_wheel_speed_rad_s),
        max_linear_m_s=max_linear_m_s or fastest,
        max_angular_rad_s=max_angular_rad_s or 2 * fastest / track_m,
        yaw_gain=1.0 if len(left_wheels) > 1 else 0.0,
        whole_body=tuple(joints),
        path=path,
    )

    def prepare(parsed: mujoco.MjSpec) -> None:
        for joint, limit in torque_limits.items():
            parsed.joint(joint).actfrcrange = [-limit, limit]
        _complete(parsed, path, facts, base, base_body, casters)

    def quietly(parsed: mujoco.MjSpec) -> None:
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")
            prepare(parsed)

    prepare(read_file(path))
    build = functools.partial(
        wheeled_robot,
        base,
        prepare=quietly,
        base_body=base_body,
        rolling=(*(w.body for w in facts.wheels), *casters),
        spawn_height_m=-facts.bottom_m,
    )
    figures = {"body_width_m": 0.0, "footprint_radius_m": 0.0, "height_m": 0.0, "camera": Camera(base_body, (0, 0, 0))}
    low, high, reach, mass = _outline(build("native", **figures))  # type: ignore[arg-type]
    view = camera or Camera(base_body, (0.0, 0.0, float(high[2]) + facts.bottom_m + 0.02))
    size = (float(high[0] - low[0]), float(high[1] - low[1]), float(high[2]))

    def factory(control_mode: str = "native") -> RobotSpec:
        return build(
            control_mode,
            camera=view,
            body_width_m=body_width_m or size[1],
            footprint_radius_m=reach,
            height_m=size[2],
            mass_kg=mass,
            size_m=size,
            drive_type="skid steer" if base.yaw_gain else "differential",
            source=path.name,
        )

    factory("native")
    return factory
