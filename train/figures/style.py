"""What stands for what in every figure: colours that colour-blind readers tell apart, markers that greyscale keeps.

Colours are Okabe and Ito's (2008). An algorithm is a colour and a marker, k_int a fill and a line style.
"""

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import matplotlib
import numpy as np

from interactive_nav_common.files import whole_file
from interactive_nav_common.records import read_packaged
from interactive_nav_common.statistics import Estimate
from scenes_mjcf.robot_facts import title

matplotlib.use("Agg")
import matplotlib.pyplot as plt
from matplotlib.artist import Artist
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.lines import Line2D

BLUE, ORANGE, GREEN, PINK, SKY, VERMILION = "#0072b2", "#e69f00", "#009e73", "#cc79a7", "#56b4e9", "#d55e00"
ALGORITHMS = {"ppo": (BLUE, "o"), "sac": (VERMILION, "s"), "ddpg": (GREEN, "^")}
ROBOTS = {"turtlebot": (BLUE, "o"), "fetch": (VERMILION, "s")}
POLICIES = {"learned": BLUE, "follower": GREEN, "random": PINK, "avoider": VERMILION}
SPARE = ((PINK, "D"), (ORANGE, "v"), (SKY, "P"), ("0.3", "X"))
FILLS = ("none", "left", "full")
LINES: tuple[Any, ...] = (":", "--", "-", "-.")
ANY = (-np.inf, np.inf)
P_LABEL, E_LABEL = "P$_{eff}$ (SPL)", "E$_{eff}$"
RC: dict[Any, Any] = read_packaged(Path(__file__).with_suffix(".yaml"), dict[str, Any])
"""What `plt.rc_context` takes to draw in this style."""


def look(kind: dict[str, tuple[str, str]], name: str, among: list[str]) -> dict[str, Any]:
    """Colour and marker of an algorithm or robot; what has none of its own gets a spare one."""
    others = [other for other in among if other not in kind]
    colour, marker = kind[name] if name in kind else SPARE[others.index(name) % len(SPARE)]
    return {"color": colour, "marker": marker}


def in_order(algorithms: set[str]) -> list[str]:
    """As the paper names them, others after."""
    return sorted(algorithms, key=lambda name: (list(ALGORITHMS).index(name) if name in ALGORITHMS else 99, name))


Cell = tuple[str, str, float]
"""Robot, algorithm, k_int."""


class Looks:
    """What stands for what in a figure of some cells."""

    def __init__(self, cells: Mapping[Cell, Sequence[Any]]):
        self.robots = sorted({robot for robot, _, _ in cells}, reverse=True)
        self.algorithms = in_order({algorithm for _, algorithm, _ in cells})
        self.k_ints = sorted({k_int for _, _, k_int in cells})
        self.seeds = seeds_text({len(runs) for runs in cells.values()})

    def algorithm(self, name: str) -> dict[str, Any]:
        """Colour and marker."""
        return look(ALGORITHMS, name, self.algorithms)

    def robot(self, name: str) -> dict[str, Any]:
        """Colour and marker."""
        return look(ROBOTS, name, self.robots)

    def fill(self, k_int: float) -> Any:
        """Marker fill of a k_int: the higher, the fuller."""
        last = len(self.k_ints) - 1
        return FILLS[round(self.k_ints.index(k_int) * (len(FILLS) - 1) / last)] if last else "full"

    def line(self, k_int: float) -> Any:
        """Line style of a k_int: the higher, the more solid."""
        return LINES[self.k_ints.index(k_int) % len(LINES)] if len(self.k_ints) > 1 else "-"

    def k_int(self, k_int: float) -> dict[str, Any]:
        """Marker fill and line style."""
        return {"fillstyle": self.fill(k_int), "linestyle": self.line(k_int)}

    def algorithm_handles(self, **more: Any) -> list[Line2D]:
        """For a legend."""
        return [handle(name_of(name), **{**self.algorithm(name), **more}) for name in self.algorithms]

    def robot_handles(self) -> list[Line2D]:
        """For a legend."""
        return [handle(robot_name(name), **self.robot(name)) for name in self.robots]

    def k_int_handles(self, **more: Any) -> list[Line2D]:
        """For a legend."""
        grey = {"color": "0.3", "marker": "o"}
        return [handle(f"k$_{{int}}$ = {k:g}", **{**grey, **self.k_int(k), **more}) for k in self.k_ints]


def save(figure: Figure, path: Path, kind: str = "png", dpi: float | None = None) -> None:
    """Writes a picture of a kind whole or not at all, and forgets the figure; without `dpi` as the style says."""
    with whole_file(path) as partial:
        figure.savefig(partial, format=kind, dpi=dpi)
    plt.close(figure)


def handle(label: str, **look: Any) -> Line2D:
    """Of a legend."""
    return Line2D([], [], label=label, **{"markersize": 5, **look})


def panels(size: tuple[float, float], rows: int = 1, columns: int = 1, **more: Any) -> tuple[Figure, np.ndarray]:
    """A figure and its axes [rows, columns]."""
    return plt.subplots(rows, columns, figsize=size, squeeze=False, layout="constrained", **more)


def legend(figure: Figure, handles: Sequence[Artist], columns: int | None = None, **more: Any) -> None:
    """Below the panels."""
    figure.legend(handles=list(handles), loc="outside lower center", ncols=columns or len(handles), **more)


def draw_means(axis: Axes, x: Any, points: Sequence[Estimate], bounds: tuple[float, float] = ANY, **look: Any) -> None:
    """Means over runs as a line, and their intervals, as far as they lie within bounds, as a band."""
    axis.plot(x, [point.mean for point in points], **look)
    low, high = (np.clip([getattr(point, end) for point in points], *bounds) for end in ("low", "high"))
    axis.fill_between(x, low, high, color=look["color"], alpha=0.13, linewidth=0)


def policy_colours(policies: Sequence[str]) -> dict[str, str]:
    """In trajectories and frontiers: those that have none of their own get what is left, in turn."""
    own = {policy: POLICIES[policy] for policy in policies if policy in POLICIES}
    others = [policy for policy in policies if policy not in own]
    left = [c for c in (BLUE, VERMILION, GREEN, PINK, ORANGE, SKY) if c not in own.values()]
    return own | {policy: left[k % len(left)] for k, policy in enumerate(others)}


def name_of(algorithm: str) -> str:
    """As papers write it."""
    return algorithm.upper()


def robot_name(robot: str) -> str:
    """Return it as papers write it."""
    return title(robot) or robot


def seeds_text(counts: set[int]) -> str:
    """ "3 seeds", or "1-3 seeds" where cells differ."""
    numbers = sorted({min(counts), max(counts)}) if counts else [0]
    return "-".join(str(n) for n in numbers) + (" seed" if numbers == [1] else " seeds")
