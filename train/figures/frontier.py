"""Rows of several policies in; the plane of path and effort efficiency with the planner's line out."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from interactive_nav_common.statistics import interval
from train.figures.style import panels, policy_colour


def frontier(rows: Mapping[str, Sequence[Any]], title: str) -> Figure:
    """Mean P_eff and E_eff of each policy, with 95 % intervals, and the line of the swept planner's weights.

    Args:
        rows: columns policy, path_efficiency and effort_efficiency, one entry an episode.
        title: of the figure.
    """
    names = np.asarray(rows["policy"])
    scores = {name: np.asarray(rows[name], float) for name in ("path_efficiency", "effort_efficiency")}
    figure, ((axis,),) = panels((6.4, 5.2))
    swept: list[tuple[float, float, float]] = []
    for k, policy in enumerate(dict.fromkeys(names)):
        x, y = (values[names == policy] for values in scores.values())
        bars = [np.abs(np.array(interval(n, v)) - v.mean())[:, None] for n, v in zip(scores, (x, y), strict=True)]
        kind, _, weight = policy.partition(":")
        colour = "0.25" if kind == "namo" else policy_colour(policy, k)
        axis.errorbar(x.mean(), y.mean(), bars[1], bars[0], fmt="o", color=colour, capsize=2, linewidth=0.9)
        right = kind == "namo" or x.mean() < 0.2  # the avoider's point lies close to that of w = 1
        axis.annotate(
            f"w = {float(weight):g}" if kind == "namo" else policy,
            (x.mean(), y.mean()),
            xytext=(6, 5) if right else (-6, 5),
            ha="left" if right else "right",
            textcoords="offset points",
            fontsize=8,
            color=colour,
        )
        if kind == "namo":
            swept.append((float(weight), x.mean(), y.mean()))
    if len(swept) > 1:
        line = np.array(sorted(swept))
        axis.plot(line[:, 1], line[:, 2], color="0.25", linewidth=1.2, label="NAMO planner, weight w of pushing")
        axis.legend(loc="lower left", fontsize=8)
    low_x, low_y = axis.get_xlim()[0], axis.get_ylim()[0]
    equal_ins(axis)
    axis.set_xlim(min(low_x, 0.0) if low_x < 0.2 else low_x, 1.12)
    axis.set_ylim(low_y, 1.02)
    axis.set_xlabel("P$_{eff}$: shortest path over path driven, 0 on failure")
    axis.set_ylabel("E$_{eff}$: effort efficiency")
    axis.set_title(f"{title}\ngrey: equal INS$_{{0.5}}$, steps of 0.1", fontsize=9)
    return figure


def equal_ins(axis: Axes, step: float = 0.1) -> None:
    """Lines of equal INS_0.5."""
    p = np.array([-1.0, 2.0])
    for level in np.arange(step, 1.0, step):
        axis.plot(p, 2 * level - p, color="0.85", linewidth=0.7, zorder=0)
