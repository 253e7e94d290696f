"""Draw with MJX-Warp's batched renderer (NVIDIA): the common boxes, in a model that holds nothing else.

Poses of boxes and cameras are computed here and written into the data, so that all backends draw alike. MJX allocates a
context for each batch size outside JAX; it is kept.
"""

import copy

import jax
import jax.numpy as jnp
import mujoco
import numpy as np
from mujoco import mjx

from interactive_nav.physics.base import uncommitted
from interactive_nav.physics.warp_callbacks import held, keep_collector_out
from interactive_nav.sensing.base import FAR_M, NEAR_M, BoxRenderer
from interactive_nav.sensing.boxes import BoxTables, box_poses
from interactive_nav.sensing.rays import camera_boxes, in_view
from scenes_mjcf.look import SKY_COLOUR, CameraPose, Lens

_HIDDEN_W = (0.0, 0.0, -50.0)
"""Padding, and boxes that the camera does not see, lie here, below the floor, which hides them."""
_HIDDEN_HALF_M = 1e-4


class WarpRenderer(BoxRenderer):
    """Draws with `mjx.render_with_segmentation`."""

    name = "warp"

    def __init__(self, tables: BoxTables, lens: Lens):
        keep_collector_out()
        self.lens, self.tables = lens, tables
        self._host = _box_model(tables.num_boxes, lens)
        self._model = uncommitted(mjx.put_model(self._host, impl="warp", device=jax.local_devices()[0]))
        self._contexts: dict[int, object] = {}

    def through(self, lens):
        return WarpRenderer(self.tables, lens)

    def _context(self, n: int):
        if n not in self._contexts:
            gpus = [d for d in jax.local_devices() if d.platform == "gpu"]
            self._contexts[n] = mjx.create_render_context(
                self._host,
                nworld=n,
                devices=[f"cuda:{d.local_hardware_id or 0}" for d in gpus] or None,
                cam_res=(self.lens.width, self.lens.height),
                render_rgb=False,
                render_depth=True,
                render_seg=True,
                use_textures=False,
                enabled_geom_groups=[0],
            )
        return self._contexts[n].pytree()  # type: ignore[attr-defined]

    def render_batch(self, scene, qpos, camera):
        depth, geom = self.trace_batch(scene, qpos, camera)
        n, boxes = scene.shape[0], self.tables.num_boxes
        ids = jnp.concatenate([self.tables.class_id, jnp.zeros((len(self.tables.class_id), 1), jnp.uint8)], 1)[scene]
        flat = jnp.where(geom < 0, boxes, geom).reshape(n, -1)
        return depth, jnp.take_along_axis(ids, flat, 1).reshape(depth.shape)

    def trace_batch(self, scene, qpos, camera):
        n = scene.shape[0]
        context = self._context(n)
        qpos = held(qpos, self._contexts[n])
        centre, axes = box_poses(self.tables, scene, qpos)
        half = self.tables.half_m[scene]
        # What the camera does not see lies aside with the padding: the tree of the rest is smaller.
        hidden = ~in_view(camera_boxes(self.tables, scene, qpos, camera), self.lens)[..., None]
        centre = jnp.where(hidden, jnp.asarray(_HIDDEN_W), centre)
        half = jnp.where(hidden, _HIDDEN_HALF_M, half)
        order = jnp.argsort(morton_codes(centre[..., :2], hidden[..., 0]), axis=1)
        centre, half = (jnp.take_along_axis(x, order[..., None], 1) for x in (centre, half))
        axes = jnp.take_along_axis(axes, order[..., None, None], 1)
        floor = jnp.zeros((n, 1, 3))
        upright = jnp.broadcast_to(jnp.eye(3), (n, 1, 3, 3))
        fields = {
            "geom_xpos": jnp.concatenate([centre, floor], 1),
            "geom_xmat": jnp.concatenate([axes, upright], 1),
            **_data_of_camera(camera, self._host),
        }
        size = jnp.concatenate([half, jnp.broadcast_to(jnp.asarray([0.0, 0.0, 0.1]), (n, 1, 3))], 1)
        template = mjx.make_data(self._host, impl="warp", naconmax=1, njmax=1)

        def one(size, fields):
            model = self._model.replace(geom_size=size)
            data = mjx.refit_bvh(model, template.replace(**fields), context)
            _, depth, seg, _ = mjx.render_with_segmentation(model, data, context)
            return depth, seg

        depth, seg = jax.vmap(one)(size, fields)
        shape = (n, self.lens.height, self.lens.width)
        geom = seg.reshape(*shape, 2)[..., 0]
        depth = depth.reshape(shape)
        met = (geom >= 0) & (depth > NEAR_M) & (depth < FAR_M)
        # The floor keeps its place behind the boxes.
        index = jnp.concatenate([order, jnp.full((n, 1), self.tables.num_boxes, order.dtype)], 1)
        geom = jnp.take_along_axis(index, jnp.maximum(geom, 0).reshape(n, -1), 1).reshape(geom.shape)
        return jnp.where(met, depth, 0.0), jnp.where(met, geom, -1)


def morton_codes(xy_m: jax.Array, hidden: jax.Array) -> jax.Array:
    """Return places [N, B] i32 on a Z-order curve, where planar neighbours are near; hidden boxes [N, B] come last.

    The renderer's tree halves this order and only refits bounds, so its quality depends on the order.
    """
    low = jnp.min(jnp.where(hidden[..., None], jnp.inf, xy_m), 1, keepdims=True)
    high = jnp.max(jnp.where(hidden[..., None], -jnp.inf, xy_m), 1, keepdims=True)
    cell = jnp.clip((xy_m - low) / jnp.maximum(high - low, 1e-6) * 1023.0, 0, 1023).astype(jnp.int32)
    for shift, mask in ((8, 0x00FF00FF), (4, 0x0F0F0F0F), (2, 0x33333333), (1, 0x55555555)):
        cell = (cell | (cell << shift)) & mask  # spreads the bits
    return jnp.where(hidden, 1 << 30, cell[..., 0] | (cell[..., 1] << 1))


class WarpColour:
    """RGB of one scene's visual meshes, with textures, for a batch of poses of it."""

    def __init__(self, model: mujoco.MjModel, lens: Lens, n: int, groups: list[int]):
        """Create a context; the first picture compiles.

        `model` has visual meshes and one camera; `n` is pictures a call, `groups` are the geom groups that are drawn.
        """
        keep_collector_out()
        model = copy.copy(model)
        model.cam_fovy[:] = lens.fov_deg
        self._host, self._lens = model, lens
        self._model = uncommitted(mjx.put_model(model, impl="warp", device=jax.local_devices()[0]))
        self._context = mjx.create_render_context(
            model,
            nworld=n,
            cam_res=(lens.width, lens.height),
            render_rgb=True,
            render_depth=False,
            render_seg=False,
            enabled_geom_groups=groups,
            enable_backface_culling=False,
            background_color=(*SKY_COLOUR, 1.0),
        )
        self.draw = jax.jit(self._draw)

    def _draw(self, geom_xpos, geom_xmat, camera: CameraPose) -> jax.Array:
        """Draw geoms' poses [N, ngeom, 3] and [N, ngeom, 3, 3], cameras [N, ...] to [N, H, W, 3] u8."""
        n = geom_xpos.shape[0]
        context, template = self._context.pytree(), mjx.make_data(self._host, impl="warp", naconmax=1, njmax=1)
        geoms = {"geom_xpos": geom_xpos, "geom_xmat": geom_xmat}
        fields = {name: jnp.asarray(x, jnp.float32) for name, x in geoms.items()} | _data_of_camera(camera, self._host)

        def one(fields):
            data = mjx.refit_bvh(self._model, template.replace(**fields), context)
            return mjx.render(self._model, data, context)[0]

        packed = jax.vmap(one)(fields).reshape(n, self._lens.height, self._lens.width)
        return jnp.stack([(packed >> shift) & 255 for shift in (16, 8, 0)], -1).astype(jnp.uint8)


def _data_of_camera(camera: CameraPose, model: mujoco.MjModel) -> dict[str, jax.Array]:
    """Return fields of MJX's data, leading axis [N]: the model's only camera, and a `qpos` that nobody reads."""
    pos_w, axes_w = jnp.asarray(camera.pos_w, jnp.float32), jnp.asarray(camera.axes_w, jnp.float32)
    # MuJoCo's cameras look along -z with x to the right.
    forward, right, up = (axes_w[..., i] for i in range(3))
    return {
        "cam_xpos": pos_w[:, None],
        "cam_xmat": jnp.stack([right, up, -forward], -1)[:, None],
        "qpos": jnp.zeros((len(pos_w), model.nq)),
    }


def _box_model(num_boxes: int, lens: Lens) -> mujoco.MjModel:
    """Build a model of `num_boxes` boxes, the floor after them, and one camera; poses and sizes are placeholders."""
    spec = mujoco.MjSpec()
    spec.stat.extent = 1.0
    spec.visual.map.znear, spec.visual.map.zfar = NEAR_M, FAR_M
    # MJX-Warp wants at least one degree of freedom.
    body = spec.worldbody.add_body(pos=[0, 0, -60.0])
    body.add_joint(type=mujoco.mjtJoint.mjJNT_SLIDE)
    body.mass, body.inertia, body.explicitinertial = 1.0, np.ones(3), True
    for i in range(num_boxes):
        spec.worldbody.add_geom(
            type=mujoco.mjtGeom.mjGEOM_BOX,
            pos=[0.0, 0.0, -10.0 - 0.01 * i],
            size=[0.1] * 3,
            contype=0,
            conaffinity=0,
            group=0,
        )
    spec.worldbody.add_geom(type=mujoco.mjtGeom.mjGEOM_PLANE, size=[0.0, 0.0, 0.1], contype=0, conaffinity=0, group=0)
    spec.worldbody.add_camera(fovy=lens.fov_deg)
    return spec.compile()
