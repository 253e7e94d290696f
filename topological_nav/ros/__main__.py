"""Run `python -m topological_nav.ros all|sim|navigator`: the simulator and the navigator as ROS 2 nodes.

Exit codes: 0 done, 2 on a user's error or a failed node of `all` (one line on stderr), 128 + signal when stopped.
"""

import contextlib
import dataclasses
import os
import shlex
import signal
import subprocess
import sys
import time
from collections.abc import Sequence
from pathlib import Path
from typing import Annotated, Any, Literal

from tyro.conf import UseAppendAction

from interactive_nav.ros.commands import Simulation, need_ros
from interactive_nav_common.commands import Command, Words, option, parse, word
from interactive_nav_common.config import overridden, refuse_unused, settings_help
from interactive_nav_common.errors import UserError, reports_errors
from interactive_nav_common.jobs.processes import GUARD
from interactive_nav_common.jobs.progress import say
from interactive_nav_common.signals import stop_signals
from topological_nav.config import NavigatorConfig
from topological_nav.ros.config import HeadingConfig, SimulatorConfig

DRIVERS = {"heading": HeadingConfig, "topological": NavigatorConfig}
"""Driver -> its settings."""
PROGRAM = [sys.executable, "-c", GUARD, sys.executable, "-m", "topological_nav.ros"]
"""Of each node of `all`."""
_GRACE_S = 10.0
"""Time for a node of `all` to end after the other one has."""


@dataclasses.dataclass(kw_only=True)
class All(Command):
    """Run one episode: the simulator and the navigator, each in a process."""

    scene: Annotated[Path, *word("SCENE")]
    """Scene folder."""
    sim: Annotated[str, option(metavar="WORDS")] = ""
    """Further words of the simulator, such as '--lockstep width=64'."""
    navigator: Annotated[str, option(metavar="WORDS")] = ""
    """Words of the navigator, such as 'heading_rad=1.57'."""
    bag: Annotated[Path | None, option(metavar="FOLDER")] = None
    """Record all topics there (rosbag2)."""


@dataclasses.dataclass(kw_only=True)
class Sim(Simulation):
    """Run the simulator's node."""

    @classmethod
    def epilog(cls) -> str:
        """Return the settings."""
        return f"settings (key=default):\n{settings_help(SimulatorConfig())}"


@dataclasses.dataclass(kw_only=True)
class Navigator(Command):
    """Run the navigator's node, for a robot or a simulator."""

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


COMMANDS = {kind.__name__.lower(): kind for kind in (All, Sim, Navigator)}


@reports_errors("topological_nav.ros")
def main(argv: Sequence[str] | None = None) -> int:
    """Run a command."""
    run = {All: _all, Sim: _sim, Navigator: _navigator}
    with stop_signals() as stops:
        arguments = parse(COMMANDS, "python -m topological_nav.ros", argv)
        run[type(arguments)](arguments, stops)
        return 128 + stops[0] if stops else 0


def _networks(arguments: Navigator) -> Any:
    from topological_nav.weights.export import choose

    if arguments.map is None:
        raise UserError("--driver topological needs a map: --map PATH")
    chosen = choose(arguments.localiser, arguments.detector, arguments.policy)
    chosen.report()
    return chosen


def _all(arguments: All, stops: list[int]) -> None:
    """Run both nodes until one ends; the other may then take `_GRACE_S` to end by itself."""
    need_ros("topological_nav.ros")
    bag = ["--bag", str(arguments.bag)] if arguments.bag else []
    words = {
        "simulator": ["sim", str(arguments.scene), *bag, *shlex.split(arguments.sim)],
        "navigator": ["navigator", *shlex.split(arguments.navigator)],
    }
    here = {"ROS_AUTOMATIC_DISCOVERY_RANGE": "LOCALHOST", **os.environ}
    nodes = {
        name: subprocess.Popen([*PROGRAM, *of], env=here, start_new_session=True)  # Ctrl-C is for us
        for name, of in words.items()
    }
    try:
        while not stops and all(node.poll() is None for node in nodes.values()):
            time.sleep(0.05)
        until = time.monotonic() + (0.0 if stops or any(node.poll() for node in nodes.values()) else _GRACE_S)
        while not stops and time.monotonic() < until and any(node.poll() is None for node in nodes.values()):
            time.sleep(0.05)
        failed = [f"{name} ended with exit code {node.poll()}" for name, node in nodes.items() if node.poll()]
    finally:
        for node in nodes.values():
            if node.poll() is None:
                node.send_signal(signal.SIGTERM)
        for node in nodes.values():
            with contextlib.suppress(subprocess.TimeoutExpired):
                node.wait(_GRACE_S)
            node.kill()
            node.wait()  # gone before this command ends
    if failed and not stops:
        raise UserError(f"{', '.join(failed)}; its message is above")


def _sim(arguments: Sim, stops: list[int]) -> None:
    config = overridden(SimulatorConfig(), arguments.settings)

    def build() -> Any:
        from topological_nav.ros.simulator import build_simulator

        return build_simulator(arguments.scene, config)

    arguments.run(build, stops, "topological_nav.ros", "/camera/image_raw")


def _navigator(arguments: Navigator, stops: list[int]) -> None:
    config = overridden(DRIVERS[arguments.driver](), arguments.settings)
    chosen = _networks(arguments) if arguments.driver == "topological" else None
    need_ros("topological_nav.ros")
    from interactive_nav.ros.nodes import ros_node
    from topological_nav.ros import drivers
    from topological_nav.ros.nodes import NavigatorNode

    if chosen is None:
        driver: drivers.Driver = drivers.HeadingDriver(config)
    else:
        assert arguments.map is not None
        goal = arguments.goal, arguments.goal_heading or 0.0
        driver = drivers.topological_driver(arguments.map, chosen, *goal, config)
    with ros_node("navigator") as node:
        navigator = NavigatorNode(node, driver, arguments.heading_from, arguments.heading_offset, say)
        done = navigator.run(lambda: bool(stops))
        say(f"navigator: {'done' if done else 'stopped'}")


if __name__ == "__main__":
    sys.exit(main())
