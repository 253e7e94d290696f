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
from scenes_mjcf.sets import existing

DEFAULTS = {"observations": ("depth", "segmentation", "rgb"), "episode_steps": 10**8, "backend": "native"}
"""Of `simulate`, where they differ from the environment's."""


class Simulate(Command):
    """Simulate a robot in a scene: publish its sensors and follow cmd_vel. Odometry starts at its pose in the map."""

    scene: Annotated[Path, *word("SCENE")]
    """Scene folder."""
    settings: Words = ()
    """Override settings, listed below."""
    robot: Annotated[str, option(metavar="NAME")] = "turtlebot"
    """Robot: a name, or a file that describes it."""
    start: Annotated[str | None, option(metavar="X,Y,YAW")] = None
    """Start pose in the map, in m and rad (default: random)."""
    seed: int = 0
    """Random seed of the start, the small objects and the noise."""
    engine: Annotated[Literal["gl", "warp", "rays"] | None, option()] = None
    """Renderer of colour images, as in films; topological networks expect warp (default: as observed)."""
    limit: Annotated[float, option(metavar="S")] = 1800.0
    """Length of an episode in simulated seconds."""
    lockstep: Flag = False
    """Wait for a velocity command after each image."""
    factor: float = 1.0
    """Simulated seconds per second of real time; 0 does not wait."""
    bag: Annotated[Path | None, option(metavar="FOLDER")] = None
    """Folder to record all topics to, as a rosbag2 bag."""
    run: Annotated[str | None, option(metavar="COMMAND")] = None
    """Also run this node, for example 'interactive-nav ros drive policy.onnx', and stop when it ends."""

    def __post_init__(self) -> None:
        super().__post_init__()
        if self.lockstep and self.factor != 1.0:
            raise UserError("--factor has no effect with --lockstep; leave it out")

    @classmethod
    def epilog(cls) -> str:
        return f"settings (key=default):\n{settings_help(make_config(**DEFAULTS))}"


class Drive(Command):
    """Drive a robot with a policy: read odom and the sensors that the policy needs, publish cmd_vel. The robot follows
    `plan` or drives to `goal_pose`, on the shortest path in --map; without --map straight ahead, even through walls."""

    policy: Annotated[Path, *word("POLICY.onnx")]
    """Policy file that `interactive-nav export` wrote."""
    robot: Annotated[str | None, option(metavar="NAME")] = None
    """Name of your robot; policies of other robots are refused."""
    map: Annotated[Path | None, option(metavar="SCENE")] = None
    """Scene folder in which shortest paths are computed."""
    odom_in_map: Annotated[str, option(metavar="X,Y,YAW")] = "0,0,0"
    """Pose of the odometry frame in the map, in m and rad, until /tf provides one."""
    max_linear: Annotated[Positive | None, option(metavar="M/S")] = None
    """Speed limit in m/s (default: the policy's)."""
    max_angular: Annotated[Positive | None, option(metavar="RAD/S")] = None
    """Turn rate limit in rad/s (default: the policy's)."""
    silence: Annotated[Positive, option(metavar="S")] = 1.0
    """Stop the robot when a required topic has been silent for this many seconds."""
    dead_man: Annotated[int | None, option(metavar="BUTTON")] = None
    """Drive only while this button of the joy topic is held."""


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
    existing(arguments.scene)  # before what takes long to import
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
    if path and (avoided := policy.about["inputs"].get("waypoints", {}).get("avoids")):
        say(f"policy: its waypoints avoided {avoided}, which paths in --map do not; send such paths on /plan")
    limits = arguments.max_linear, arguments.max_angular
    pilot = Pilot(policy, limits, _pose(arguments.odom_in_map, "--odom-in-map"), path)
    need_ros("interactive_nav.ros")
    from interactive_nav.ros.drive import DriveNode
    from interactive_nav.ros.nodes import ros_node

    with ros_node("policy") as node:
        DriveNode(node, pilot, arguments.silence, arguments.dead_man, say).run(lambda: bool(stops))


if __name__ == "__main__":
    sys.exit(main())
