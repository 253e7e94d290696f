"""A map, networks and goal pictures in, the navigator as a driver out."""

from collections.abc import Sequence
from pathlib import Path

import numpy as np
from PIL import Image

from interactive_nav.robots import get_robot
from interactive_nav_common.errors import ConfigError
from topological_nav.config import NavigatorConfig
from topological_nav.data.folders import lens_of
from topological_nav.drives.driving import local_policy
from topological_nav.learn.training import load_networks
from topological_nav.maps.graph import load_map
from topological_nav.maps.sight import NetworkSight
from topological_nav.navigate.navigator import Navigator
from topological_nav.ros.drivers import PilotDriver
from topological_nav.ros.messages import seen_through
from topological_nav.weights.packaged import Choice


def topological_driver(
    map_file: Path, seeing: Choice, goals: Sequence[Path], goal_heading_rad: float, config: NavigatorConfig
) -> PilotDriver:
    """Return the navigator with its goal; the first picture of it looks along `goal_heading_rad` in the map's frame."""
    networks, made = load_networks(seeing.localiser, seeing.detector), load_map(map_file)
    lens = lens_of(networks.camera, get_robot(networks.camera.robot))
    sight = NetworkSight(made, networks.localiser, networks.detector, config.match)
    runs = (seeing.localiser, networks.localiser), (seeing.detector, networks.detector)
    policy = local_policy(seeing.policy, sight, config, *runs)
    if not goals:
        raise ConfigError("the navigator has no goal; name a picture taken there: --goal PICTURE")
    pictures = np.stack([seen_through(_picture(path), lens.fov_deg, lens) for path in goals])
    around = goal_heading_rad + 2 * np.pi * np.arange(len(pictures)) / len(pictures)
    navigator = Navigator(made, sight, policy, config)
    return PilotDriver(navigator, navigator.start(navigator.goal_nodes(pictures[None], around)), lens)


def _picture(path: Path) -> np.ndarray:
    try:
        with Image.open(path) as image:
            return np.asarray(image.convert("RGB"))
    except OSError as error:
        raise ConfigError(f"{path}: is no picture that can be read ({error})") from None
