"""The small objects strewn about each episode: parametric boxes out, with real-world masses (kg) and sizes (m).

Four kinds as in the paper (section IV): baskets, shoes, pots, toys. The original's meshes are not public
with textures, so these are ours: unions of boxes, which every physics backend collides alike.
"""

from __future__ import annotations

import dataclasses
import math


@dataclasses.dataclass(frozen=True)
class Box:
    """A box of an object, in the object's frame (origin on the floor, z up)."""

    centre_m: tuple[float, float, float]
    half_m: tuple[float, float, float]


@dataclasses.dataclass(frozen=True)
class SmallObject:
    """A movable small object."""

    category: str
    mass_kg: float
    friction: float
    boxes: tuple[Box, ...]

    @property
    def radius_m(self) -> float:
        """Radius of the disc about the origin that holds the object's footprint."""
        return max(math.hypot(abs(b.centre_m[0]) + b.half_m[0], abs(b.centre_m[1]) + b.half_m[1]) for b in self.boxes)


def _basket(width: float, depth: float, height: float, mass: float) -> SmallObject:
    wall = 0.012
    w, d, h = width / 2, depth / 2, height / 2
    return SmallObject(
        "basket",
        mass,
        0.5,
        (
            Box((0, 0, wall / 2), (w, d, wall / 2)),
            Box((w - wall / 2, 0, h), (wall / 2, d, h)),
            Box((-w + wall / 2, 0, h), (wall / 2, d, h)),
            Box((0, d - wall / 2, h), (w, wall / 2, h)),
            Box((0, -d + wall / 2, h), (w, wall / 2, h)),
        ),
    )


def _shoe(length: float, width: float, mass: float) -> SmallObject:
    return SmallObject(
        "shoe",
        mass,
        0.7,
        (
            Box((0, 0, 0.025), (length / 2, width / 2, 0.025)),
            Box((-0.22 * length, 0, 0.075), (0.28 * length, 0.42 * width, 0.025)),
        ),
    )


def _pot(width: float, height: float, mass: float) -> SmallObject:
    # An octagonal prism from two boxes turned against each other would need a quaternion; a plus of two
    # boxes keeps the frame and is 8 % smaller in area than the disc.
    r = width / 2
    return SmallObject(
        "pot",
        mass,
        0.45,
        (
            Box((0, 0, height / 2), (r * 0.92, r * 0.55, height / 2)),
            Box((0, 0, height / 2), (r * 0.55, r * 0.92, height / 2)),
        ),
    )


def _toy(length: float, width: float, mass: float) -> SmallObject:
    return SmallObject(
        "toy",
        mass,
        0.4,
        (
            Box((0, 0, 0.04), (length / 2, width / 2, 0.04)),
            Box((0.05 * length, 0, 0.115), (0.2 * length, 0.4 * width, 0.035)),
        ),
    )


# Masses: a plastic laundry basket weighs 0.6 to 1.2 kg, a shoe 0.3 to 0.5, a cooking or flower pot
# 0.8 to 2, a toy car or robot 0.3 to 0.7.
MODELS: tuple[SmallObject, ...] = (
    _basket(0.38, 0.28, 0.24, 0.9),
    _shoe(0.28, 0.10, 0.38),
    _pot(0.24, 0.18, 1.4),
    _toy(0.26, 0.16, 0.5),
    _shoe(0.25, 0.09, 0.32),
    _basket(0.30, 0.30, 0.30, 0.7),
    _toy(0.18, 0.12, 0.3),
    _pot(0.18, 0.14, 0.9),
)


def pick(num_objects: int) -> tuple[SmallObject, ...]:
    """The first `num_objects` of the models, repeated in order: ten give 3 baskets, 3 shoes, 2 pots, 2 toys.

    Raises:
        ValueError: a negative number.
    """
    if num_objects < 0:
        raise ValueError(f"num_objects is {num_objects}, expected 0 or more")
    return tuple(MODELS[i % len(MODELS)] for i in range(num_objects))
