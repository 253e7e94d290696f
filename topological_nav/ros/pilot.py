"""A map, networks and goal pictures in, the navigator as a driver out."""

from __future__ import annotations

import dataclasses
from pathlib import Path

import numpy as np
from PIL import Image

from interactive_nav.robots import get_robot
from interactive_nav_common.errors import ConfigError
from topological_nav.config import PASSAGE_POLICY, NavigatorConfig
from topological_nav.data.folders import lens_of
from topological_nav.drives.driving import local_policy
from topological_nav.learn.pairs import load_networks
from topological_nav.maps.graph import load_map
from topological_nav.maps.sight import NetworkSight
from topological_nav.navigate.navigator import Navigator, Pilot
from topological_nav.ros.drivers import PilotDriver
from topological_nav.ros.messages import seen_through


@dataclasses.dataclass(frozen=True)
class Journey:
    """What the navigator goes by, and where to."""

    map: Path
    localiser: Path
    """Run folder: embeds images."""
    detector: Path
    """Run folder: judges passages."""
    goals: tuple[Path, ...]
    """Pictures taken at the goal, along headings evenly about it; as wide as what the networks learned from."""
    goal_heading_rad: float = 0.0
    """Of the first, in the map's frame."""
    policy: str = PASSAGE_POLICY
    """What drives along edges: passage, straight on while the detector agrees; or a run folder."""


def topological_driver(journey: Journey, config: NavigatorConfig) -> PilotDriver:
    """The navigator, with its goal.

    Raises:
        MapError, RunError: map or networks cannot be used, or do not belong together.
        ConfigError: no goal picture, or one that cannot be read.
    """
    networks, made = load_networks(journey.localiser, journey.detector), load_map(journey.map)
    lens = lens_of(networks.camera, get_robot(networks.camera.robot))
    sight = NetworkSight(made, networks.localiser, networks.detector, config.match)
    seeing = (journey.localiser, networks.localiser), (journey.detector, networks.detector)
    policy = local_policy(journey.policy, sight, config, *seeing)
    if not journey.goals:
        raise ConfigError("the navigator has no goal; name a picture taken there: --goal PICTURE")
    pictures = np.stack([seen_through(_picture(path), lens.fov_deg, lens) for path in journey.goals])
    around = journey.goal_heading_rad + 2 * np.pi * np.arange(len(pictures)) / len(pictures)
    return PilotDriver(Pilot(Navigator(made, sight, policy, config), pictures[None], around), lens)


def _picture(path: Path) -> np.ndarray:
    try:
        with Image.open(path) as image:
            return np.asarray(image.convert("RGB"))
    except OSError as error:
        raise ConfigError(f"{path}: is no picture that can be read ({error})") from None
