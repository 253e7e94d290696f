"""Compute the flat observation from pose, velocity, path and other signals, in the original benchmark's order.

By default (reference benchmark, section 1.1) ten waypoints x0, y0, ..., x9, y9, m, and goal minus robot position, m;
then the base's linear and angular velocity, m/s and rad/s: robot frame, full roll-pitch-yaw inverse, no clipping. Then,
where requested: localisation, odometry, collision, joints, lidar, hand (`docs/sensors.md`).
"""

import jax
import jax.numpy as jnp


def waypoints_in_body(waypoints_w: jax.Array, pos_w: jax.Array, rotation: jax.Array) -> jax.Array:
    """Return world waypoints (W, 2), lifted to the robot's height, in the robot's frame (W, 2)."""
    offset = jnp.concatenate([waypoints_w - pos_w[None, :2], jnp.zeros((waypoints_w.shape[0], 1))], -1)
    return (offset @ rotation)[:, :2]


def task_observation(
    pos_w: jax.Array,
    rotation: jax.Array,
    linear_velocity_w: jax.Array,
    angular_velocity_b: jax.Array,
    goal_xy_w: jax.Array,
    waypoints_b: jax.Array,
) -> dict[str, jax.Array]:
    """Return the task's parts of one environment's observation, name -> (n,) f32, in the vector's order.

    `pos_w` (3,) m, `rotation` (3, 3) base axes as columns, `linear_velocity_w` (3,) m/s, `angular_velocity_b` (3,)
    rad/s, `goal_xy_w` (2,) m on the floor z = 0, `waypoints_b` (W, 2) m.
    """
    goal_w = jnp.concatenate([goal_xy_w, jnp.zeros(1)])
    return {
        "waypoints": waypoints_b.reshape(-1),
        "goal": (goal_w - pos_w) @ rotation,
        "velocity": jnp.concatenate([linear_velocity_w @ rotation, angular_velocity_b]),
    }


def advance_odometry(
    pose: jax.Array, moved_w: jax.Array, yaw_rad: jax.Array, turned_rad: jax.Array, noise: jax.Array
) -> jax.Array:
    """Advance the dead reckoning `pose` (3,) x, y (m), yaw (rad, not wrapped) by one control step.

    It is relative to the episode's start. `moved_w` (2,) m is the true displacement, `noise` (2,) the relative error of
    distance and angle.
    """
    cos, sin = jnp.cos(pose[2] - yaw_rad), jnp.sin(pose[2] - yaw_rad)
    x, y = moved_w * (1 + noise[0])
    return pose + jnp.stack([cos * x - sin * y, sin * x + cos * y, turned_rad * (1 + noise[1])])
