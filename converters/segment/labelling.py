"""Label the vertices of an unlabelled scan with NYU40 ids, and score labels against those of a labelled scan.

A 3-D U-Net scores the classes of all voxels of dense tiles. It packs each 2 x 2 x 2 cell into channels for an eighth of
the work, and normalises over channels only, so that the tile's size does not matter.
"""

import dataclasses
import functools
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

import flax.linen as nn
import jax
import jax.numpy as jnp
import numpy as np
from flax.traverse_util import unflatten_dict

from converters.clock import Report
from converters.propose.pieces import bounds, box_iou
from converters.propose.proposals import propose_instances
from converters.propose.retrieval import annotated_vertices
from converters.read.surfaces import floor_level, storey_of
from converters.records.errors import SceneRejected
from converters.records.raw import UNLABELLED, RawScene
from converters.segment import voxels
from interactive_nav_common.runs import weights
from interactive_nav_common.signals import signals_wait

WEIGHTS = Path(__file__).with_name("weights.safetensors")
TILE, MARGIN = 160, 16
"""Voxels of a tile's side, and of its border, which is left to the next tile."""


class VoxelNet(nn.Module):
    """Compute scores [N, X, Y, Z, classes] of tiles [N, X, Y, Z, FEATURES + 2]."""

    widths: Sequence[int]

    @nn.compact
    def __call__(self, x: jax.Array) -> jax.Array:
        """Return the scores of every voxel; sides are multiples of 8."""
        x, skips = _fold(x), []
        for level, width in enumerate(self.widths):
            if level:
                skips.append(x)
                x = nn.Dense(width)(_fold(x))
            x = self._block(x, width)
        for skip in reversed(skips):
            width = skip.shape[-1]
            x = jnp.concatenate([_unfold(nn.Dense(8 * width)(x)), skip], axis=-1)
            x = self._block(x, width)
        return _unfold(nn.Dense(8 * len(voxels.NAMES))(x)).astype(jnp.float32)

    def _block(self, x: jax.Array, width: int) -> jax.Array:
        x = nn.relu(nn.LayerNorm()(nn.Conv(width, (3, 3, 3))(x)))
        return nn.relu(x + nn.LayerNorm()(nn.Conv(width, (3, 3, 3))(x)))


def _fold(x: jax.Array) -> jax.Array:
    """Turn [N, X, Y, Z, C] into [N, X/2, Y/2, Z/2, 8C]."""
    n, a, b, c, f = x.shape
    x = x.reshape(n, a // 2, 2, b // 2, 2, c // 2, 2, f).transpose(0, 1, 3, 5, 2, 4, 6, 7)
    return x.reshape(n, a // 2, b // 2, c // 2, 8 * f)


def _unfold(x: jax.Array) -> jax.Array:
    """Turn [N, X, Y, Z, 8C] into [N, 2X, 2Y, 2Z, C]."""
    n, a, b, c, f = x.shape
    x = x.reshape(n, a, b, c, 2, 2, 2, f // 8).transpose(0, 1, 4, 2, 5, 3, 6, 7)
    return x.reshape(n, 2 * a, 2 * b, 2 * c, f // 8)


def dense(index: jax.Array, features: jax.Array, shape: tuple[int, int]) -> jax.Array:
    """Return [N, X, Y, LAYERS, FEATURES + 2] tiles: occupied, height over the floor (in 3 m), then the features.

    Rows of the index [N, K, 3] with a negative x are padding; features are [N, K, FEATURES] int8.
    """
    height = (index[..., 2:] + 0.5) * (voxels.VOXEL_M / 3) - voxels.BELOW_M / 3
    given = jnp.concatenate([jnp.ones_like(height), height, features.astype(jnp.float32) / 127], axis=-1)
    x, y, z = (jnp.where(index[..., :1] < 0, 1 << 20, index)[..., k] for k in range(3))
    tile = jnp.arange(len(index))[:, None]
    return jnp.zeros((len(index), *shape, voxels.LAYERS, voxels.FEATURES + 2)).at[tile, x, y, z].set(given, mode="drop")


Scores = Callable[[jax.Array, jax.Array, tuple[int, int]], jax.Array]
"""Index, features and shape of `dense` -> [N, X, Y, LAYERS, classes]."""


def score_voxels(
    occupied: voxels.Voxels, scores: Scores, report: Callable[[float], None] = lambda share: None
) -> np.ndarray:
    """Return (k, classes) scores of occupied voxels, tile by tile."""
    out = np.zeros((len(occupied.index), len(voxels.NAMES)), np.float32)
    extent = occupied.index[:, :2].max(axis=0, initial=0) + 1
    side = [min(TILE, int(-(-n // 16) * 16)) for n in extent]
    step = [s - 2 * MARGIN if n > s else s for n, s in zip(extent, side, strict=True)]
    starts = [(i, j) for i in range(0, int(extent[0]), step[0]) for j in range(0, int(extent[1]), step[1])]
    tiles = []
    for start in starts:
        low = np.array(start) - [MARGIN if n > s else 0 for n, s in zip(extent, side, strict=True)]
        at = occupied.index[:, :2] - low
        near = np.flatnonzero(((at >= 0) & (at < side)).all(axis=1))
        inner = ((occupied.index[near, :2] >= start) & (occupied.index[near, :2] < np.add(start, step))).all(axis=1)
        if inner.any():
            tiles.append((low, near, near[inner]))
    most = max((len(near) for _, near, _ in tiles), default=0)
    for k, (low, near, inner) in enumerate(tiles):
        index, features = np.full((1, most, 3), -1), np.zeros((1, most, voxels.FEATURES), np.int8)
        index[0, : len(near)], features[0, : len(near)] = occupied.index[near] - [*low, 0], occupied.features[near]
        tile = scores(jnp.asarray(index), jnp.asarray(features), (side[0], side[1]))[0]
        x, y, z = (occupied.index[inner] - [*low, 0]).T
        out[inner] = np.asarray(tile[x, y, z])
        report((k + 1) / len(tiles))
    return out


MATCH_IOU = 0.5
"""Of boxes, from which on a proposal is an annotated object."""


def load_scores() -> Scores:
    """Load the packaged network, which commit b97304ed trained, for `label_scan`; compiled once a shape."""
    tensors, about = weights.read_weights(WEIGHTS, SceneRejected, "install the package again")
    net = VoxelNet(tuple(about["widths"]))
    variables = {"params": unflatten_dict({k: jnp.asarray(v, jnp.float32) for k, v in tensors.items()}, sep="/")}

    @signals_wait()  # a compilation that is left crashes the interpreter at its end
    @functools.partial(jax.jit, static_argnums=2)
    def scores(index: jax.Array, features: jax.Array, shape: tuple[int, int]) -> jax.Array:
        out = net.apply(variables, dense(index, features, shape))
        assert isinstance(out, jax.Array)
        return jax.nn.log_softmax(out)

    return scores


def score_points(surface: voxels.Surface, floors_m: tuple[float, ...], scores: Scores, report: Report) -> np.ndarray:
    """Return (n, classes) scores of a surface's points, storey by storey; zeros too high above a floor."""
    out, of = np.zeros((len(surface.points), len(voxels.NAMES)), np.float32), storey_of(surface.points[:, 2], floors_m)
    for k, floor_m in enumerate(floors_m):
        mine = np.flatnonzero(of == k)
        occupied = voxels.voxelise(surface.rows(mine), floor_m)
        scored = score_voxels(occupied, scores, lambda share, k=k: report("segment", (k + share) / len(floors_m)))
        inside = occupied.of_point >= 0
        out[mine[inside]] = scored[occupied.of_point[inside]]
    return out


def label_scan(raw: RawScene, scores: Scores, report: Report = lambda stage, share: None) -> np.ndarray:
    """Return (n,) int64 NYU40 ids of the scan's vertices; its labels are not read. `report` takes stage, share."""
    scan = raw.scan
    floors = tuple(s.height_m for s in raw.storeys)
    if not floors:
        given = raw.floor_height_m
        floors = (floor_level(scan.vertices, scan.faces, raw.name) if given is None else given,)
    surface = voxels.sample_surface(scan)
    scored = voxels.at_vertices(score_points(surface, floors, scores, report), surface, scan.faces, len(scan.vertices))
    return np.where(scored.any(axis=1), voxels.NYU40[scored.argmax(axis=1)], UNLABELLED)


def score_source(raw: RawScene, scores: Scores, report: Report) -> dict[str, Any]:
    """Return IoU by class at the vertices of a labelled source, and how many annotated objects `propose` finds."""
    labels = label_scan(raw, scores, report)
    iou = voxels.intersection_over_union(voxels.classes_of(raw.scan.labels), voxels.classes_of(labels))
    boxes, matched = [(a.category, bounds(annotated_vertices(a, raw.cads))) for a in raw.annotations], []
    for scan in (dataclasses.replace(raw.scan, labels=labels), raw.scan):
        proposed = [(p.category, bounds(p.points)) for p in propose_instances(scan)]
        hits = [any(c == of and box_iou(box, at) >= MATCH_IOU for c, at in proposed) for of, box in boxes]
        matched.append(sum(hits))
    return {"iou": iou, "objects": len(raw.annotations), "matched": matched[0], "matched_true": matched[1]}
