"""Define what commands of ROS 2 nodes share."""

import contextlib
import dataclasses
import json
import sys
from collections.abc import Callable
from pathlib import Path
from typing import Annotated, Any

from interactive_nav_common.commands import Command, Flag, Words, option, word
from interactive_nav_common.errors import UserError, missing, optional
from interactive_nav_common.jobs.progress import say
from scenes_mjcf.sets import installed


def need_ros(program: str) -> Any:
    """Import rclpy, or say how to install it."""
    line = missing(program, "rclpy (wheels exist for Python 3.11)", "ros2")
    for module in ("sensor_msgs.msg", "nav_msgs.msg", "geometry_msgs.msg", "rosgraph_msgs.msg", "std_msgs.msg"):
        optional(module, line)
    return optional("rclpy", line)


@dataclasses.dataclass(kw_only=True)
class Simulation(Command):
    """Run a simulated robot's node."""

    scene: Annotated[Path, *word("SCENE")]
    """Scene folder."""
    settings: Words = ()
    """Change settings, listed below."""
    limit: Annotated[float, option(metavar="S")] = 1800.0
    """Simulated seconds of an episode."""
    lockstep: Flag = False
    """Each picture waits for its velocity command."""
    factor: float = 1.0
    """Simulated seconds a second; 0: no waiting."""
    bag: Annotated[Path | None, option(metavar="FOLDER")] = None
    """Record all topics there (rosbag2)."""

    def __post_init__(self) -> None:
        super().__post_init__()
        if self.lockstep and self.factor != 1.0:
            raise UserError("--factor has no effect with --lockstep; leave it out")

    def run(self, build: Callable[[], Any], stops: list[int], program: str, awaited: str) -> None:
        """Run the node of the simulator that `build` returns, and print its tally; in lockstep it starts when somebody
        reads the topic `awaited`."""
        if not (installed(self.scene) / "scene.json").is_file():  # before what takes long to import
            raise UserError(f"{self.scene}: no scene folder (no scene.json in it)")
        need_ros(program)
        from interactive_nav.ros import messages as ros
        from interactive_nav.ros.nodes import SimulatorNode, recording, ros_node
        from interactive_nav.ros.simulator import Pace

        with contextlib.redirect_stdout(sys.stderr):  # Warp prints its kernels
            simulator = build()
        pace = Pace(self.factor, self.lockstep, self.limit, self.bag is not None)
        with contextlib.ExitStack() as stack:
            node = stack.enter_context(ros_node("simulator"))
            if self.bag is not None:
                topics = ros.TOPICS | ros.camera_topics(simulator.sense().images)
                stack.enter_context(recording(stack.enter_context(ros_node("recorder")), self.bag, topics))
            tally = SimulatorNode(node, simulator, pace, say, awaited).run(lambda: bool(stops))
            print(json.dumps(tally.row()), flush=True)
