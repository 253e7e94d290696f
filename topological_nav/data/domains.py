"""Convert rendered images to those of another camera, as a stand-in for the real world.

Steps follow a real camera: lens (narrower, distorted, vignetted), motion blur, exposure and white balance in linear
light, sensor noise, tone curve. All are pure functions of images and a seed.
"""

import dataclasses
import math
from pathlib import Path
from typing import Annotated, Literal

import numpy as np
from scipy.ndimage import convolve1d, map_coordinates

from interactive_nav_common.config import Bounds, Count, Seed, Settings, Share
from interactive_nav_common.records import read_packaged

_GAMMA = 2.2
"""Between grey levels and linear light of rendered images."""
_CHUNK = 256


@dataclasses.dataclass(frozen=True)
class DomainConfig(Settings):
    """Describe a camera that is not the renderer's; the defaults change nothing."""

    seed: Seed = 0
    """Of noise and of what differs from image to image."""
    zoom: Annotated[float, Bounds(1.0, 10.0)] = 1.0
    """Focal length over the renderer's: 1.3 sees the middle 77 % of the picture's height."""
    barrel: Annotated[float, Bounds(0.0, 2.0)] = 0.0
    """Radial distortion: what is shown at radius r (1 in the corners) comes from r (1 + barrel r^2) / (1 + barrel): the
    middle bulges, as in wide lenses."""
    vignette: Share = 0.0
    """Share of light that the corners lose."""
    blur_px: Annotated[float, Bounds(0.0, 1000.0)] = 0.0
    """Longest way of a point during the exposure, along the rows: a robot that turns. Images differ, from 0 to this."""
    exposure_ev: Annotated[float, Bounds(-10.0, 10.0)] = 0.0
    """Stops brighter (+) or darker (-)."""
    exposure_spread_ev: Annotated[float, Bounds(0.0, 10.0)] = 0.0
    """Standard deviation of the exposure from image to image."""
    warmth: Annotated[float, Bounds(-0.9, 0.9)] = 0.0
    """White balance: red gains, and blue loses, this share of light."""
    contrast: Annotated[float, Bounds(0.1, 10.0)] = 1.0
    """Of the tone curve about middle grey, in grey levels."""
    shot_noise: Annotated[float, Bounds(0.0, 10.0)] = 0.0
    """Standard deviation of light at full scale, as a share of it; it goes with the root of the light."""
    read_noise: Annotated[float, Bounds(0.0, 10.0)] = 0.0
    """Standard deviation of light in the dark, as a share of full scale."""


PRESETS = read_packaged(Path(__file__).with_suffix(".yaml"), dict[str, DomainConfig])
"""Named cameras; `camera` is all of them at once. Sizes in pixels are meant for images of 64 x 48."""


@dataclasses.dataclass(frozen=True)
class AdaptConfig(Settings):
    """Set how networks are taken to another domain; `preset=report` has the report's values."""

    seed: Seed = 0
    """Random seed of weights, order and splits."""
    domain: Literal[tuple(PRESETS)] = "camera"  # type: ignore[valid-type]
    """Camera that takes target images; `camera` is all the others at once."""
    epochs: Count = 20
    """features: passes over the target images."""
    batch: Count = 50
    """features: images of each domain per update."""
    learning_rate: Annotated[float, Bounds(1e-9, 10.0)] = 1e-4
    """features: Adam's step size for the extractor."""
    critic_learning_rate: Annotated[float, Bounds(1e-9, 10.0)] = 1e-3
    """features: Adam's step size for the critic."""
    hidden: Count = 512
    """features: units of each of the critic's two layers."""
    fine_tune: Annotated[int, Bounds(2, 10**6)] = 252
    """passages: most target images to learn from."""
    fine_tune_free: Annotated[int | None, Bounds(1, 10**6)] = None
    """passages: number of free images to learn from; auto: half."""
    test: Annotated[int, Bounds(2, 10**6)] = 108
    """passages: most target images to test on."""
    test_free: Annotated[int | None, Bounds(1, 10**6)] = None
    """passages: number of free images to test on; auto: half."""
    fine_tune_epochs: Count = 20
    """passages: passes over the images."""
    fine_tune_batch: Count = 32
    """passages: images per update."""
    fine_tune_augment: bool = True
    """passages: vary brightness, contrast and colour, and shift and mirror images."""
    fine_tune_learning_rate: Annotated[float, Bounds(1e-9, 10.0)] = 1e-4
    """passages: Adam's step size."""
    edge_m: Annotated[float, Bounds(0.1, 100.0)] = 2.5
    """map: largest distance in m between joined nodes, in both directions."""
    passable: Share = 0.5
    """map: least probability of an edge that counts as open."""


def as_seen(images: np.ndarray, config: DomainConfig, stream: int = 0) -> np.ndarray:
    """Return images [..., H, W, 3] u8 of the camera; each depends only on seed, stream, its index and itself."""
    if _changes_nothing(config):
        return images
    flat = images.reshape(-1, *images.shape[-3:])
    out = np.empty_like(flat)
    for first in range(0, len(flat), _CHUNK):
        rng = np.random.default_rng([config.seed, stream, first])
        chunk = flat[first : first + _CHUNK]
        out[first : first + _CHUNK] = _taken(chunk, config, *_chance(rng, config, chunk.shape))
    return out.reshape(images.shape)


def as_seen_from(images: np.ndarray, config: DomainConfig, xy_w: np.ndarray, heading_rad: np.ndarray) -> np.ndarray:
    """Return images [N, H, W, 3] u8 of the camera; noise depends on seed, place (to 1 mm) and heading (to 1 mrad)."""
    if _changes_nothing(config) or not len(images):
        return images
    places = np.rint(1000.0 * np.concatenate([xy_w, np.asarray(heading_rad)[:, None]], -1)).astype(np.int64) % 2**32
    rngs = (np.random.default_rng([config.seed, *place]) for place in places.tolist())
    drawn = [_chance(rng, config, (1, *images.shape[1:])) for rng in rngs]
    ways, stops, noise = (np.concatenate(one) for one in zip(*drawn, strict=True))
    return _taken(images, config, ways, stops, noise)


def _changes_nothing(config: DomainConfig) -> bool:
    return config == dataclasses.replace(DomainConfig(), seed=config.seed)


def _chance(
    rng: np.random.Generator, config: DomainConfig, shape: tuple[int, ...]
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Draw blur lengths [N] (px), exposures [N] and standard normal noise for images of a shape."""
    ways, stops = rng.uniform(0.0, config.blur_px, shape[0]), rng.standard_normal(shape[0])
    noisy = config.shot_noise or config.read_noise
    return ways, stops, rng.standard_normal(shape) if noisy else np.zeros((shape[0], 1, 1, 1))


def _taken(
    images: np.ndarray, config: DomainConfig, ways: np.ndarray, spread: np.ndarray, noise: np.ndarray
) -> np.ndarray:
    height, width = images.shape[1:3]
    light = (images.astype(np.float32) / 255.0) ** _GAMMA
    if config.zoom != 1.0 or config.barrel:
        light = _through_lens(light, config.zoom, config.barrel)
    if config.vignette:
        light = light * (1.0 - config.vignette * _radius(height, width) ** 2)[..., None]
    if config.blur_px:
        light = np.stack([smeared(one, way) for one, way in zip(light, ways, strict=True)])
    stops = config.exposure_ev + config.exposure_spread_ev * spread
    balance = np.array([1.0 + config.warmth, 1.0, 1.0 - config.warmth])
    light = light * (2.0**stops)[:, None, None, None] * balance
    if config.shot_noise or config.read_noise:
        light = light + np.sqrt(config.shot_noise**2 * np.clip(light, 0.0, 1.0) + config.read_noise**2) * noise
    grey = np.clip(light, 0.0, 1.0) ** (1.0 / _GAMMA)
    grey = (grey - 0.5) * config.contrast + 0.5
    return np.rint(255.0 * np.clip(grey, 0.0, 1.0)).astype(np.uint8)


def smeared(light: np.ndarray, way_px: float) -> np.ndarray:
    """Blur an image [H, W, 3] along its rows: a mean over 1 + `way_px` pixels, outer ones in part, borders repeated."""
    half = way_px / 2
    whole = math.floor(half)
    weights = np.ones(2 * whole + 3)
    weights[[0, -1]] = half - whole
    return convolve1d(light, weights / weights.sum(), axis=1, mode="nearest")


def _through_lens(light: np.ndarray, zoom: float, barrel: float) -> np.ndarray:
    """Resample images [N, H, W, 3] bilinearly without reading outside of them."""
    height, width = light.shape[1:3]
    factor = (1.0 + barrel * _radius(height, width) ** 2) / (1.0 + barrel) / zoom
    y, x = np.meshgrid(np.arange(height) - (height - 1) / 2, np.arange(width) - (width - 1) / 2, indexing="ij")
    at = np.stack([y * factor + (height - 1) / 2, x * factor + (width - 1) / 2])
    channels = np.moveaxis(light, -1, 1).reshape(-1, height, width)
    taken = np.stack([map_coordinates(one, at, order=1, mode="nearest") for one in channels])
    return np.moveaxis(taken.reshape(-1, 3, height, width), 1, -1)


def _radius(height: int, width: int) -> np.ndarray:
    """Return distances [H, W] from the centre; 1 at the corner pixels."""
    y, x = np.meshgrid(np.arange(height) - (height - 1) / 2, np.arange(width) - (width - 1) / 2, indexing="ij")
    return np.hypot(x, y) / max(np.hypot((height - 1) / 2, (width - 1) / 2), 1e-9)
