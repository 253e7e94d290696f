"""Run `python -m interactive_nav.robots`: print the table of robots; exit with 0, or 2 for a user's error."""

import sys
from typing import Annotated

from rich.table import Table

from interactive_nav.robots import get_robot, robot_names
from interactive_nav_common.commands import Command, option, parse, word
from interactive_nav_common.errors import reports_errors
from interactive_nav_common.jobs.progress import SafeConsole


class Robots(Command):
    """Print a table of robots."""

    files: Annotated[tuple[str, ...], *word("FILE")] = ()
    """Your own robots: URDF or MJCF files, or path.py:function."""
    robots: Annotated[str | None, option(metavar="NAME,...")] = None
    """Names of the built-in robots to list (default: all, or none if you give FILE)."""

    def names(self) -> tuple[str, ...]:
        """Return the names and files of the table's rows."""
        names = self.robots or ("" if self.files else "all")
        listed = robot_names() if names == "all" else [name.strip() for name in names.split(",") if name]
        return (*listed, *self.files)


@reports_errors("interactive_nav.robots")
def main(argv: list[str] | None = None) -> int:
    arguments = parse(Robots, "python -m interactive_nav.robots", argv)
    table = Table("robot", "kg", "L x W x H m", "drive", "native action", "modes", "camera", "success m", "sources")
    for name in arguments.names():
        robot = get_robot(name)
        size = " x ".join(f"{v:.3g}" for v in robot.size_m) if robot.size_m else "-"
        ranges = sorted({(low, high) for low, high in zip(robot.action_low, robot.action_high, strict=True)})
        units = sorted({"N m" if name.endswith(" N m") else name.rsplit(" ", 1)[-1] for name in robot.action_names})
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
    SafeConsole(width=None if sys.stdout.isatty() else 220).print(table)
    return 0


if __name__ == "__main__":
    sys.exit(main())
