"""Homes made of parts: which level faces show, however many lie on one another."""

from __future__ import annotations

import tracemalloc

import numpy as np
import pytest

from converters.read.homes.parts import _shown


def sheets(*boxes: tuple[float, float, float, float, float]) -> tuple[np.ndarray, np.ndarray]:
    """Level rectangles (x0, y0, x1, y1, z), two triangles each."""
    vertices = [(x, y, z) for x0, y0, x1, y1, z in boxes for x, y in ((x0, y0), (x1, y0), (x1, y1), (x0, y1))]
    faces = [(4 * k + a, 4 * k + b, 4 * k + c) for k in range(len(boxes)) for a, b, c in ((0, 1, 2), (0, 2, 3))]
    return np.array(vertices, float), np.array(faces)


@pytest.mark.parametrize(
    ("above", "shows"),
    [
        ((0, 0, 4, 3, 0.2), False),  # a floor on its slab
        ((0, 0, 4, 3, 0.4), True),  # a table's top
        ((0, 0, 4, 3, 0.001), True),  # the same level, drawn twice
        ((0, 0, 1, 3, 0.2), True),  # a step hides a quarter
        ((4, 0, 8, 3, 0.2), True),  # beside it
    ],
)
def test_a_slab_under_a_floor_is_not_shown(above, shows):
    vertices, faces = sheets((0, 0, 4, 3, 0.0), above)
    assert (_shown(vertices, faces) < 4).all(axis=1).any() == shows


@pytest.mark.parametrize("step", [0.0, 1.2e-4, 0.02])
def test_thousands_of_level_faces_take_little_memory(step):
    """Pairs of them would be 36 million."""
    vertices, faces = sheets(*((0.0, 0.0, 6.0, 6.0, k * step) for k in range(3000)))
    tracemalloc.start()
    shown = _shown(vertices, faces)
    peak = tracemalloc.get_traced_memory()[1]
    tracemalloc.stop()
    assert {float(z) for z in vertices[shown, 2].ravel()} == {
        float(z) for z in vertices[:, 2] if z > 2999 * step - 0.005
    }
    assert peak < 120e6
