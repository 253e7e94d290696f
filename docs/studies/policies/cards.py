"""`python -m docs.studies.policies.cards -o docs`: draw the results' bars and the chart of steps and homes."""

import argparse
from pathlib import Path
from typing import Any

import numpy as np
import pandas
from matplotlib.figure import Figure

from interactive_nav_common.figures import BLUE, panels, save
from interactive_nav_common.statistics import over_runs, paired_difference

GREY = "0.7"
NAMES = {"learned": "learned", "namo:1": "planner namo:1", "puller": "script puller", "follower": "follower"}
ROBOTS = {"turtlebot": "TurtleBot", "fetch": "Fetch"}


def draw(rows: pandas.DataFrame, by: str, titles: dict[str, str], score: str, policies: tuple[str, ...]) -> Figure:
    """Return a figure with a panel for each value of a column, and a bar with its interval for each policy."""
    figure, grid = panels((4.2, 2.0), 1, len(titles), sharey=True)
    for panel, (value, title) in zip(grid.flat, titles.items(), strict=True):
        for k, policy in enumerate(reversed(policies)):
            played = rows[(rows[by] == value) & (rows.policy == policy)]
            mean = over_runs(np.asarray(played.groupby("seed")[score].mean(), float))
            spread = {"xerr": mean.bar} if mean.runs > 1 else {}
            panel.barh(k, mean.mean, color=BLUE if policy == "learned" else GREY, **spread)
            at = 0.03 if mean.mean > 0.3 else mean.mean + 0.03  # within a bar that is long enough
            panel.text(at, k, f"{mean.mean:.2f}", va="center", color="white" if policy == "learned" else "black")
        panel.set(title=title, xlim=(0, 1), xlabel="INS$_{0.5}$" if score == "ins_0.5" else score)
        panel.set_yticks(range(len(policies)), [NAMES[policy] for policy in reversed(policies)])
    return figure


def of_homes(rows: Any) -> np.ndarray:
    """Return each home's mean INS_0.5."""
    return np.asarray(rows.groupby("scene")["ins_0.5"].mean(), float)


def scale(seeds: pandas.DataFrame, planner: pandas.DataFrame, rows: pandas.DataFrame) -> Figure:
    """Return a chart of INS_0.5 less the planner's against a policy's env steps and against its training homes."""
    base = of_homes(planner)
    figure, grid = panels((8.4, 2.9), 1, 2, sharey=True)
    lengths = rows[rows.run.str.startswith("long")]
    homes = pandas.concat([rows[rows.run.str.startswith("homes")], seeds[seeds.seed == 0]])
    numbers = homes.run.str.extract(r"homes(\d+)")[0].fillna("100").astype(float)
    for panel, played, by in zip(grid.flat, (lengths, homes), (lengths.checkpoint_steps / 1e6, numbers), strict=True):
        less = {x: paired_difference(of_homes(part), base) for x, part in played.groupby(by)}
        bars = np.hstack([one.bar for one in less.values()])
        means = [one.mean for one in less.values()]
        panel.errorbar([*less], means, bars, fmt="o-", color=BLUE, label="one seed", capsize=3)
        panel.axhline(0, color="black", linewidth=1)
        each = [(of_homes(part) - base).mean() for _, part in seeds.groupby("seed")]
        at = seeds.checkpoint_steps.max() / 1e6 if played is lengths else 100
        panel.plot([at] * len(each), each, "_", color="black", markersize=9, label="each seed of 13.1 million steps")
        panel.set_xscale("log")
        panel.set_xticks([*less], [f"{x:.1f}".removesuffix(".0") for x in less])
        panel.minorticks_off()
    grid[0, 0].set(xlabel="env steps, millions (100 homes)", ylabel="INS$_{0.5}$ less namo:1")
    grid[0, 1].set(xlabel="training homes (13.1 million env steps)", ylim=(-0.009, None))
    grid[0, 0].legend(loc="lower right", frameon=False)
    return figure


def main() -> None:
    """Write the pictures."""
    words = argparse.ArgumentParser(description=__doc__)
    words.add_argument("-o", "--output", type=Path, required=True)
    to = words.parse_args().output
    above = pandas.concat([pandas.read_parquet(f"results/above/{x}.parquet") for x in ("episodes", "planners")])
    save(draw(above.fillna({"seed": 0}), "robot", ROBOTS, "ins_0.5", ("learned", "namo:1", "follower")),
         to / "results-above.webp", "webp", 110)  # fmt: skip
    ours, planner = (above.query(f"robot == 'turtlebot' and policy == '{x}'") for x in ("learned", "namo:1"))
    save(
        scale(ours, planner, pandas.read_parquet("results/above/scale.parquet")), to / "results-scale.webp", "webp", 110
    )
    doors = pandas.read_parquet("results/tasks/episodes.parquet").query(
        "robot == 'fetch' and scene in ('rowan', 'willow')"
    )
    save(draw(doors.fillna({"seed": 0}), "task", {"clear": "through a door", "open": "open a door"}, "success",
              ("learned", "puller", "follower")), to / "results-doors.webp", "webp", 110)  # fmt: skip


if __name__ == "__main__":
    main()
