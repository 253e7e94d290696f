"""Write Markdown tables of scores, claims and provenance of the rows of a sweep."""

import dataclasses
import re
from collections.abc import Iterable

import numpy as np
import pyarrow as pa
import pyarrow.compute as pc

from interactive_nav_common.errors import FileError
from interactive_nav_common.rows import markdown, where
from interactive_nav_common.statistics import over_episodes, over_runs
from train.figures import style
from train.scoring.rows import SCORES
from train.scoring.statistics import Finding, cells, claims, learned_rows, objects_moved, run_means

SPLITS = {"train": "seen", "test": "unseen"}
COLUMNS = ("success", "P_eff = SPL = INS_1", "E_eff = INS_0", "INS_0.5")


def score_cells(rows: pa.Table) -> str:
    """Return the scores of every cell on seen and unseen scenes: mean over seeds and its 95 % interval."""
    lines = []
    for split, name in SPLITS.items():
        for (robot, algorithm, k_int), runs in cells(run_means(rows, split)).items():
            scores = [over_runs(run.scores[score] for run in runs).with_ends() for score in SCORES]
            episodes = sum(run.episodes for run in runs)
            cell = (style.robot_name(robot), algorithm.upper(), f"{k_int:g}", name)
            lines.append((*cell, len(runs), f"{episodes:,}", *scores))
    lines.sort(key=lambda line: (line[0], line[1], line[2]))
    return markdown(("robot", "algorithm", "k_int", "scenes", "runs", "episodes", *COLUMNS), lines)


def baselines(rows: pa.Table) -> str:
    """Return the scores of policies that never learned, means over episodes; empty where there are none."""
    names, lines = ("robot", "policy", "split"), []
    for robot, policy, split in sorted(set(zip(*(rows[name].to_pylist() for name in names), strict=True))):
        if policy != "learned":
            part = where(rows, robot=robot, policy=policy, split=split)
            scores = (over_episodes(score, part[score].to_numpy()).with_ends() for score in SCORES)
            lines.append((style.robot_name(robot), policy, SPLITS.get(split, split), f"{len(part):,}", *scores))
    return markdown(("robot", "policy", "scenes", "episodes", *COLUMNS), lines) if lines else ""


def claim_lines(findings: Iterable[Finding]) -> str:
    """Return the paper's claims and what the runs say to them."""
    return markdown(("claim", "compared", "difference [95 % interval], p", "here"), map(dataclasses.astuple, findings))


def effort_lines(rows: pa.Table, split: str | None) -> str:
    """Return the claims on effort without episodes that touched a wall; empty where none did."""
    if "structure_steps" not in rows.column_names:
        return ""
    free = rows.filter(pc.field("structure_steps") == 0)
    if len(free) == len(rows):
        return ""
    return claim_lines(
        f for f in claims(free, split) if any(name in f"{f.claim} {f.compared}," for name in ("E_eff", "INS_0,"))
    )


def need_lines(rows: pa.Table) -> str:
    """Return success by whether the goal can be reached without touching anything: as the episodes' file says, or as
    the avoider did; empty where neither is there."""
    names = ("policy", "robot", "scene", "episode", "k_int", "success")
    if not set(names) <= set(rows.column_names):
        return ""
    every = list(zip(*(rows[name].to_pylist() for name in names), strict=True))
    avoidable = {tuple(task): success > 0 for policy, *task, _, success in every if policy == "avoider"}
    if "push_needed" in rows.column_names:
        noted = zip(every, rows["push_needed"].to_pylist(), strict=True)
        avoidable |= {tuple(task): not needed for (_, *task, _, _), needed in noted if needed is not None}
    by_cell: dict[tuple[str, float], dict[bool, list[float]]] = {}
    for policy, *task, k_int, success in every:
        if policy == "learned" and tuple(task) in avoidable:
            cell = by_cell.setdefault((task[0], k_int), {True: [], False: []})
            cell[avoidable[tuple(task)]].append(success)
    lines = []
    for (robot, k_int), cell in sorted(by_cell.items()):
        scores = [f"{np.mean(cell[free]):.3f} ({len(cell[free]):,})" if cell[free] else "-" for free in (True, False)]
        lines.append((style.robot_name(robot), f"{k_int:g}", *scores))
    header = ("robot", "k_int", "success where no push is needed (episodes)", "where one is")
    return markdown(header, lines) if lines else ""


def category_lines(rows: pa.Table, split: str | None) -> str:
    """Return how often and how far each policy moved objects of each category; empty without such columns."""
    rows = where(rows, split=split)
    if not len(rows):
        return ""
    policy = [
        name if name != "learned" else f"k_int = {k_int:g}"
        for name, k_int in zip(rows["policy"].to_pylist(), rows["k_int"].to_pylist(), strict=True)
    ]
    moved = objects_moved(rows.append_column("of", pa.array(policy, pa.string())), ["robot", "of"])
    policies = sorted({of for _, of, _ in moved}, key=lambda of: (not of.startswith("k_int"), of))
    lines = []
    for robot, category in sorted({key[::2] for key in moved}):
        each = (moved.get((robot, of, category)) for of in policies)
        shown = (
            f"{s['touched'] / s['objects']:.1%}, {100 * s['displacement_m'] / s['objects']:.1f}" if s else "-"
            for s in each
        )
        lines.append((style.robot_name(robot), category.replace("_", " "), *shown))
    return markdown(("robot", "category", *policies), lines) if lines else ""


def provenance(rows: pa.Table) -> str:
    """Return env steps, wall-clock, device and commit of every run."""
    names = ("run", "train_env_steps", "checkpoint_steps", "train_wall_s", "train_device", "train_commit", "device")
    if not set(names) <= set(rows.column_names):
        return ""
    runs = learned_rows(rows).group_by(list(names)).aggregate([("episode", "count")]).to_pylist()
    lines = [
        (
            row["run"],
            *("-" if row[name] is None else f"{row[name]:,}" for name in names[1:3]),
            "-" if row["train_wall_s"] is None else f"{row['train_wall_s'] / 60:.1f}",
            row["train_device"] or "-",
            (row["train_commit"] or "-")[:10],
            row["device"],
        )
        for row in sorted(runs, key=lambda row: (row["run"], row["device"]))
    ]
    header = ("run", "env steps", "evaluated at", "wall-clock [min]", "trained on", "commit", "evaluated on")
    return markdown(header, lines) if lines else ""


def sections(rows: pa.Table, split: str | None) -> list[tuple[str, str, str]]:
    """Return (heading, what the numbers mean, table) of all tables; without learned runs, those of the others."""
    shown = {"train": "training", "test": "unseen", None: "all"}[split]
    learned = bool(len(learned_rows(rows)))
    every = [
        (
            "Scores",
            "Mean over runs [95 % bootstrap interval; of three runs, lowest and highest]; a run's score is the mean "
            "over its episodes.",
            score_cells(rows) if learned else "",
        ),
        (
            "The paper's claims",
            f"On {shown} scenes unless the line says otherwise. Two-sided Welch t tests over seeds, each seed's score "
            "the mean over the settings of both sides; level 5 %, not corrected for the number of tests. "
            "Cells with fewer runs are not compared. "
            "`undecided`: these runs cannot tell.",
            claim_lines(claims(rows, split)) if learned else "",
        ),
        (
            "Effort without walls",
            "The same over the episodes that touched no wall. The dynamic term of E_eff counts forces on "
            "walls, the penalty counts movable objects only. Which episodes these are depends on the policy.",
            effort_lines(rows, split) if learned else "",
        ),
        (
            "Where touching is needed",
            "All scenes and algorithms, the episodes of which it is known: their file says so, or the avoider played "
            "them too. It knows all poses and touches nothing; where it does not reach the goal, no path was "
            "wide enough.",
            need_lines(rows),
        ),
        (
            "What was touched and moved",
            "By category, over all algorithms: the share of the objects there that were touched in an episode, and how "
            "far each of them was moved on average, in centimetres of its centre's path.",
            category_lines(rows, split),
        ),
        ("Policies that never learned", "Mean over episodes [Wilson's or bootstrap's 95 % interval].", baselines(rows)),
        ("Runs", "", provenance(rows)),
    ]
    return [section for section in every if section[2]]


def document(rows: pa.Table, split: str | None, name: str | None = None) -> str:
    """Return all tables as one document in Markdown, or only the one whose heading has this name, as in its anchor."""
    named = {re.sub(r"\W+", "-", section[0].lower()): section for section in sections(rows, split)}
    if name not in {None, *named}:
        raise FileError(f"--table {name}: no such table; these rows have {', '.join(named)}")
    shown = (section for key, section in named.items() if name in {None, key})
    parts = (part for heading, *text in shown for part in (f"## {heading}", *text) if part)
    return "\n\n".join(part.rstrip() for part in parts) + "\n"
