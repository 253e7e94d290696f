"""Run `interactive-nav ros drive|simulate`: a policy and a simulated robot as ROS 2 nodes.

Exit codes: 0 done, 2 on a user's error (one line on stderr), 128 + signal when stopped.
"""

import contextlib
import json
import sys
from collections.abc import Sequence
from pathlib import Path
from typing import Annotated, Any, Literal

from interactive_nav.config import make_config
from interactive_nav.ros.commands import beside, need_ros
from interactive_nav_common.commands import Command, Flag, Words, option, parse, word
from interactive_nav_common.config import Positive, overridden, settings_help
from interactive_nav_common.errors import UserError, reports_errors
from interactive_nav_common.jobs.progress import say
from interactive_nav_common.signals import stop_signals
from scenes_mjcf.sets import installed

DEFAULTS = {"observations": ("depth", "segmentation", "rgb"), "episode_steps": 10**8, "backend": "native"}
"""Of `simulate`, where they differ from the environment's."""


class Simulate(Command):
    """Run a simulated robot in a scene: sensors on topics, driven by cmd_vel. The odometry begins at the robot's pose
    in the map."""

    scene: Annotated[Path, *word("SCENE")]
    """Scene folder."""
    settings: Words = ()
    """Change settings, listed below."""
    robot: Annotated[str, option(metavar="NAME")] = "turtlebot"
    """Robot, or its file."""
    start: Annotated[str | None, option(metavar="X,Y,YAW")] = None
    """In m and rad, map (default: drawn)."""
    seed: int = 0
    """Of the start, small objects and noise."""
    engine: Literal["gl", "warp", "rays"] | None = None
    """Draw colours as films do, which the topological networks know (warp; default: as observed)."""
    limit: Annotated[float, option(metavar="S")] = 1800.0
    """Simulated seconds of an episode."""
    lockstep: Flag = False
    """Each picture waits for its velocity command."""
    factor: float = 1.0
    """Simulated seconds a second; 0: no waiting."""
    bag: Annotated[Path | None, option(metavar="FOLDER")] = None
    """Record all topics there (rosbag2)."""
    run: Annotated[str | None, option(metavar="COMMAND")] = None
    """Run a node beside, such as 'interactive-nav ros drive policy.onnx', and end with it."""

    def __post_init__(self) -> None:
        super().__post_init__()
        if self.lockstep and self.factor != 1.0:
            raise UserError("--factor has no effect with --lockstep; leave it out")

    @classmethod
    def epilog(cls) -> str:
        return f"settings (key=default):\n{settings_help(make_config(**DEFAULTS))}"


class Drive(Command):
    """Drive a robot by a policy: cmd_vel from odom and the scan, contacts and cameras that the policy needs. It goes
    along plan, or to goal_pose: by the shortest path in --map, without one straight ahead, whatever stands there."""

    policy: Annotated[Path, *word("POLICY.onnx")]
    """File of interactive-nav export."""
    robot: Annotated[str | None, option(metavar="NAME")] = None
    """Refuse a policy of another robot."""
    map: Annotated[Path | None, option(metavar="SCENE")] = None
    """Scene folder, for shortest paths."""
    odom_in_map: Annotated[str, option(metavar="X,Y,YAW")] = "0,0,0"
    """Pose of the odometry's frame in the map, m and rad, until /tf has one."""
    max_linear: Annotated[Positive | None, option(metavar="M/S")] = None
    """Limit of the speed (default: the policy's)."""
    max_angular: Annotated[Positive | None, option(metavar="RAD/S")] = None
    """Limit of the turn rate (default: the policy's)."""
    silence: Annotated[Positive, option(metavar="S")] = 1.0
    """Stop when a needed topic is silent for so long."""
    dead_man: Annotated[int | None, option(metavar="BUTTON")] = None
    """Drive only while this button of joy is held."""


COMMANDS = {kind.__name__.lower(): kind for kind in (Drive, Simulate)}


@reports_errors("interactive_nav.ros")
def main(argv: Sequence[str] | None = None) -> int:
    run = {Drive: _drive, Simulate: _simulate}
    with stop_signals() as stops:
        arguments = parse(COMMANDS, "python -m interactive_nav.ros", argv)
        run[type(arguments)](arguments, stops)
        return 128 + stops[0] if stops else 0


def _pose(text: str, name: str) -> tuple[float, ...]:
    try:
        x, y, yaw = map(float, text.split(","))
    except ValueError:
        raise UserError(f"{name} is {text!r}, expected X,Y,YAW, such as 1.0,-0.5,0") from None
    return x, y, yaw


def _simulate(arguments: Simulate, stops: list[int]) -> None:
    config = overridden(make_config(**DEFAULTS), arguments.settings)
    start = _pose(arguments.start, "--start") if arguments.start else ()
    if not (installed(arguments.scene) / "scene.json").is_file():  # before what takes long to import
        raise UserError(f"{arguments.scene}: no scene folder (no scene.json in it)")
    need_ros("interactive_nav.ros")
    from interactive_nav import make
    from interactive_nav.ros import messages as ros
    from interactive_nav.ros.nodes import SimulatorNode, recording, ros_node
    from interactive_nav.ros.simulator import NEEDED, Pace, RosSimulator

    with contextlib.ExitStack() as stack:
        stop = stack.enter_context(beside(arguments.run, stops)) if arguments.run else lambda: bool(stops)
        with contextlib.redirect_stdout(sys.stderr):  # Warp prints its kernels
            observed = tuple(dict.fromkeys((*config.observations, *NEEDED)))
            settings: dict[str, Any] = vars(config) | {"observations": observed}
            env = make(arguments.robot, [arguments.scene], **settings)
            simulator = RosSimulator(env, arguments.seed, start, arguments.engine)
            topics = ros.TOPICS | ros.camera_topics(simulator.sense().images)
        node = stack.enter_context(ros_node("simulator"))
        if arguments.bag is not None:
            stack.enter_context(recording(stack.enter_context(ros_node("recorder")), arguments.bag, topics))
        pace = Pace(arguments.factor, arguments.lockstep, arguments.limit, arguments.bag is not None)
        print(json.dumps(SimulatorNode(node, simulator, pace, say).run(stop).row()), flush=True)


def _drive(arguments: Drive, stops: list[int]) -> None:
    from interactive_nav.interop.onnx_file import OnnxFile
    from interactive_nav.ros.pilot import Pilot, scene_path

    policy = OnnxFile(arguments.policy)
    name = policy.about["robot"]["name"]
    if arguments.robot not in (None, name):
        raise UserError(f"{arguments.policy}: the policy is for robot '{name}', expected '{arguments.robot}'")
    path = scene_path(policy.about, arguments.map) if arguments.map else None
    limits = arguments.max_linear, arguments.max_angular
    pilot = Pilot(policy, limits, _pose(arguments.odom_in_map, "--odom-in-map"), path)
    need_ros("interactive_nav.ros")
    from interactive_nav.ros.drive import DriveNode
    from interactive_nav.ros.nodes import ros_node

    with ros_node("policy") as node:
        DriveNode(node, pilot, arguments.silence, arguments.dead_man, say).run(lambda: bool(stops))


if __name__ == "__main__":
    sys.exit(main())
