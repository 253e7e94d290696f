"""The order in which MJX-Warp's renderer is given the boxes, by hand."""

import jax.numpy as jnp
import numpy as np

from interactive_nav.sensing.warp import morton_codes


def test_codes_interleave_the_bits_of_both_coordinates():
    # Extent 0 to 1023 m: cells are metres. x in the even bits, y in the odd ones.
    xy = np.array([[[0, 0], [1023, 1023], [1, 0], [0, 1], [3, 5], [500, 500], [9e6, 9e6]]], float)
    hidden = np.array([[False] * 6 + [True]])
    codes = np.asarray(morton_codes(jnp.asarray(xy), jnp.asarray(hidden)))[0]
    # 3 = 011, 5 = 101: y2 x2 y1 x1 y0 x0 = 1 0 0 1 1 1.
    assert codes[:5].tolist() == [0, 2**20 - 1, 1, 2, 0b100111]
    assert codes[6] == 1 << 30 and codes[6] > codes[:6].max()  # hidden ones neither stretch the extent nor come first


def test_boxes_of_one_place_are_consecutive():
    rng = np.random.default_rng(0)
    corners = np.array([[0.0, 0.0], [0.0, 8.0], [8.0, 0.0], [8.0, 8.0]])
    room = rng.permutation(np.repeat(np.arange(4), 20))
    xy = corners[room] + rng.uniform(0, 2, (80, 2))
    order = np.argsort(np.asarray(morton_codes(jnp.asarray(xy[None]), jnp.zeros((1, 80), bool)))[0], kind="stable")
    assert np.count_nonzero(np.diff(room[order])) == 3


def test_boxes_all_in_one_place_have_one_code():
    assert len(set(np.asarray(morton_codes(jnp.full((1, 5, 2), 2.5), jnp.zeros((1, 5), bool)))[0].tolist())) == 1
