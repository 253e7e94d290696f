"""Colour classes and bodies, and light pictures and observations."""

from typing import Any

import flax.struct
import jax
import jax.numpy as jnp
import mujoco
import numpy as np

from interactive_nav.scenes.objects import VISUAL_GROUP
from interactive_nav.scenes.scene import Scene
from scenes_mjcf.categories import SEGMENTATIONS, MaskClasses
from scenes_mjcf.look import SKY_COLOUR, geom_image

FLOOR_COLOUR = (0.56, 0.50, 0.43)
PALETTES = {
    classes: np.array([*masks.colours, FLOOR_COLOUR, SKY_COLOUR], np.float32)
    for classes, masks in SEGMENTATIONS.items()
}
"""The setting `segmentation_classes` -> colours by class id, then the floor's and the background's."""
_LIGHT_W = np.array([0.35, 0.25, 0.9], np.float32) / np.linalg.norm([0.35, 0.25, 0.9])


@flax.struct.dataclass
class Look:
    """How an episode looks; leading axes as the caller has them."""

    tint: jax.Array
    """[..., classes, 3] factors of the colours of each class of the masks; structure and sky are 0."""
    sun_w: jax.Array
    """[..., 3] unit vector towards the sun."""
    brightness: jax.Array
    """[...] factor of everything."""


def draw_look(key: jax.Array, colours: float, light: float, classes: MaskClasses) -> Look:
    """Draw an episode's look with standard deviations `colours` and `light`.

    `light` is in stops of brightness, and of each component of the vector to the sun before it has length 1.
    """
    tint, sun, bright = jax.random.split(key, 3)
    sun_w = _LIGHT_W + light * jax.random.normal(sun, (3,))
    # It stays above the floor.
    sun_w = sun_w.at[2].set(jnp.maximum(jnp.abs(sun_w[2]), 0.1))
    return Look(
        jnp.exp(colours * jax.random.normal(tint, (len(SEGMENTATIONS[classes].names), 3))),
        sun_w / jnp.linalg.norm(sun_w),
        2.0 ** (light * jax.random.normal(bright)),
    )


def lit(base: Any, normal_w: Any, forward_w: Any, met: Any, xp: Any, sun_w: Any = _LIGHT_W) -> Any:
    """Return colours [..., 3] in [0, 1] under a sun and a lamp at the camera; what is not `met` keeps its colour."""
    light_w = xp.broadcast_to(xp.asarray(sun_w), normal_w.shape)
    sun = xp.maximum((normal_w * light_w).sum(-1), 0.0)
    lamp = xp.maximum(-(normal_w * forward_w).sum(-1), 0.0)
    return base * xp.where(met, xp.minimum(0.45 + 0.4 * sun + 0.25 * lamp, 1.0), 1.0)[..., None]


def lambert(base: Any, normal_w: Any, forward_w: Any, met: Any, xp: Any) -> Any:
    """Return `lit` as u8."""
    return xp.round(255.0 * lit(base, normal_w, forward_w, met, xp)).astype(xp.uint8)


def geom_colour(model: mujoco.MjModel, geom: int) -> np.ndarray:
    """Return (3,) in [0, 1]: of the geom, or its texture's mean."""
    material, image = model.geom_matid[geom], geom_image(model, geom)
    if image is None:
        return (model.mat_rgba[material] if material >= 0 else model.geom_rgba[geom])[:3]
    pixels = image.reshape(-1, image.shape[-1])[:, :3]
    # Atlases are padded with black.
    used = pixels.max(1) > 8
    return pixels[used].mean(0) / 255.0 if used.any() else np.full(3, 0.5)


def visual_geoms(scene: Scene) -> tuple[mujoco.MjModel, dict[str, list[int]]]:
    """Return a scene's model as stored, and the geoms for show by the name of each body that has any."""
    model, geoms = mujoco.MjModel.from_xml_path(str(scene.path / "scene.xml")), {}
    for geom in map(int, np.flatnonzero(model.geom_group == VISUAL_GROUP)):
        geoms.setdefault(model.body(model.geom_bodyid[geom]).name, []).append(geom)
    return model, geoms
