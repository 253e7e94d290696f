"""Choose colour and marker by algorithm, fill and line style by k_int, also distinguishable without colour."""

from collections.abc import Mapping, Sequence
from typing import Any

from matplotlib.lines import Line2D

from interactive_nav_common.figures import BLUE, GREEN, ORANGE, PINK, SKY, VERMILION, handle
from scenes_mjcf.robot_facts import title

ALGORITHMS = {"ppo": (BLUE, "o"), "sac": (VERMILION, "s"), "ddpg": (GREEN, "^")}
ROBOTS = {"turtlebot": (BLUE, "o"), "fetch": (VERMILION, "s")}
POLICIES = {"learned": BLUE, "follower": GREEN, "random": PINK, "avoider": VERMILION}
SPARE = ((PINK, "D"), (ORANGE, "v"), (SKY, "P"), ("0.3", "X"))
FILLS = ("none", "left", "full")
LINES: tuple[Any, ...] = (":", "--", "-", "-.")
Cell = tuple[str, str, float]
"""Robot, algorithm, k_int."""


def look(kind: dict[str, tuple[str, str]], name: str, among: list[str]) -> dict[str, Any]:
    """Return the colour and marker of an algorithm or robot; one that has none gets a spare one."""
    others = [other for other in among if other not in kind]
    return dict(zip(("color", "marker"), kind.get(name) or SPARE[others.index(name) % len(SPARE)], strict=True))


def in_order(algorithms: set[str]) -> list[str]:
    """Return algorithms as the paper names them, others after."""
    return sorted(algorithms, key=lambda name: (list(ALGORITHMS).index(name) if name in ALGORITHMS else 99, name))


class Looks:
    """What stands for what in a figure of some cells."""

    def __init__(self, cells: Mapping[Cell, Sequence[Any]]):
        self.robots = sorted({robot for robot, _, _ in cells}, reverse=True)
        self.algorithms = in_order({algorithm for _, algorithm, _ in cells})
        self.k_ints = sorted({k_int for _, _, k_int in cells})
        self.seeds = seeds_text({len(runs) for runs in cells.values()})

    def algorithm(self, name: str) -> dict[str, Any]:
        return look(ALGORITHMS, name, self.algorithms)

    def robot(self, name: str) -> dict[str, Any]:
        return look(ROBOTS, name, self.robots)

    def fill(self, k_int: float) -> Any:
        """Return the marker fill of a k_int: the higher, the fuller."""
        last = len(self.k_ints) - 1
        return FILLS[round(self.k_ints.index(k_int) * (len(FILLS) - 1) / last)] if last else "full"

    def k_int(self, k_int: float) -> dict[str, Any]:
        """Return marker fill and line style: the higher, the fuller and the more solid."""
        line = LINES[self.k_ints.index(k_int) % len(LINES)] if len(self.k_ints) > 1 else "-"
        return {"fillstyle": self.fill(k_int), "linestyle": line}

    def algorithm_handles(self, **more: Any) -> list[Line2D]:
        return [handle(name.upper(), **{**self.algorithm(name), **more}) for name in self.algorithms]

    def k_int_handles(self, **more: Any) -> list[Line2D]:
        grey = {"color": "0.3", "marker": "o"}
        return [handle(f"k$_{{int}}$ = {k:g}", **{**grey, **self.k_int(k), **more}) for k in self.k_ints]


def policy_colours(policies: Sequence[str]) -> dict[str, str]:
    """Return the colours of trajectories and frontiers; policies that have none get what is left, in turn."""
    taken = {policy: POLICIES[policy] for policy in policies if policy in POLICIES}
    left = [c for c in (BLUE, VERMILION, GREEN, PINK, ORANGE, SKY) if c not in taken.values()]
    others = [policy for policy in policies if policy not in taken]
    return taken | {policy: left[k % len(left)] for k, policy in enumerate(others)}


def robot_name(robot: str) -> str:
    return title(robot) or robot


def seeds_text(counts: set[int]) -> str:
    """Return "3 seeds", or "1-3 seeds" where cells differ."""
    numbers = sorted({min(counts), max(counts)}) if counts else [0]
    return "-".join(str(n) for n in numbers) + (" seed" if numbers == [1] else " seeds")
