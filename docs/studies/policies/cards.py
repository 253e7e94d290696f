"""`python -m docs.studies.policies.cards -o docs`: draw the pictures of the results page's cards from kept rows."""

import argparse
from pathlib import Path

import numpy as np
import pandas
from matplotlib.figure import Figure

from interactive_nav_common.figures import BLUE, panels, save
from interactive_nav_common.statistics import over_runs

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


def main() -> None:
    """Write both pictures."""
    words = argparse.ArgumentParser(description=__doc__)
    words.add_argument("-o", "--output", type=Path, required=True)
    to = words.parse_args().output
    above = pandas.concat([pandas.read_parquet(f"results/above/{x}.parquet") for x in ("episodes", "planners")])
    save(draw(above.fillna({"seed": 0}), "robot", ROBOTS, "ins_0.5", ("learned", "namo:1", "follower")),
         to / "results-above.webp", "webp", 110)  # fmt: skip
    doors = pandas.read_parquet("results/tasks/episodes.parquet").query(
        "robot == 'fetch' and scene in ('rowan', 'willow')"
    )
    save(draw(doors.fillna({"seed": 0}), "task", {"clear": "through a door", "open": "open a door"}, "success",
              ("learned", "puller", "follower")), to / "results-doors.webp", "webp", 110)  # fmt: skip


if __name__ == "__main__":
    main()
