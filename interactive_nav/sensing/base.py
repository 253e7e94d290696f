"""Define what every renderer offers: images of scenes, `qpos` and camera poses, for a batch at once."""

from __future__ import annotations

import abc
import copy
import functools

import jax

from interactive_nav.physics.base import one_of_batch
from interactive_nav.sensing.boxes import BoxTables
from interactive_nav.sensing.shading import Look
from scenes_mjcf.look import CameraPose, Lens

NEAR_M = 0.01
FAR_M = 100.0
"""Near and far plane of the original's renderer (reference benchmark, section 1.3); what is farther is empty."""


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
