"""Depth and box indices in, surface normals and colours out, in JAX for any number of environments."""

from __future__ import annotations

from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from interactive_nav.sensing.base import SKY_COLOUR, CameraPose, Lens
from interactive_nav.sensing.boxes import BoxTables, box_poses, rotate
from scenes_mjcf.categories import SEGMENTATIONS

FLOOR_COLOUR = (0.56, 0.50, 0.43)
PALETTES = {
    classes: np.array([*masks.colours, FLOOR_COLOUR, SKY_COLOUR], np.float32)
    for classes, masks in SEGMENTATIONS.items()
}
"""The setting `segmentation_classes` -> colours by class id, then the floor's and the background's."""
_LIGHT_W = np.array([0.35, 0.25, 0.9], np.float32) / np.linalg.norm([0.35, 0.25, 0.9])


def normals(
    tables: BoxTables, scene: jax.Array, qpos: jax.Array, camera: CameraPose, lens: Lens, depth, index
) -> jax.Array:
    """World normals of what the pixels show; leading axes [N].

    Args:
        tables: of the world.
        scene: [N] i32.
        qpos: [N, nq].
        camera: leaves [N, ...].
        lens: of the images.
        depth: [N, H, W] f32, m.
        index: [N, H, W] i32, both from `Renderer.trace_batch`.

    Returns:
        [N, H, W, 3] f32 unit vectors, 0 where nothing is met.
    """
    centre, axes = box_poses(tables, scene, qpos)
    n, boxes = centre.shape[:2]
    forward, right, up = (camera.axes_w[:, None, None, :, i] for i in range(3))
    columns, rows = jnp.asarray(lens.columns)[None, None, :, None], jnp.asarray(lens.rows)[None, :, None, None]
    ray = forward + right * columns + up * rows
    point = camera.pos_w[:, None, None] + ray * depth[..., None]

    def of_pixel(table):
        """[N, B + 2, k] to [N, H, W, k]: rows by the pixels' indices; the floor's and nothing's come last."""
        row = jnp.where(index < 0, boxes + 1, index) + (boxes + 2) * jnp.arange(n)[:, None, None]
        return table.reshape(n * (boxes + 2), -1)[row]

    def with_rest(table):
        return jnp.concatenate([table, jnp.zeros((n, 2, table.shape[-1]))], 1)

    # The face that a point lies on is the one that it is least inside of, by distance to the box's middle planes.
    inverse = jnp.swapaxes(axes, -1, -2).reshape(n, boxes, 9)
    planes = jnp.concatenate([inverse, rotate(jnp.swapaxes(axes, -1, -2), centre), tables.half_m[scene]], -1)
    row = jax.lax.optimization_barrier(of_pixel(with_rest(planes)))
    offsets = [(row[..., 3 * i : 3 * i + 3] * point).sum(-1) - row[..., 9 + i] for i in range(3)]
    depths = [jnp.abs(o) - row[..., 12 + i] for i, o in enumerate(offsets)]
    first = (depths[0] >= depths[1]) & (depths[0] >= depths[2])
    second = ~first & (depths[1] >= depths[2])
    normal = jnp.sign(offsets[2])[..., None] * row[..., 6:9]
    normal = jnp.where(second[..., None], jnp.sign(offsets[1])[..., None] * row[..., 3:6], normal)
    normal = jnp.where(first[..., None], jnp.sign(offsets[0])[..., None] * row[..., 0:3], normal)
    return jnp.where((index == boxes)[..., None], jnp.asarray([0.0, 0.0, 1.0]), normal)


def colours(tables: BoxTables, scene: jax.Array, camera: CameraPose, normal_w: jax.Array, index) -> jax.Array:
    """Flat colours by class, lit from above and from the camera (Lambert).

    Args:
        tables: of the world.
        scene: [N] i32.
        camera: leaves [N, ...].
        normal_w: [N, H, W, 3].
        index: [N, H, W] i32.

    Returns:
        [N, H, W, 3] u8.
    """
    n, boxes = len(scene), tables.num_boxes
    ids = tables.class_id[scene].astype(jnp.int32)
    palette = jnp.asarray(PALETTES[tables.classes])
    floor, background = len(palette) - 2, len(palette) - 1
    ids = jnp.concatenate([ids, jnp.full((n, 1), floor), jnp.full((n, 1), background)], 1)
    place = jnp.where(index < 0, boxes + 1, index).reshape(n, -1)
    base = palette[jnp.take_along_axis(ids, place, 1)].reshape(*index.shape, 3)
    return lambert(base, normal_w, camera.axes_w[:, None, None, :, 0], index >= 0, jnp)


def lambert(base: Any, normal_w: Any, forward_w: Any, met: Any, xp: Any) -> Any:
    """Colours [..., 3] in [0, 1] lit by a sun and a lamp at the camera; u8; what is not `met` keeps its colour."""
    light_w = xp.broadcast_to(xp.asarray(_LIGHT_W), normal_w.shape)
    sun = xp.maximum((normal_w * light_w).sum(-1), 0.0)
    lamp = xp.maximum(-(normal_w * forward_w).sum(-1), 0.0)
    light = xp.where(met, xp.minimum(0.45 + 0.4 * sun + 0.25 * lamp, 1.0), 1.0)
    return xp.round(255.0 * base * light[..., None]).astype(xp.uint8)
