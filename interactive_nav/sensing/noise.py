"""Disturb a camera's images by the errors of real cameras; every model is off by default.

Formulas and sources stand in `docs/sensors.md`.
"""

import functools
import math
from collections.abc import Callable

import jax
import jax.numpy as jnp
import numpy as np

from interactive_nav.camera_config import CameraNoise
from scenes_mjcf.look import Lens

KeyOf = Callable[[str], jax.Array]
"""An error's name to its PRNG key: each has a separate stream, so that switching one on leaves the others alone."""


def disturbed(noise: CameraNoise, lens: Lens, images: dict[str, jax.Array], key_of: KeyOf) -> dict[str, jax.Array]:
    """Return the images of one camera with its errors.

    Args:
        images: as `Renderer.images` gives them: depth in m, rgb in [0, 1]; normals are needed for `depth_grazing_deg`.
    """
    out = dict(images)
    if "rgb" in out:
        out["rgb"] = noisy_rgb(noise, out["rgb"], key_of)
    out["depth"] = noisy_depth(noise, lens, out["depth"], out.get("normals"), key_of)
    if noise.frame_dropout:
        kept = ~jax.random.bernoulli(key_of("frame_dropout"), noise.frame_dropout)
        out = {name: image * kept.astype(image.dtype) for name, image in out.items()}
    return out


def noisy_rgb(noise: CameraNoise, rgb: jax.Array, key_of: KeyOf) -> jax.Array:
    """Return [H, W, 3] in [0, 1] with the errors of the lens, then the exposure, then the sensor."""
    if noise.rgb_blur_px:
        rgb = blurred(rgb, noise.rgb_blur_px)
    if noise.rgb_exposure:
        rgb = jnp.clip(rgb * 2.0 ** (noise.rgb_exposure * jax.random.normal(key_of("rgb_exposure"))), 0.0, 1.0)
    if noise.rgb_noise or noise.rgb_shot_noise:
        deviation = jnp.sqrt(noise.rgb_noise**2 + noise.rgb_shot_noise**2 * rgb)
        rgb = jnp.clip(rgb + deviation * jax.random.normal(key_of("rgb_noise"), rgb.shape), 0.0, 1.0)
    if noise.rgb_dropout:
        lost = jax.random.bernoulli(key_of("rgb_dropout"), noise.rgb_dropout, (*rgb.shape[:-1], 1))
        rgb = jnp.where(lost, 0.0, rgb)
    return rgb


def blurred(image: jax.Array, deviation_px: float) -> jax.Array:
    """Return [H, W, C] convolved with a Gaussian cut at three deviations, its edges continued outwards."""
    reach = math.ceil(3 * deviation_px)
    weights = np.exp(-0.5 * (np.arange(-reach, reach + 1) / deviation_px) ** 2)
    weights = (weights / weights.sum()).astype(np.float32)
    for axis in (0, 1):
        padding = [(reach, reach) if a == axis else (0, 0) for a in range(3)]
        wide, side = jnp.pad(image, padding, mode="edge"), image.shape[axis]
        parts = [w * jax.lax.slice_in_dim(wide, i, i + side, axis=axis) for i, w in enumerate(weights)]
        image = functools.reduce(jnp.add, parts)
    return image


def noisy_depth(
    noise: CameraNoise, lens: Lens, depth: jax.Array, normals: jax.Array | None, key_of: KeyOf
) -> jax.Array:
    """Return [H, W] m as a sensor of structured light reads it; 0 where it reads nothing.

    It measures disparity, the reciprocal of depth times a constant: an even error of disparity is one of depth that
    grows with its square.
    """
    met, out = depth > 0, depth
    near = jnp.maximum(depth, 1e-3)
    if noise.depth_disparity_noise or noise.depth_disparity_step:
        disparity, step = 1.0 / near, noise.depth_disparity_step
        if noise.depth_disparity_noise:
            disparity += noise.depth_disparity_noise * jax.random.normal(key_of("depth_disparity"), depth.shape)
        if step:
            disparity = step * jnp.round(disparity / step)
        # No disparity: too far to be read.
        out = jnp.where(disparity > 0, 1.0 / jnp.maximum(disparity, 1e-6), 0.0)
    if noise.depth_grazing_deg:
        assert normals is not None
        across, upward = jnp.asarray(lens.columns)[None], jnp.asarray(lens.rows)[:, None]
        # Of the ray to the viewer, in the camera's frame, on the surface's normal.
        along = normals[..., 2] - normals[..., 0] * across - normals[..., 1] * upward
        met &= along > math.sin(math.radians(noise.depth_grazing_deg)) * jnp.sqrt(1.0 + across**2 + upward**2)
    if noise.depth_edge_m:
        # What is nearer hides the projector from what is behind it.
        wide = jnp.pad(jnp.where(depth > 0, depth, jnp.inf), 1, mode="edge")
        beside = [wide[1:-1, :-2], wide[1:-1, 2:], wide[:-2, 1:-1], wide[2:, 1:-1]]
        met &= depth - jnp.min(jnp.stack(beside), 0) <= noise.depth_edge_m
    met &= out >= noise.depth_min_m
    if noise.depth_max_m:
        met &= out <= noise.depth_max_m
    return jnp.where(met, out, 0.0)
