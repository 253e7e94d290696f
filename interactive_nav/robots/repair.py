"""Adapt a user's parsed robot file to the task's physics; every change produces a warning.

Wheels become spheres that roll on the floor only, with a box for contact with furniture; cylinders and meshes become
boxes; links without inertia take that of their shapes; driven joints get a servo. Actuators, sensors and options go.
"""

import dataclasses
import math
from collections.abc import Mapping
from pathlib import Path

import mujoco
import numpy as np

from interactive_nav.robots.build import Joint, WheeledBase, half_extents
from interactive_nav.robots.files import compiled, warn
from interactive_nav.robots.spec import set_servo
from interactive_nav_common.errors import FileError
from interactive_nav_common.rotations import matrix_from_quat

_GEOM = mujoco.mjtGeom
_ROUND = (_GEOM.mjGEOM_CYLINDER, _GEOM.mjGEOM_SPHERE, _GEOM.mjGEOM_CAPSULE)
_SPHERE_WIDTH = 0.25
"""Half width of a wheel that the file gives as a sphere or capsule, over its radius."""
_WHEEL_FRICTION = 1.0
_G_M_S2 = 9.81
_STIFFNESS_PER_EFFORT = 10.0
"""Position servo of a joint: its torque limit is reached at an error of 0.1 rad (m)."""
_CLEAR_M = 0.005
"""Boxes of the base are this high above the floor at least."""
FLOOR_M = 0.02
"""A wheel of a joint that nothing drives rolls on the floor when it comes this near to it."""


@dataclasses.dataclass(frozen=True)
class Round:
    """A link that collides as one sphere, capsule or cylinder, as the file has it at its zero pose."""

    body: str
    joint: str
    """One of the link's joints; empty: none."""
    axis: np.ndarray
    """(3,) of the joint, in the base's frame: y is a wheel's, -y that of one whose positive speed rolls backwards."""
    rolls: bool
    """The joint is a hinge about y, and the link's only one; its parent is fixed to the base."""
    effort: float
    """Torque limit of the joint, N m; 0: none."""
    pos_m: np.ndarray
    """(3,) in the base's frame."""
    radius_m: float
    half_width_m: float
    sphere: bool

    @property
    def low_m(self) -> float:
        """Return the height of its lowest point in the base's frame."""
        return float(self.pos_m[2] - self.radius_m)


def read_rounds(child: mujoco.MjSpec, path: Path, base_body: str) -> list[Round]:
    """Return the round links below the base, one for each of their joints."""
    model = compiled(child, path)
    data, weld = mujoco.MjData(model), model.body_weldid
    mujoco.mj_kinematics(model, data)
    rounds = []
    for body in range(model.body(base_body).id + 1, model.nbody):
        geoms = np.flatnonzero((model.geom_bodyid == body) & (model.geom_group == 3)).tolist()  # those that collide
        if len(geoms) != 1 or (kind := _GEOM(int(model.geom_type[geoms[0]]))) not in _ROUND:
            continue
        pos_m, (radius_m, length_m, _) = data.geom_xpos[geoms[0]].copy(), model.geom_size[geoms[0]].tolist()
        half_width_m = length_m if kind == _GEOM.mjGEOM_CYLINDER else _SPHERE_WIDTH * radius_m
        first, count, fixed = model.body_jntadr[body], model.body_jntnum[body], weld[model.body_parentid[body]]
        for j in range(first, first + count) if count else (-1,):
            axis, joint = data.xaxis[j].copy() if count else np.zeros(3), model.joint(j).name if count else ""
            rolls = count == 1 and model.jnt_type[j] == mujoco.mjtJoint.mjJNT_HINGE and abs(axis[1]) > 0.95
            rolls = bool(rolls) and fixed == weld[model.body(base_body).id]
            effort = float(child.joint(joint).actfrcrange[1]) if count else 0.0
            shape = pos_m, radius_m, half_width_m, kind == _GEOM.mjGEOM_SPHERE
            rounds.append(Round(model.body(body).name, joint, axis, rolls, effort, *shape))
    return rounds


def _solid(geom) -> bool:
    return bool(geom.contype or geom.conaffinity)


def find(child: mujoco.MjSpec, path: Path, kind: str, name: str):
    """Return the body or joint of a name."""
    element = child.body(name) if kind == "body" else child.joint(name)
    if element is None:
        available = [x.name for x in (child.bodies if kind == "body" else child.joints) if x.name not in ("world", "")]
        raise FileError(f"robot file {path} has no {kind} named '{name}'; it has {', '.join(available)}")
    return element


def strip(child: mujoco.MjSpec, path: Path, base_body: str) -> None:
    """Leave bodies, joints, geoms, sites and cameras; gives the base its free joint, geoms their groups."""
    child.compiler.fusestatic = False
    child.compiler.balanceinertia = True
    child.compiler.boundmass, child.compiler.boundinertia = 1e-4, 1e-7
    for kind in (child.actuators, child.sensors, child.keys, child.pairs, child.tendons, child.lights):
        for element in list(kind):
            child.delete(element)
    base = find(child, path, "body", base_body)
    for geom in list(child.worldbody.geoms):
        child.delete(geom)
    for other in list(child.worldbody.bodies):
        if other.name != base.name:
            carries = base.parent.name != "world"
            raise FileError(
                f"robot file {path}: body '{other.name}' is no part of '{base_body}', expected one tree; "
                + (f"give base_body='{other.name}', which carries it" if carries else "remove it, or join it")
            )
    free = [j for j in base.joints if j.type == mujoco.mjtJoint.mjJNT_FREE]
    if not free:
        if base.joints:
            raise FileError(f"robot file {path}: base body '{base_body}' hangs on a joint, expected it free")
        base.add_freejoint(name="free")
    elif not free[0].name:
        free[0].name = "free"
    place(base, [0, 0, 0], [1, 0, 0, 0])
    for k, joint in enumerate(child.joints):
        joint.name = joint.name or f"{joint.parent.name}_joint_{k}"
    for k, geom in enumerate(list(child.geoms)):
        if not geom.name:
            geom.name = f"{geom.parent.name}_geom_{k}"
        if _solid(geom):
            geom.group, geom.contype, geom.conaffinity = 3, 1, 0
        else:
            geom.group, geom.mass = 2, 0.0
    for mesh in child.meshes:
        mesh.inertia = mujoco.mjtMeshInertia.mjMESH_INERTIA_SHELL  # a flat one has no volume
    meshes = [g for g in child.geoms if g.group == 3 and g.type == _GEOM.mjGEOM_MESH]
    if meshes:
        warn(path, f"{len(meshes)} meshes now collide as the boxes around them, or as wheels")
        model = compiled(child, path)
        for geom in meshes:
            _replace_mesh(geom, model)


def _replace_mesh(geom, model: mujoco.MjModel) -> None:
    """Replace a colliding mesh by the box around it along its body's axes.

    A link's only shape becomes a cylinder about the link's only hinge, one without limits, if that box is square there.
    """
    i, body, quat = model.geom(geom.name).id, model.body(geom.parent.name), np.array([1.0, 0.0, 0.0, 0.0])
    start, count = model.mesh_vertadr[model.geom_dataid[i]], model.mesh_vertnum[model.geom_dataid[i]]
    points_m = model.mesh_vert[start : start + count] @ matrix_from_quat(model.geom_quat[i]).T + model.geom_pos[i]
    low_m, high_m = points_m.min(0), points_m.max(0)
    geom.type, geom.meshname, geom.size, j = _GEOM.mjGEOM_BOX, "", (high_m - low_m) / 2, body.jntadr[0]
    alone = sum(g.group == 3 for g in geom.parent.geoms) == body.jntnum[0] == 1
    if alone and model.jnt_type[j] == mujoco.mjtJoint.mjJNT_HINGE and not model.jnt_limited[j]:
        k = abs(model.jnt_axis[j]).argmax()
        least, most = sorted(np.delete(geom.size, k))
        if least > 0.95 * most:
            geom.type, geom.size = _GEOM.mjGEOM_CYLINDER, [most, geom.size[k], 0.0]
            mujoco.mju_quatZ2Vec(quat, np.eye(3)[k])
    place(geom, (low_m + high_m) / 2, quat)


def _replace_wheel(child: mujoco.MjSpec, wheel: Round, base_body: str) -> None:
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
    """Replace a cylinder by a regular octagon of four boxes."""
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


def _fix_masses(child: mujoco.MjSpec, path: Path, base_body: str) -> None:
    """Make every body's inertia explicit, so that what is put in for collision weighs nothing."""
    for body in child.bodies:
        shapes = [g for g in body.geoms if g.group == 3]
        if body.name == "world":
            continue
        turns = np.nansum(np.abs([*body.inertia, *body.fullinertia])) > 0
        if body.explicitinertial and body.mass > 0 and shapes and not turns:
            warn(path, f"body '{body.name}' has mass but no inertia; taken from its shapes at that mass")
            body.explicitinertial, body.ipos = False, [math.nan] * 3  # MuJoCo asks the shapes where ipos is none
            for geom in shapes:
                geom.mass = body.mass / len(shapes)
        elif body.explicitinertial or (shapes and not any(math.isnan(g.mass) for g in shapes)):
            continue
        elif shapes:
            warn(path, f"body '{body.name}' has no inertia; taken from its shapes at 1000 kg/m3")
        elif body.joints and body.name != base_body and not body.bodies:
            raise FileError(f"robot file {path}: moving body '{body.name}' has neither inertia nor collision shapes")
    model = compiled(child, path)
    fixed = model.body_weldid == model.body(base_body).id
    if model.body_mass[fixed].sum() < 1e-3 * fixed.sum():
        mass = float(model.body(base_body).mass[0])
        raise FileError(f"robot file {path}: base '{base_body}' weighs {mass:g} kg, expected its mass; give it inertia")
    for body in child.bodies:
        if body.name == "world":
            continue
        has = model.body(body.name)
        body.explicitinertial = True
        body.mass, body.ipos, body.iquat, body.inertia = has.mass[0], has.ipos, has.iquat, has.inertia
        body.fullinertia = [math.nan] * 6


def place(part, pos, quat) -> None:
    """Set the pose of a body in its parent's frame, or of a geom in its body's."""
    part.alt.type = mujoco.mjtOrientation.mjORIENTATION_QUAT
    part.pos, part.quat = pos, quat


def turn_freely(joint, path: Path, slip_n_m: float, speed_rad_s: float) -> None:
    """Take away a wheel's position limits, torque beyond its grip, and damping and friction beyond its torque."""
    if joint.limited and joint.range[0] < joint.range[1]:
        warn(path, f"wheel joint '{joint.name}' has position limits {joint.range.tolist()}; it turns without")
    joint.limited, joint.range = False, [0, 0]
    if not joint.actfrcrange[1] > 0:
        warn(path, f"wheel joint '{joint.name}' has no torque limit; {slip_n_m:.3g} N m is taken, at which it slips")
        joint.actfrcrange = [-slip_n_m, slip_n_m]
    elif joint.actfrcrange[1] > slip_n_m:
        warn(
            path,
            f"wheel joint '{joint.name}' has a torque limit of {joint.actfrcrange[1]:g} N m; bounded to "
            f"{slip_n_m:.3g} N m, at which a wheel that carries the whole robot slips",
        )
        joint.actfrcrange = [-slip_n_m, slip_n_m]
    lost_n_m = float(joint.damping[0]) * speed_rad_s + joint.frictionloss
    if lost_n_m > joint.actfrcrange[1]:
        warn(path, f"wheel joint '{joint.name}' would lose {lost_n_m:.3g} N m to damping and friction; it has none")
        joint.damping, joint.frictionloss = 0.0 * joint.damping, 0.0


def hold(
    child: mujoco.MjSpec,
    path: Path,
    bottom_m: float,
    driven: set[str],
    casters: tuple[str, ...],
    home: Mapping[str, float],
) -> None:
    """Fix the joints that nothing drives at their home; those of casters and of wheels on the floor turn freely."""
    model = compiled(child, path)
    data = mujoco.MjData(model)
    hinge, free = mujoco.mjtJoint.mjJNT_HINGE, mujoco.mjtJoint.mjJNT_FREE
    loose = [j for j in child.joints if j.type != free and j.name not in driven]
    for joint in loose:
        loose_joint = model.joint(joint.name)
        if joint.name in home:
            data.qpos[loose_joint.qposadr[0]] = home[joint.name]
        elif model.jnt_limited[loose_joint.id]:
            data.qpos[loose_joint.qposadr[0]] = np.clip(data.qpos[loose_joint.qposadr[0]], *loose_joint.range)
    mujoco.mj_kinematics(model, data)
    parents = model.body_parentid
    held, swinging = [], []
    for joint in loose:
        body, below = model.body(joint.parent.name).id, [joint.parent, *joint.parent.find_all("body")]
        geoms = [model.geom(g.name).id for g in joint.parent.find_all("geom") if g.group == 3]
        down_m = [np.abs(data.geom_xmat[g, 6:]) @ half_extents(model, g) for g in geoms]
        lowest = min((data.geom_xpos[g, 2] - down for g, down in zip(geoms, down_m, strict=True)), default=np.inf)
        on_floor = joint.type == hinge and not model.jnt_limited[model.joint(joint.name).id]
        on_floor = on_floor and lowest < bottom_m + FLOOR_M
        if on_floor or any(part.name in casters for part in below):
            swinging.append(joint)
            continue
        held.append(joint)
        axes = data.xmat[parents[body]].reshape(3, 3)
        quat = np.zeros(4)
        mujoco.mju_mulQuat(quat, data.xquat[parents[body]] * [1, -1, -1, -1], data.xquat[body])
        place(joint.parent, axes.T @ (data.xpos[body] - data.xpos[parents[body]]), quat)
    for joints, said in ((held, "are held at home; name those to drive in joints"), (swinging, "turn freely")):
        if joints:
            warn(path, f"nothing drives {', '.join(repr(j.name) for j in joints)}: they {said}")
    for joint in held:
        child.delete(joint)


def add_servo(child: mujoco.MjSpec, path: Path, joint: Joint) -> None:
    """Add the joint's native actuator; gains from its torque limit and speed."""
    driven = child.joint(joint.name)
    effort = float(driven.actfrcrange[1])
    if not effort > 0:
        raise FileError(
            f"robot file {path}: joint '{joint.name}' has no torque limit; give one (URDF: <limit effort>, "
            f"MJCF: actuatorfrcrange, or torque_limits={{'{joint.name}': ...}})"
        )
    driven.actfrclimited = True
    if joint.side:
        stiff, damp = 0.0, 5.0 * effort / joint.max_speed
        # Wheels much lighter than their servo is stiff chatter at the environment's timestep of 0.02 s.
        least = 0.01 * damp
    else:
        stiff = _STIFFNESS_PER_EFFORT * effort
        damp = 0.12 * stiff
        least = 2e-4 * stiff
    driven.armature = max(driven.armature, least)
    actuator = child.add_actuator(name=joint.name, target=joint.name, trntype=mujoco.mjtTrn.mjTRN_JOINT)
    set_servo(actuator, (stiff, damp), None)


def complete(
    child: mujoco.MjSpec,
    path: Path,
    wheels: Mapping[str, Round],
    base: WheeledBase,
    base_body: str,
    casters: tuple[str, ...],
    home: Mapping[str, float],
) -> None:
    """Apply every change but `strip` to the file, in order; warn of each. `wheels`: the driven ones by joint."""
    bottom_m = min(wheel.low_m for wheel in wheels.values())
    _fix_masses(child, path, base_body)
    hold(child, path, bottom_m, {joint.name for joint in base.joints}, casters, home)
    for name, wheel in wheels.items():
        warn(
            path,
            f"wheel '{wheel.body}' now rolls on the floor as a sphere of radius {wheel.radius_m:g} m and "
            "meets furniture as a box",
        )
        _replace_wheel(child, wheel, base_body)
        if wheel.axis[1] < 0:
            joint = child.joint(name)
            joint.axis = [-v for v in joint.axis]
    for name in casters:
        for geom in [g for g in find(child, path, "body", name).geoms if g.group == 3]:
            if geom.type not in _ROUND:
                raise FileError(f"robot file {path}: caster '{name}' is not round, expected a sphere or a cylinder")
            geom.type = _GEOM.mjGEOM_SPHERE
            geom.contype, geom.condim, geom.friction = 0, 1, [0.0, 0.0, 0.0]
    model = compiled(child, path)
    mujoco.mj_kinematics(model, data := mujoco.MjData(model))
    for geom in [g for g in child.geoms if g.contype and g.type == _GEOM.mjGEOM_BOX]:
        i, body = model.geom(geom.name).id, model.body(geom.parent.name)
        clear_m = data.geom_xpos[i, 2] - abs(data.geom_xmat[i, 6:]) @ half_extents(model, i) - bottom_m
        if clear_m < _CLEAR_M and body.weldid == model.body(base_body).id:
            warn(path, f"'{geom.name}' would drag on the floor; it is lifted by {100 * (_CLEAR_M - clear_m):.2g} cm")
            geom.pos += data.xmat[body.id].reshape(3, 3)[2] * (_CLEAR_M - clear_m)
    for geom in [g for g in child.geoms if g.group == 3 and g.type == _GEOM.mjGEOM_CYLINDER]:
        warn(path, f"cylinder '{geom.name}' now collides as four boxes, an octagon")
        _replace_cylinder(child, geom)
    # The torque at which a wheel that carries the whole robot slips.
    slip_n_m = _WHEEL_FRICTION * _G_M_S2 * float(sum(model.body_mass)) * base.wheel_radius_m
    for joint in base.joints:
        if joint.side:
            turn_freely(child.joint(joint.name), path, slip_n_m, joint.max_speed)
        add_servo(child, path, joint)
