"""Simulate a robot's sensors in a scene under velocity commands; without ROS."""

import dataclasses
import math
from collections.abc import Mapping
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from interactive_nav.navigation.lookup import all_free
from interactive_nav.pictures.camera import PictureCamera
from interactive_nav.sensing.description import describe, inputs_of
from interactive_nav.sensing.sensors import LIDAR_NEAR_M
from interactive_nav_common.errors import UserError
from interactive_nav_common.rotations import matrix_from_quat

NEEDED = ("velocity", "odometry", "lidar")
"""Observations of the environment that are sent on topics other than a camera's."""
IMAGES = ("depth", "segmentation", "rgb")
"""Kinds of images that topics carry."""
Images = Mapping[str, np.ndarray]
"""By kind, such as `rgb` or `left/depth`: colours [H, W, 3] u8, depth [H, W] f32 in m, class ids [H, W] u8."""


CameraPoses = Mapping[str, tuple[np.ndarray, float, float]]
"""By the prefix of its images where each camera is, (3,) m, and the yaw and the pitch (positive looks down), rad, that
it looks along, in the base's frame."""


@dataclasses.dataclass(frozen=True)
class Sensed:
    """Hold one moment as sensors measure it, and the ground truth for scoring."""

    time_s: float
    images: Images
    scan: np.ndarray
    """[lidar_rays] f32 in [0, 1], from the right on; 1: nothing within range. Empty: no scanner."""
    odometry: np.ndarray
    """(3,) x, y (m), yaw (rad) in the odometry's frame."""
    linear_b: np.ndarray
    """(3,) m/s, robot frame."""
    angular_b: np.ndarray
    """(3,) rad/s, robot frame."""
    heading_rad: float
    """Yaw in the world's frame."""
    touches_movable: bool
    touches_structure: bool
    force_n: float
    """Mean over the last control step of what the robot pushes with."""
    truth_w: np.ndarray
    """(3,) x, y (m), yaw (rad), world: no sensor measures it."""
    cameras: CameraPoses = dataclasses.field(default_factory=dict)
    """Of those that joints move."""


@dataclasses.dataclass(frozen=True)
class Pace:
    """Set how simulated time runs."""

    factor: float = 1.0
    """Simulated seconds per second; 0: as fast as possible."""
    lockstep: bool = False
    """Each picture waits for its command, so that nothing depends on the computer's speed."""
    limit_s: float = 1800.0
    """Simulated seconds until the episode is over."""
    recorded: bool = False
    """Start when every topic has a listener, and the picture has two."""


@dataclasses.dataclass
class Tally:
    """Sum up an episode, from the simulator's ground truth."""

    seconds: float = 0.0
    path_m: float = 0.0
    movable_s: float = 0.0
    structure_s: float = 0.0
    done: bool = False
    """The navigator declared the episode over, within the limit."""
    end_w: tuple[float, ...] = ()
    """x, y (m), yaw (rad), world."""

    def add(self, before: Sensed, after: Sensed) -> None:
        step = after.time_s - before.time_s
        self.seconds += step
        self.path_m += float(np.linalg.norm(after.truth_w[:2] - before.truth_w[:2]))
        self.movable_s += step * after.touches_movable
        self.structure_s += step * after.touches_structure
        self.end_w = tuple(round(float(v), 4) for v in after.truth_w)

    def row(self) -> dict[str, Any]:
        """Return the totals as JSON holds them."""
        return {k: round(v, 4) if isinstance(v, float) else v for k, v in dataclasses.asdict(self).items()}


class RosSensors:
    """Read a robot's sensor values from an environment's states; its odometry frame is the map.

    Scans and velocities are available if the environment observes `lidar` and `velocity`.
    """

    range_min_m = LIDAR_NEAR_M

    def __init__(self, env: Any):
        """Take an environment that velocities drive."""
        self._env, config, self._origin_w = env, env.config, None
        self._scales = {name: of["scale"] for name, of in describe(env)["inputs"].items()}
        if env.robot.twist is None:
            env.robot.drive(0.0, 0.0)  # says which modes take a velocity
        self.lidar_fov_deg, self.lidar_range_m = config.lidar_fov_deg, config.lidar_range_m
        self.lidar_pos_m, self.dt_s = config.lidar_pos_m, env.dt
        self.lenses = {"": env.sensors.lens} | {camera.prefix: camera.lens for camera in env.sensors.cameras}

    def camera_poses(self, state: Any, moving: bool) -> CameraPoses:
        """Return the poses of the robot's cameras in a state: those that joints move, or those fixed to its base."""
        sensors, qpos = self._env.sensors, np.asarray(state.pipeline_state.qpos)
        at = self._env.world.layout.robot_qpos
        into_base = np.asarray(matrix_from_quat(qpos[at + 3 : at + 7])).T
        poses = {}
        for prefix, mount in {"": sensors.mount, **{c.prefix: c.mount for c in sensors.cameras}}.items():
            if any(link.joints for link in mount.links.rest) != moving:
                continue
            pose = mount.pose(jnp.asarray(qpos))
            x, y, z = into_base @ np.asarray(pose.axes_w)[:, 0]
            place = into_base @ (np.asarray(pose.pos_w) - qpos[at : at + 3])
            poses[prefix] = place, math.atan2(y, x), -math.atan2(z, math.hypot(x, y))
        return poses

    def read(self, state: Any, time_s: float, force_n: float = 0.0) -> Sensed:
        """Return what the sensors measure of a state."""
        nav, values = state.info["nav"], inputs_of(self._env, jax.tree.map(np.asarray, state.obs))
        images = ((name, value) for name, value in values.items() if name.rpartition("/")[2] in IMAGES)
        movable, structure = (bool(t) for t in np.asarray(nav.memory["touching"]))
        velocity = values.get("velocity", np.zeros(6))
        truth_w = np.append(np.asarray(nav.robot_pos_w)[:2], nav.yaw_rad)
        return Sensed(
            time_s=time_s,
            images={name.removeprefix("pixels/"): self._image(name, value) for name, value in images},
            scan=values.get("lidar", np.zeros(0)),
            odometry=truth_w if self._origin_w is None else compose(self._origin_w, values["odometry"]),
            linear_b=velocity[:3],
            angular_b=velocity[3:],
            heading_rad=float(nav.yaw_rad),
            touches_movable=movable,
            touches_structure=structure,
            force_n=force_n,
            truth_w=truth_w,
            cameras=self.camera_poses(state, moving=True),
        )

    def _image(self, name: str, value: np.ndarray) -> np.ndarray:
        """Return an image of the observation in a message's unit and type."""
        image = value * np.float32(self._scales[name])
        if name.endswith("depth"):
            return image[..., 0]
        return np.squeeze(np.round(image * (255 if name.endswith("rgb") else 1)).astype(np.uint8))


class RosSimulator(RosSensors):
    """Simulate one robot in one environment, which observes `NEEDED` and takes velocity commands."""

    def __init__(self, env: Any, seed: int = 0, start: tuple[float, ...] = (), engine: str | None = None):
        """Place the robot at `start` (x, y in m and yaw in rad, world; empty: random) and compile.

        `engine` of `PictureCamera` draws the robot camera's colours; None: as the environment observes.
        """
        super().__init__(env)
        self._camera = PictureCamera(env, engine) if engine else None
        self._step = jax.jit(env.step)
        key = jax.random.PRNGKey(seed)
        begin = env.draw_start(key)
        if start:
            x, y, yaw = start
            if not bool(all_free(env.tables, jnp.int32(0), jnp.asarray([[x, y]], jnp.float32))):
                raise UserError(f"start ({x}, {y}) is not where the robot has room; choose another")
            begin = begin.replace(start_xy_w=jnp.asarray([x, y], jnp.float32), start_yaw_rad=jnp.float32(yaw))
        self._state = jax.jit(env.reset_to)(begin, jax.random.fold_in(key, 1))
        self._force_before = 0.0
        self._origin_w = np.array([*begin.start_xy_w, begin.start_yaw_rad])
        self.cameras = self.camera_poses(self._state, moving=False)
        jax.block_until_ready(self._step(self._state, jnp.zeros(env.action_size)))  # compiled before it counts

    def step(self, linear_mps: float, angular_radps: float) -> Sensed:
        """Drive for one control step; commands beyond the robot's limits are clipped."""
        self._force_before = float(self._state.info["nav"].memory["force_sum_n"])
        action = self._env.robot.drive(jnp.float32(linear_mps), jnp.float32(angular_radps), jnp)
        self._state = self._step(self._state, action)
        if float(self._state.metrics["nonfinite"]) > 0:
            raise UserError("the physics broke down (non-finite state); start again, with another seed")
        return self.sense()

    def sense(self) -> Sensed:
        nav = self._state.info["nav"]
        force_n = float(nav.memory["force_sum_n"]) - self._force_before
        now, lens = self.read(self._state, int(nav.step_count) * self.dt_s, force_n), self.lenses[""]
        drawn = self._camera.frame(self._state, lens.width, lens.height) if self._camera else {}
        return dataclasses.replace(now, images={**now.images, **drawn})


def compose(outer: np.ndarray, inner: Any) -> np.ndarray:
    """Return a pose (3,), x, y (m), yaw (rad), of a frame at the pose `outer`, in that one's frame."""
    cos, sin = np.cos(outer[2]), np.sin(outer[2])
    return outer + np.array([cos * inner[0] - sin * inner[1], sin * inner[0] + cos * inner[1], inner[2]])
