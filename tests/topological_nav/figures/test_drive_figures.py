"""The picture of drives: every step of those that are kept, coloured by how it turned."""

from typing import Any

import matplotlib.pyplot as plt
import numpy as np
from matplotlib.collections import LineCollection

from topological_nav.drives.dataset import load_drives
from topological_nav.figures.learning import drives_figure


def test_every_kept_step_is_a_line_of_its_turning(driven, painted):
    drives = load_drives(driven)
    figure = drives_figure([painted], driven)
    axes: list[Any] = [axis for axis in figure.axes if axis.get_label() != "<colorbar>"]
    plan, *_, speeds, turns, seconds = axes
    lines = next(c for c in plan.collections if isinstance(c, LineCollection))
    kept = np.flatnonzero(drives.kept)
    assert len(lines.get_segments()) == (drives.steps[kept] - 1).sum()
    np.testing.assert_array_equal(lines.get_segments()[0], drives.pose_w[drives.rows(kept[0])][:2, :2])
    assert np.asarray(lines.get_array())[0] == drives.command[drives.rows(kept[0])][0, 1]
    assert f"{len(kept)} of {len(drives.kept)} drives kept" in plan.get_title()
    for axis in (speeds, turns, seconds):  # shares
        np.testing.assert_allclose(sum(bar.get_height() for bar in axis.patches), 1.0)
    plt.close("all")
