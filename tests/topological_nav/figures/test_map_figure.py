"""A map's picture: its bar, its numbers, its route."""

from __future__ import annotations

from types import SimpleNamespace
from typing import Any

import matplotlib.pyplot as plt
import numpy as np
from matplotlib.collections import LineCollection

from topological_nav.figures.maps import Driven, map_figure
from topological_nav.scenes.space import FreeSpace


def built() -> Any:
    """Four nodes in an empty room of 6 x 4 m, two of them a hand apart."""
    xy_w = np.array([[1.0, 1.0], [3.0, 1.0], [3.1, 1.0], [5.0, 3.0]])
    edges = np.array([[0, 1], [1, 0], [1, 3], [2, 3]])
    made = SimpleNamespace(scene="room", xy_w=xy_w, edges=edges, p=np.array([0.9, 0.8, 0.1, 0.5]), room=np.arange(4))
    return SimpleNamespace(map=made, space=FreeSpace(np.ones((40, 60)), 0.1, (0.0, 0.0)))


def test_a_map_has_a_bar_numbers_apart_and_its_route():
    there = built()
    axis, scale = map_figure(there.space, [there.map], [0, 1, 3]).axes  # type: ignore[arg-type]
    assert [text.get_text() for text in axis.texts] == ["2 m", "0", "1", "3"]
    bar, route = axis.lines
    ends = np.asarray(bar.get_xdata(), float)
    np.testing.assert_allclose(ends - axis.get_xlim()[0], [0.2, 2.2])  # not at the edge, where a film cuts it off
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


def test_a_film_shows_where_the_robot_is_and_the_camera_s_image_beside_the_plan():
    there, steps = built(), 11
    venue = SimpleNamespace(
        space=there.space,
        contest=SimpleNamespace(config=SimpleNamespace(passable=0.5)),
        scene=SimpleNamespace(name="room"),
        player=SimpleNamespace(env=SimpleNamespace(dt=0.1)),
    )
    xy_w = np.stack([np.linspace(1.0, 5.0, steps), np.full(steps, 2.0)], -1)
    episode = SimpleNamespace(goal_xy_w=np.array([[5.0, 3.0]]))
    moment, views = 0.1 * np.arange(steps), {10: np.full((30, 40, 3), 77, np.uint8)}
    yaw_rad = np.full(steps, np.pi)
    state: Any = venue, there.map, episode, None, 3, moment, xy_w, yaw_rad, np.zeros(steps, int), views, np.zeros(0), []
    first, _, last = Driven(*state).frames()
    assert (last[:, len(last[0]) - 640 :] == 77).all()  # 480 pixels high, as the plan, and 4 : 3
    np.testing.assert_array_equal(np.shape(first), (480, len(last[0]) - 640, 3))
    for frame, (x, y) in ((first, xy_w[0]), (last[:, :-640], xy_w[10])):
        red = np.asarray((np.abs(frame - np.array([0xD5, 0x5E, 0x00])) < 3).all(-1))
        rows, columns = np.nonzero(red)
        # The plan spans 6.7 x 5.3 m, with half a metre for the bar below; the line ahead reaches to the left.
        middle_x, middle_y = columns.max() / red.shape[1], np.median(rows) / red.shape[0]
        assert abs(middle_x - (x + 0.35) / 6.7) < 0.02 and abs(middle_y - (4.35 - y) / 5.3) < 0.02
