"""What the environment must know of a robot, in one frozen record."""

from __future__ import annotations

import dataclasses
from collections.abc import Callable

import mujoco
import numpy as np


@dataclasses.dataclass(frozen=True)
class RobotSpec:
    """A robot: its MJCF and the figures that the task needs. Frame: x forward, y left, z up."""

    name: str
    add_to: Callable[[mujoco.MjSpec], None]
    """Adds the robot to a world spec: one body `base_body` with a free joint, its actuators and sites."""
    base_body: str
    """Body whose free joint is the robot's pose; its subtree is 'the robot' for contact forces."""
    base_joint: str
    actuators: tuple[str, ...]
    """One per action, in order."""
    action_low: tuple[float, ...]
    """Command at action -1, per actuator, in the actuator's unit."""
    action_high: tuple[float, ...]
    """Command at action +1."""
    body_width_m: float
    """Success distance: the paper's 'width of the robot's body'."""
    footprint_radius_m: float
    """Smallest disc about the base frame that holds the body: erosion of maps, clearance of placements."""
    height_m: float
    """Top of the body above the floor."""
    spawn_height_m: float
    """Height of the base frame above the floor when the robot stands."""

    @property
    def action_size(self) -> int:
        """Number of actions."""
        return len(self.actuators)

    def command(self, action, xp=np):
        """Maps actions [..., A] in [-1, 1] (clipped) affinely to actuator commands [..., A]."""
        low, high = xp.asarray(self.action_low), xp.asarray(self.action_high)
        return low + 0.5 * (xp.clip(action, -1.0, 1.0) + 1.0) * (high - low)
