"""Compare topological navigators in the same episodes: from the report's to ours, and what clutter costs.

`python -m docs.studies.homes.navigator collect RUNS -o ROWS` rows of `benchmarks/topological.mk SIZE=homes` as one file
`python -m docs.studies.homes.navigator tables ROWS` its tables, as Markdown

Means and 95 % intervals are over homes: bootstrap for scores, Student's for differences. A difference compares
the same episodes of two variants.
"""

import argparse
from collections.abc import Sequence
from pathlib import Path

import numpy as np
import pyarrow as pa
import pyarrow.compute as pc

from interactive_nav_common.rows import markdown, read_rows, where, write_parquet
from interactive_nav_common.statistics import estimate, over_runs

LADDER = {
    "ladder-0": "the report's navigator",
    "ladder-1": "18 images for one, of places and of the goal",
    "ladder-2": "images compared by heading",
    "ladder-3": "a glance after each run",
    "ladder-4": "a look for the edge's end in each run",
    "ladder-5": "0.3 for each metre of an edge",
    "ladder-6": "1 for each failed try of an edge",
    "ladder-7": "the detector asked for each edge's length",
    "ladder-8": "for 0.3 m less: ours",
}
"""Rows of a ladder: a difference is from the row above. The last is of the first episodes of `evaluation-policy` of the
same runs."""
CLUTTER = {
    "evaluation-policy": "ours",
    "metres-0": "without metres",
    "objects-10": "10 small objects",
    "objects-30": "30 small objects",
    "hard": "blocked",
    "hard-metres-0": "blocked, without metres",
    "hard-push": "blocked, pushes on",
    "hard-expert": "blocked, the expert that knows all poses",
    "evaluation-dense": "baseline policy",
    "evaluation-expert": "the expert",
}
"""Here it is from the first row."""
FIRST = 12
"""Episodes of each home that climb the ladder."""
HEADER = ("Navigator", "Homes", "Success in 600 s", "in 175 s", "SPL", "RC", "AD (s)", "Difference in success")
EXACT = 2**16


def collect(runs: Path) -> pa.Table:
    """Return the rows of all variants, with numbers rounded to 2^-16 and the policy named by its folder."""
    tables = []
    for folder in sorted(path.parent for path in runs.glob("*/rows")):
        for contender in ("dense", "expert"):
            rows = where(read_rows(sorted((folder / "rows").glob("*.parquet"))), contender=contender)
            name = folder.name if folder.name != "evaluation" else f"evaluation-{contender}"
            names = [name, "ladder-8"] if name == "evaluation-policy" and any(runs.glob("ladder-*")) else [name]
            parts = [rows, rows.filter(pc.less(rows["episode"], FIRST))]
            for name, part in zip(names, parts, strict=False):
                part = part.append_column("variant", pa.array([name] * len(part), pa.string()))
                tables += [part] if len(part) else []
    every = pa.concat_tables(tables, promote_options="default")
    every = every.set_column(
        every.schema.get_field_index("policy"),
        "policy",
        pa.array([Path(one).name for one in every["policy"].to_pylist()]),
    )
    for place, field in enumerate(every.schema):
        if pa.types.is_floating(field.type):
            values = np.round(every[field.name].to_numpy() * EXACT) / EXACT
            every = every.set_column(place, field.name, pa.array(values.astype(np.float32)))
    return every.drop_columns(["wall_s", "split", "sight", "domain"])


def scores(rows: pa.Table) -> dict[str, dict[str, np.ndarray]]:
    """Return for each home its episodes' values, in the order of episodes."""
    out = {}
    for scene in sorted(rows["scene"].unique().to_pylist()):
        part = where(rows, scene=scene).sort_by("episode")
        won, seconds = part["success"].to_numpy(), part["duration_s"].to_numpy()
        soon = won * (seconds <= 175.0)
        out[scene] = {"600": won, "175": soon, "spl": part["spl"].to_numpy(), "ad": seconds}
        out[scene]["episode"] = part["episode"].to_numpy()
        out[scene]["contact"] = part["contact"].to_numpy()[won > 0]
    return out


def _gain(mine: dict[str, np.ndarray], other: dict[str, np.ndarray]) -> float:
    """Return the mean difference in success over the episodes of both."""
    _, left, right = np.intersect1d(mine["episode"], other["episode"], return_indices=True)
    return float((mine["600"][left] - other["600"][right]).mean())


def table(rows: pa.Table, variants: dict[str, str]) -> str:
    """Return a Markdown table with a line for each variant; those without rows are empty on the ladder, else absent."""
    lines, before, climbs = [], None, variants is LADDER
    rows = rows.filter(pc.less(rows["episode"], FIRST)) if climbs else rows
    for variant, title in variants.items():
        part = where(rows, variant=variant)
        if not len(part):
            before, lines = (None, [*lines, [title, "0", *[""] * 6]]) if climbs else (before, lines)
            continue
        mine = scores(part)
        cells = [
            over_runs(v[name].mean() for v in mine.values() if len(v[name]))
            for name in ("600", "175", "spl", "contact", "ad")
        ]
        change = ""
        if before is not None:
            pairs = [(mine[home], before[home]) for home in mine if home in before]
            change = estimate(_gain(one, other) for one, other in pairs).with_ends(2)
        texts = [cell.with_ends(0 if place == 4 else 2) for place, cell in enumerate(cells)]
        lines.append([title, str(len(mine)), *texts, change])
        before = mine if climbs or before is None else before
    return markdown(HEADER, lines)


def main(argv: Sequence[str] | None = None) -> None:
    """Collect rows, or print tables."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("what", choices=["collect", "tables"])
    parser.add_argument("path", type=Path)
    parser.add_argument("-o", dest="out", type=Path)
    arguments = parser.parse_args(argv)
    if arguments.what == "collect":
        write_parquet(collect(arguments.path), arguments.out, small=True)
    else:
        rows = read_rows([arguments.path])
        for tier in (None, "furnished", "cluttered"):
            chosen = rows
            if tier:
                chosen = rows.filter(pc.starts_with(rows["scene"], tier))
            print(f"## {tier or 'All'}\n\n{table(chosen, LADDER)}\n{table(chosen, CLUTTER)}")


if __name__ == "__main__":
    main()
