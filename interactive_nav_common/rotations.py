"""Compute rotations with NumPy or JAX: quaternions w x y z, angles in rad, matrices with the body's axes as columns."""

import math
from typing import Any

import numpy as np

Array = Any
"""A NumPy or JAX array, or a number."""
Y_UP_TO_Z_UP = np.array([[1.0, 0.0, 0.0], [0.0, 0.0, -1.0], [0.0, 1.0, 0.0]])
"""Turns a y-up vector into a z-up one: x stays, y becomes z, z becomes -y."""


def namespace(*values: Array) -> Any:
    """Return `jax.numpy` when any value is a JAX array or tracer, else `numpy`."""
    spaces = {v.__array_namespace__() for v in values if hasattr(v, "__array_namespace__")} - {np}
    return spaces.pop() if spaces else np


def matrix_from_quat(quat: Array) -> Array:
    """Return the matrices [..., 3, 3] of unit quaternions [..., 4]."""
    xp = namespace(quat)
    w, x, y, z = xp.moveaxis(xp.asarray(quat), -1, 0)
    rows = [
        [1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y)],
        [2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x)],
        [2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y)],
    ]
    return xp.stack([xp.stack(r, -1) for r in rows], -2)


def yaw_from_quat(quat: Array) -> Array:
    """Return the heading [...] of the body's x axis of unit quaternions [..., 4]."""
    xp = namespace(quat)
    w, x, y, z = xp.moveaxis(xp.asarray(quat), -1, 0)
    return xp.arctan2(2 * (w * z + x * y), 1 - 2 * (y * y + z * z))


def apply_axes(axes: Array, vector: Array) -> Array:
    """Return [..., 3, 3] times [..., 3]: a sum, as GPUs may round a matmul to TF32."""
    return (axes * vector[..., None, :]).sum(-1)


def compose(first: Array, second: Array) -> Array:
    """Return [..., 3, 3] times [..., 3, 3]."""
    return (first[..., :, :, None] * second[..., None, :, :]).sum(-2)


def swing(axis: Array, anchor_m: Array, angle_rad: Array) -> tuple[Array, Array]:
    """Return a hinged body's frame in its rest frame: place [..., 3], m, and axes [..., 3, 3].

    `axis` (a unit) and `anchor_m`, [..., 3], are in its frame; `angle_rad` is [...].
    """
    half, xp = 0.5 * angle_rad[..., None], namespace(angle_rad)
    turned = matrix_from_quat(xp.concatenate([xp.cos(half), xp.sin(half) * axis], -1))
    return anchor_m - apply_axes(turned, anchor_m), turned


def rotate(quat: Array, vector: Array) -> Array:
    """Return vectors [..., 3] of a body with unit quaternion [..., 4] in the world frame."""
    xp = namespace(quat, vector)
    w, axis = quat[..., :1], quat[..., 1:]
    t = 2.0 * xp.cross(axis, vector)
    return vector + w * t + xp.cross(axis, t)


def rotate_back(quat: Array, vector: Array) -> Array:
    """Return world vectors [..., 3] in the frame of a body with unit quaternion [..., 4]."""
    xp = namespace(quat, vector)
    return rotate(xp.concatenate([quat[..., :1], -quat[..., 1:]], -1), vector)


def yaw_matrix(yaw_rad: float) -> np.ndarray:
    """Return the [3, 3] rotation about z."""
    c, s = math.cos(yaw_rad), math.sin(yaw_rad)
    return np.array([[c, -s, 0.0], [s, c, 0.0], [0.0, 0.0, 1.0]])


def transform(matrix: np.ndarray, position: Any = 0.0) -> np.ndarray:
    """Return the [4, 4] of a [3, 3] matrix, after which points move by a position [3]."""
    result = np.eye(4)
    result[:3, :3], result[:3, 3] = matrix, position
    return result


def transformed(points: np.ndarray, matrix: np.ndarray) -> np.ndarray:
    """Return points [n, 3] after a [4, 4]."""
    return points @ matrix[:3, :3].T + matrix[:3, 3]


def scale_sides(linear: Array, angular: Array, left: Array, right: Array, half_width_m: float) -> tuple[Array, Array]:
    """Return a base's velocity [...], m/s and rad/s, with the speeds of its left and right side scaled."""
    left, right = left * (linear - half_width_m * angular), right * (linear + half_width_m * angular)
    return (left + right) / 2, (right - left) / (2 * half_width_m)


def wrap_angle(angle_rad: Array, period_rad: float = 2 * math.pi) -> Array:
    """Return the angles wrapped to [-period/2, period/2)."""
    return (angle_rad + period_rad / 2) % period_rad - period_rad / 2
