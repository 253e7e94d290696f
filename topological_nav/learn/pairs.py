"""Two runs in, a localiser and a passage detector out that see through one camera."""

import dataclasses
from collections.abc import Sequence
from pathlib import Path
from typing import Any

from interactive_nav_common.config import overlay
from topological_nav.config import DataConfig
from topological_nav.errors import RunError
from topological_nav.learn.training import Trained, load_trained

SAME = ("robot", "engine", "width", "height", "fov_deg")
"""What two networks' images must have in common to look through one camera."""


def seen_by(network: Trained) -> dict[str, Any]:
    """Settings of the images that a network learned from, the lens as it was."""
    return {**network.about["data"], "fov_deg": network.about["fov_deg"]}


def need_task(about: dict[str, Any], task: str, who: str) -> None:
    """Refuses a run of another task."""
    if about["task"] != task:
        raise RunError(f"{who} was trained for '{about['task']}', expected a run of 'train {task}'")


def load_pair(localiser_run: Path, detector_run: Path, same: Sequence[str] = SAME) -> tuple[Trained, Trained]:
    """A room classifier and a passage detector of finished runs."""
    networks = load_trained(localiser_run), load_trained(detector_run)
    for run, network, task in zip((localiser_run, detector_run), networks, ("rooms", "passages"), strict=True):
        need_task(network.about, task, f"{run}:")
    _need_one_camera(*networks, same)
    return networks


@dataclasses.dataclass(frozen=True)
class Networks:
    """What a navigator sees by."""

    localiser: Trained
    detector: Trained
    camera: DataConfig

    @property
    def digests(self) -> dict[str, str]:
        """Of the weights, as a map names those that made it."""
        return {"localiser": self.localiser.about["digest"], "detector": self.detector.about["digest"]}


def load_networks(localiser: Path, detector: Path) -> Networks:
    """The networks of two finished runs; the first may be of either task, as any embedding localises."""
    pair = load_trained(localiser), load_trained(detector)
    return Networks(*pair, camera_of(*pair))


def camera_of(localiser: Trained, detector: Trained) -> DataConfig:
    """The settings of the camera that both networks learned from."""
    need_task(detector.about, "passages", "the detector")
    _need_one_camera(localiser, detector, (*SAME, "headings"))
    return overlay(DataConfig(), seen_by(localiser), "network.json")


def _need_one_camera(localiser: Trained, detector: Trained, same: Sequence[str]) -> None:
    first, second = seen_by(localiser), seen_by(detector)
    for name in same:
        if first[name] != second[name]:
            raise RunError(
                f"the localiser learned from images with {name} = {first[name]!r}, the detector {second[name]!r}; "
                "train both on one dataset"
            )
