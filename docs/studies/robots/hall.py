"""The hall that robots are measured in: a floor without walls near, and boxes to push."""

from __future__ import annotations

import dataclasses
from pathlib import Path

import numpy as np

from interactive_nav.metrics import GRAVITY
from interactive_nav.scenes.scene import Movable, Scene
from scenes_mjcf.schema import SceneManifest, SceneMaps


@dataclasses.dataclass(frozen=True)
class Load:
    """A box to push."""

    name: str
    mass_kg: float
    friction: float
    half_m: tuple[float, float, float]

    @property
    def force_n(self) -> float:
        """Horizontal force that keeps it sliding: mu m g."""
        return self.friction * self.mass_kg * GRAVITY


LOADS = (
    Load("basket", 0.9, 0.5, (0.14, 0.19, 0.12)),
    Load("table", 12.0, 0.4, (0.3, 0.3, 0.25)),
    Load("sofa", 80.0, 0.6, (0.45, 1.0, 0.4)),
)


def box(load: Load, x: float, y: float) -> Movable:
    """The load on the floor, its middle at (x, y) m."""
    hx, hy, hz = load.half_m
    inertia = load.mass_kg / 3 * np.array([hy**2 + hz**2, hx**2 + hz**2, hx**2 + hy**2])
    return Movable(
        name=load.name,
        category="table",
        mass_kg=load.mass_kg,
        inertia=inertia,
        com_m=np.zeros(3),
        inertia_quat=np.array([1.0, 0, 0, 0]),
        pos_w=np.array([x, y, hz]),
        quat_w=np.array([1.0, 0, 0, 0]),
        friction=load.friction,
        boxes=np.array([[0, 0, 0, 1, 0, 0, 0, hx, hy, hz]]),
        hulls=(),
        joint=None,
    )


def hall(movables: tuple[Movable, ...]) -> Scene:
    """A scene in memory: a floor without walls near, and the given bodies."""
    manifest = SceneManifest("hall", "train", {"format": "none", "files": {}}, "CC0-1.0", 1.0, (), {}, {}, {})
    maps = SceneMaps(np.ones((4, 4), bool), 0.05, (0.0, 0.0), 0.0)
    wall = np.array([[0.0, -100.0, 0.5, 1, 0, 0, 0, 1.0, 0.05, 0.5]])
    return Scene(Path("hall"), "hall", "train", "", manifest, maps, wall, movables)
