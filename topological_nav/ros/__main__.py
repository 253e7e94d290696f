"""Run `python -m topological_nav.ros`: the navigator as a ROS 2 node.

Exit codes: 0 done, 2 on a user's error (one line on stderr), 128 + signal when stopped.
"""

import sys
from collections.abc import Sequence
from pathlib import Path
from typing import Annotated, Literal

from tyro.conf import UseAppendAction

from interactive_nav.ros.commands import need_ros
from interactive_nav_common.commands import Words, option, parse
from interactive_nav_common.config import overridden
from interactive_nav_common.errors import reports_errors
from interactive_nav_common.jobs.progress import say
from interactive_nav_common.signals import stop_signals
from topological_nav.__main__ import UsesNetworks
from topological_nav.config import NavigatorConfig


class Navigator(UsesNetworks):
    """Run the topological navigator as a ROS 2 node, for a robot or a simulator."""

    LISTED = {"": NavigatorConfig()}
    settings: Words = ()
    """Override settings of the navigator, listed below."""
    map: Annotated[Path, option(metavar="PATH")]
    """Map file that `python -m topological_nav map` wrote."""
    heading_from: Literal["imu", "odom"] = "imu"
    """Topic that the heading is read from."""
    heading_offset: Annotated[float, option(metavar="RAD")] = 0.0
    """Yaw of the heading's frame in the map's frame, in rad."""
    policy: Annotated[str | None, option(metavar="RUN")] = None
    """Local policy: a run folder, or passage, a rule without learning (default: the networks', if you name none)."""
    goal: Annotated[UseAppendAction[tuple[Path, ...]], option(metavar="PICTURE")] = ()
    """Image taken at the goal."""
    goal_heading: Annotated[float, option(metavar="RAD")] = 0.0
    """Heading of the first image of the goal, in rad."""


@reports_errors("topological_nav.ros")
def main(argv: Sequence[str] | None = None) -> int:
    with stop_signals() as stops:
        arguments = parse(Navigator, "python -m topological_nav.ros", argv)
        config = overridden(NavigatorConfig(), arguments.settings)
        need_ros("topological_nav.ros")
        from interactive_nav.ros.nodes import ros_node
        from topological_nav.ros.drivers import topological_driver
        from topological_nav.ros.nodes import NavigatorNode
        from topological_nav.weights.export import choose

        chosen = choose(arguments.localiser, arguments.detector, arguments.policy)
        chosen.report()
        driver = topological_driver(arguments.map, chosen, arguments.goal, arguments.goal_heading, config)
        with ros_node("navigator") as node:
            navigator = NavigatorNode(node, driver, arguments.heading_from, arguments.heading_offset, say)
            done = navigator.run(lambda: bool(stops))
            say(f"navigator: {'done' if done else 'stopped'}")
        return 128 + stops[0] if stops else 0


if __name__ == "__main__":
    sys.exit(main())
