"""Environments against steps per second, from rows of `benchmarks`: the chart of the README.

    python -m docs.studies.throughput -o docs/throughput.png

Takes the rows of one program over ten scenes on one NVIDIA H200 (commits 3163049, 5e8efe7 and 773b647 of
`benchmarks/results/steps_per_second.jsonl.gz`) and of PyBullet on one CPU core (`pybullet_peer.jsonl`).
"""

import argparse
import gzip
import json
from pathlib import Path

import matplotlib

matplotlib.use("Agg")
import matplotlib.pyplot as plt
from PIL import Image

ROWS = Path(__file__).parents[2] / "benchmarks" / "results"
COMMITS = ("3163049", "5e8efe7")
IMAGES = {"observations": ["goal", "velocity", "waypoints", "depth", "segmentation"], "image_dtype": "uint8"}
NUMBERS, PICTURES, PEER = "#1b6ca8", "#d1603d", "#666666"


def rows(name: str) -> list[dict]:
    """The lines of a file of results."""
    read = gzip.open if name.endswith(".gz") else open
    with read(ROWS / name, "rt") as lines:
        return [json.loads(line) for line in lines]


def curve(settings: dict) -> list[tuple[int, float]]:
    """(environments, env steps/s) of the TurtleBot in ten scenes on one GPU; of equal batches the newest."""
    found = {}
    for row in rows("steps_per_second.jsonl.gz"):
        same = row["mode"] == "simulation" and len(row["scenes"]) == 10 and row.get("devices", 1) == 1
        if (
            same
            and row["commit"] in COMMITS
            and row.get("robot") == "turtlebot"
            and (row.get("settings") or {}) == settings
        ):
            found[row["num_envs"]] = row["env_steps_per_s"]
    return sorted(found.items())


def main() -> None:
    """Draws the chart."""
    words = argparse.ArgumentParser(description=__doc__)
    words.add_argument("-o", "--output", type=Path, required=True)
    output = words.parse_args().output
    figure, axes = plt.subplots(figsize=(7.2, 3.2), dpi=110, layout="constrained")
    for settings, colour, label in (
        ({}, NUMBERS, "29 numbers"),
        (IMAGES, PICTURES, "with 68 x 68 depth and segmentation"),
    ):
        x, y = zip(*curve(settings), strict=True)
        axes.plot(x, y, "o-", color=colour, label=label)
    measured = [r for r in rows("steps_per_second.jsonl.gz") if r["commit"] == "773b647" and len(r["scenes"]) == 10]
    best = next(r for r in measured if (r.get("settings") or {}).get("active_furniture") == 4)
    axes.plot(
        best["num_envs"], best["env_steps_per_s"], "*", ms=13, color=NUMBERS, label="29 numbers, fewer bodies at a time"
    )
    slow = rows("pybullet_peer.jsonl")[0]["pybullet_env_steps_per_s"]["4x1/40"]
    axes.axhline(slow, color=PEER, ls="--")
    axes.text(64, 1.15 * slow, f"PyBullet, the original's engine, one CPU core: {slow:,.0f}", color=PEER, fontsize=9)
    axes.annotate(
        f"{best['env_steps_per_s']:,.0f}",
        (best["num_envs"], best["env_steps_per_s"]),
        (-8, 4),
        textcoords="offset points",
        ha="right",
        fontsize=9,
        color=NUMBERS,
    )
    axes.set(
        xscale="log",
        yscale="log",
        ylim=(300, 600_000),
        xlabel="environments at once, one NVIDIA H200",
        ylabel="environment steps/s",
    )
    axes.set_xticks([64, 1024, 4096, 16384], ["64", "1,024", "4,096", "16,384"])
    axes.minorticks_off()
    axes.grid(alpha=0.3)
    axes.legend(frameon=False, fontsize=9, loc="center right")
    figure.savefig(output)
    Image.open(output).convert("RGB").quantize(32).save(output, optimize=True)


if __name__ == "__main__":
    main()
