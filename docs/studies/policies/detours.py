"""`python -m docs.studies.policies.detours ROWS --scenes SET --episode-file FILE --share S`: scores by detour.

How much longer an episode's way is round furniture that is too heavy (friction above S times the robot's weight) than
among structure alone; the episodes' scores, by that and by who played them, as a table.
"""

import argparse
from collections.abc import Sequence

import jax
import numpy as np
import pandas

import interactive_nav
from interactive_nav.episodes import load_episode_files, starts_of
from interactive_nav_common.errors import reports_errors
from interactive_nav_common.rows import read_rows

EDGES_M = (0.05, 0.3, 1.0)


def detours_m(robot: str, scenes: Sequence[str], episode_file: str, share: float) -> np.ndarray:
    """[N] m of each episode's detour; infinite where start or goal is shut in by what is heavy."""
    file, _ = load_episode_files([episode_file])
    env = interactive_nav.make(
        robot, list(scenes), backend="native", num_objects=len(file.episodes[0]["objects"]), potential_round=share
    )
    starts = starts_of(file, env, episode_file)
    keys = jax.random.split(jax.random.PRNGKey(0), len(file.episodes))
    nav = jax.jit(jax.vmap(env.reset_to))(starts, keys).info["nav"]
    return np.where(nav.round_field[1], nav.geodesic_m - nav.shortest_path_m, np.inf)


def by_detour(rows: pandas.DataFrame, detour_m: np.ndarray) -> pandas.DataFrame:
    """Scores by detour and player; `failed` counts episodes, which several seeds may have played."""
    names = [f"below {edge} m" for edge in EDGES_M] + [f"{EDGES_M[-1]} m and more", "shut in"]
    bins = np.where(np.isinf(detour_m), len(EDGES_M) + 1, np.digitize(detour_m, EDGES_M))[rows.episode]
    learned = rows.policy == "learned"
    who = rows.policy.where(~learned, rows.algorithm.str.upper() + ", k_int " + rows.k_int.map("{:g}".format))
    told = rows.assign(detour=pandas.Categorical.from_codes(bins, names), who=who, failed=1 - rows.success)
    groups = told.groupby(["who", "detour"], observed=True)
    of = {name: (name, "mean") for name in ("success", "path_efficiency", "effort_efficiency", "ins_0.5")}
    return groups.agg(episodes=("episode", "nunique"), **of, failed=("failed", "sum")).round(3)


@reports_errors("detours")
def main(argv: Sequence[str] | None = None) -> int:
    """Prints the table."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("rows", nargs="+", help="Parquet files of rows")
    parser.add_argument("--robot", default="turtlebot")
    parser.add_argument("--scenes", required=True, help="such as cluttered/test")
    parser.add_argument("--episode-file", required=True)
    parser.add_argument("--share", type=float, default=1.0, help="of the robot's weight")
    parser.add_argument("--split", default="test", help="of the rows")
    parser.add_argument("--episodes", type=int, help="the first so many")
    asked = parser.parse_args(argv)
    detour_m = detours_m(asked.robot, [asked.scenes], asked.episode_file, asked.share)[: asked.episodes]
    rows = read_rows(asked.rows).to_pandas()
    rows = rows[(rows.robot == asked.robot) & (rows.split == asked.split) & (rows.episode < len(detour_m))]
    print(by_detour(rows, detour_m).to_string())
    return 0


if __name__ == "__main__":
    raise SystemExit(main())
