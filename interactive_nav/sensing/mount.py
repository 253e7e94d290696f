"""Robot state in, pose of its camera out."""

from __future__ import annotations

import dataclasses
import math

import jax
import jax.numpy as jnp
import mujoco
import numpy as np

from interactive_nav.robots.spec import RobotCamera
from interactive_nav.sensing.base import CameraPose, look_along
from interactive_nav.sensing.boxes import compose, rotate, swing
from interactive_nav_common.config import nearest
from interactive_nav_common.errors import ConfigError
from interactive_nav_common.rotations import matrix_from_quat


@dataclasses.dataclass(frozen=True)
class _Link:
    pos: np.ndarray
    axes: np.ndarray
    joints: tuple[tuple[bool, int, float, np.ndarray, np.ndarray], ...]
    """(slides, address in qpos, qpos0, axis, anchor) in order."""


@dataclasses.dataclass(frozen=True)
class Mount:
    """A camera fixed to a body of the robot: its base, or a link that hinges and slides carry."""

    base_qpos: int
    links: tuple[_Link, ...]
    pos_b: np.ndarray
    """(3,) of the camera in its body's frame, m."""
    forward_b: np.ndarray
    """(3,)."""

    def pose(self, qpos: jax.Array) -> CameraPose:
        """The camera's pose, without roll.

        Args:
            qpos: [..., nq].
        """
        at = self.base_qpos

        def constant(value: np.ndarray) -> jax.Array:
            return jnp.broadcast_to(jnp.asarray(value, qpos.dtype), (*qpos.shape[:-1], *value.shape))

        pos, axes = qpos[..., at : at + 3], matrix_from_quat(qpos[..., at + 3 : at + 7])
        for link in self.links:
            pos = pos + rotate(axes, constant(link.pos))
            axes = compose(axes, constant(link.axes))
            for slides, address, zero, axis, anchor in link.joints:
                value, axis = qpos[..., address] - zero, constant(axis)
                if slides:
                    pos = pos + rotate(axes, axis) * value[..., None]
                    continue
                arm, turn = swing(axis, constant(anchor), value)
                pos = pos + rotate(axes, arm)
                axes = compose(axes, turn)
        where = pos + rotate(axes, constant(self.pos_b))
        return look_along(where, rotate(axes, constant(self.forward_b)))


def make_mount(model: mujoco.MjModel, base_body: str, camera: RobotCamera, yaw_rad: float = 0.0) -> Mount:
    """Finds the chain of bodies from a robot's base to its camera.

    Args:
        model: with the robot.
        base_body: the body with the free joint.
        camera: its body lies in the base's subtree.
        yaw_rad: how far it looks to the left of its body's x axis.

    Raises:
        ConfigError: no such body, or one that is not part of the robot.
    """
    base, body = (mujoco.mj_name2id(model, mujoco.mjtObj.mjOBJ_BODY, n) for n in (base_body, camera.body))
    own = [model.body(b).name for b in range(model.nbody) if model.body_rootid[b] == base]
    if body < 0 or model.body_rootid[body] != base:
        raise ConfigError(
            f"camera body {camera.body!r} is no body of the robot{nearest(camera.body, own)}; "
            f"its bodies: {', '.join(own)}"
        )
    links = []
    while body != base:
        joints = []
        first = model.body_jntadr[body]
        for j in range(first, first + model.body_jntnum[body]):
            slides = model.jnt_type[j] == mujoco.mjtJoint.mjJNT_SLIDE
            address = int(model.jnt_qposadr[j])
            zero = float(model.qpos0[address])
            joints.append((bool(slides), address, zero, model.jnt_axis[j].copy(), model.jnt_pos[j].copy()))
        links.append(_Link(model.body_pos[body].copy(), matrix_from_quat(model.body_quat[body]), tuple(joints)))
        body = model.body_parentid[body]
    cos = math.cos(camera.pitch_rad)
    return Mount(
        base_qpos=int(model.jnt_qposadr[model.body_jntadr[base]]),
        links=tuple(reversed(links)),
        pos_b=np.asarray(camera.pos_m, float),
        forward_b=np.array([cos * math.cos(yaw_rad), cos * math.sin(yaw_rad), -math.sin(camera.pitch_rad)]),
    )
