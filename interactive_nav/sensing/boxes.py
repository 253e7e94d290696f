"""What cameras and scanners see: a `World` in, its collision boxes with class ids as arrays, and their world poses out.

Every backend draws the same boxes and the floor, the plane z = 0. The robot is not among them: it is
invisible to itself.
"""

from __future__ import annotations

import flax.struct
import jax
import jax.numpy as jnp
import numpy as np

from interactive_nav.scenes.scene import Scene
from interactive_nav.scenes.spec import sorted_movables
from interactive_nav.scenes.world import World
from interactive_nav.sensing.shading import FLOOR_COLOUR, PALETTES, body_colours
from interactive_nav_common.rotations import Array, matrix_from_quat
from scenes_mjcf.categories import MaskClasses, class_id

_TINY = np.float32(1e-12)


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
    colour: jax.Array | None
    """[S, B + 1, 3] f32 in [0, 1], the floor's last; None: not asked for."""
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


def boxes_of_slots(world: World, scene: Scene, classes: MaskClasses) -> list[tuple[np.ndarray, int]]:
    """Boxes [n, 10] and class id of what is in each slot of a scene, then of its walls."""
    free, hinged = sorted_movables(scene)
    own, out = {"free": iter(free), "hinge": iter(hinged)}, []
    for i, kind in enumerate(world.layout.slot_kind):
        if kind == "small":
            out.append((world.small_objects[i].rows, world.small_objects[i].mask_id(classes)))
            continue
        movable = next(own[kind], None)
        boxes = np.zeros((0, 10)) if movable is None else movable.boxes
        out.append((boxes, 0 if movable is None else class_id(movable.category, classes)))
    return [*out, (scene.walls, 0)]


def _colours_of_slots(world: World, s: int, ids: list[int], classes: MaskClasses) -> np.ndarray:
    """[M + 2, 3]: mean colour of the visual meshes in each slot, of the walls, and the floor's; where a body has no
    mesh, that of its class."""
    own, names = body_colours(world.scenes[s]), (*world.names[s], "structure")
    rows = [own[name] if name in own else PALETTES[classes][number] for name, number in zip(names, ids, strict=True)]
    return np.stack([*rows, np.asarray(FLOOR_COLOUR)])


def build_boxes(world: World, classes: MaskClasses = 4, colours: bool = False) -> BoxTables:
    """Collects the boxes of every scene into common slots.

    Args:
        world: with its scenes.
        classes: the setting `segmentation_classes`.
        colours: reads the textures, for images in colour.
    """
    layout, scenes = world.layout, world.scenes
    slots = layout.num_slots
    columns = [boxes_of_slots(world, scene, classes) for scene in scenes]
    counts = [max(len(column[m][0]) for column in columns) for m in range(slots + 1)]
    body = np.repeat(np.arange(slots + 1), counts)
    first = np.concatenate([[0], np.cumsum(counts)])
    shape = (len(scenes), len(body))
    pos, half, ids = np.zeros((*shape, 3)), np.full((*shape, 3), -1.0), np.zeros(shape, np.uint8)
    axes = np.broadcast_to(np.eye(3), (*shape, 3, 3)).copy()
    is_hinge = np.asarray([kind == "hinge" for kind in layout.slot_kind], bool)
    hinge_pos, hinge_axis, anchor = np.zeros((3, len(scenes), slots, 3))
    hinge_axes = np.broadcast_to(np.eye(3), (len(scenes), slots, 3, 3)).copy()
    for s, (column, model) in enumerate(zip(columns, world.models, strict=True)):
        for m, (boxes, number) in enumerate(column):
            at = slice(first[m], first[m] + len(boxes))
            pos[s, at], half[s, at], ids[s, at] = boxes[:, :3], boxes[:, 7:10], number
            axes[s, at] = matrix_from_quat(boxes[:, 3:7])
        for m in np.flatnonzero(is_hinge):
            leaf = layout.slot_body[m]
            joint = model.body_jntadr[leaf]
            hinge_pos[s, m], hinge_axes[s, m] = model.body_pos[leaf], matrix_from_quat(model.body_quat[leaf])
            hinge_axis[s, m], anchor[s, m] = model.jnt_axis[joint], model.jnt_pos[joint]
    painted = [
        _colours_of_slots(world, s, [number for _, number in column], classes)[[*body, -1]]
        for s, column in enumerate(columns if colours else [])
    ]
    f32 = jnp.float32
    return BoxTables(
        body=body,
        slot_qpos=np.asarray(layout.slot_qpos),
        hinged=is_hinge,
        pos_b=jnp.asarray(pos, f32),
        axes_b=jnp.asarray(axes, f32),
        half_m=jnp.asarray(half, f32),
        class_id=jnp.asarray(ids),
        colour=jnp.asarray(np.stack(painted), f32) if colours else None,
        classes=classes,
        hinge_pos_w=jnp.asarray(hinge_pos, f32),
        hinge_axes_w=jnp.asarray(hinge_axes, f32),
        hinge_axis_b=jnp.asarray(hinge_axis, f32),
        hinge_anchor_b=jnp.asarray(anchor, f32),
    )


def rotate(axes: jax.Array, vector: jax.Array) -> jax.Array:
    """[..., 3, 3] times [..., 3]; a sum of products, because GPUs may round a matmul's factors to TF32."""
    return (axes * vector[..., None, :]).sum(-1)


def compose(first: jax.Array, second: jax.Array) -> jax.Array:
    """[..., 3, 3] times [..., 3, 3], in full float32."""
    return (first[..., :, :, None] * second[..., None, :, :]).sum(-2)


def swing(axis: Array, anchor_m: Array, angle_rad: jax.Array) -> tuple[jax.Array, jax.Array]:
    """A hinged body's frame in its frame at rest: place [..., 3], m, and axes as columns [..., 3, 3].

    Args:
        axis: [..., 3] unit vector, in the body's frame.
        anchor_m: [..., 3] in the body's frame.
        angle_rad: [...].
    """
    half = 0.5 * angle_rad[..., None]
    turned = matrix_from_quat(jnp.concatenate([jnp.cos(half), jnp.sin(half) * axis], -1))
    return anchor_m - rotate(turned, anchor_m), turned


def body_poses(tables: BoxTables, scene: jax.Array, qpos: jax.Array) -> tuple[jax.Array, jax.Array]:
    """World frames of the bodies; leading batch axes as the caller has them.

    Args:
        tables: of the world.
        scene: [...] i32.
        qpos: [..., nq].

    Returns:
        Positions [..., M + 1, 3], m, and axes as columns [..., M + 1, 3, 3]; the last is the standing body.
    """
    lead = qpos.shape[:-1]
    free, hinged = np.flatnonzero(~tables.hinged), np.flatnonzero(tables.hinged)
    pose = qpos[..., tables.slot_qpos[free][:, None] + np.arange(7)]
    axis, anchor = tables.hinge_axis_b[scene][..., hinged, :], tables.hinge_anchor_b[scene][..., hinged, :]
    arm, turned = swing(axis, anchor, qpos[..., tables.slot_qpos[hinged]])
    rest = tables.hinge_axes_w[scene][..., hinged, :, :]
    swung = tables.hinge_pos_w[scene][..., hinged, :] + rotate(rest, arm)
    standing = jnp.broadcast_to(jnp.eye(3, dtype=qpos.dtype), (*lead, 1, 3, 3))
    pos = jnp.concatenate([pose[..., :3], swung, jnp.zeros((*lead, 1, 3), qpos.dtype)], -2)
    axes = jnp.concatenate([matrix_from_quat(pose[..., 3:]), compose(rest, turned), standing], -3)
    order = np.argsort(np.concatenate([free, hinged, [len(tables.slot_qpos)]]))
    if (order != np.arange(len(order))).any():
        pos, axes = pos[..., order, :], axes[..., order, :, :]
    return pos, axes


def box_poses(tables: BoxTables, scene: jax.Array, qpos: jax.Array) -> tuple[jax.Array, jax.Array]:
    """World frames of the boxes: centres [..., B, 3], m, and axes as columns [..., B, 3, 3]."""
    pos, axes = body_poses(tables, scene, qpos)
    pos, axes = pos[..., tables.body, :], axes[..., tables.body, :, :]
    return pos + rotate(axes, tables.pos_b[scene]), compose(axes, tables.axes_b[scene])


def slab(eye: jax.Array, half: jax.Array, direction: jax.Array) -> tuple[jax.Array, jax.Array]:
    """Where rays enter and leave the space between two opposite faces of a box, in units of the direction's length.

    Args:
        eye: the rays' origin along the faces' normal, from the box's centre, m.
        half: from the centre to a face, m.
        direction: of the rays, along the normal.
    """
    # A ray in a face's plane would divide by 0.
    inverse = 1.0 / (direction + _TINY)
    middle, reach = -eye * inverse, half * jnp.abs(inverse)
    return middle - reach, middle + reach
