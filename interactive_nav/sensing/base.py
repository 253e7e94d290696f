"""Define what every renderer offers: images of scenes, `qpos` and camera poses, for a batch at once."""

from __future__ import annotations

import abc
import copy
import dataclasses
import functools
import math
from typing import Any

import flax.struct
import jax
import jax.numpy as jnp
import numpy as np

from interactive_nav.physics.base import one_of_batch
from interactive_nav.sensing.boxes import BoxTables
from interactive_nav.sensing.shading import Look

NEAR_M = 0.01
FAR_M = 100.0
"""Near and far plane of the original's renderer (reference benchmark, section 1.3); what is farther is empty."""


@flax.struct.dataclass
class CameraPose:
    """Where a camera is, world frame."""

    pos_w: Any
    """[..., 3], m: f32 of JAX, or NumPy's on the host."""
    axes_w: Any
    """[..., 3, 3], columns: forward, right, up."""


@dataclasses.dataclass(frozen=True)
class Lens:
    """A pinhole camera with square pixels."""

    width: int
    height: int
    fov_deg: float
    """Vertical field of view."""

    @property
    def half_height(self) -> float:
        """Return half of the image's height at depth 1."""
        return math.tan(math.radians(self.fov_deg) / 2)

    @property
    def pixel(self) -> float:
        """Return the side of a pixel at depth 1."""
        return 2 * self.half_height / self.height

    @property
    def columns(self) -> np.ndarray:
        """Return [width] f32: rightward offset of the pixels' centres at depth 1, left to right."""
        return ((np.arange(self.width) + 0.5 - self.width / 2) * self.pixel).astype(np.float32)

    @property
    def rows(self) -> np.ndarray:
        """Return [height] f32: upward offset at depth 1, top to bottom."""
        return ((self.height / 2 - np.arange(self.height) - 0.5) * self.pixel).astype(np.float32)

    def rays(self, pose: CameraPose) -> np.ndarray:
        """Return the rays [height, width, 3] of one camera's pixels, world frame; along its axis their length is 1."""
        right, up = np.meshgrid(self.columns.astype(float), self.rows.astype(float))
        return np.stack([np.ones_like(right), right, up], -1) @ np.asarray(pose.axes_w, float).T


def look_along(pos_w: Any, forward_w: Any) -> CameraPose:
    """Return a camera without roll: its right is horizontal, as if the world's z were up.

    NumPy's arrays stay NumPy's: JAX would compile each operation anew for every number of cameras.

    Args:
        pos_w: [..., 3] m.
        forward_w: [..., 3], any length; a vertical one takes the world's -y as right.
    """
    xp = jnp if isinstance(forward_w, jax.Array) else np
    forward = forward_w / xp.linalg.norm(forward_w, axis=-1, keepdims=True)
    flat = xp.stack([forward[..., 1], -forward[..., 0], xp.zeros_like(forward[..., 0])], -1)
    length = xp.linalg.norm(flat, axis=-1, keepdims=True)
    aside = xp.broadcast_to(xp.asarray([0.0, -1.0, 0.0], forward.dtype), flat.shape)
    right = xp.where(length > 1e-6, flat / xp.where(length > 1e-6, length, 1.0), aside)
    up = xp.cross(right, forward)
    return CameraPose(pos_w, xp.stack([forward, right, up], -1))


class Renderer(abc.ABC):
    """Draws N environments at once through one lens."""

    name: str
    lens: Lens
    tables: BoxTables

    def through(self, lens: Lens) -> Renderer:
        """Return a renderer of the same through another lens; what does not depend on that is shared."""
        other = copy.copy(self)
        other.lens = lens
        return other

    def render_batch(self, scene: jax.Array, qpos: jax.Array, camera: CameraPose) -> tuple[jax.Array, jax.Array]:
        """Draw a batch.

        Args:
            scene: [N] i32 index of each environment's scene.
            qpos: [N, nq] f32.
            camera: leaves [N, ...].

        Returns:
            Depth [N, H, W] f32, the distance along the optical axis, m, 0 where nothing is met; class ids [N, H, W] u8.
        """
        images = self.images_batch(("depth", "segmentation"), scene, qpos, camera)
        return images["depth"], images["segmentation"]

    @abc.abstractmethod
    def images_batch(
        self, names: tuple[str, ...], scene: jax.Array, qpos: jax.Array, camera: CameraPose, look: Look | None = None
    ) -> dict[str, jax.Array]:
        """Draw a batch in several ways.

        Args:
            scene: [N] i32.
            qpos: [N, nq] f32.
            camera: leaves [N, ...].
            look: leaves [N, ...]; None: objects keep their colours.

        Returns:
            depth and segmentation as `render_batch` gives them; rgb [N, H, W, 3] f32 in [0, 1]; normals
            [N, H, W, 3] f32, unit vectors in the camera's frame (right, up, towards the viewer), 0 where nothing is.
        """

    def images(
        self, names: tuple[str, ...], scene: jax.Array, qpos: jax.Array, camera: CameraPose, look: Look | None = None
    ) -> dict[str, jax.Array]:
        """Draw one environment's `images_batch`; under any number of `vmap`s all are drawn in one call."""
        drawn = (scene, qpos, camera) if look is None else (scene, qpos, camera, look)
        return one_of_batch(functools.partial(self.images_batch, names), drawn)

    def render(self, scene: jax.Array, qpos: jax.Array, camera: CameraPose) -> tuple[jax.Array, jax.Array]:
        """Draw one environment's `render_batch`; under any number of `vmap`s all are drawn in one call."""
        return one_of_batch(self.render_batch, (scene, qpos, camera))
