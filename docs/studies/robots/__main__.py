"""`python -m docs.studies.robots`: robots measured, and drawn with what was measured of them.

    python -m docs.studies.robots evidence --backend warp --robots all
    python -m docs.studies.robots figure robots.png
    python -m docs.studies.robots gallery docs/robots.webp
    python -m docs.studies.robots pictures pictures/                # one PNG per robot

Exit status: 0; 1 if a check failed; 2 for a question that cannot be answered, with one line that says why.
"""

from __future__ import annotations

import argparse
import sys
from pathlib import Path

from rich.console import Console
from rich.table import Table

from docs.studies.robots.evidence import EVIDENCE, Evidence, measure
from docs.studies.robots.pictures import gallery, picture, save_pictures
from interactive_nav.robots import get_robot, robot_names
from interactive_nav_common.errors import reports_errors


def _print_evidence(names: tuple[str, ...], backend: str, console: Console) -> bool:
    """Prints each robot's checks as it is measured; whether all passed."""
    passed = True
    for k, name in enumerate(names):
        kind = get_robot(name).kind
        if kind not in EVIDENCE:
            console.print(f"[{k + 1}/{len(names)}] {name}: {kind}, no manoeuvres are defined for its kind")
            continue
        own = measure(name, backend)
        table = Table("check", "value", "limits", "", title=f"[{k + 1}/{len(names)}] {name} on {own.backend}")
        for check in own.checks:
            verdict = "ok" if check.passed else "FAILED"
            table.add_row(check.name, f"{check.value:.4g}", f"{check.low:.3g} .. {check.high:.3g}", verdict)
        console.print(table)
        console.file.flush()
        passed &= own.passed
    console.print("all passed" if passed else "some checks FAILED")
    return passed


def save_figure(evidence: dict[str, Evidence | None], path: Path) -> None:
    """One row per robot: its picture, the straight drive, the turn on the spot, and its checks.

    Args:
        evidence: robot -> what was measured; none: a picture only.
        path: of the PNG.
    """
    from matplotlib.figure import Figure

    figure = Figure(figsize=(17, 2.9 * len(evidence)))
    axes = figure.subplots(len(evidence), 4, width_ratios=(1, 1.3, 1.3, 2.6), squeeze=False)
    for (image, straight, turn, table), (name, own) in zip(axes, evidence.items(), strict=True):
        robot = get_robot(name)
        image.imshow(picture(robot))
        image.set_title(f"{name}, {robot.mass_kg:.4g} kg" if robot.mass_kg else name, fontsize=10)
        for axis in (image, table):
            axis.set_axis_off()
        if own is None:
            straight.set_axis_off()
            turn.set_axis_off()
            continue
        curves = (
            (straight, own.speed_m_s, own.commanded_m_s, "m/s", "straight, then stop"),
            (turn, own.turn_rad_s, own.commanded_rad_s, "rad/s", "turn on the spot, then stop"),
        )
        for axis, got, asked, unit, title in curves:
            axis.plot(own.time_s, asked, "--", color="0.5", linewidth=1, label="asked")
            axis.plot(own.time_s, got, color="tab:blue", linewidth=1.5, label="measured")
            axis.set_ylabel(unit, fontsize=8)
            axis.set_title(title, fontsize=8)
            axis.set_xlabel("s", fontsize=8)
            axis.tick_params(labelsize=7)
            axis.legend(fontsize=7, loc="lower left")
        half = (len(own.checks) + 1) // 2
        for column, part in enumerate((own.checks[:half], own.checks[half:])):
            for row, check in enumerate(part):
                table.text(
                    0.5 * column,
                    1.0 - row / half,
                    f"{check.name}: {check.value:.3g}",
                    fontsize=8,
                    color="black" if check.passed else "red",
                    transform=table.transAxes,
                    va="top",
                )
    figure.tight_layout()
    figure.savefig(path, dpi=80)


@reports_errors("docs.studies.robots")
def main(argv: list[str] | None = None) -> int:
    """Runs the command; returns its exit status."""
    parser = argparse.ArgumentParser(prog="python -m docs.studies.robots", description=__doc__.splitlines()[0])  # type: ignore[union-attr]
    commands = parser.add_subparsers(dest="command", required=True)
    for command, text in (
        ("evidence", "measure the robots and print the checks"),
        ("figure", "draw all of it"),
        ("gallery", "draw all robots to one scale"),
        ("pictures", "draw each robot alone"),
    ):
        sub = commands.add_parser(command, help=text)
        sub.add_argument("--backend", default="native", choices=("native", "jax", "warp", "auto"))
        sub.add_argument("--robots", default="all", help="names, comma between them; default all")
        if command != "evidence":
            sub.add_argument("out", type=Path, help="picture to write; pictures: folder of them")
    args = parser.parse_args(argv)
    console = Console(width=None if sys.stdout.isatty() else 220)
    names = robot_names() if args.robots == "all" else tuple(name.strip() for name in args.robots.split(","))
    if args.command == "pictures":
        for path in save_pictures(names, args.out):
            console.print(f"wrote {path}")
        return 0
    if args.command == "gallery":
        gallery(names).savefig(args.out, dpi=200)
        console.print(f"wrote {args.out}")
        return 0
    kinds = {name: get_robot(name).kind for name in names}
    if args.command == "evidence":
        return 0 if _print_evidence(names, args.backend, console) else 1
    save_figure({n: measure(n, args.backend) if kind in EVIDENCE else None for n, kind in kinds.items()}, args.out)
    console.print(f"wrote {args.out}")
    return 0


if __name__ == "__main__":
    sys.exit(main())
