"""Define drivers behind the navigator's node, which map an image, a heading and a time to a velocity."""

from collections.abc import Sequence
from pathlib import Path

import numpy as np

from interactive_nav import get_robot
from interactive_nav_common.errors import ConfigError
from scenes_mjcf.look import Lens
from topological_nav.config import NavigatorConfig
from topological_nav.data.folders import lens_of
from topological_nav.data.photographs import read_picture
from topological_nav.drives.driving import local_policy
from topological_nav.learn.training import load_networks
from topological_nav.maps.build import NetworkSight
from topological_nav.maps.graph import load_map
from topological_nav.navigate.navigator import Navigator, State
from topological_nav.weights.export import Choice


class PilotDriver:
    """Drive one robot by the navigator until it reaches the goal or runs out of time."""

    def __init__(self, navigator: Navigator, state: State, lens: Lens | None):
        """Begin an episode from its first state; `lens` is the one that pictures must have, None: any."""
        self._navigator, self._state, self.lens = navigator, state, lens

    def step(self, image: np.ndarray, heading_rad: float, time_s: float) -> tuple[tuple[float, float], bool]:
        """Return the next command, m/s and rad/s, and whether the episode is over and the robot stands still.

        It follows from a level image [H, W, 3] u8 straight ahead and the yaw in the map's frame.
        """
        now = image[None], np.array([heading_rad]), np.array([time_s])
        self._state = state = self._navigator.step(self._state, *now)
        done = bool(state.arrived[0]) or bool(state.timed_out[0])
        return (0.0, 0.0) if done else (float(state.linear[0]), float(state.angular[0])), done


def topological_driver(
    map_file: Path, choice: Choice, goals: Sequence[Path], goal_heading_rad: float, config: NavigatorConfig
) -> PilotDriver:
    """Return the navigator with its goal; the goal's first image is along `goal_heading_rad` in the map's frame."""
    networks, built = load_networks(choice.localiser, choice.detector), load_map(map_file)
    lens = lens_of(networks.camera, get_robot(networks.camera.robot))
    sight = NetworkSight(built, networks, config.match)
    policy = local_policy(choice.policy, sight, config, networks)
    if not goals:
        raise ConfigError("the navigator has no goal; name a picture taken there: --goal PICTURE")
    pictures = [read_picture(path, lens.fov_deg, lens) for path in goals]
    around = goal_heading_rad + 2 * np.pi * np.arange(len(pictures)) / len(pictures)
    navigator = Navigator(built, sight, policy, config)
    return PilotDriver(navigator, navigator.start(navigator.goal_nodes(np.stack(pictures)[None], around)), lens)
