"""Compute the pose of a robot's camera from the robot's state."""

import dataclasses
import math

import jax
import jax.numpy as jnp
import mujoco
import numpy as np

from interactive_nav.robots.spec import RobotCamera
from interactive_nav.sensing.base import CameraPose, look_along
from interactive_nav.sensing.boxes import Links, apply_axes, make_links
from interactive_nav_common.config import nearest
from interactive_nav_common.errors import ConfigError


@dataclasses.dataclass(frozen=True)
class Mount:
    """A camera fixed to a body of the robot: its base, or a link that hinges and slides carry."""

    links: Links
    """From the base to that body."""
    pos_b: np.ndarray
    """(3,) of the camera in its body's frame, m."""
    forward_b: np.ndarray
    """(3,)."""

    def pose(self, qpos: jax.Array) -> CameraPose:
        """Return the camera's pose, without roll, for qpos [..., nq]."""
        pos, axes = self.links.frames(qpos)[-1]

        def constant(value: np.ndarray) -> jax.Array:
            return jnp.broadcast_to(jnp.asarray(value, qpos.dtype), (*qpos.shape[:-1], *value.shape))

        where = pos + apply_axes(axes, constant(self.pos_b))
        return look_along(where, apply_axes(axes, constant(self.forward_b)))


def make_mount(model: mujoco.MjModel, base_body: str, camera: RobotCamera, yaw_rad: float = 0.0) -> Mount:
    """Find the chain of bodies from a robot's base to its camera.

    Args:
        camera: its body lies in the base's subtree.
        yaw_rad: how far it looks to the left of its body's x axis.
    """
    base, body = (mujoco.mj_name2id(model, mujoco.mjtObj.mjOBJ_BODY, n) for n in (base_body, camera.body))
    names = [model.body(b).name for b in range(model.nbody) if model.body_rootid[b] == base]
    if body < 0 or model.body_rootid[body] != base:
        raise ConfigError(
            f"camera body {camera.body!r} is no body of the robot{nearest(camera.body, names)}; "
            f"its bodies: {', '.join(names)}"
        )
    chain = [body]
    while chain[0] != base:
        chain.insert(0, int(model.body_parentid[chain[0]]))
    cos = math.cos(camera.pitch_rad)
    return Mount(
        links=make_links(model, chain),
        pos_b=np.asarray(camera.pos_m, float),
        forward_b=np.array([cos * math.cos(yaw_rad), cos * math.sin(yaw_rad), -math.sin(camera.pitch_rad)]),
    )
