"""What the navigator's node drives by: a picture, a heading and a time in, a velocity out."""

from __future__ import annotations

import dataclasses
import math
from typing import TYPE_CHECKING, Protocol

import numpy as np

from interactive_nav_common.errors import UserError
from topological_nav.ros.config import HeadingConfig

if TYPE_CHECKING:
    from scenes_mjcf.look import Lens
    from topological_nav.navigate.navigator import Navigator
    from topological_nav.navigate.state import State


@dataclasses.dataclass(frozen=True)
class Command:
    """What a driver wants until its next step."""

    linear_mps: float
    angular_radps: float
    done: bool = False
    """The episode is over: the robot stands, and no more is asked."""

    def __post_init__(self) -> None:
        if not math.isfinite(self.linear_mps + self.angular_radps):
            raise UserError(
                f"the driver commands {self.linear_mps} m/s and {self.angular_radps} rad/s, expected finite numbers"
            )


class Driver(Protocol):
    """Drives one episode; called once for each picture that arrives."""

    @property
    def lens(self) -> Lens | None:
        """That its pictures must be seen through; None: any."""
        ...

    def step(self, image: np.ndarray, heading_rad: float, time_s: float) -> Command:
        """Return the next command, by a level image [H, W, 3] u8 straight ahead and the yaw in the map's frame."""
        ...


class HeadingDriver:
    """Turns to a heading and drives along it; looks at no picture. For tests, and for trying out a robot's topics."""

    lens: Lens | None = None

    def __init__(self, config: HeadingConfig):
        self._config = config
        self._since: float | None = None

    def step(self, image: np.ndarray, heading_rad: float, time_s: float) -> Command:
        """See `Driver.step`."""
        del image
        config = self._config
        error = math.remainder(config.heading_rad - heading_rad, math.tau)
        turn = min(max(config.gain * error, -config.max_angular_radps), config.max_angular_radps)
        if self._since is None:
            if abs(error) > config.tolerance_rad:
                return Command(0.0, turn)
            self._since = time_s
        if time_s - self._since >= config.drive_s - 1e-6:
            return Command(0.0, 0.0, done=True)
        return Command(config.linear_mps, turn)


class PilotDriver:
    """Drive one robot by the navigator: done where it arrived, or ran out of time."""

    def __init__(self, navigator: Navigator, state: State, lens: Lens):
        """Take the navigator and its state, of `Navigator.start`."""
        self._navigator, self._state, self.lens = navigator, state, lens

    def step(self, image: np.ndarray, heading_rad: float, time_s: float) -> Command:
        """See `Driver.step`."""
        seen = image[None], np.array([heading_rad]), np.array([time_s])
        self._state, linear, angular, events = self._navigator.step(self._state, *seen)
        done = bool(events.arrived[0]) or bool(events.timed_out[0])
        return Command(0.0, 0.0, done=True) if done else Command(float(linear[0]), float(angular[0]))
