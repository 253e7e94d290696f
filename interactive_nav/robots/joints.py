"""Prepare the joints of a user's robot: wheels turn without limits, driven joints get servos, the others are held."""

from collections.abc import Mapping
from pathlib import Path

import mujoco
import numpy as np

from interactive_nav.robots.build import Joint, half_extents
from interactive_nav.robots.files import compiled, warn
from interactive_nav.robots.spec import set_servo
from interactive_nav_common.errors import FileError

_STIFFNESS_PER_EFFORT = 10.0
"""Position servo of a joint: its torque limit is reached at an error of 0.1 rad (m)."""
FLOOR_M = 0.02
"""A wheel of a joint that nothing drives rolls on the floor when it comes this near to it."""


def place(body, pos, quat) -> None:
    """Set a body's pose in its parent's frame."""
    body.alt.type = mujoco.mjtOrientation.mjORIENTATION_QUAT
    body.pos, body.quat = pos, quat


def turn_freely(joint, path: Path, slip_n_m: float) -> None:
    """Take a driven wheel's position limits away, and bound its torque by that of a wheel that carries the robot."""
    if joint.limited and joint.range[0] < joint.range[1]:
        warn(path, f"wheel joint '{joint.name}' has position limits {joint.range.tolist()}; it turns without")
    joint.limited, joint.range = False, [0, 0]
    if joint.actfrcrange[1] > slip_n_m:
        warn(
            path,
            f"wheel joint '{joint.name}' has a torque limit of {joint.actfrcrange[1]:g} N m; bounded to "
            f"{slip_n_m:.3g} N m, at which a wheel that carries the whole robot slips",
        )
        joint.actfrcrange = [-slip_n_m, slip_n_m]


def _height_m(model: mujoco.MjModel, data: mujoco.MjData, geom: int) -> float:
    """Return half the height of the geom's box."""
    return float(np.abs(data.geom_xmat[geom, 6:]) @ half_extents(model, geom))


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
        body = model.body(joint.parent.name).id
        below = {body}
        for other in range(body + 1, model.nbody):  # children come after their parents
            if parents[other] in below:
                below.add(other)
        geoms = [g for g in range(model.ngeom) if model.geom_bodyid[g] in below and model.geom_group[g] == 3]
        lowest = min((data.geom_xpos[g, 2] - _height_m(model, data, g) for g in geoms), default=np.inf)
        on_floor = joint.type == hinge and not model.jnt_limited[model.joint(joint.name).id]
        on_floor = on_floor and lowest < bottom_m + FLOOR_M
        if on_floor or any(model.body(name).id in below for name in casters):
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
    if driven.armature < least:
        driven.armature = least
    actuator = child.add_actuator(name=joint.name, target=joint.name, trntype=mujoco.mjtTrn.mjTRN_JOINT)
    set_servo(actuator, (stiff, damp), None)
