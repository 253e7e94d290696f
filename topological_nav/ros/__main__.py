"""Run `python -m topological_nav.ros all|sim|navigator|check`: the simulator and the navigator as ROS 2 nodes.

Exit codes: 0 done, 2 on a user's error or a failed node of `all` (one line on stderr), 128 + signal when stopped.
"""

import argparse
import contextlib
import json
import os
import re
import shlex
import signal
import subprocess
import sys
import time
from collections.abc import Sequence
from pathlib import Path
from typing import Any

from interactive_nav_common.config import overridden, refuse_unused, settings_help
from interactive_nav_common.errors import UserError, missing, optional, reports_errors
from interactive_nav_common.jobs.processes import GUARD
from interactive_nav_common.jobs.progress import say
from interactive_nav_common.signals import stop_signals
from interactive_nav_common.words import Parser, add_words, read_commands
from topological_nav.config import RUNS, NavigatorConfig
from topological_nav.ros.config import HeadingConfig, SimulatorConfig

DRIVERS = {"heading": HeadingConfig, "topological": NavigatorConfig}
"""Driver -> its settings."""
_GRACE_S = 10.0
"""Time for a node of `all` to end after the other one has."""


def parser() -> argparse.ArgumentParser:
    """Return the parser of the command line."""
    program = Parser(
        prog="python -m topological_nav.ros",
        description="The simulator and the navigator as ROS 2 nodes. Words key=value change settings.",
    )
    commands = program.add_subparsers(dest="command", required=True)

    def command(name: str, text: str, *configs: Any) -> argparse.ArgumentParser:
        epilog = "".join(f"settings of {what} (key=default):\n{settings_help(c)}\n" for what, c in configs)
        return commands.add_parser(
            name, help=text, description=text, epilog=epilog, formatter_class=argparse.RawDescriptionHelpFormatter
        )

    sim, heading = ("the simulator", SimulatorConfig()), ("driver heading", HeadingConfig())
    topological = ("driver topological", NavigatorConfig())
    everything = command("all", "One episode: the simulator and the navigator, each in a process.")
    alone = command("sim", "The simulator's node.", sim)
    navigator = command("navigator", "The navigator's node, for a robot or a simulator.", heading, topological)
    sets = read_commands(Path(__file__).with_name("words.yaml"))
    add_words(everything, sets["all"].words)
    add_words(alone, sets["sim"].words)
    add_words(alone.add_mutually_exclusive_group(), sets["pace"].words)
    add_words(navigator, sets["navigator"].words, drivers=tuple(DRIVERS))
    add_words(navigator.add_argument_group("driver topological"), sets["topological"].words, runs=RUNS)
    command("check", "Says whether ROS 2 can be used here.")
    return program


@reports_errors("topological_nav.ros")
def main(argv: Sequence[str] | None = None) -> int:
    """Run a command."""
    words = list(sys.argv[1:] if argv is None else argv)
    # Words of `all` are those of the nodes, in quotes.
    settings = [word for word in words if re.match(r"\w+=", word)] if words[:1] != ["all"] else []
    arguments = parser().parse_args([word for word in words if word not in settings])
    arguments.settings = settings
    run = {"all": _all, "sim": _sim, "navigator": _navigator, "check": _check}
    with stop_signals() as stops:
        _refuse_unused(arguments)
        run[arguments.command](arguments, stops)
        return 128 + stops[0] if stops else 0


def _refuse_unused(arguments: argparse.Namespace) -> None:
    """Refuse what the chosen driver, or the command, does not read."""
    if arguments.command == "check":
        named = " ".join(word.partition("=")[0] for word in arguments.settings)
        refuse_unused(arguments, named, "in 'check', which has no settings")
    elif arguments.command == "navigator" and arguments.driver == "heading":
        options = "--map --localiser --detector --policy --goal --goal-heading"
        refuse_unused(arguments, options, "with --driver heading, only with --driver topological")


def need_ros() -> Any:
    """Import rclpy, or say how to install it."""
    line = missing("topological_nav.ros", "rclpy (wheels exist for Python 3.11)", "ros2")
    for module in ("sensor_msgs.msg", "nav_msgs.msg", "geometry_msgs.msg", "rosgraph_msgs.msg", "std_msgs.msg"):
        optional(module, line)
    return optional("rclpy", line)


def _networks(arguments: argparse.Namespace) -> Any:
    from topological_nav.weights.export import choose

    if arguments.map is None:
        raise UserError("--driver topological needs a map: --map PATH")
    chosen = choose(arguments.localiser, arguments.detector, arguments.policy)
    chosen.report()
    return chosen


def _all(arguments: argparse.Namespace, stops: list[int]) -> None:
    """Run both nodes until one ends; the other may then take `_GRACE_S` to end by itself."""
    need_ros()
    program = [sys.executable, "-c", GUARD, sys.executable, "-m", "topological_nav.ros"]
    bag = ["--bag", str(arguments.bag)] if arguments.bag else []
    words = {
        "simulator": ["sim", str(arguments.scene), *bag, *shlex.split(arguments.sim)],
        "navigator": ["navigator", *shlex.split(arguments.navigator)],
    }
    here = {"ROS_AUTOMATIC_DISCOVERY_RANGE": "LOCALHOST", **os.environ}
    nodes = {
        name: subprocess.Popen([*program, *of], env=here, start_new_session=True)  # Ctrl-C is for us
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


def _sim(arguments: argparse.Namespace, stops: list[int]) -> None:
    config = overridden(SimulatorConfig(), arguments.settings)
    need_ros()
    from topological_nav.ros.nodes import SimulatorNode, recording, ros_node
    from topological_nav.ros.simulator import Pace, RosSimulator

    with contextlib.redirect_stdout(sys.stderr):  # Warp prints its kernels
        simulator = RosSimulator(arguments.scene, config)
    pace = Pace(arguments.factor, arguments.lockstep, arguments.limit, arguments.bag is not None)
    with contextlib.ExitStack() as stack:
        node = stack.enter_context(ros_node("simulator"))
        if arguments.bag is not None:
            stack.enter_context(recording(stack.enter_context(ros_node("recorder")), arguments.bag))
        tally = SimulatorNode(node, simulator, pace, say).run(lambda: bool(stops))
        print(json.dumps(tally.row()), flush=True)


def _navigator(arguments: argparse.Namespace, stops: list[int]) -> None:
    config = overridden(DRIVERS[arguments.driver](), arguments.settings)
    chosen = _networks(arguments) if arguments.driver == "topological" else None
    need_ros()
    from topological_nav.ros import drivers
    from topological_nav.ros.nodes import NavigatorNode, ros_node

    if chosen is None:
        driver: drivers.Driver = drivers.HeadingDriver(config)
    else:
        goal = tuple(arguments.goal), arguments.goal_heading or 0.0
        driver = drivers.topological_driver(arguments.map, chosen, *goal, config)
    with ros_node("navigator") as node:
        navigator = NavigatorNode(node, driver, arguments.heading_from, arguments.heading_offset, say)
        done = navigator.run(lambda: bool(stops))
        say(f"navigator: {'done' if done else 'stopped'}")


def _check(arguments: argparse.Namespace, stops: list[int]) -> None:
    del arguments, stops
    print(f"rclpy: {need_ros().__file__}")


if __name__ == "__main__":
    sys.exit(main())
