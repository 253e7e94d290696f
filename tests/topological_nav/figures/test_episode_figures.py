"""Pictures of few episodes and of thousands."""

import numpy as np
import pytest
from matplotlib.collections import LineCollection
from matplotlib.colors import to_rgb

from interactive_nav.scenes.scene import load_scene
from topological_nav.figures.maps import FEW, LOST, WON, journeys_figure
from topological_nav.scenes.space import free_space


def drawn(room, count):
    """Colour -> paths, opacity and markers of so many episodes, every tenth of them lost."""
    rng = np.random.default_rng(0)
    tracks = {i: rng.uniform(-1, 1, (5, 2)) for i in range(count)}
    ends = {f"{end}_{x}_w": 0.0 for end in ("start", "goal") for x in "xy"}
    rows = {i: {"success": float(i % 10 != 0), **ends} for i in range(count)}
    figure = journeys_figure("room", free_space(load_scene(room), 0.4), {"dense": (None, tracks, rows)}, 0.5)
    axis = figure.axes[0]
    ways = {}
    for lines in (c for c in axis.collections if isinstance(c, LineCollection)):
        (colour,) = (c for c in (WON, LOST) if np.allclose(np.asarray(lines.get_colors())[0, :3], to_rgb(c)))
        ways[colour] = len(lines.get_segments()), lines.get_alpha()
    marks = {c: [len(np.asarray(m.get_xdata())) for m in axis.lines if m.get_color() == c] for c in (WON, LOST)}
    return ways, marks, axis.get_title()


def test_of_few_episodes_every_end_is_shown(room):
    ways, marks, title = drawn(room, 20)
    assert ways == {WON: (18, 0.65), LOST: (2, 0.65)}
    assert marks == {WON: [18, 18], LOST: [2, 2]}
    assert title == "room, dense: 18 of 20 reached (blue; red: not)\n● start, ★ goal"


def test_thousands_lie_thinly_over_each_other_and_the_lost_stand_out(room):
    ways, marks, title = drawn(room, 2000)
    assert ways[WON] == (1800, pytest.approx(40 / 1800)) and ways[LOST] == (200, pytest.approx(0.2))
    assert marks == {WON: [0, 0], LOST: [200, 200]}
    assert title == "room, dense: 1,800 of 2,000 reached (blue; red: not)\n● start, ★ goal of the others"
    assert drawn(room, FEW)[1] == {WON: [90, 90], LOST: [10, 10]}
