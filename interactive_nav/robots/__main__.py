"""Run `python -m interactive_nav.robots`: print the table of robots.

Exit status: 0; 2 for a question that cannot be answered, with one line that says why.
"""

import sys
from pathlib import Path

from rich.console import Console
from rich.table import Table

from interactive_nav.robots import get_robot, robot_names
from interactive_nav_common.errors import reports_errors
from interactive_nav_common.jobs.progress import SafeConsole
from interactive_nav_common.words import program


def _names(text: str | None) -> tuple[str, ...]:
    return robot_names() if text == "all" else tuple(name.strip() for name in text.split(",")) if text else ()


def _unit(label: str) -> str:
    """Return the unit at the end of an action's name."""
    return "N m" if label.endswith(" N m") else label.rsplit(" ", 1)[-1]


def _print_table(names: tuple[str, ...], console: Console) -> None:
    table = Table("robot", "kg", "L x W x H m", "drive", "native action", "modes", "camera", "success m", "sources")
    for name in names:
        robot = get_robot(name)
        size = " x ".join(f"{v:.3g}" for v in robot.size_m) if robot.size_m else "-"
        ranges = sorted({(low, high) for low, high in zip(robot.action_low, robot.action_high, strict=True)})
        units = sorted({_unit(label) for label in robot.action_names})
        action = f"{robot.action_size}: " + ", ".join(f"{low:g}..{high:g}" for low, high in ranges[:2])
        camera = robot.camera
        table.add_row(
            robot.name,
            f"{robot.mass_kg:.4g}" if robot.mass_kg else "-",
            size,
            robot.drive_type or robot.kind,
            f"{action} {'/'.join(units)}",
            ", ".join(robot.control_modes),
            f"{camera.body} ({', '.join(f'{v:g}' for v in camera.pos_m)}), {camera.fov_deg:g} deg",
            f"{robot.body_width_m:g}",
            robot.source or "-",
        )
    console.print(table)


@reports_errors("interactive_nav.robots")
def main(argv: list[str] | None = None) -> int:
    """Run the command; return its exit status."""
    args = program(Path(__file__).parents[1] / "words.yaml", "robots").parse_args(argv)
    console = SafeConsole(width=None if sys.stdout.isatty() else 220)
    _print_table((*_names(args.robots or ("" if args.files else "all")), *args.files), console)
    return 0


if __name__ == "__main__":
    sys.exit(main())
