"""Run `python -m topological_nav.ros`: the navigator as a ROS 2 node.

Exit codes: 0 done, 2 on a user's error (one line on stderr), 128 + signal when stopped.
"""

import dataclasses
import sys
from collections.abc import Sequence
from pathlib import Path
from typing import Annotated, Any, Literal

from tyro.conf import UseAppendAction

from interactive_nav.ros.commands import need_ros
from interactive_nav_common.commands import Command, Words, option, parse
from interactive_nav_common.config import overridden, refuse_unused, settings_help
from interactive_nav_common.errors import UserError, reports_errors
from interactive_nav_common.jobs.progress import say
from interactive_nav_common.signals import stop_signals
from topological_nav.config import NavigatorConfig
from topological_nav.ros import HeadingConfig

DRIVERS = {"heading": HeadingConfig, "topological": NavigatorConfig}
"""Driver -> its settings."""


@dataclasses.dataclass(kw_only=True)
class Navigator(Command):
    """Run the navigator as a node of ROS 2, for a robot or a simulator."""

    settings: Words = ()
    """Change settings of the driver, listed below."""
    driver: Literal["heading", "topological"] = "heading"
    """What decides on velocities."""
    heading_from: Literal["imu", "odom"] = "imu"
    """Topic of the heading."""
    heading_offset: Annotated[float, option(metavar="RAD")] = 0.0
    """Of that frame in the map's."""
    map: Annotated[Path | None, option(metavar="PATH")] = None
    """Of `python -m topological_nav map`."""
    localiser: Annotated[Path | None, option(metavar="RUN")] = None
    """Network that embeds images (default: a trained one, else the packaged)."""
    detector: Annotated[Path | None, option(metavar="RUN")] = None
    """Network that judges passages (default: as the localiser)."""
    policy: Annotated[str | None, option(metavar="RUN")] = None
    """Drives along edges; or passage (default: as the networks, if none is named)."""
    goal: Annotated[UseAppendAction[tuple[Path, ...]], option(metavar="PICTURE")] = ()
    """Taken at the goal."""
    goal_heading: Annotated[float | None, option(metavar="RAD")] = None
    """Along which the first was (default: 0)."""

    def __post_init__(self) -> None:
        super().__post_init__()
        if self.driver == "heading":
            options = "--map --localiser --detector --policy --goal --goal-heading"
            refuse_unused(self, options, "with --driver heading, only with --driver topological")

    @classmethod
    def epilog(cls) -> str:
        """Return the settings of both drivers."""
        drivers = DRIVERS.items()
        return "\n".join(f"settings of driver {name} (key=default):\n{settings_help(of())}" for name, of in drivers)

    def choose(self) -> Any:
        """Return the networks that are named, or used where none are."""
        from topological_nav.weights.export import choose

        if self.map is None:
            raise UserError("--driver topological needs a map: --map PATH")
        chosen = choose(self.localiser, self.detector, self.policy)
        chosen.report()
        return chosen


@reports_errors("topological_nav.ros")
def main(argv: Sequence[str] | None = None) -> int:
    """Run the navigator's node."""
    with stop_signals() as stops:
        arguments = parse(Navigator, "python -m topological_nav.ros", argv)
        config = overridden(DRIVERS[arguments.driver](), arguments.settings)
        chosen = arguments.choose() if arguments.driver == "topological" else None
        need_ros("topological_nav.ros")
        from interactive_nav.ros.nodes import ros_node
        from topological_nav.ros import drivers
        from topological_nav.ros.nodes import NavigatorNode

        if chosen is None:
            driver: drivers.Driver = drivers.HeadingDriver(config)
        else:
            goal = arguments.goal, arguments.goal_heading or 0.0
            driver = drivers.topological_driver(arguments.map, chosen, *goal, config)
        with ros_node("navigator") as node:
            navigator = NavigatorNode(node, driver, arguments.heading_from, arguments.heading_offset, say)
            done = navigator.run(lambda: bool(stops))
            say(f"navigator: {'done' if done else 'stopped'}")
        return 128 + stops[0] if stops else 0


if __name__ == "__main__":
    sys.exit(main())
