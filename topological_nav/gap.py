"""Simulate slip, delays and a drifting compass of real robots between a navigator and simulated robots."""

import dataclasses
from typing import Annotated

import numpy as np

from interactive_nav_common.config import Bounds, Settings
from interactive_nav_common.rotations import scale_sides


@dataclasses.dataclass(frozen=True)
class GapConfig(Settings):
    """Set how a robot differs from the one that the navigator commands; the defaults change nothing."""

    linear_gain: Annotated[float, Bounds(0.0, 10.0)] = 1.0
    """Forward velocity that the robot executes per commanded m/s."""
    angular_gain: Annotated[float, Bounds(0.0, 10.0)] = 1.0
    """Turning velocity that the robot executes per commanded rad/s."""
    slip: Annotated[float, Bounds(0.0, 10.0)] = 0.0
    """Standard deviation of the speed of each side's wheels, as a share of it, drawn in every control step."""
    delay_steps: Annotated[int, Bounds(0, 1000)] = 0
    """Number of control steps (of 0.1 s) between a command and its execution."""
    image_steps: Annotated[int, Bounds(1, 1000)] = 1
    """Number of control steps between two images; in between, the navigator uses the last one."""
    compass_deg: Annotated[float, Bounds(-180.0, 180.0)] = 0.0
    """Error of the compass in degrees."""
    compass_drift_deg: Annotated[float, Bounds(-3600.0, 3600.0)] = 0.0
    """Change of the compass error in degrees per minute."""


class Gap:
    """Hold the pending commands to a batch of robots; noise depends on seed, episode and control step alone."""

    def __init__(self, config: GapConfig, seed: int, episode: np.ndarray, half_width_m: float):
        """Store the numbers of the episodes [B], and half the distance between the robot's wheels."""
        self._config, self._seed, self._episode, self._half_m = config, seed, episode, half_width_m
        self._waiting = np.zeros((config.delay_steps, len(episode), 2))

    def keep(self, rows: np.ndarray) -> None:
        """Keep only these rows of the batch."""
        self._episode, self._waiting = self._episode[rows], self._waiting[:, rows]

    def heading(self, yaw_rad: np.ndarray, time_s: float) -> np.ndarray:
        """Return the compass headings [B] (rad) at a time of the episode."""
        return yaw_rad + np.radians(self._config.compass_deg + self._config.compass_drift_deg * time_s / 60.0)

    def executed(self, linear: np.ndarray, angular: np.ndarray, step: int) -> tuple[np.ndarray, np.ndarray]:
        """Return the velocities [B] (m/s, rad/s) that robots execute in the step of a command."""
        queue = np.concatenate([self._waiting, np.stack([linear, angular], -1)[None]])
        self._waiting, config = queue[1:], self._config
        linear, angular = (queue[0] * [config.linear_gain, config.angular_gain]).T
        if not config.slip:
            return linear, angular
        rngs = (np.random.default_rng([self._seed, 15, number, step]) for number in self._episode.tolist())
        left, right = 1.0 + config.slip * np.array([rng.standard_normal(2) for rng in rngs]).T
        return scale_sides(linear, angular, left, right, self._half_m)
