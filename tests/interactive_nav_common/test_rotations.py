"""Rotations against SciPy's, on NumPy and JAX arrays, one or many."""

from __future__ import annotations

import math

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from interactive_nav_common import rotations

QUATS = Rotation.random(24, rng=np.random.default_rng(0)).as_quat(scalar_first=True)
VECTORS = np.random.default_rng(1).normal(size=(24, 3))


@pytest.mark.parametrize("xp", [np, jnp])
def test_quaternions_turn_as_scipys(xp):
    oracle = Rotation.from_quat(QUATS, scalar_first=True)
    quats, vectors = xp.asarray(QUATS), xp.asarray(VECTORS)
    tolerance = 1e-12 if xp is np else 1e-5
    matrices = rotations.matrix_from_quat(quats)
    assert isinstance(matrices, type(quats)) and matrices.shape == (24, 3, 3)
    np.testing.assert_allclose(matrices, oracle.as_matrix(), atol=tolerance)
    np.testing.assert_allclose(rotations.rotate(quats, vectors), oracle.apply(VECTORS), atol=tolerance)
    np.testing.assert_allclose(rotations.rotate_back(quats, vectors), oracle.inv().apply(VECTORS), atol=tolerance)
    ahead = oracle.apply([1.0, 0.0, 0.0])
    np.testing.assert_allclose(rotations.yaw_from_quat(quats), np.arctan2(ahead[:, 1], ahead[:, 0]), atol=1e-4)


def test_leading_axes_and_tracers():
    shaped = QUATS.reshape(2, 3, 4, 4)
    assert rotations.matrix_from_quat(shaped).shape == (2, 3, 4, 3, 3)
    inside = jax.jit(jax.vmap(rotations.yaw_from_quat))(jnp.asarray(shaped))
    np.testing.assert_allclose(inside, rotations.yaw_from_quat(shaped), atol=1e-4)
    assert rotations.matrix_from_quat((1.0, 0.0, 0.0, 0.0)).tolist() == np.eye(3).tolist()


def test_about_the_vertical():
    # A quarter turn takes x to y and y to -x.
    np.testing.assert_allclose(rotations.yaw_matrix(math.pi / 2) @ [1, 2, 3], [-2, 1, 3], atol=1e-15)
    assert rotations.wrap_angle(1.5 * math.pi) == pytest.approx(-0.5 * math.pi)
    assert rotations.wrap_angle(math.pi) == -math.pi
    assert rotations.wrap_angle(100.0, period_rad=90.0) == pytest.approx(10.0)
