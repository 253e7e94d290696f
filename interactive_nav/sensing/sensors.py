"""Compute what the robot observes from the physics' state and the task's memory: a vector, and images on request.

Without images the observation is a flat f32 vector. By default it has ten waypoints x0, y0, ..., x9, y9 (m), goal minus
robot position (m), and the base's linear and angular velocity (m/s, rad/s), all in the robot's frame, in the original
benchmark's order (reference benchmark, section 1.1); other parts follow on request. With images it is a dict of
`state`, that vector if a part of it is requested, and images such as `pixels/depth` (H, W, 1), with several cameras
`pixels/<camera>/depth`. `docs/sensors.md` has their contents, types, ranges and errors. Noise depends on the episode's
key and the step alone.
"""

import dataclasses
import functools
import math
import zlib
from collections.abc import Callable, Mapping

import jax
import jax.numpy as jnp
import mujoco
import numpy as np

from interactive_nav.camera_config import CameraNoise
from interactive_nav.config import IMAGES, NavConfig, SensorConfig
from interactive_nav.physics.base import PhysicsState
from interactive_nav.robots.links import Links, make_links, repeated
from interactive_nav.robots.spec import RobotCamera
from interactive_nav.scenes.world import World
from interactive_nav.sensing import Renderer, build_boxes, make_renderer
from interactive_nav.sensing.base import draw_look
from interactive_nav.sensing.rays import cast_fan
from interactive_nav.types import NavInfo
from interactive_nav_common.config import nearest
from interactive_nav_common.errors import ConfigError
from interactive_nav_common.rotations import apply_axes, matrix_from_quat, wrap_angle
from scenes_mjcf.categories import SEGMENTATIONS
from scenes_mjcf.look import CameraPose, Lens, look_along

KeyOf = Callable[[str], jax.Array]
"""An error's name to its PRNG key: each has a separate stream, so that switching one on leaves the others alone."""


@dataclasses.dataclass(frozen=True)
class Mount:
    """A camera fixed to a body of the robot: its base, or a link that hinges and slides carry."""

    links: Links
    """From the base to that body."""
    pos_b: np.ndarray
    """(3,) of the camera in its body's frame, m."""
    forward_b: np.ndarray
    """(3,)."""

    def pose(self, qpos: jax.Array) -> CameraPose:
        """Return the camera's pose, without roll, for qpos [..., nq]."""
        pos, axes = self.links.frames(qpos)[-1]
        where = pos + apply_axes(axes, repeated(qpos, self.pos_b))
        return look_along(where, apply_axes(axes, repeated(qpos, self.forward_b)))


def make_mount(model: mujoco.MjModel, base_body: str, camera: RobotCamera, yaw_rad: float = 0.0) -> Mount:
    """Return a camera's mount in the base's subtree, which looks `yaw_rad` to the left of its body's x axis."""
    base, body = (mujoco.mj_name2id(model, mujoco.mjtObj.mjOBJ_BODY, n) for n in (base_body, camera.body))
    names = [model.body(b).name for b in range(model.nbody) if model.body_rootid[b] == base]
    if body < 0 or model.body_rootid[body] != base:
        raise ConfigError(
            f"camera body {camera.body!r} is no body of the robot{nearest(camera.body, names)}; "
            f"its bodies: {', '.join(names)}"
        )
    chain = [body]
    while chain[0] != base:
        chain.insert(0, int(model.body_parentid[chain[0]]))
    cos = math.cos(camera.pitch_rad)
    return Mount(
        links=make_links(model, chain),
        pos_b=np.asarray(camera.pos_m, float),
        forward_b=np.array([cos * math.cos(yaw_rad), cos * math.sin(yaw_rad), -math.sin(camera.pitch_rad)]),
    )


LIDAR_NEAR_M = 0.05
"""Distance of the beams' start from the scanner (iGibson)."""


def stream(rng: jax.Array, name: str, step_count: jax.Array) -> jax.Array:
    """Return a sensor's key of one control step, by folding its name into the episode's key.

    A small number would not do: `fold_in(key, 1)` is `split(key)[1]`, from which the next episode is drawn.
    """
    return jax.random.fold_in(jax.random.fold_in(rng, zlib.crc32(name.encode())), step_count)


@dataclasses.dataclass(frozen=True)
class SensorCamera:
    """A camera of the robot's, and what draws for it."""

    prefix: str
    """Of its images' names: empty for the robot's camera, else its name and a slash."""
    mount: Mount
    lens: Lens
    renderer: Renderer


class Sensors:
    """All that one world's robots can sense under one configuration."""

    renderer: Renderer | None

    def __init__(self, world: World, config: NavConfig, backend: str, extra: Mapping[str, int] | None = None):
        """Build tables, and a renderer if images are observed; `extra` is name -> length of appended parts."""
        self._layout, self._config = world.layout, config
        model = world.models[0]
        # The robot's joints but its free one: addresses in qpos and qvel, and whether they turn without limit.
        driven = np.isin(model.jnt_type, [mujoco.mjtJoint.mjJNT_HINGE, mujoco.mjtJoint.mjJNT_SLIDE])
        joints = np.flatnonzero(driven & np.isin(model.jnt_bodyid, world.layout.robot_bodies))
        turns = (model.jnt_type[joints] == mujoco.mjtJoint.mjJNT_HINGE) & ~model.jnt_limited[joints].astype(bool)
        self._joints = model.jnt_qposadr[joints], model.jnt_dofadr[joints], turns
        self._images = tuple(name for name in IMAGES if name in config.observations)
        meshes = config.image_geometry == "meshes"
        self._drawn = (*self._images, *(["normals"] if config.depth_grazing_deg else []))
        coloured = not meshes and bool({"rgb", "normals"} & set(self._drawn))
        self.boxes = build_boxes(world, config.segmentation_classes, coloured)
        shown = build_boxes(world, config.segmentation_classes, coloured, True) if config.robot_visible else self.boxes
        self.mount = make_mount(model, world.robot.base_body, world.robot.camera)
        self.lens = Lens(config.image_size, config.image_size, config.image_fov_deg or world.robot.camera.fov_deg)
        drawn = shown, self.lens, config.renderer, backend, world if meshes else None
        self.renderer = make_renderer(*drawn) if self._images else None
        self.cameras: tuple[SensorCamera, ...] = _cameras(world, config, self.renderer) if self.renderer else ()
        angles = -0.5 * config.lidar_fov_deg + np.arange(config.lidar_rays) * config.lidar_fov_deg / config.lidar_rays
        beams = [np.cos(np.radians(angles)), np.sin(np.radians(angles)), np.zeros(config.lidar_rays)]
        self._beams_b = np.stack(beams, -1).astype(np.float32)
        sizes = {
            "waypoints": 2 * config.num_waypoints,
            "goal": 3,
            "velocity": 6,
            "localisation": 3,
            "odometry": 3,
            "collision": 2,
            "joints": 2 * len(self._joints[0]),
            "lidar": config.lidar_rays,
            "hand": 10,
        }
        self.sizes = {name: size for name, size in sizes.items() if name in config.observations} | dict(extra or {})
        """Parts of the vector in order -> their lengths."""

    @property
    def observation_size(self) -> int | dict[str, tuple[int, ...]]:
        """Return the length of the vector, or with images the shape under each key."""
        length = sum(self.sizes.values())
        if not self._images:
            return length
        shapes: dict[str, tuple[int, ...]] = {"state": (length,)} if length else {}
        for camera in self.cameras:
            side = camera.lens.height, camera.lens.width
            image_shapes = {name: (*side, 3 if name in ("rgb", "normals") else 1) for name in self._images}
            shapes |= {f"pixels/{camera.prefix}{name}": shape for name, shape in image_shapes.items()}
        return shapes

    def observe(
        self, physics: PhysicsState, nav: NavInfo, rng: jax.Array, remembered: Mapping[str, jax.Array] | None = None
    ) -> jax.Array | dict[str, jax.Array]:
        """Return one environment's observation; noise uses the episode's key `rng` without consuming it.

        `remembered` has the observed values among `odometry`, `hand` and the `extra` parts.
        """
        vector = self._vector(physics, nav, rng, remembered or {})
        if not self._images:
            return vector
        out = {"state": vector} if self.sizes else {}
        for camera in self.cameras:
            out |= self._pixels(camera, physics, nav, rng)
        return out

    def _pixels(self, camera: SensorCamera, physics: PhysicsState, nav: NavInfo, rng: jax.Array):
        """Return what one camera adds to the observation."""
        config, out = self._config, {}

        def key_of(name: str) -> jax.Array:
            return stream(rng, f"{camera.prefix}{name}", nav.step_count)

        noisy = disturbed(config, camera.lens, self.render(physics, nav, camera, rng), key_of)
        depth = jnp.clip(noisy["depth"] / config.depth_range_m, 0.0, 1.0)
        depth = _noisy(depth, config.depth_noise, config.depth_dropout, 0.0, key_of("depth"))
        ids = noisy["segmentation"].astype(jnp.float32) / SEGMENTATIONS[self.boxes.classes].divisor
        images = {**noisy, "depth": depth[..., None], "segmentation": ids[..., None]}
        dtype = jnp.dtype(config.image_dtype)
        whole = dtype == jnp.uint8
        for name in self._images:
            key = f"pixels/{camera.prefix}{name}"
            if name == "normals":
                out[key] = images[name].astype(jnp.float32 if whole else dtype)
            else:
                out[key] = (jnp.round(255.0 * images[name]) if whole else images[name]).astype(dtype)
        return out

    def render(self, physics: PhysicsState, nav: NavInfo, camera: SensorCamera, rng: jax.Array) -> dict[str, jax.Array]:
        """Return what a camera sees, without noise: the images that are observed or needed for it, as
        `Renderer.images_batch` has them, without its leading axis; depth and segmentation always."""
        # A broken world's numbers must not reach the renderer's search tree.
        qpos = jnp.where(jnp.isfinite(physics.qpos), physics.qpos, 0.0)
        config, look = self._config, None
        if config.random_colours or config.random_light:
            key = stream(rng, "look", jnp.zeros((), jnp.int32))
            look = draw_look(key, config.random_colours, config.random_light, self.boxes.classes)
        return camera.renderer.images(self._drawn, nav.scene_index, qpos, camera.mount.pose(qpos), look)

    def _vector(
        self, physics: PhysicsState, nav: NavInfo, rng: jax.Array, remembered: Mapping[str, jax.Array]
    ) -> jax.Array:
        v, q = self._layout.robot_qvel, self._layout.robot_qpos
        rotation = matrix_from_quat(physics.qpos[q + 3 : q + 7])
        goal_w = jnp.concatenate([nav.goal_xy_w, jnp.zeros(1)])
        values = {
            "waypoints": nav.waypoints_b.reshape(-1),
            "goal": (goal_w - nav.robot_pos_w) @ rotation,
            "velocity": jnp.concatenate([physics.qvel[v : v + 3] @ rotation, physics.qvel[v + 3 : v + 6]]),
            **remembered,
        }
        if "localisation" in self.sizes:
            values["localisation"] = jnp.append(nav.robot_pos_w[:2], nav.yaw_rad)
        if "collision" in self.sizes:
            values["collision"] = nav.memory["touching"].astype(jnp.float32)
        if "joints" in self.sizes:
            position, velocity, turns = self._joints
            angle = physics.qpos[position]
            angle = jnp.where(turns, wrap_angle(angle), angle)
            values["joints"] = jnp.concatenate([angle, physics.qvel[velocity]])
        if "lidar" in self.sizes:
            values["lidar"] = self._scan(physics, nav, rotation, rng)
        return jnp.concatenate([values[name] for name in self.sizes] or [jnp.zeros(0)])

    def _scan(self, physics: PhysicsState, nav: NavInfo, rotation: jax.Array, rng: jax.Array) -> jax.Array:
        config = self._config
        origin = nav.robot_pos_w + apply_axes(rotation, jnp.asarray(config.lidar_pos_m, jnp.float32))
        beams = apply_axes(rotation[None], jnp.asarray(self._beams_b))
        distance = cast_fan(self.boxes, nav.scene_index, physics.qpos, origin, beams)
        scan = jnp.clip(distance / config.lidar_range_m, LIDAR_NEAR_M / config.lidar_range_m, 1.0)
        key = stream(rng, "lidar", nav.step_count)
        return _noisy(scan, config.lidar_noise, config.lidar_dropout, 1.0, key)


def _cameras(world: World, config: SensorConfig, renderer: Renderer) -> tuple[SensorCamera, ...]:
    """Return the requested cameras; those of one lens share a renderer."""
    robot_camera, drawn = world.robot.camera, {renderer.lens: renderer}
    out = []
    for view in config.views:
        side = view.size or config.image_size
        lens = Lens(side, side, view.fov_deg or config.image_fov_deg or robot_camera.fov_deg)
        if lens not in drawn:
            drawn[lens] = renderer.through(lens)
        pitch = robot_camera.pitch_rad if view.pitch_deg is None else math.radians(view.pitch_deg)
        place = {"body": view.body or robot_camera.body, "pos_m": view.pos_m or robot_camera.pos_m}
        seat = dataclasses.replace(robot_camera, pitch_rad=pitch, **place)
        mount = make_mount(world.models[0], world.robot.base_body, seat, math.radians(view.yaw_deg))
        out.append(SensorCamera(f"{view.name}/" if view.name else "", mount, lens, drawn[lens]))
    return tuple(out)


def _noisy(reading: jax.Array, noise: float, dropout: float, lost: float, key: jax.Array) -> jax.Array:
    """Return readings in [0, 1] with a Gaussian error in proportion, some replaced by `lost`."""
    key_noise, key_dropout = jax.random.split(key)
    if noise:
        reading = jnp.clip(reading * (1 + noise * jax.random.normal(key_noise, reading.shape)), 0.0, 1.0)
    if dropout:
        reading = jnp.where(jax.random.bernoulli(key_dropout, dropout, reading.shape), lost, reading)
    return reading


def disturbed(noise: CameraNoise, lens: Lens, images: dict[str, jax.Array], key_of: KeyOf) -> dict[str, jax.Array]:
    """Return the images of one camera, as `Renderer.images` gives them, with its errors; `depth_grazing_deg` needs
    normals."""
    out = dict(images)
    if "rgb" in out:
        out["rgb"] = noisy_rgb(noise, out["rgb"], key_of)
    out["depth"] = noisy_depth(noise, lens, out["depth"], out.get("normals"), key_of)
    if noise.frame_dropout:
        kept = ~jax.random.bernoulli(key_of("frame_dropout"), noise.frame_dropout)
        out = {name: image * kept.astype(image.dtype) for name, image in out.items()}
    return out


def noisy_rgb(noise: CameraNoise, rgb: jax.Array, key_of: KeyOf) -> jax.Array:
    """Return [H, W, 3] in [0, 1] with the errors of the lens, then the exposure, then the sensor."""
    if noise.rgb_blur_px:
        rgb = blurred(rgb, noise.rgb_blur_px)
    if noise.rgb_exposure:
        rgb = jnp.clip(rgb * 2.0 ** (noise.rgb_exposure * jax.random.normal(key_of("rgb_exposure"))), 0.0, 1.0)
    if noise.rgb_noise or noise.rgb_shot_noise:
        deviation = jnp.sqrt(noise.rgb_noise**2 + noise.rgb_shot_noise**2 * rgb)
        rgb = jnp.clip(rgb + deviation * jax.random.normal(key_of("rgb_noise"), rgb.shape), 0.0, 1.0)
    if noise.rgb_dropout:
        lost = jax.random.bernoulli(key_of("rgb_dropout"), noise.rgb_dropout, (*rgb.shape[:-1], 1))
        rgb = jnp.where(lost, 0.0, rgb)
    return rgb


def blurred(image: jax.Array, deviation_px: float) -> jax.Array:
    """Return [H, W, C] convolved with a Gaussian cut at three deviations, its edges continued outwards."""
    reach = math.ceil(3 * deviation_px)
    weights = np.exp(-0.5 * (np.arange(-reach, reach + 1) / deviation_px) ** 2)
    weights = (weights / weights.sum()).astype(np.float32)
    for axis in (0, 1):
        padding = [(reach, reach) if a == axis else (0, 0) for a in range(3)]
        wide, side = jnp.pad(image, padding, mode="edge"), image.shape[axis]
        parts = [w * jax.lax.slice_in_dim(wide, i, i + side, axis=axis) for i, w in enumerate(weights)]
        image = functools.reduce(jnp.add, parts)
    return image


def noisy_depth(
    noise: CameraNoise, lens: Lens, depth: jax.Array, normals: jax.Array | None, key_of: KeyOf
) -> jax.Array:
    """Return [H, W] m as a structured-light sensor reads it; 0 without a reading.

    The sensor measures disparity, so a constant disparity error gives a depth error that grows with its square.
    """
    met, out = depth > 0, depth
    near = jnp.maximum(depth, 1e-3)
    if noise.depth_disparity_noise or noise.depth_disparity_step:
        disparity, step = 1.0 / near, noise.depth_disparity_step
        if noise.depth_disparity_noise:
            disparity += noise.depth_disparity_noise * jax.random.normal(key_of("depth_disparity"), depth.shape)
        if step:
            disparity = step * jnp.round(disparity / step)
        # No disparity: too far to be read.
        out = jnp.where(disparity > 0, 1.0 / jnp.maximum(disparity, 1e-6), 0.0)
    if noise.depth_grazing_deg:
        assert normals is not None
        across, upward = jnp.asarray(lens.columns)[None], jnp.asarray(lens.rows)[:, None]
        # Of the ray to the viewer, in the camera's frame, on the surface's normal.
        along = normals[..., 2] - normals[..., 0] * across - normals[..., 1] * upward
        met &= along > math.sin(math.radians(noise.depth_grazing_deg)) * jnp.sqrt(1.0 + across**2 + upward**2)
    if noise.depth_edge_m:
        # A nearer surface hides the projector from the surfaces behind it.
        wide = jnp.pad(jnp.where(depth > 0, depth, jnp.inf), 1, mode="edge")
        beside = [wide[1:-1, :-2], wide[1:-1, 2:], wide[:-2, 1:-1], wide[2:, 1:-1]]
        met &= depth - jnp.min(jnp.stack(beside), 0) <= noise.depth_edge_m
    met &= out >= noise.depth_min_m
    if noise.depth_max_m:
        met &= out <= noise.depth_max_m
    return jnp.where(met, out, 0.0)
