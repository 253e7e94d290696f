"""`python -m topological_nav.ros all|sim|navigator|check`: the simulator and the navigator as ROS nodes.

Exit codes: 0 done, 2 on a user's error or a failed node of `all` (one line on stderr), 128 + signal when asked to stop.
"""

import argparse
import contextlib
import importlib
import json
import os
import re
import sys
import time
from collections.abc import Iterator, Sequence
from pathlib import Path
from types import SimpleNamespace
from typing import Any

from interactive_nav_common.config import overridden, refuse_unused, settings_help
from interactive_nav_common.errors import UserError, reports_errors
from interactive_nav_common.signals import stop_signals
from interactive_nav_common.words import Parser, add_words, read_commands
from topological_nav.commands.progress import say
from topological_nav.config import RUNS, NavigatorConfig
from topological_nav.ros import debian
from topological_nav.ros.config import HeadingConfig, SimulatorConfig

DRIVERS = {"heading": HeadingConfig, "topological": NavigatorConfig}
"""Driver -> its settings."""
_DELIVERY_S = 1.0
"""Between the last message and the end of a node: rospy sends in threads of their own."""


def parser() -> argparse.ArgumentParser:
    """The command line."""
    made = Parser(
        prog="python -m topological_nav.ros",
        description="The simulator and the navigator as ROS 1 nodes. Words key=value change settings.",
    )
    commands = made.add_subparsers(dest="command", required=True)

    def command(name: str, text: str, *configs: Any) -> argparse.ArgumentParser:
        told = "".join(f"settings of {what} (key=default):\n{settings_help(c)}\n" for what, c in configs)
        return commands.add_parser(
            name, help=text, description=text, epilog=told, formatter_class=argparse.RawDescriptionHelpFormatter
        )

    sim, heading = ("the simulator", SimulatorConfig()), ("driver heading", HeadingConfig())
    topological = ("driver topological", NavigatorConfig())
    everything = command("all", "One episode by roslaunch: simulator, navigator, recorder, master where none is.")
    everything.add_argument("words", nargs=argparse.REMAINDER, metavar="name:=value", help="see episode.launch")
    alone = command("sim", "The simulator's node.", sim)
    navigator = command("navigator", "The navigator's node, for a robot or a simulator.", heading, topological)
    sets = read_commands(Path(__file__).with_name("words.yaml"))
    add_words(alone, sets["sim"].words)
    add_words(alone.add_mutually_exclusive_group(), sets["pace"].words)
    add_words(navigator, sets["navigator"].words, drivers=tuple(DRIVERS))
    add_words(navigator.add_argument_group("driver topological"), sets["topological"].words, runs=RUNS)
    command("check", "Says whether ROS can be used here.")
    return made


@reports_errors("topological_nav.ros")
def main(argv: Sequence[str] | None = None) -> int:
    """Runs a command."""
    words = list(sys.argv[1:] if argv is None else argv)
    if words[:1] != ["all"]:
        words = [word for word in words if ":=" not in word]  # of roslaunch to rospy
    settings = [word for word in words if re.match(r"\w+=", word)]
    arguments = parser().parse_args([word for word in words if word not in settings])
    arguments.settings = settings
    run = {"all": _all, "sim": _sim, "navigator": _navigator, "check": _check}
    with stop_signals() as stops:
        _refuse_unused(arguments)
        run[arguments.command](arguments, stops)
        return 128 + stops[0] if stops else 0


def _refuse_unused(arguments: argparse.Namespace) -> None:
    """Refuses what the chosen driver, or the command, does not look at."""
    if arguments.command in ("all", "check"):
        named = " ".join(word.partition("=")[0] for word in arguments.settings)
        refuse_unused(arguments, named, f"in '{arguments.command}', which has no settings")
    elif arguments.command == "navigator" and arguments.driver == "heading":
        options = "--map --localiser --detector --policy --goal --goal-heading"
        refuse_unused(arguments, options, "with --driver heading, only with --driver topological")


def _seeing(arguments: argparse.Namespace) -> Any:
    from topological_nav.weights.packaged import choose

    if arguments.map is None:
        raise UserError("--driver topological needs a map: --map PATH")
    chosen = choose(arguments.localiser, arguments.detector, arguments.policy)
    if chosen.told:
        say(chosen.told)
    return chosen


def _all(arguments: argparse.Namespace, stops: list[int]) -> None:
    """roslaunch from within: its program ends with 0 whatever became of its nodes."""
    debian.load()
    roslaunch: Any = importlib.import_module("roslaunch")
    here = Path(__file__).parent
    os.environ["PWD"] = os.getcwd()  # told to episode.launch
    os.environ["ROS_PACKAGE_PATH"] = f"{here}{os.pathsep}{os.environ.get('ROS_PACKAGE_PATH') or '/usr/share'}"
    launched = str(here / "episode.launch"), [f"python:={sys.executable}", *arguments.words]
    run = roslaunch.rlutil.get_or_generate_uuid(None, False)
    roslaunch.configure_logging(run)
    codes: dict[str, int | None] = {}  # of what ended by itself
    try:
        parent = roslaunch.parent.ROSLaunchParent(run, [launched])
        roslaunch.pmon._init_signal_handlers()  # before the monitor, which would put them there twice: ours is lost
        parent.pm = roslaunch.pmon.start_process_monitor()  # before the launch: a node may fail at once
        parent.pm.add_process_listener(SimpleNamespace(process_died=codes.__setitem__))
        parent.start()
        parent.spin()
    except roslaunch.RLException as error:
        raise debian.RosError(" ".join(str(error).split())) from None
    failed = [f"{node} ended with exit code {code}" for node, code in codes.items() if code != 0]
    if failed and not stops:
        raise debian.RosError(f"{', '.join(failed)}; what it said is above")


def _sim(arguments: argparse.Namespace, stops: list[int]) -> None:
    config = overridden(SimulatorConfig(), arguments.settings)
    ros = debian.load()
    from topological_nav.ros.nodes import Pace, SimulatorNode
    from topological_nav.ros.simulator import RosSimulator

    debian.need_master(ros)
    with _ended(ros):
        with contextlib.redirect_stdout(sys.stderr):  # Warp tells of its kernels there
            simulator = RosSimulator(arguments.scene, config)
            pace = Pace(arguments.factor, arguments.lockstep, arguments.limit, arguments.recorded)
            tally = SimulatorNode(ros, simulator, pace, say).run(lambda: bool(stops))
        print(json.dumps(tally.row()), flush=True)


def _navigator(arguments: argparse.Namespace, stops: list[int]) -> None:
    config = overridden(DRIVERS[arguments.driver](), arguments.settings)
    seeing = _seeing(arguments) if arguments.driver == "topological" else None
    ros = debian.load()
    from topological_nav.ros import drivers
    from topological_nav.ros.nodes import NavigatorNode

    debian.need_master(ros)
    with _ended(ros):
        if seeing is None:
            driver: drivers.Driver = drivers.HeadingDriver(config)
        else:
            from topological_nav.ros.pilot import topological_driver

            goal = tuple(arguments.goal), arguments.goal_heading or 0.0
            driver = topological_driver(arguments.map, seeing, *goal, config)
        node = NavigatorNode(ros, driver, arguments.heading_from, arguments.heading_offset, say)
        done = node.run(lambda: bool(stops))
        say(f"navigator: {'done' if done else 'stopped'}")


def _check(arguments: argparse.Namespace, stops: list[int]) -> None:
    del arguments, stops
    print(f"rospy: {debian.load().rospy.__file__}")


@contextlib.contextmanager
def _ended(ros: Any) -> Iterator[None]:
    """Lets the last messages go out, then leaves the master."""
    try:
        yield
        time.sleep(_DELIVERY_S)
    finally:
        ros.rospy.signal_shutdown("done")


if __name__ == "__main__":
    sys.exit(main())
