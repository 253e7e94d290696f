"""Describe what a policy takes and gives, as files of policies and of demonstrations carry it."""

import json
import math
from collections.abc import Mapping
from typing import Any

import jax
import numpy as np

from interactive_nav.robots.spec import RobotSpec
from interactive_nav.sensing.sensors import LIDAR_NEAR_M
from scenes_mjcf.categories import SEGMENTATIONS

KEY = "interactive_nav"
"""Key of the description, as JSON, in a file's metadata."""
PARTS = {
    "waypoints": ("m", "base", "x0, y0, x1, ... of points on the shortest path, the nearest first"),
    "goal": ("m", "base", "x, y, z"),
    "velocity": ("m/s, rad/s", "base", "linear x, y, z, then angular x, y, z"),
    "localisation": ("m, rad", "map", "x, y, yaw"),
    "odometry": ("m, rad", "base at the start of the episode", "x, y, yaw"),
    "collision": ("0 or 1", "", "whether a movable object, a wall was touched since the last action"),
    "joints": ("rad or m, rad/s or m/s", "joint", "positions in the robot model's order, then velocities"),
    "lidar": ("m", "scanner", "distances, beams from right to left"),
    "hand": ("m, 1", "base", "grip, opening, gap, touched, class, offset"),
    "hook": ("1, m", "base", "whether the hook holds something, and x, y, z of the coupled point"),
    "depth": ("m", "camera", "distance along the optical axis; 0: nothing is met"),
    "segmentation": ("class id", "camera", "as docs/sensors.md numbers them"),
    "rgb": ("1", "camera", "colour"),
    "normals": ("1", "camera", "unit vectors: right, up, towards the viewer; 0: nothing is met"),
}
"""Part of an observation -> its unit, its frame (base: x forward, y left, z up) and its numbers."""
COMPARED = ("shape", "dtype", "unit", "scale", "frame", "spacing_m", "avoids")
"""Properties of an input that must agree with the file's."""


def inputs_of(env: Any, observations: Any) -> dict[str, Any]:
    """Return the inputs of a policy [..., n] by name: the parts of the vector in order, then the images."""
    observations = observations if isinstance(observations, Mapping) else {"state": observations}
    sizes = env.sensors.sizes if "state" in observations else {}
    ends = np.cumsum([0, *sizes.values()]).tolist()
    parts = {name: observations["state"][..., a:b] for name, a, b in zip(sizes, ends, ends[1:], strict=False)}
    return parts | {name: value for name, value in observations.items() if name != "state"}


def twist_matrix(robot: RobotSpec) -> np.ndarray:
    """Return [2, A]: a base's velocity (m/s, rad/s) is its product with a command of the robot."""
    assert robot.twist
    return np.linalg.pinv(np.array(robot.twist.matrix))


def describe(env: Any) -> dict[str, Any]:
    """Describe what an environment's policy takes and gives, as JSON holds it."""
    observations = jax.eval_shape(env.reset, jax.ShapeDtypeStruct((2,), np.uint32)).obs
    inputs = inputs_of(env, jax.tree.map(lambda x: np.zeros(x.shape, x.dtype), observations))
    robot, config, rate_hz = env.robot, env.config, 1.0 / env.config.control_dt_s
    names = list(robot.action_names or robot.actuators)
    outputs = {
        "action": {"names": names, "unit": "1", "low": [-1.0] * len(names), "high": [1.0] * len(names)},
        "command": {"names": names, "low": list(robot.action_low), "high": list(robot.action_high)},
    }
    if robot.twist:
        ends = twist_matrix(robot) * np.array([robot.action_low, robot.action_high])[:, None]
        limits = {"low": ends.min(0).sum(-1).tolist(), "high": ends.max(0).sum(-1).tolist()}
        outputs["twist"] = {"names": ["linear.x m/s", "angular.z rad/s"], **limits, "frame": "base"}
    distance_m = config.success_distance_m or robot.body_width_m
    placed = {"base_height_m": robot.spawn_height_m, "success_distance_m": distance_m}
    about: dict[str, Any] = {
        "robot": {"name": robot.name, "control_mode": robot.control_mode, "rate_hz": rate_hz, **placed},
        "inputs": {name: describe_input(name, x, config) | {"rate_hz": rate_hz} for name, x in inputs.items()},
        "outputs": {name: {"shape": [len(of["names"])], "dtype": "float32"} | of for name, of in outputs.items()},
        "cameras": [_camera(*of, robot) for of in zip(env.sensors.cameras, config.views, strict=False)],
    }
    if "waypoints" in about["inputs"]:
        about["inputs"]["waypoints"]["spacing_m"] = config.waypoint_spacing_m
        if config.waypoints_round:
            heavy = f"furniture whose friction exceeds {config.potential_round:g} of the robot's weight"
            about["inputs"]["waypoints"]["avoids"] = heavy
    if "lidar" in about["inputs"]:
        fields = ("lidar_rays", "lidar_fov_deg", "lidar_range_m", "lidar_pos_m")
        about["lidar"] = {name: getattr(config, name) for name in fields}
    return json.loads(json.dumps(about))


def describe_input(name: str, value: Any, config: Any) -> dict[str, Any]:
    """Describe one input of a policy."""
    kind, steps = name.rpartition("/")[2], 255 if value.dtype == np.uint8 else 1
    unit, frame, content = PARTS.get(kind, ("", "", "a term of the environment's"))
    ranges = {"depth": config.depth_range_m, "lidar": config.lidar_range_m}
    scale = ranges.get(kind, 1.0)
    least, most = {"lidar": LIDAR_NEAR_M / scale, "normals": -1.0}.get(kind, 0.0), steps
    if kind == "segmentation":
        scale = SEGMENTATIONS[config.segmentation_classes].divisor
    bounded = "/" in name or kind in ("lidar", "collision")
    return {
        "shape": value.shape,
        "dtype": str(value.dtype),
        "unit": unit,
        "scale": scale / steps,  # an input times it is in the unit
        "frame": frame,
        "range": [least, most] if bounded else None,
        "content": content,
    }


def _camera(camera: Any, view: Any, robot: RobotSpec) -> dict[str, Any]:
    x, y, z = map(float, camera.mount.forward_b)
    return {
        "inputs": f"pixels/{camera.prefix}",
        "body": view.body or robot.camera.body,
        "pos_m": camera.mount.pos_b.tolist(),
        "yaw_deg": math.degrees(math.atan2(y, x)),
        "pitch_down_deg": math.degrees(-math.asin(z)),
        "vertical_fov_deg": camera.lens.fov_deg,
        "width": camera.lens.width,
        "height": camera.lens.height,
    }


def difference(file: Mapping[str, Any], here: Mapping[str, Any]) -> str:
    """Return the first difference of a file from an environment; empty: none."""
    names = [{"names": list(about["inputs"])} for about in (file, here)]
    groups = [("robot", file["robot"], here["robot"], ("name", "control_mode")), ("inputs", *names, ("names",))]
    shared = [name for name in here["inputs"] if name in file["inputs"]]
    groups += [(f"input {name}", file["inputs"][name], here["inputs"][name], COMPARED) for name in shared]
    groups += [("command", file["outputs"]["command"], here["outputs"]["command"], ("names", "low", "high"))]
    facts = [(f"{key} of {what}", a.get(key), b.get(key)) for what, a, b, keys in groups for key in keys]
    return next((f"{name} in the file: {a!r}, in the environment: {b!r}" for name, a, b in facts if a != b), "")
