"""Decide on a robot's velocity by a policy of an ONNX file, from measured numbers; without ROS."""

import functools
import math
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any

import numpy as np

from interactive_nav.interop.onnx_file import OnnxError, OnnxFile
from interactive_nav.ros.simulator import IMAGES, compose
from interactive_nav_common.errors import UserError
from scenes_mjcf.look import Lens

TAKEN = ("waypoints", "goal", "velocity", "localisation", "odometry", "collision", "lidar")
"""Inputs of policies that topics carry, beside images."""
ScenePath = Callable[[np.ndarray, np.ndarray], np.ndarray]
"""Takes a goal and a place (2,), m, map; returns waypoints [n, 2]."""


class Pilot:
    """Drive to goals in the map's frame, as a policy was trained to."""

    def __init__(
        self,
        policy: OnnxFile,
        limits: tuple[float | None, float | None] = (None, None),
        odom_in_map: tuple[float, ...] = (0.0, 0.0, 0.0),
        scene: ScenePath | None = None,
    ):
        """Refuse a policy whose inputs no topic carries, or that gives no velocity.

        `limits` are forward m/s and turn rad/s (None: the policy's); `odom_in_map` is a pose, m and rad.
        """
        about, self._policy, self._scene = policy.about, policy, scene
        self.inputs: dict[str, Any] = about["inputs"]
        strange = [name for name in self.inputs if name not in TAKEN and name.rpartition("/")[2] not in IMAGES]
        if strange or "twist" not in about["outputs"]:
            wrong = f"no topic carries its input {strange[0]}" if strange else "the policy gives no velocity of a base"
            raise OnnxError(f"{policy.path}: {wrong}; choose another policy")
        robot, twist = about["robot"], about["outputs"]["twist"]
        self.period_s, self._success_m = 1.0 / robot["rate_hz"], robot["success_distance_m"]
        self._base_m, self.lidar = robot["base_height_m"], about.get("lidar", {})
        self._limits = [
            high if limit is None else min(limit, high) for limit, high in zip(limits, twist["high"], strict=True)
        ]
        images = [name for name in self.inputs if "/" in name]
        cameras = {of["inputs"]: Lens(of["width"], of["height"], of["vertical_fov_deg"]) for of in about["cameras"]}
        self.lenses = {name: cameras[name[: name.rfind("/") + 1]] for name in images}
        self.odom_in_map, self._start, self.goal = np.asarray(odom_in_map, float), None, None
        self._plan = np.zeros((0, 2))

    def aim(self, goal: np.ndarray | None, plan: np.ndarray | None = None) -> None:
        """Set the goal (2,), m, map, or none, and the way there; a plan that ends at the goal stays."""
        if plan is not None:
            self._plan = plan
        elif goal is None or not len(self._plan) or math.dist(self._plan[-1], goal) > self._success_m:
            self._plan = np.zeros((0, 2))
        self.goal, self._start = goal, None

    def decide(self, values: Mapping[str, np.ndarray]) -> tuple[float, float]:
        """Return the velocity, m/s forward and rad/s to the left: zero without a goal or at the goal.

        `values` are the policy's inputs in sensor units, as far as sensors measure them; `pose` (3,) is the odometry's.
        """
        x, y, yaw = pose = compose(self.odom_in_map, values["pose"])
        if self.goal is None:
            return 0.0, 0.0
        if math.dist(self.goal, pose[:2]) < self._success_m:
            self.aim(None)
            return 0.0, 0.0
        if self._start is None:
            self._start = values["pose"]
        into = np.array([[math.cos(yaw), -math.sin(yaw)], [math.sin(yaw), math.cos(yaw)]])
        turned = math.remainder(values["pose"][2] - self._start[2], math.tau)
        back = compose(np.array([0.0, 0.0, -self._start[2]]), values["pose"] - self._start)
        computed = {
            "goal": np.array([*(self.goal - pose[:2]) @ into, -self._base_m]),
            "localisation": np.array([x, y, math.remainder(yaw, math.tau)]),
            "odometry": np.array([*back[:2], turned]),
        }
        if "waypoints" in self.inputs:
            computed["waypoints"] = (self._ahead(pose[:2], self.goal) - pose[:2]) @ into
        inputs = {name: encoded({**values, **computed}[name], of) for name, of in self.inputs.items()}
        command = self._policy.run("twist", inputs)[0].astype(float)
        excess = max(1.0, *(np.abs(command) / self._limits))  # both shrink, so that the robot keeps to its curve
        return float(command[0] / excess), float(command[1] / excess)

    def _ahead(self, xy: np.ndarray, goal: np.ndarray) -> np.ndarray:
        of = self.inputs["waypoints"]
        count, spacing_m = of["shape"][0] // 2, of["spacing_m"]
        if self._scene and not len(self._plan):
            return self._scene(goal, xy)
        if not len(self._plan):
            return resampled(np.stack([xy, goal]), count, spacing_m)
        self._plan = remaining(self._plan, xy, count * spacing_m)
        return resampled(self._plan, count, spacing_m)


def encoded(value: np.ndarray, of: Mapping[str, Any]) -> np.ndarray:
    """Return [1, ...] of an input of a policy from its value in the unit that the policy's file names."""
    scaled = np.asarray(value, np.float32) / np.float32(of["scale"])
    scaled = np.clip(scaled, *of["range"]) if of["range"] else scaled
    return (np.round(scaled) if of["dtype"] == "uint8" else scaled).astype(of["dtype"]).reshape(1, *of["shape"])


def remaining(path: np.ndarray, xy: np.ndarray, within_m: float) -> np.ndarray:
    """Return a path [p, 2] from its nearest point to a place on, which is sought up to `within_m` along it."""
    if len(path) < 2:
        return path
    begin, along = path[:-1], np.diff(path, axis=0)
    share = ((xy - begin) * along).sum(-1) / np.maximum((along**2).sum(-1), 1e-12)
    foot = begin + np.clip(share, 0.0, 1.0)[:, None] * along
    length = np.linalg.norm(along, axis=-1)
    away = np.where(np.cumsum(length) - length <= within_m, np.linalg.norm(foot - xy, axis=-1), np.inf)
    nearest = int(np.argmin(away))
    return np.concatenate([foot[nearest][None], path[nearest + 1 :]])


def resampled(path: np.ndarray, count: int, spacing_m: float) -> np.ndarray:
    """Return the next points [count, 2] at equal arc length on a path [p, 2], its end repeated."""
    arc = np.concatenate([[0.0], np.cumsum(np.linalg.norm(np.diff(path, axis=0), axis=-1))])
    at = np.minimum(spacing_m * np.arange(1, count + 1), arc[-1])
    return np.stack([np.interp(at, arc, path[:, axis]) for axis in (0, 1)], -1)


def scene_path(about: Mapping[str, Any], scene: Path) -> ScenePath:
    """Return the shortest paths of a policy's robot in a scene, as the policy was trained along."""
    import jax
    import jax.numpy as jnp

    from interactive_nav import make
    from interactive_nav.navigation.lookup import geodesic_at, goal_field, waypoints_at

    robot, of = about["robot"], about["inputs"].get("waypoints", {"shape": [2], "spacing_m": 1.0})
    env = make(robot["name"], [scene], control_mode=robot["control_mode"], backend="native", num_objects=0)
    tables, first = env.tables, jnp.int32(0)
    field_of = jax.jit(functools.partial(goal_field, tables, first))
    count, spacing_m = of["shape"][0] // 2, of["spacing_m"]

    @jax.jit
    def at(field: Any, xy: Any) -> Any:
        return geodesic_at(tables, first, field, xy), waypoints_at(tables, first, field, xy, count, spacing_m)

    @functools.lru_cache(1)
    def field(x: float, y: float) -> Any:
        return field_of(jnp.asarray([x, y], jnp.float32))

    def path(goal: np.ndarray, xy: np.ndarray) -> np.ndarray:
        length, waypoints = at(field(*goal.tolist()), jnp.asarray(xy, jnp.float32))
        if not math.isfinite(length):
            raise UserError(f"no path from ({xy[0]:.2f}, {xy[1]:.2f}) to ({goal[0]:.2f}, {goal[1]:.2f}) in {scene}")
        return np.asarray(waypoints, float)

    return path
