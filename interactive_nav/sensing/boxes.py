"""Build tables of collision boxes with class ids for cameras and scanners, and compute their world poses.

All backends draw these boxes and the floor, the plane z = 0. Settings decide if the robot sees itself.
"""

from typing import Any

import flax.struct
import jax
import jax.numpy as jnp
import mujoco
import numpy as np

from interactive_nav.robots.links import Links, make_links
from interactive_nav.scenes.objects import VISUAL_GROUP
from interactive_nav.scenes.scene import Scene
from interactive_nav.scenes.world import World
from interactive_nav_common.rotations import apply_axes, compose, matrix_from_quat, swing
from scenes_mjcf.categories import SEGMENTATIONS, MaskClasses, class_id
from scenes_mjcf.look import SKY_COLOUR, geom_colour

FLOOR_COLOUR = (0.56, 0.50, 0.43)
PALETTES = {
    classes: np.array([*masks.colours, FLOOR_COLOUR, SKY_COLOUR], np.float32)
    for classes, masks in SEGMENTATIONS.items()
}
"""The setting `segmentation_classes` -> colours by class id, then the floor's and the background's."""
_TINY = np.float32(1e-12)
CLEAR_M = 5.0
"""Boxes that are farther away count as this far in clearances."""
HOUSING_M = 0.01
"""A box this near to the robot's camera counts as its housing."""


def visual_geoms(scene: Scene) -> tuple[mujoco.MjModel, dict[str, list[int]]]:
    """Return a scene's model as stored, and the geoms for show by the name of each body that has any."""
    model, geoms = mujoco.MjModel.from_xml_path(str(scene.path / "scene.xml")), {}
    for geom in map(int, np.flatnonzero(model.geom_group == VISUAL_GROUP)):
        geoms.setdefault(model.body(model.geom_bodyid[geom]).name, []).append(geom)
    return model, geoms


def robot_geoms(world: World) -> list[list[int]]:
    """Return the geoms that show each of the robot's bodies, or those that collide where it has none for show, but for
    the housing of its camera."""
    model, camera = world.models[0], world.robot.camera
    bodies = world.layout.robot_bodies
    every = np.flatnonzero(np.isin(model.geom_bodyid, bodies))
    shown = every[model.geom_group[every] == VISUAL_GROUP]
    geoms: list[list[int]] = [[] for _ in bodies]
    for geom in map(int, shown if len(shown) else every):
        body, box = int(model.geom_bodyid[geom]), geom_box(model, geom)
        inside = np.abs((np.asarray(camera.pos_m) - box[:3]) @ matrix_from_quat(box[3:7])) <= box[7:] + HOUSING_M
        if model.body(body).name != camera.body or not inside.all():
            geoms[list(bodies).index(body)].append(geom)
    return geoms


def geom_box(model: mujoco.MjModel, geom: int) -> np.ndarray:
    """Return the (10,) box around a geom in its body's frame: centre, orientation, half sizes."""
    around, turn = model.geom_aabb[geom], model.geom_quat[geom]
    return np.concatenate([model.geom_pos[geom] + matrix_from_quat(turn) @ around[:3], turn, around[3:]])


@flax.struct.dataclass
class BoxTables:
    """Boxes of all scenes, padded alike; S scenes, B boxes, M bodies that move, then one that stands (the walls), then
    the robot's if it is visible."""

    world: World = flax.struct.field(pytree_node=False)
    body: np.ndarray = flax.struct.field(pytree_node=False)
    """[B] index of each box's body; M for walls."""
    pos_b: jax.Array
    """[S, B, 3] f32 centre in the body's frame, m."""
    axes_b: jax.Array
    """[S, B, 3, 3] f32 the box's axes as columns, in the body's frame."""
    half_m: jax.Array
    """[S, B, 3] f32 half sizes; negative: padding, met by no ray."""
    class_id: jax.Array
    """[S, B] u8."""
    colour: jax.Array | None
    """[S, B + 1, 3] f32 in [0, 1], the floor's last; None: no images in colour."""
    classes: MaskClasses = flax.struct.field(pytree_node=False, default=4)
    """Categories that `class_id` distinguishes: the setting `segmentation_classes`."""
    robot: Links | None = flax.struct.field(pytree_node=False, default=None)
    """None: it is invisible."""

    @property
    def num_boxes(self) -> int:
        """Return B."""
        return len(self.body)


def _colours_of_slots(world: World, s: int, ids: np.ndarray, classes: MaskClasses) -> np.ndarray:
    """Return [M + 2 or more, 3]: mean colour of the visual meshes in each slot, of the walls, of the robot's bodies,
    and the floor's; where a body has no mesh, that of its class."""
    (model, visual), names = visual_geoms(world.scenes[s]), (*world.slots.names[s], "structure")
    shown = [(model, visual.get(name, []), PALETTES[classes][number]) for name, number in zip(names, ids, strict=False)]
    shown += [(world.models[0], geoms, np.zeros(3)) for geoms in robot_geoms(world)[: len(ids) - len(shown)]]
    rows = [np.mean([geom_colour(of, g) for g in geoms], 0) if geoms else other for of, geoms, other in shown]
    return np.stack([*rows, np.asarray(FLOOR_COLOUR)])


def build_boxes(world: World, classes: MaskClasses = 4, colours: bool = False, robot: bool = False) -> BoxTables:
    """Collect the boxes of every scene into common slots.

    `colours` reads textures for colour images; `robot` makes each of its geoms visible as a box.
    """
    slots, model = world.slots, world.models[0]
    body, rows, ids = slots.box_slot, slots.boxes_b, slots.class_ids(classes)
    if robot:
        links, first = robot_geoms(world), ids.shape[1]
        shown = np.array([geom_box(model, geom) for geoms in links for geom in geoms])
        body = np.concatenate([body, np.repeat(first + np.arange(len(links)), [len(geoms) for geoms in links])])
        rows = np.concatenate([rows, np.broadcast_to(shown, (len(rows), *shown.shape))], 1)
        ids = np.pad(ids, [(0, 0), (0, len(links))], constant_values=class_id("robot", classes))
    scenes = range(len(rows) if colours else 0)
    painted = [_colours_of_slots(world, s, ids[s], classes)[[*body, -1]] for s in scenes]
    f32 = jnp.float32
    return BoxTables(
        world=world,
        body=body,
        pos_b=jnp.asarray(rows[..., :3], f32),
        axes_b=jnp.asarray(matrix_from_quat(rows[..., 3:7]), f32),
        half_m=jnp.asarray(rows[..., 7:], f32),
        class_id=jnp.asarray(ids[:, body]),
        colour=jnp.asarray(np.stack(painted), f32) if colours else None,
        classes=classes,
        robot=make_links(model, world.layout.robot_bodies.tolist()) if robot else None,
    )


def half_sizes_m(boxes: BoxTables) -> jax.Array:
    """Return [S, M, 3] half sizes of the box around each movable object, symmetric about its body's frame."""
    slots, world = boxes.world.slots, boxes.world
    rows = slots.boxes_b
    reach = np.abs(rows[..., :3]) + (np.abs(matrix_from_quat(rows[..., 3:7])) * rows[..., None, 7:]).sum(-1)
    reach = np.where((rows[..., 7:] > 0).all(-1, keepdims=True), reach, 0.0)
    of_slot = [reach[:, slots.box_slot == i].max(1, initial=0.0) for i in range(world.layout.num_slots)]
    return jnp.asarray(np.stack(of_slot, 1) if of_slot else np.zeros((len(rows), 0, 3)), jnp.float32)


def body_poses(tables: BoxTables, scene: jax.Array, qpos: jax.Array) -> tuple[jax.Array, jax.Array]:
    """Return world frames of the bodies, for scenes [...] i32 and qpos [..., nq].

    These are positions [..., M + 1, 3], m, and axes as columns [..., M + 1, 3, 3]; the last is the static body,
    followed by the robot's bodies if it is visible.
    """
    lead, slots, address = qpos.shape[:-1], tables.world.slots, tables.world.layout.slot_qpos
    held = slots.held  # which `find_slots` puts last
    pose = qpos[..., address[~held][:, None] + np.arange(7)]
    at_rest = slots.pos_w_m, slots.axes_w, slots.axis_b, slots.anchor_b_m
    pos, rest, axis, anchor = (jnp.asarray(table[:, held], jnp.float32)[scene] for table in at_rest)
    reach, slides = qpos[..., address[held]], slots.slides[held]
    arm, turned = swing(axis, anchor, jnp.where(slides, 0.0, reach) if slides.any() else reach)
    if slides.any():
        arm = arm + jnp.where(slides[:, None], axis * reach[..., None], 0.0)
    swung = pos + apply_axes(rest, arm)
    standing = jnp.broadcast_to(jnp.eye(3, dtype=qpos.dtype), (*lead, 1, 3, 3))
    pos = jnp.concatenate([pose[..., :3], swung, jnp.zeros((*lead, 1, 3), qpos.dtype)], -2)
    axes = jnp.concatenate([matrix_from_quat(pose[..., 3:]), compose(rest, turned), standing], -3)
    if tables.robot is not None:
        robot_pos, robot_axes = zip(*tables.robot.frames(qpos), strict=True)
        pos = jnp.concatenate([pos, jnp.stack(robot_pos, -2)], -2)
        axes = jnp.concatenate([axes, jnp.stack(robot_axes, -3)], -3)
    return pos, axes


def box_poses(tables: BoxTables, scene: jax.Array, qpos: jax.Array) -> tuple[jax.Array, jax.Array]:
    """Return world frames of the boxes: centres [..., B, 3], m, and axes as columns [..., B, 3, 3]."""
    pos, axes = body_poses(tables, scene, qpos)
    pos, axes = pos[..., tables.body, :], axes[..., tables.body, :, :]
    return pos + apply_axes(axes, tables.pos_b[scene]), compose(axes, tables.axes_b[scene])


def box_gaps_m2(
    tables: BoxTables, scene: jax.Array, qpos: jax.Array, xy_w: jax.Array, heights_m: tuple[Any, Any]
) -> jax.Array:
    """Return [B] m^2: how far an upright line at (2,), m, is from each box; `CLEAR_M**2` if none is between heights.

    The distance is taken from the line's point at the height of the box's centre, so it is horizontal unless the box
    is tilted.
    """

    def dot(a: Any, b: Any) -> jax.Array:
        return a[0] * b[0] + a[1] * b[1] + a[2] * b[2]

    # By components, [B] each: a sum over an axis of three is ten times as slow on CPUs.
    pos, axes = (jnp.moveaxis(x[tables.body], 0, -1) for x in body_poses(tables, scene, qpos))
    stored = tables.pos_b, tables.axes_b, tables.half_m
    offset, box_axes, half = (jnp.moveaxis(x[scene], 0, -1) for x in stored)
    low, high = heights_m
    middle = pos[2] + dot(axes[2], offset)
    reach = dot([jnp.abs(dot(axes[2], box_axes[:, j])) for j in range(3)], half)
    line = xy_w[0] - pos[0], xy_w[1] - pos[1], jnp.clip(middle, low, high) - pos[2]
    in_body = [dot(axes[:, j], line) - offset[j] for j in range(3)]
    outside = [jnp.maximum(jnp.abs(dot(box_axes[:, j], in_body)) - half[j], 0.0) for j in range(3)]
    counts = (half[0] >= 0) & (middle - reach < high) & (middle + reach > low)
    return jnp.where(counts, dot(outside, outside), CLEAR_M**2)


def slab(eye: jax.Array, half: jax.Array, direction: jax.Array) -> tuple[jax.Array, jax.Array]:
    """Return where rays enter and leave the slab between two opposite faces, in units of their directions.

    `eye` (origin relative to the box's centre) and `half` are along the faces' normal, m.
    """
    # A ray in a face's plane would divide by 0.
    inverse = 1.0 / (direction + _TINY)
    middle, reach = -eye * inverse, half * jnp.abs(inverse)
    return middle - reach, middle + reach
