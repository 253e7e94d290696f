"""Define the renderer interface: images of scenes, `qpos` and camera poses, for a batch at once, lit alike.

Box renderers compute depth, class, normal and colour from the box that each pixel shows.
"""

import abc
import copy
import functools
from typing import Any

import flax.struct
import jax
import jax.numpy as jnp
import numpy as np
from PIL import Image

from interactive_nav.physics.base import one_of_batch
from interactive_nav.sensing.boxes import BoxTables, apply_axes, box_poses, slab
from interactive_nav_common.errors import UserError
from scenes_mjcf.categories import SEGMENTATIONS, MaskClasses
from scenes_mjcf.look import SKY_COLOUR, CameraPose, Lens

NEAR_M = 0.01
FAR_M = 100.0
"""Near and far plane of the original's renderer (reference benchmark, section 1.3); what is farther is empty."""
_FLOOR_HALF_M = (1e4, 1e4, 1.0)
"""Half sizes of the floor's box, whose top is z = 0."""
_LIGHT_W = np.array([0.35, 0.25, 0.9], np.float32) / np.linalg.norm([0.35, 0.25, 0.9])


@flax.struct.dataclass
class Look:
    """Hold an episode's colours and light, with any leading axes."""

    tint: jax.Array
    """[..., classes, 3] factors of the colours of each class of the masks; structure and sky are 0."""
    sun_w: jax.Array
    """[..., 3] unit vector towards the sun."""
    brightness: jax.Array
    """[...] factor of everything."""


def draw_look(key: jax.Array, colours: float, light: float, classes: MaskClasses) -> Look:
    """Draw an episode's look with standard deviations `colours` and `light`.

    `light` applies to the brightness, in stops, and to the components of the sun's direction before normalisation.
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


class Renderer(abc.ABC):
    """Draws N environments at once through one lens."""

    name: str
    lens: Lens
    tables: BoxTables

    def through(self, lens: Lens) -> "Renderer":
        """Return a renderer of the same through another lens; what does not depend on that is shared."""
        other = copy.copy(self)
        other.lens = lens
        return other

    def render_batch(self, scene: jax.Array, qpos: jax.Array, camera: CameraPose) -> tuple[jax.Array, jax.Array]:
        """Draw a batch of scenes [N], qpos [N, nq] and cameras, leaves [N, ...]: depth [N, H, W] f32, the distance
        along the optical axis, m, 0 where nothing is met, and class ids [N, H, W] u8."""
        images = self.images_batch(("depth", "segmentation"), scene, qpos, camera)
        return images["depth"], images["segmentation"]

    @abc.abstractmethod
    def images_batch(
        self, names: tuple[str, ...], scene: jax.Array, qpos: jax.Array, camera: CameraPose, look: Look | None = None
    ) -> dict[str, jax.Array]:
        """Draw several kinds of images of a batch; without a `look` objects keep their colours.

        Depth and segmentation are as in `render_batch`; rgb is [N, H, W, 3] f32 in [0, 1]; normals [N, H, W, 3] f32 are
        unit vectors in the camera's frame (right, up, towards the viewer), 0 in empty pixels.
        """

    def images(
        self, names: tuple[str, ...], scene: jax.Array, qpos: jax.Array, camera: CameraPose, look: Look | None = None
    ) -> dict[str, jax.Array]:
        """Draw one environment's `images_batch`; under any number of `vmap`s all are drawn in one call."""
        drawn = (scene, qpos, camera) if look is None else (scene, qpos, camera, look)
        return one_of_batch(functools.partial(self.images_batch, names), drawn)


class BoxRenderer(Renderer):
    """Draws the tables' boxes and the floor."""

    @abc.abstractmethod
    def trace_batch(self, scene: jax.Array, qpos: jax.Array, camera: CameraPose) -> tuple[jax.Array, jax.Array]:
        """Return depth as `render_batch` has it, and the box that each pixel shows: indices [N, H, W] i32 into the
        tables' boxes, B the floor, -1 nothing."""

    def images_batch(self, names, scene, qpos, camera, look=None):
        if not set(names) & {"rgb", "normals"}:
            return dict(zip(("depth", "segmentation"), self.render_batch(scene, qpos, camera), strict=True))
        tables, lens, (_, index) = self.tables, self.lens, self.trace_batch(scene, qpos, camera)
        n, shape = len(scene), index.shape
        assert tables.colour is not None
        centre, axes = box_poses(tables, scene, qpos)
        boxes = jnp.concatenate([axes.reshape(n, -1, 9), centre, tables.half_m[scene]], -1)
        floor = jnp.concatenate([jnp.eye(3).ravel(), jnp.asarray([0.0, 0.0, -_FLOOR_HALF_M[2], *_FLOOR_HALF_M])])
        boxes = jnp.concatenate([boxes, jnp.broadcast_to(floor, (n, 1, 15))], 1)
        ids = jnp.pad(tables.class_id, ((0, 0), (0, 1)))[scene]
        place = jnp.where(index < 0, tables.num_boxes, index).reshape(n, -1)
        met = index >= 0

        def of_pixel(table: jax.Array) -> jax.Array:
            """Return a table [N, B + 1, k] by pixel, [N, H, W, k]."""
            return jnp.take_along_axis(table, place[..., None], 1).reshape(*shape, table.shape[-1])

        # Each ray meets its box again, so that depth and face are exact and equal for all renderers.
        row = of_pixel(boxes)
        axes, centre, half = row[..., :9].reshape(*shape, 3, 3), row[..., 9:12], row[..., 12:]
        inverse = jnp.swapaxes(axes, -1, -2)
        forward, right, up = (camera.axes_w[:, None, None, :, i] for i in range(3))
        across, along = jnp.asarray(lens.columns)[None, None, :, None], jnp.asarray(lens.rows)[None, :, None, None]
        direction = apply_axes(inverse, forward + right * across + up * along)
        low, _ = slab(apply_axes(inverse, camera.pos_w[:, None, None] - centre), half, direction)
        outward = -jnp.sign(direction) * jax.nn.one_hot(jnp.argmax(low, -1), 3)
        normal = apply_axes(axes, outward) * met[..., None]
        sky = jnp.broadcast_to(jnp.asarray(SKY_COLOUR), (*shape, 3))
        base = jnp.where(met[..., None], of_pixel(tables.colour[scene]), sky)
        classes = jnp.where(met, of_pixel(ids[..., None])[..., 0], 0)
        images = lit_images(base, normal, camera, met, classes, look)
        return {"depth": jnp.where(met, low.max(-1), 0.0), "segmentation": classes, **images}


def lit_images(
    base: jax.Array,
    normal_w: jax.Array,
    camera: CameraPose,
    shaded: jax.Array,
    ids: jax.Array,
    look: Look | None = None,
) -> dict[str, jax.Array]:
    """Return images `rgb` and `normals` of `base` colours in [0, 1] and `normal_w`, both [N, H, W, 3], 0 if empty.

    Light falls on `shaded` pixels, [N, H, W] bool; others keep their colours. A `look` of None changes nothing.
    """
    forward, right, up = (camera.axes_w[:, None, None, :, i] for i in range(3))
    sideways, upward, away = ((normal_w * axis).sum(-1) for axis in (right, up, forward))
    normals = jnp.stack([sideways, upward, -away], -1)
    if look is None:
        return {"normals": normals, "rgb": lit(base, normal_w, forward, shaded, jnp)}
    flat = ids.reshape(len(ids), -1, 1).astype(jnp.int32)
    base = jnp.clip(base * jnp.take_along_axis(look.tint, flat, 1).reshape(base.shape), 0.0, 1.0)
    rgb = lit(base, normal_w, forward, shaded, jnp, look.sun_w[:, None, None])
    return {"normals": normals, "rgb": jnp.clip(rgb * look.brightness[:, None, None, None], 0.0, 1.0)}


def seen_through(image: np.ndarray, fov_deg: float, lens: Lens) -> np.ndarray:
    """Return what a narrower or coarser pinhole lens on the same axis would show of a picture [H, W, ...].

    It is [h, w, ...], the middle of the picture: colours averaged over each wanted pixel, else the nearest pixel's.
    """
    height, width, *channels = image.shape
    have = Lens(width, height, fov_deg)
    # In pixels of the picture: what the wanted lens covers.
    rows = 2 * lens.half_height / have.pixel
    columns = rows * lens.width / lens.height
    if rows > height * 1.001 or columns > width * 1.001:
        raise UserError(
            f"the camera's picture of {width} x {height} spans {fov_deg:.1f} degrees in height, the networks learned "
            f"from {lens.width} x {lens.height} that span {lens.fov_deg:.1f}: use a wider lens, or train with fov_deg"
        )
    rows, columns = min(rows, height), min(columns, width)
    box = ((width - columns) / 2, (height - rows) / 2, (width + columns) / 2, (height + rows) / 2)
    how = Image.Resampling.BOX if channels else Image.Resampling.NEAREST
    return np.asarray(Image.fromarray(image).resize((lens.width, lens.height), how, box=box))
