"""The toy with a picture: where the goal lies is to be seen in an image only, so who learns has looked at it."""

from __future__ import annotations

from typing import Any

import jax.numpy as jnp

from tests.train.toy_env import ToyEnv, ToyNav
from train.config import NetworkConfig

SIDE, SPAN_M = 12, 5.4
"""Pixels a side, and the side of the ground that the picture shows, the robot in its middle."""
SMALL = NetworkConfig(
    conv_channels=(8, 8),
    conv_kernels=(4, 3),
    conv_strides=(2, 1),
    image_features=32,
    state_features=16,
    action_features=16,
)
"""Encoders small enough for a CPU and 12 x 12 pixels."""


class ToyPixels(ToyEnv):
    """ToyEnv seen from above: a u8 map with a blob at the goal, in the robot's frame; the vector is the velocity."""

    def __init__(self, *given: Any, **named: Any):
        super().__init__(*given, **named)
        self.sensors.sizes = {"velocity": 6}

    @property
    def observation_size(self) -> Any:
        return {"state": (6,), "pixels/depth": (SIDE, SIDE, 1), "pixels/segmentation": (SIDE, SIDE, 1)}

    def _observe(self, nav: ToyNav) -> Any:
        vector = super()._observe(nav)
        centres_m = ((jnp.arange(SIDE) + 0.5) / SIDE - 0.5) * SPAN_M
        x, y = centres_m[:, None] - vector[20], centres_m[None, :] - vector[21]
        blob = jnp.exp(-(x**2 + y**2) / (2 * 0.5**2))
        image = jnp.round(255 * blob).astype(jnp.uint8)[..., None]
        return {"state": vector[23:29], "pixels/depth": image, "pixels/segmentation": jnp.zeros_like(image)}
