"""Strew small objects around the sources of passage images, and label the paths that they block."""

import numpy as np
import shapely

from interactive_nav.scenes.objects import body_names, pick
from interactive_nav_common.errors import ConfigError
from topological_nav.config import DataConfig
from topological_nav.scenes.rendering import HIDDEN_M, Bodies
from topological_nav.scenes.space import FreeSpace, shadow

TRIES = 32
"""Places to draw for an object; it takes the first free one."""


def strew(space: FreeSpace, sources_w: np.ndarray, config: DataConfig, rng: np.random.Generator) -> np.ndarray:
    """Draw a layout around each source [S, 2]: x, y (m, world) and yaw of small objects, [S, N, 3]; NaN: absent.

    A layout has up to N objects, in sight of the source, on free floor and apart from each other. Their fronts are as
    far away as sources keep from obstacles, up to the longest length to label.
    """
    radii_m = np.array([thing.radius_m for thing in pick(config.objects)])
    nearest_m, farthest_m = config.passage_clearance_m, config.passage_lengths_m[-1]
    small_w = np.full((len(sources_w), config.objects, 3), np.nan)
    wanted = rng.integers(config.objects + 1, size=len(sources_w))  # takes nothing from rng if there are none
    for source_w, placed_w, count in zip(sources_w, small_w, wanted, strict=True):
        for i in rng.permutation(config.objects)[:count]:
            away_m = radii_m[i] + rng.uniform(nearest_m, max(nearest_m, farthest_m), (TRIES, 1))
            angle_rad, yaw_rad = rng.uniform(-np.pi, np.pi, TRIES), rng.uniform(-np.pi, np.pi)
            xy_w = source_w + away_m * np.stack([np.cos(angle_rad), np.sin(angle_rad)], -1)
            apart_m = np.linalg.norm(xy_w[:, None] - placed_w[:, :2], axis=-1) - radii_m  # NaN to absent ones
            free = (space.at(xy_w) >= radii_m[i]) & ~(apart_m < radii_m[i]).any(1)
            free &= space.segment_free(np.broadcast_to(source_w, xy_w.shape), xy_w, config.passage_points, 0.0)
            if free.any():
                placed_w[i] = *xy_w[free.argmax()], yaw_rad
    if wanted.any() and np.isnan(small_w).all():
        raise ConfigError(
            f"none of {config.objects} small objects fits on the floor within {farthest_m:g} m of {len(sources_w)} "
            "places; leave out objects, or choose a scene with more free floor"
        )
    return small_w


def bodies(small_w: np.ndarray) -> Bodies:
    """Return the poses of small objects in images with layouts [n, N, 3]; absent ones are far below the floor."""
    xy_w, half_rad = np.nan_to_num(small_w[..., :2]), np.nan_to_num(small_w[..., 2:]) / 2
    pos_w = np.concatenate([xy_w, np.where(np.isnan(small_w[..., 2:]), HIDDEN_M, 0.0)], -1)
    quat_w = np.concatenate([np.cos(half_rad), 0 * half_rad, 0 * half_rad, np.sin(half_rad)], -1)
    return body_names(pick(small_w.shape[1])), pos_w, quat_w


def clear_of(small_w: np.ndarray, sources_w: np.ndarray, heading_rad: np.ndarray, config: DataConfig) -> np.ndarray:
    """Return whether paths from S sources along T headings each keep the margin from their layouts: [S, T, L] bool."""
    (_, pos_w, quat_w), things = bodies(small_w), pick(small_w.shape[1])
    covered = np.full(small_w.shape[:2], None, object)
    for s, i in np.argwhere(~np.isnan(small_w[..., 0])):
        covered[s, i] = shadow(things[i].rows, pos_w[s, i], quat_w[s, i])
    step = np.stack([np.cos(heading_rad), np.sin(heading_rad)], -1)[:, :, None]
    from_w = np.broadcast_to(sources_w[:, None, None], (*heading_rad.shape, len(config.passage_lengths_m), 2))
    to_w = from_w + np.asarray(config.passage_lengths_m)[:, None] * step
    paths = np.asarray(shapely.linestrings(np.stack([from_w, to_w], -2)))
    away_m = shapely.distance(paths[..., None], covered[:, None, None])  # NaN to absent ones
    return ~((away_m < config.passage_margin_m) | (away_m == 0.0)).any(-1)


def fewer_at_furniture(bare: np.ndarray, free: np.ndarray, rng: np.random.Generator) -> np.ndarray:
    """Return the indices of passages [n] without a surplus of those blocked without objects (`bare`), too.

    As many stay as balance free and blocked ones, and at least as many as objects block; few of these would stay else.
    """
    objects = (bare & ~free).sum()
    kept = rng.permutation(np.flatnonzero(~bare))[: max(objects, free.sum() - objects)]
    return np.sort(np.concatenate([np.flatnonzero(bare), kept]))
