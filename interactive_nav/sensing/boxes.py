"""What cameras and scanners see: a `World` in, its collision boxes with class ids as arrays, and their world poses out.

Every backend draws the same boxes and the floor, the plane z = 0. The robot is not among them: it is
invisible to itself.
"""

from __future__ import annotations

from typing import Any

import flax.struct
import jax
import jax.numpy as jnp
import numpy as np

from interactive_nav.scenes.scene import Movable
from interactive_nav.scenes.spec import sorted_movables
from interactive_nav.scenes.world import World
from interactive_nav_common.rotations import matrix_from_quat
from scenes_mjcf.categories import MaskClasses, class_id


@flax.struct.dataclass
class BoxTables:
    """Boxes of all scenes, padded alike; S scenes, B boxes, M bodies that move, then one that stands (the walls)."""

    body: np.ndarray = flax.struct.field(pytree_node=False)
    """[B] index of each box's body; M for walls."""
    slot_qpos: np.ndarray = flax.struct.field(pytree_node=False)
    """[M] address in qpos."""
    hinged: np.ndarray = flax.struct.field(pytree_node=False)
    """[M] bool."""
    pos_b: jax.Array
    """[S, B, 3] f32 centre in the body's frame, m."""
    axes_b: jax.Array
    """[S, B, 3, 3] f32 the box's axes as columns, in the body's frame."""
    half_m: jax.Array
    """[S, B, 3] f32 half sizes; negative: padding, met by no ray."""
    class_id: jax.Array
    """[S, B] u8."""
    hinge_pos_w: jax.Array
    """[S, M, 3] f32 rest position of a hinged body's frame, m."""
    hinge_axes_w: jax.Array
    """[S, M, 3, 3] f32 rest orientation of it."""
    hinge_axis_b: jax.Array
    """[S, M, 3] f32."""
    hinge_anchor_b: jax.Array
    """[S, M, 3] f32, m."""
    classes: MaskClasses = flax.struct.field(pytree_node=False, default=4)
    """How `class_id` tells categories apart: the setting `segmentation_classes`."""

    @property
    def num_boxes(self) -> int:
        """B."""
        return len(self.body)


def build_boxes(world: World, classes: MaskClasses = 4) -> BoxTables:
    """Collects the boxes of every scene into common slots.

    Args:
        world: with its scenes.
        classes: the setting `segmentation_classes`.
    """
    layout, scenes = world.layout, world.scenes
    slots = layout.num_slots
    columns: list[list[tuple[np.ndarray, int, Movable | None]]] = []
    for scene in scenes:
        free, hinged = sorted_movables(scene)
        own = {"free": iter(free), "hinge": iter(hinged)}
        column: list[tuple[np.ndarray, int, Movable | None]] = []
        for i, kind in enumerate(layout.slot_kind):
            if kind == "small":
                column.append((world.small_objects[i].rows, world.small_objects[i].mask_id(classes), None))
                continue
            movable = next(own[kind], None)
            boxes = np.zeros((0, 10)) if movable is None else movable.boxes
            column.append((boxes, 0 if movable is None else class_id(movable.category, classes), movable))
        column.append((scene.walls, 0, None))
        columns.append(column)
    counts = [max(len(column[m][0]) for column in columns) for m in range(slots + 1)]
    body = np.repeat(np.arange(slots + 1), counts)
    first = np.concatenate([[0], np.cumsum(counts)])
    shape = (len(scenes), len(body))
    pos, half, ids = np.zeros((*shape, 3)), np.full((*shape, 3), -1.0), np.zeros(shape, np.uint8)
    axes = np.broadcast_to(np.eye(3), (*shape, 3, 3)).copy()
    hinge_pos, hinge_axis, anchor = np.zeros((3, len(scenes), slots, 3))
    hinge_axes = np.broadcast_to(np.eye(3), (len(scenes), slots, 3, 3)).copy()
    for s, column in enumerate(columns):
        for m, (boxes, number, movable) in enumerate(column):
            for i, row in enumerate(boxes):
                at = first[m] + i
                pos[s, at], axes[s, at], half[s, at], ids[s, at] = (
                    row[:3],
                    matrix_from_quat(row[3:7]),
                    row[7:10],
                    number,
                )
            if movable is not None and movable.hinge is not None:
                hinge_pos[s, m], hinge_axes[s, m] = movable.pos_w, matrix_from_quat(movable.quat_w)
                hinge_axis[s, m], anchor[s, m] = movable.hinge.axis, movable.hinge.anchor_m
    f32 = jnp.float32
    return BoxTables(
        body=body,
        slot_qpos=np.asarray(layout.slot_qpos),
        hinged=np.asarray([kind == "hinge" for kind in layout.slot_kind], bool),
        pos_b=jnp.asarray(pos, f32),
        axes_b=jnp.asarray(axes, f32),
        half_m=jnp.asarray(half, f32),
        class_id=jnp.asarray(ids),
        hinge_pos_w=jnp.asarray(hinge_pos, f32),
        hinge_axes_w=jnp.asarray(hinge_axes, f32),
        hinge_axis_b=jnp.asarray(hinge_axis, f32),
        hinge_anchor_b=jnp.asarray(anchor, f32),
        classes=classes,
    )


def rotate(axes: jax.Array, vector: jax.Array) -> jax.Array:
    """[..., 3, 3] times [..., 3]; a sum of products, because GPUs may round a matmul's factors to TF32."""
    return (axes * vector[..., None, :]).sum(-1)


def compose(first: jax.Array, second: jax.Array) -> jax.Array:
    """[..., 3, 3] times [..., 3, 3], in full float32."""
    return (first[..., :, :, None] * second[..., None, :, :]).sum(-2)


def body_poses(tables: BoxTables, scene: jax.Array, qpos: jax.Array) -> tuple[jax.Array, jax.Array]:
    """World frames of the bodies; leading batch axes as the caller has them.

    Args:
        tables: of the world.
        scene: [...] i32.
        qpos: [..., nq].

    Returns:
        Positions [..., M + 1, 3], m, and axes as columns [..., M + 1, 3, 3]; the last is the standing body.
    """
    lead, slots = qpos.shape[:-1], len(tables.slot_qpos)
    pos = jnp.zeros((*lead, slots + 1, 3), qpos.dtype)
    axes = jnp.broadcast_to(jnp.eye(3, dtype=qpos.dtype), (*lead, slots + 1, 3, 3))
    free, swing = np.flatnonzero(~tables.hinged), np.flatnonzero(tables.hinged)
    if len(free):
        pose = qpos[..., tables.slot_qpos[free][:, None] + np.arange(7)]
        pos = pos.at[..., free, :].set(pose[..., :3])
        axes = axes.at[..., free, :, :].set(matrix_from_quat(pose[..., 3:]))
    if len(swing):
        half = 0.5 * qpos[..., tables.slot_qpos[swing]]
        axis, anchor = tables.hinge_axis_b[scene][..., swing, :], tables.hinge_anchor_b[scene][..., swing, :]
        quat = jnp.concatenate([jnp.cos(half)[..., None], jnp.sin(half)[..., None] * axis], -1)
        turned = matrix_from_quat(quat)
        arm = anchor - rotate(turned, anchor)
        rest = tables.hinge_axes_w[scene][..., swing, :, :]
        origin = tables.hinge_pos_w[scene][..., swing, :]
        pos = pos.at[..., swing, :].set(origin + rotate(rest, arm))
        axes = axes.at[..., swing, :, :].set(compose(rest, turned))
    return pos, axes


def box_poses(tables: BoxTables, scene: jax.Array, qpos: jax.Array) -> tuple[jax.Array, jax.Array]:
    """World frames of the boxes: centres [..., B, 3], m, and axes as columns [..., B, 3, 3]."""
    pos, axes = body_poses(tables, scene, qpos)
    pos, axes = pos[..., tables.body, :], axes[..., tables.body, :, :]
    return pos + rotate(axes, tables.pos_b[scene]), compose(axes, tables.axes_b[scene])


def with_robot(tables: BoxTables, world: World) -> BoxTables:
    """The same boxes and one about the robot, for views from outside."""
    slots, scenes = len(tables.slot_qpos), tables.half_m.shape[0]
    radius, half_height = world.robot.footprint_radius_m, world.robot.height_m / 2

    def add(array: jax.Array, row: Any, at: int) -> jax.Array:
        new = jnp.broadcast_to(jnp.asarray(row, array.dtype), (scenes, 1, *array.shape[2:]))
        return jnp.concatenate([array[:, :at], new, array[:, at:]], 1)

    eye = np.eye(3).tolist()
    return tables.replace(
        body=np.append(np.where(tables.body == slots, slots + 1, tables.body), slots),
        slot_qpos=np.append(tables.slot_qpos, world.layout.robot_qpos),
        hinged=np.append(tables.hinged, False),
        pos_b=add(tables.pos_b, [0.0, 0.0, half_height], tables.num_boxes),
        axes_b=add(tables.axes_b, eye, tables.num_boxes),
        half_m=add(tables.half_m, [0.8 * radius, 0.8 * radius, half_height], tables.num_boxes),
        class_id=add(tables.class_id, class_id("robot", tables.classes), tables.num_boxes),
        hinge_pos_w=add(tables.hinge_pos_w, [0.0] * 3, slots),
        hinge_axes_w=add(tables.hinge_axes_w, eye, slots),
        hinge_axis_b=add(tables.hinge_axis_b, [0.0] * 3, slots),
        hinge_anchor_b=add(tables.hinge_anchor_b, [0.0] * 3, slots),
    )
