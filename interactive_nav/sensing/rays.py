"""Cast rays against boxes in plain JAX, on any device: depth and class images of `BoxTables` through a lens.

A ray meets a box where it has entered the box's three slabs and left none. A pixel keeps one integer, the bits
of its nearest distance with the class id in the lowest (four cost 2^-19 of the distance, six 2^-17), so that a minimum
over boxes yields both. Two orders of work:

- `scan`: every box against every pixel, a few boxes at a time, one fused pass over the image each; for GPUs.
- `tiles`: the image is cut into tiles, each with the list of boxes that may show in it, and tiles with lists of
  like length are worked off together; for CPUs, where it does a sixteenth of the tests.
"""

import jax
import jax.numpy as jnp
import numpy as np

from interactive_nav.sensing.base import FAR_M, NEAR_M, BoxRenderer
from interactive_nav.sensing.boxes import BoxTables, apply_axes, box_poses, compose, slab
from scenes_mjcf.categories import SEGMENTATIONS
from scenes_mjcf.look import CameraPose, Lens

_EMPTY = np.int32(2**31 - 1)
_BOXES_AT_ONCE = 8
_TILES_AT_ONCE = 64


class RayRenderer(BoxRenderer):
    """Draws by casting a ray through the middle of each pixel."""

    def __init__(self, tables: BoxTables, lens: Lens, tiled: bool | None = None):
        """Choose the order of work by `tiled`; None: tiles on CPUs."""
        self.lens, self.tables = lens, tables
        self._tiled = jax.default_backend() == "cpu" if tiled is None else tiled
        self.name = "rays (tiles)" if self._tiled else "rays (scan)"

    def render_batch(self, scene, qpos, camera):
        boxes = camera_boxes(self.tables, scene, qpos, camera)
        depth, ids = self._cast(boxes, camera, _low_bits(len(SEGMENTATIONS[self.tables.classes].names) - 1))
        return depth, ids.astype(jnp.uint8)

    def trace_batch(self, scene, qpos, camera):
        count = self.tables.num_boxes
        boxes = camera_boxes(self.tables, scene, qpos, camera)
        boxes["id"] = jnp.broadcast_to(jnp.arange(1, count + 1, dtype=jnp.int32), boxes["id"].shape)
        depth, ids = self._cast(boxes, camera, _low_bits(count))
        index = jnp.where(ids > 0, ids - 1, count)
        return depth, jnp.where(depth > 0, index, -1)

    def _cast(self, boxes: dict[str, jax.Array], camera: CameraPose, mask: int) -> tuple[jax.Array, jax.Array]:
        """Return depth f32, m, and the boxes' numbers i32; both 0 where nothing is met before the far plane."""
        cast = _tiles if self._tiled and self.tables.num_boxes else _scan
        keys = cast(boxes, camera, self.lens, mask)
        distance = jax.lax.bitcast_convert_type(keys & ~mask, jnp.float32)
        met = distance < FAR_M
        return jnp.where(met, distance, 0.0), jnp.where(met, keys & mask, 0)


def _low_bits(number: int) -> int:
    """Return the mask of the bits of a key that hold numbers up to this one."""
    return (1 << number.bit_length()) - 1


def camera_boxes(tables: BoxTables, scene: jax.Array, qpos: jax.Array, camera: CameraPose) -> dict[str, jax.Array]:
    """Return what a slab test needs of each box: axes [N, B, 3, 3], the camera's forward, right and up (columns) in the
    box's frame; eye [N, B, 3], its position there, m; half [N, B, 3], m, negative for padding; id [N, B] i32."""
    centre, axes = box_poses(tables, scene, qpos)
    inverse = jnp.swapaxes(axes, -1, -2)
    return {
        "axes": compose(inverse, camera.axes_w[..., None, :, :]),
        "eye": apply_axes(inverse, camera.pos_w[..., None, :] - centre),
        "half": tables.half_m[scene],
        "id": tables.class_id[scene].astype(jnp.int32),
    }


def _lesser(a, b):
    # One instruction on CPUs, where jnp.minimum takes several to pass NaN on; so for the greater below.
    return jnp.where(a < b, a, b)


def enter_and_leave(eye, half, directions) -> tuple[jax.Array, jax.Array]:
    """Return distances (entry, exit) of rays through a box, in units of the direction; it is hit if entry < exit.

    `eye`, the rays' origin in the box's frame, `half` and `directions` are three arrays each, broadcast.
    """
    entry = leave = None
    for o, h, d in zip(eye, half, directions, strict=True):
        low, high = slab(o, h, d)
        entry = low if entry is None else jnp.where(entry > low, entry, low)
        leave = high if leave is None else _lesser(leave, high)
    assert entry is not None and leave is not None
    return entry, leave


def _key(entry, leave, half, number, mask: int) -> jax.Array:
    met = (entry < leave) & (entry > NEAR_M) & (half >= 0)
    return jnp.where(met, (jax.lax.bitcast_convert_type(entry, jnp.int32) & ~mask) | number, _EMPTY)


def _floor_key(height, down, mask: int) -> jax.Array:
    """Return the floor's key for a camera `height` above it and rays that fall by `down` per depth; its id is 0."""
    met = down > 1e-6
    distance = jnp.where(met, height / jnp.where(met, down, 1.0), -1.0)
    return jnp.where(distance > NEAR_M, jax.lax.bitcast_convert_type(distance, jnp.int32) & ~mask, _EMPTY)


def _scan(boxes: dict[str, jax.Array], camera: CameraPose, lens: Lens, mask: int) -> jax.Array:
    right, up = jnp.asarray(lens.columns)[None, None], jnp.asarray(lens.rows)[None, :, None]

    def direction(axes):
        """Return the component of the pixels' rays along one axis: axes [N, 3] -> [N, H, W]."""
        f, r, u = (axes[:, i, None, None] for i in range(3))
        return (f + r * right) + u * up

    def body(keys, box):
        def image(x):
            return x[:, None, None]

        directions = [direction(box["axes"][:, i]) for i in range(3)]
        eye, half = [image(box["eye"][:, i]) for i in range(3)], [image(box["half"][:, i]) for i in range(3)]
        entry, leave = enter_and_leave(eye, half, directions)
        return jnp.minimum(keys, _key(entry, leave, half[0], image(box["id"]), mask)), None

    keys = _floor_key(camera.pos_w[:, 2, None, None], -direction(camera.axes_w[:, 2]), mask)
    per_box = jax.tree.map(lambda x: jnp.moveaxis(x, 1, 0), boxes)
    return jax.lax.scan(body, keys, per_box, unroll=_BOXES_AT_ONCE)[0]


def _tile_side(size: int) -> int:
    """Return the side of a tile, pixels: 16, or what divides the image and is near."""
    return min((s for s in range(12, 21) if size % s == 0), key=lambda s: abs(s - 16), default=min(16, size))


def _shows(boxes: dict[str, jax.Array], edges: np.ndarray, axis: int) -> jax.Array:
    """Return [N, B, k]: whether boxes may show between neighbouring planes through the eye.

    `edges` are [k + 1] rising offsets at depth 1, along the camera's right (axis 1) or up (axis 2).
    """
    ahead, aside = boxes["axes"][..., 0], boxes["axes"][..., axis]
    # The box's centre in the camera's frame is minus the eye's position in the box's.
    normal = aside[..., None, :] - ahead[..., None, :] * jnp.asarray(edges)[None, None, :, None]
    centre = -(boxes["eye"][..., None, :] * normal).sum(-1)
    reach = (boxes["half"][..., None, :] * jnp.abs(normal)).sum(-1)
    slack = 1e-4
    return (centre + reach > -slack)[..., :-1] & (centre - reach < slack)[..., 1:]


def in_view(boxes: dict[str, jax.Array], lens: Lens) -> jax.Array:
    """Return which boxes of `camera_boxes` may show in the image: [N, B]; false for padding."""
    wide, high = lens.half_height * lens.width / lens.height, lens.half_height
    across = _shows(boxes, np.array([-wide, wide], np.float32), 1)
    along = _shows(boxes, np.array([-high, high], np.float32), 2)
    return _in_front(boxes) & across[..., 0] & along[..., 0]


def _in_front(boxes: dict[str, jax.Array]) -> jax.Array:
    """Return which boxes are not padding and reach before the near plane: [N, B]."""
    ahead = -(boxes["eye"] * boxes["axes"][..., 0]).sum(-1)
    ahead += (boxes["half"] * jnp.abs(boxes["axes"][..., 0])).sum(-1)
    return (boxes["half"][..., 0] >= 0) & (ahead > NEAR_M)


def _lists(shows: jax.Array, env: np.ndarray, n: int) -> tuple[jax.Array, jax.Array]:
    """Return each tile's list of the boxes that it shows, and how many, from `shows` [T, B] and its environment [T]:
    [T, B + 1] i32 rows of boxes, the free places pointing at the row of padding behind all of them; [T] i32."""
    count, num_boxes = shows.shape
    rank = jnp.cumsum(shows, -1, dtype=jnp.int32)
    number = env[:, None] * num_boxes + np.arange(num_boxes, dtype=np.int32)
    lists = jnp.full((count, num_boxes + 1), n * num_boxes, jnp.int32)
    lists = lists.at[np.arange(count)[:, None], jnp.where(shows, rank - 1, num_boxes)].set(jnp.asarray(number))
    return lists.at[:, num_boxes].set(n * num_boxes), rank[:, -1]


def _tiles(boxes: dict[str, jax.Array], camera: CameraPose, lens: Lens, mask: int) -> jax.Array:
    n, num_boxes = boxes["id"].shape
    tw, th = _tile_side(lens.width), _tile_side(lens.height)
    nx, ny = -(-lens.width // tw), -(-lens.height // th)
    left = ((np.arange(nx) * tw - lens.width / 2) * lens.pixel).astype(np.float32)
    bottom = ((lens.height / 2 - (np.arange(ny) + 1) * th) * lens.pixel).astype(np.float32)[::-1]
    x_edges = np.append(left, left[-1] + tw * lens.pixel)
    y_edges = np.append(bottom, bottom[-1] + th * lens.pixel)
    # Rows of tiles run from the top, edges rise: reversed.
    across, along = _shows(boxes, x_edges, 1), _shows(boxes, y_edges, 2)[..., ::-1]
    shows = _in_front(boxes)[:, :, None, None] & along[..., :, None] & across[..., None, :]
    shows = jnp.moveaxis(shows.reshape(n, num_boxes, ny * nx), 1, 2).reshape(n * ny * nx, num_boxes)
    count = n * ny * nx
    env = np.repeat(np.arange(n, dtype=np.int32), ny * nx)
    lists, lengths = _lists(shows, env, n)
    bits = jax.lax.bitcast_convert_type(boxes["id"], jnp.float32)
    parts = (boxes["axes"].reshape(n, num_boxes, 9), boxes["eye"], boxes["half"], bits[..., None])
    rows = jnp.concatenate(parts, -1).reshape(n * num_boxes, 16)
    rows = jnp.concatenate([rows, jnp.full((1, 16), -1.0, jnp.float32)])

    # Ray directions are the tile's corner's plus an offset that all tiles share.
    corner_x = np.tile(np.tile(left, ny), n)
    corner_y = np.tile(np.repeat(((lens.height / 2 - np.arange(ny) * th) * lens.pixel).astype(np.float32), nx), n)
    dx = np.tile(((np.arange(tw) + 0.5) * lens.pixel).astype(np.float32), th)[None]
    dy = np.repeat((-(np.arange(th) + 0.5) * lens.pixel).astype(np.float32), tw)[None]
    falls = jnp.concatenate([-camera.axes_w[:, 2], camera.pos_w[:, 2:]], -1)[env]

    def work(tiles):
        x, y = jnp.asarray(corner_x)[tiles], jnp.asarray(corner_y)[tiles]
        in_tile, todo = lists[tiles], lengths[tiles].max()

        def direction(f, r, u):
            return (f + r * x + u * y)[:, None] + r[:, None] * dx + u[:, None] * dy

        def body(carry):
            k, keys = carry
            row = rows[jax.lax.dynamic_index_in_dim(in_tile, k, 1, keepdims=False)]
            column = [row[:, i] for i in range(15)]
            directions = [direction(*column[3 * i : 3 * i + 3]) for i in range(3)]
            wide = [c[:, None] for c in column]
            entry, leave = enter_and_leave(wide[9:12], wide[12:15], directions)
            number = jax.lax.bitcast_convert_type(row[:, 15:], jnp.int32)
            return k + 1, jnp.minimum(keys, _key(entry, leave, wide[12], number, mask))

        fall = falls[tiles]
        keys = _floor_key(fall[:, 3:], direction(fall[:, 0], fall[:, 1], fall[:, 2]), mask)
        return jax.lax.while_loop(lambda carry: carry[0] < todo, body, (jnp.int32(0), keys))[1]

    order = jnp.argsort(lengths)
    groups = max(1, min(_TILES_AT_ONCE, count // 16))
    size = -(-count // groups)
    padded = jnp.concatenate([order, jnp.broadcast_to(order[-1:], (groups * size - count,))])
    done = jax.lax.map(work, padded.reshape(groups, size)).reshape(groups * size, th * tw)
    place = jnp.zeros(count, order.dtype).at[order].set(jnp.arange(count, dtype=order.dtype))
    image = done[place].reshape(n, ny, nx, th, tw).transpose(0, 1, 3, 2, 4).reshape(n, ny * th, nx * tw)
    return image[:, : lens.height, : lens.width]


def cast_fan(
    tables: BoxTables, scene: jax.Array, qpos: jax.Array, origin_w: jax.Array, directions_w: jax.Array
) -> jax.Array:
    """Return lidar distances [R] f32 from `origin_w` (3,), m, along `directions_w` [R, 3], in units of their length.

    The floor counts; distances are infinite without a hit.
    """
    centre, axes = box_poses(tables, scene, qpos)
    inverse = jnp.swapaxes(axes, -1, -2)
    eye, half = apply_axes(inverse, origin_w[None] - centre), tables.half_m[scene]

    def body(nearest, box):
        inverse, eye, half = box
        directions = [(directions_w * inverse[i][None]).sum(-1) for i in range(3)]
        entry, leave = enter_and_leave(eye, half, directions)
        # From inside a box its far side is met: an object under the scanner does not blind it.
        distance = jnp.where(entry > 0, entry, leave)
        met = (entry < leave) & (distance > 0) & (half[0] >= 0)
        return _lesser(nearest, jnp.where(met, distance, jnp.inf)), None

    down = -directions_w[:, 2]
    floor = jnp.where(down > 1e-6, origin_w[2] / jnp.where(down > 1e-6, down, 1.0), jnp.inf)
    return jax.lax.scan(body, floor, (inverse, eye, half))[0]
