"""Pose, velocity and path in, the flat observation out, in the original benchmark's order.

Layout (reference benchmark, section 1.1), robot frame, full roll-pitch-yaw inverse, no clipping:

| slice | content | unit |
|---|---|---|
| 0-19 | ten waypoints x0, y0, ..., x9, y9 | m |
| 20-22 | goal minus robot position x, y, z | m |
| 23-25 | base linear velocity | m/s |
| 26-28 | base angular velocity | rad/s |
"""

from __future__ import annotations

import jax
import jax.numpy as jnp


def rotation_from_quat(quat: jax.Array) -> jax.Array:
    """(..., 4) w x y z -> (..., 3, 3), the body's axes as columns."""
    w, x, y, z = jnp.moveaxis(quat, -1, 0)
    rows = [
        [1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y)],
        [2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x)],
        [2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y)],
    ]
    return jnp.stack([jnp.stack(r, -1) for r in rows], -2)


def parts(num_waypoints: int) -> dict[str, int]:
    """Sizes of the observation's parts, in the vector's order."""
    return {"waypoints": 2 * num_waypoints, "goal": 3, "velocity": 6}


def waypoints_in_body(waypoints_w: jax.Array, pos_w: jax.Array, rotation: jax.Array) -> jax.Array:
    """World waypoints (W, 2), lifted to the robot's own height, in the robot's frame (W, 2)."""
    offset = jnp.concatenate([waypoints_w - pos_w[:2], jnp.zeros((waypoints_w.shape[0], 1))], -1)
    return (offset @ rotation)[:, :2]


def observe(
    which: tuple[str, ...],
    pos_w: jax.Array,
    rotation: jax.Array,
    linear_velocity_w: jax.Array,
    angular_velocity_b: jax.Array,
    goal_xy_w: jax.Array,
    waypoints_b: jax.Array,
) -> jax.Array:
    """The observation vector of one environment.

    Args:
        which: parts to include; their order in the vector is fixed.
        pos_w: (3,) base position, m.
        rotation: (3, 3) base axes as columns.
        linear_velocity_w: (3,) m/s.
        angular_velocity_b: (3,) rad/s, base frame (as MuJoCo's free joint has it).
        goal_xy_w: (2,) m; the goal lies on the floor, z = 0.
        waypoints_b: (W, 2) m.

    Returns:
        (n,) f32.
    """
    goal_w = jnp.concatenate([goal_xy_w, jnp.zeros(1)])
    values = {
        "waypoints": waypoints_b.reshape(-1),
        "goal": (goal_w - pos_w) @ rotation,
        "velocity": jnp.concatenate([linear_velocity_w @ rotation, angular_velocity_b]),
    }
    return jnp.concatenate([values[name] for name in values if name in which])
