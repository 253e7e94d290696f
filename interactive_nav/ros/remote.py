"""Play episodes with a policy behind ROS 2 topics: `evaluate --policies ros`."""

import atexit
import contextlib
import operator
import time
from typing import Any

import jax
import numpy as np

from interactive_nav.ros import messages as ros
from interactive_nav.ros.nodes import SimulatorNode, ros_node
from interactive_nav.ros.simulator import Pace, RosSensors
from interactive_nav.task.rollout import HostPolicy
from interactive_nav_common.errors import UserError
from interactive_nav_common.jobs.progress import say
from interactive_nav_common.signals import raise_stop

_GOAL_ARRIVES_S = 0.1
"""Between a goal and the first sensors' data: DDS keeps no order between topics."""


class RosPolicy(HostPolicy):
    """Publish the robot's sensors and goals, and drive by the commands on cmd_vel.

    Each control step waits for its command, so scores do not depend on the computer's speed. The clock continues across
    episodes, where the robot's pose jumps.
    """

    def __init__(self, env: Any):
        """Start a node; `drive` or another one that answers may be started before or after."""
        nodes = contextlib.ExitStack()
        self.close = nodes.close
        atexit.register(self.close)
        self._env, self._sensors, self._node = env, RosSensors(env), nodes.enter_context(ros_node("evaluate"))
        self._goal = self._node.create_publisher(ros.PoseStamped, ros.GOAL, ros.qos(ros.GOAL))
        self._topics = SimulatorNode(self._node, self._sensors, Pace(lockstep=True), say)
        self._steps, self._stop = 0, lambda: bool(raise_stop())

    def act(self, state: Any, episode: np.ndarray, running: np.ndarray, step: int) -> np.ndarray:
        if len(episode) > 1:
            raise UserError("policy ros: one episode at a time can be driven; set --batch 1")
        one = jax.tree.map(operator.itemgetter(0), jax.tree.map(np.asarray, state))
        now = self._sensors.read(one, self._steps * self._sensors.dt_s)
        if not self._steps:
            self._topics.begin(now, self._sensors.camera_poses(one, moving=False), self._stop)
        if step == 0:
            x, y = map(float, one.info["nav"].goal_xy_w)
            pose = ros.Pose(position=ros.Point(x=x, y=y), orientation=ros.yaw_quat(0.0))
            self._goal.publish(ros.PoseStamped(header=ros.header(now.time_s, ros.MAP), pose=pose))
            time.sleep(_GOAL_ARRIVES_S)
        self._steps += 1
        linear, angular = self._topics.answer(self._topics.publish(now), self._stop)
        return np.asarray(self._env.robot.drive(np.array([linear]), np.array([angular]), np), np.float32)
