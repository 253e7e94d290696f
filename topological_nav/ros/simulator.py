"""Simulate TTbot on C MuJoCo (`native`) with pictures as networks learned from.

The odometry's frame is the start's; the heading is the world's, as a compass has it.
"""

from pathlib import Path
from typing import Any

import numpy as np

from interactive_nav.pictures.camera import PictureCamera
from interactive_nav.ros.simulator import NEEDED, Images, RosSimulator
from interactive_nav_common.errors import UserError
from scenes_mjcf.look import Lens
from topological_nav.drives.expert import LIDAR_B
from topological_nav.ros.config import SimulatorConfig
from topological_nav.scenes.rendering import make_env, need_engine, shrink
from topological_nav.scenes.space import free_space

ROBOT = "ttbot"


def build_simulator(scene: Path, config: SimulatorConfig) -> RosSimulator:
    """Build the world and place the robot."""
    need_engine(config.engine)
    names = ("lidar_rays", "lidar_fov_deg", "lidar_range_m", "lidar_noise", "odometry_noise")
    sensors = {name: getattr(config, name) for name in names}
    sensors |= {"observations": NEEDED, "lidar_pos_m": LIDAR_B[ROBOT]}
    env = make_env([scene], ROBOT, "native", num_objects=config.objects, **sensors)
    if config.start:
        x, y, _ = config.start
        clear, least = (
            float(free_space(env.scenes[0], env.robot.height_m).at(np.array([x, y]))),
            env.robot.body_width_m / 2,
        )
        if clear < least:
            raise UserError(f"start ({x}, {y}) is {clear:.2f} m from obstacles, expected at least {least} m")
    camera, by = PictureCamera(env, config.engine, config.fov_deg), config.supersample

    def pictures(state: Any) -> Images:
        drawn = camera.frame(state, config.width * by, config.height * by, ("rgb",), "robot")["rgb"]
        return {"rgb": shrink(drawn[None], by)[0]}

    simulator = RosSimulator(env, config.seed, config.start, False, pictures)
    simulator.lenses = {"": Lens(config.width, config.height, config.fov_deg)}
    return simulator
