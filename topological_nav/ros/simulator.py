"""Simulate a robot's sensors in a scene under velocity commands; without ROS.

TTbot on C MuJoCo (`native`), its lidar and odometry from `interactive_nav.sensing.sensors`, its pictures from
`interactive_nav.pictures.camera`. The odometry's frame is the start's; the heading is the world's, as a compass has
it.
"""

import dataclasses
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from interactive_nav.pictures.camera import PictureCamera
from interactive_nav.sensing.sensors import LIDAR_NEAR_M
from interactive_nav_common.errors import UserError
from scenes_mjcf.look import Lens
from topological_nav.drives.expert import LIDAR_B
from topological_nav.ros.config import SimulatorConfig
from topological_nav.scenes.rendering import make_env, need_engine, shrink
from topological_nav.scenes.space import free_space

ROBOT = "ttbot"
LIDAR_POS_M = LIDAR_B[ROBOT]


@dataclasses.dataclass(frozen=True)
class Sensed:
    """Hold one moment as sensors measure it, and the ground truth for scoring."""

    time_s: float
    rgb: np.ndarray
    """[H, W, 3] u8."""
    scan: np.ndarray
    """[lidar_rays] f32 in [0, 1], from the right on; 1: nothing within range."""
    odometry: np.ndarray
    """(3,) x, y (m), yaw (rad) in the frame of the start."""
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
        """Add a control step."""
        step = after.time_s - before.time_s
        self.seconds += step
        self.path_m += float(np.linalg.norm(after.truth_w[:2] - before.truth_w[:2]))
        self.movable_s += step * after.touches_movable
        self.structure_s += step * after.touches_structure
        self.end_w = tuple(round(float(v), 4) for v in after.truth_w)

    def row(self) -> dict[str, Any]:
        """Return the totals as JSON holds them."""
        return {k: round(v, 4) if isinstance(v, float) else v for k, v in dataclasses.asdict(self).items()}


class RosSimulator:
    """Simulate one robot in one scene."""

    range_min_m, lidar_pos_m = LIDAR_NEAR_M, LIDAR_POS_M

    def __init__(self, scene: Path, config: SimulatorConfig):
        """Build the world, place the robot and compile."""
        need_engine(config.engine)
        self.config = config
        names = ("lidar_rays", "lidar_fov_deg", "lidar_range_m", "lidar_noise", "odometry_noise")
        sensors = {name: getattr(config, name) for name in names}
        sensors |= {"observations": ("velocity", "localisation", "odometry", "lidar"), "lidar_pos_m": LIDAR_POS_M}
        self._env = make_env([scene], ROBOT, "native", num_objects=config.objects, **sensors)
        twist = self._env.robot.twist
        assert twist is not None
        self.max_linear_mps, self.max_angular_radps = twist.max_linear_m_s, twist.max_angular_rad_s
        self.dt_s = self._env.dt
        self.lens = Lens(config.width, config.height, config.fov_deg)
        self._camera = PictureCamera(self._env, config.engine, config.fov_deg)
        self._step = jax.jit(self._env.step)
        key = jax.random.PRNGKey(config.seed)
        start = self._env.draw_start(key)
        if config.start:
            x, y, yaw = config.start
            clear = float(free_space(self._env.scenes[0], self._env.robot.height_m).at(np.array([x, y])))
            least = self._env.robot.body_width_m / 2
            if clear < least:
                raise UserError(f"start ({x}, {y}) is {clear:.2f} m from obstacles, expected at least {least} m")
            start = start.replace(start_xy_w=jnp.asarray([x, y], jnp.float32), start_yaw_rad=jnp.float32(yaw))
        self._state = jax.jit(self._env.reset_to)(start, jax.random.fold_in(key, 1))
        self._force_before = 0.0
        jax.block_until_ready(self._step(self._state, jnp.zeros(self._env.action_size)))  # compiled before it counts

    @property
    def camera_pos_m(self) -> tuple[float, float, float]:
        """Return the camera's position in the base's frame."""
        return self._env.robot.camera.pos_m

    def step(self, linear_mps: float, angular_radps: float) -> Sensed:
        """Drive for one control step; commands beyond the robot's limits are clipped."""
        self._force_before = float(self._state.info["nav"].memory["force_sum_n"])
        action = self._env.robot.drive(jnp.float32(linear_mps), jnp.float32(angular_radps), jnp)
        self._state = self._step(self._state, action)
        if float(self._state.metrics["nonfinite"]) > 0:
            raise UserError("the physics broke down (non-finite state); start again, with another seed")
        return self.sense()

    def sense(self) -> Sensed:
        """Return what the sensors measure now."""
        nav, sizes = self._state.info["nav"], self._env.sensors.sizes
        ends = np.cumsum(list(sizes.values()))
        values: Any = dict(zip(sizes, np.split(np.asarray(self._state.obs), ends[:-1]), strict=True))
        by = self.config.supersample
        drawn = self._camera.frame(self._state, self.lens.width * by, self.lens.height * by, ("rgb",), "robot")["rgb"]
        movable, structure = (bool(t) for t in np.asarray(nav.memory["touching"]))
        return Sensed(
            time_s=int(nav.step_count) * self.dt_s,
            rgb=shrink(drawn[None], by)[0],
            scan=values["lidar"],
            odometry=values["odometry"],
            linear_b=values["velocity"][:3],
            angular_b=values["velocity"][3:],
            heading_rad=float(values["localisation"][2]),
            touches_movable=movable,
            touches_structure=structure,
            force_n=float(nav.memory["force_sum_n"]) - self._force_before,
            truth_w=values["localisation"],
        )
