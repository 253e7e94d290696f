"""A map's picture: its bar, its numbers, its route."""

from __future__ import annotations

from types import SimpleNamespace
from typing import Any

import matplotlib.pyplot as plt
import numpy as np
from matplotlib.collections import LineCollection

from topological_nav.figures.maps import map_figure
from topological_nav.scenes.space import FreeSpace


def built() -> Any:
    """Four nodes in an empty room of 6 x 4 m, two of them a hand apart."""
    xy_w = np.array([[1.0, 1.0], [3.0, 1.0], [3.1, 1.0], [5.0, 3.0]])
    edges = np.array([[0, 1], [1, 0], [1, 3], [2, 3]])
    made = SimpleNamespace(scene="room", xy_w=xy_w, edges=edges, p=np.array([0.9, 0.8, 0.1, 0.5]), room=np.arange(4))
    return SimpleNamespace(map=made, space=FreeSpace(np.ones((40, 60)), 0.1, (0.0, 0.0)))


def test_a_map_has_a_bar_numbers_apart_and_its_route():
    there, route = built(), SimpleNamespace(nodes=(0, 1, 3), cost=1.0)
    axis, scale = map_figure(there.space, [there.map], route).axes  # type: ignore[arg-type]
    assert [text.get_text() for text in axis.texts] == ["2 m", "0", "1", "3"]
    bar, route = axis.lines
    assert np.ptp(np.asarray(bar.get_xdata(), float)) == 2.0
    np.testing.assert_array_equal(np.asarray(route.get_xydata()), [[1, 1], [3, 1], [5, 3]])
    assert scale.get_xlabel() == "probability that the way is free"
    low, high = axis.get_ylim()
    assert low < np.asarray(bar.get_ydata(), float)[0] < 0.0 < 4.0 < high
    plt.close("all")


def test_two_maps_stand_side_by_side():
    there = built()
    sparse = SimpleNamespace(**{**vars(there.map), "edges": there.map.edges[:1], "p": there.map.p[:1]})
    axes: Any = map_figure(there.space, [there.map, sparse]).axes  # type: ignore[list-item]
    titles = [axis.get_title() for axis in axes[:2]]
    assert titles == ["room: 4 nodes, 4 directed edges", "room: 4 nodes, 1 directed edges"]
    # The surest are drawn last; each edge reaches half of the way.
    (ways,) = (c for c in axes[0].collections if isinstance(c, LineCollection))
    assert np.asarray(ways.get_array()).tolist() == [0.1, 0.5, 0.8, 0.9]
    np.testing.assert_array_equal(ways.get_segments()[-1], [[1, 1], [2, 1]])
    plt.close("all")
