"""What stands for what in every figure: colours that colour-blind readers tell apart, markers that greyscale keeps.

Colours are Okabe and Ito's (2008). An algorithm is a colour and a marker, k_int a fill and a line style.
"""

from __future__ import annotations

import contextlib
from collections.abc import Iterator
from typing import Any

import matplotlib

matplotlib.use("Agg")
import matplotlib.pyplot as plt
from matplotlib.lines import Line2D

BLUE, ORANGE, GREEN, PINK, SKY, VERMILION = "#0072b2", "#e69f00", "#009e73", "#cc79a7", "#56b4e9", "#d55e00"
ALGORITHMS = {"ppo": (BLUE, "o"), "sac": (VERMILION, "s"), "ddpg": (GREEN, "^")}
ROBOTS = {"turtlebot": (BLUE, "o"), "fetch": (VERMILION, "s")}
POLICIES = {"learned": BLUE, "follower": GREEN, "random": PINK, "avoider": VERMILION}
SPARE = ((PINK, "D"), (ORANGE, "v"), (SKY, "P"), ("0.3", "X"))
FILLS = ("none", "left", "full")
LINES: tuple[Any, ...] = (":", "--", "-", "-.")
P_LABEL, E_LABEL = "P$_{eff}$ (SPL)", "E$_{eff}$"
RC: dict[Any, Any] = {
    "font.size": 9,
    "axes.titlesize": 9,
    "axes.labelsize": 9,
    "legend.fontsize": 8,
    "xtick.labelsize": 8,
    "ytick.labelsize": 8,
    "axes.spines.top": False,
    "axes.spines.right": False,
    "axes.grid": True,
    "grid.color": "0.9",
    "grid.linewidth": 0.6,
    "axes.axisbelow": True,
    "legend.frameon": False,
    "savefig.dpi": 200,
}


@contextlib.contextmanager
def applied() -> Iterator[None]:
    """Draws in this style."""
    with plt.rc_context(RC):
        yield


def look(kind: dict[str, tuple[str, str]], name: str, among: list[str]) -> tuple[str, str]:
    """Colour and marker of an algorithm or robot; what has none of its own gets a spare one."""
    if name in kind:
        return kind[name]
    others = [other for other in among if other not in kind]
    return SPARE[others.index(name) % len(SPARE)]


def in_order(algorithms: set[str]) -> list[str]:
    """As the paper names them, others after."""
    return sorted(algorithms, key=lambda name: (list(ALGORITHMS).index(name) if name in ALGORITHMS else 99, name))


def fill_of(k_int: float, among: list[float]) -> Any:
    """Marker fill: the higher k_int, the fuller."""
    place = sorted(among).index(k_int)
    if len(among) == 1:
        return "full"
    return FILLS[round(place * (len(FILLS) - 1) / (len(among) - 1))]


def line_of(k_int: float, among: list[float]) -> Any:
    """Line style: the higher k_int, the more solid."""
    place = sorted(among).index(k_int)
    return LINES[2] if len(among) == 1 else LINES[min(place, 3)] if len(among) <= 3 else LINES[place % 4]


def look_of(k_int: float, among: list[float]) -> dict[str, Any]:
    """Marker fill and line style of a k_int."""
    return {"fillstyle": fill_of(k_int, among), "linestyle": line_of(k_int, among)}


def algorithm_handles(algorithms: list[str], markersize: float = 5) -> list[Line2D]:
    """For a legend."""
    looks = {algorithm: look(ALGORITHMS, algorithm, algorithms) for algorithm in algorithms}
    return [
        Line2D([], [], color=colour, marker=marker, markersize=markersize, label=name_of(algorithm))
        for algorithm, (colour, marker) in looks.items()
    ]


def k_int_handles(k_ints: list[float], markersize: float = 5) -> list[Line2D]:
    """For a legend."""
    grey = {"color": "0.3", "marker": "o", "markersize": markersize}
    return [Line2D([], [], label=f"k$_{{int}}$ = {k:g}", **grey, **look_of(k, k_ints)) for k in k_ints]


def policy_colour(policy: str, index: int) -> str:
    """Of a policy in trajectories and frontiers."""
    return POLICIES.get(policy, (BLUE, VERMILION, GREEN, PINK, ORANGE, SKY)[index % 6])


def name_of(algorithm: str) -> str:
    """As papers write it."""
    return algorithm.upper()


def robot_name(robot: str) -> str:
    """As papers write it."""
    return {"turtlebot": "TurtleBot", "fetch": "Fetch"}.get(robot, robot)


def seeds_text(counts: set[int]) -> str:
    """ "3 seeds", or "1-3 seeds" where cells differ."""
    numbers = sorted({min(counts), max(counts)}) if counts else [0]
    return "-".join(str(n) for n in numbers) + (" seed" if numbers == [1] else " seeds")
