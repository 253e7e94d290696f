"""Play an episode step by step into a `Replay` of named bodies' world poses, and keep it in a file.

A replay can be drawn from the scene folder alone, without the policy, the physics or the environment.
"""

import dataclasses
import json
from collections.abc import Callable
from pathlib import Path
from typing import Any

import jax
import numpy as np

from interactive_nav.scenes.objects import SmallObject, small_objects
from interactive_nav.scenes.world import world_poses
from interactive_nav.task.env import InteractiveNav
from interactive_nav.task.rollout import HostPolicy, Player, PolicyFn, Recorder
from interactive_nav.types import EpisodeStart
from interactive_nav_common.errors import UserError, typed
from interactive_nav_common.files import write_arrays
from interactive_nav_common.untrusted.reading import read_npz
from scenes_mjcf.categories import MaskClasses

FORMAT = 2


class ReplayError(UserError):
    """A file that is no replay, or one that does not fit what is there to draw it."""


@dataclasses.dataclass(frozen=True)
class Replay:
    """T control steps of one episode; B bodies: the robot's, then the movable objects of its scene."""

    robot: str
    """Name of the robot, or the file that describes it."""
    scene: str
    """Scene folder."""
    scene_digest: str
    """SHA-256 of its scene.xml and maps.npz."""
    control_dt_s: float
    num_objects: int
    """Small objects; `small` says which."""
    policy: str
    episode: int
    label: str
    """Where the policy comes from: a run and its checkpoint, or empty."""
    bodies: tuple[str, ...]
    """Names: the robot's base first."""
    num_robot_bodies: int
    """How many of the bodies are the robot's."""
    goal_xy_w: np.ndarray
    """(2,) f32, m."""
    body_pos_w: np.ndarray
    """[T + 1, B, 3] f32, m."""
    body_quat_w: np.ndarray
    """[T + 1, B, 4] f32, w x y z."""
    action: np.ndarray
    """[T, A] f32."""
    reward: np.ndarray
    """[T] f32."""
    force_n: np.ndarray
    """[T] f32: F_t of the Interactive Navigation Score, N."""
    touches_movable: np.ndarray
    """[T] bool."""
    touches_structure: np.ndarray
    """[T] bool."""
    metrics: dict[str, float]
    """The episode's scores."""
    small_objects: str
    """Whose models the small objects are."""
    objects: tuple[str, ...]
    """Their folders, absolute, where they are not the built-in ones."""
    segmentation_classes: MaskClasses
    """As in `NavConfig`."""
    success_distance_m: float
    """Of the goal."""
    image_fov_deg: float
    """Vertical, of the robot's camera as the episode had it."""
    waypoints_b: np.ndarray
    """[T + 1, W, 2] f32, m: in the frame of the robot's base."""
    reward_names: tuple[str, ...]
    """`reward/...`, of each of the K terms."""
    reward_terms: np.ndarray
    """[T, K] f32."""

    @property
    def small(self) -> tuple[SmallObject, ...]:
        return small_objects(self.num_objects, self.small_objects, self.objects)

    @property
    def num_steps(self) -> int:
        """Return T."""
        return len(self.action)

    @property
    def robot_xy_w(self) -> np.ndarray:
        """Return the [T + 1, 2] path of the robot's base, m."""
        return self.body_pos_w[:, 0, :2]


_ARRAYS = tuple(field.name for field in dataclasses.fields(Replay) if field.type is np.ndarray)


def _read(state: Any, action: jax.Array) -> dict[str, Any]:
    nav, counts = state.info["nav"], ("force_sum_n", "interaction_steps", "structure_steps")
    values = {"qpos": state.pipeline_state.qpos, "action": action, "reward": state.reward, "waypoints": nav.waypoints_b}
    terms = {name: value for name, value in state.metrics.items() if name.startswith("reward/")}
    return values | terms | {name: nav.memory[name] for name in counts}


class EpisodePlayer(Player):
    """Play episodes of one unbatched environment with one policy, compiled once.

    The policy is a pure (observation, key) -> action (A,) in [-1, 1], or one on the host; `name` and `label` (its
    origin) are for captions.
    """

    def __init__(self, env: InteractiveNav, policy: PolicyFn | HostPolicy, name: str = "policy", label: str = ""):
        metrics = Recorder(lambda state, action: {key: state.metrics[key] for key in env.metric_names})
        start = Recorder(lambda state, action: state.pipeline_state.qpos, "start")
        super().__init__(env, {"steps": Recorder(_read, "step"), "metrics": metrics, "qpos": start})
        self.policy, self.name, self.label = policy, name, label

    def play(
        self,
        key: jax.Array,
        episode: int = 0,
        on_progress: Callable[[int], None] = lambda step: None,
        start: EpisodeStart | None = None,
    ) -> Replay:
        """Play one episode from the key or `start` (leaves [1, ...]); call `on_progress` with the number of steps."""
        played = self.rollout(self.policy, key[None], start, on_progress=lambda finished, step: on_progress(step))
        first, values = jax.tree.map(lambda x: x[0], (played.first, played.values))
        env, joined = self.env, values["steps"]
        qpos = np.concatenate([values["qpos"][None], joined["qpos"]])
        scene = int(first.scene_index)
        bodies, num_robot, pos, quat = world_poses(env.world, scene, qpos)
        counts = {name: np.diff(joined[name], prepend=0) > 0 for name in ("interaction_steps", "structure_steps")}
        return Replay(
            robot=env.robot.reference or env.robot.name,
            scene=str(env.scenes[scene].path),
            scene_digest=env.scenes[scene].digest,
            control_dt_s=env.config.control_dt_s,
            num_objects=env.config.num_objects,
            policy=self.name,
            episode=episode,
            label=self.label,
            bodies=bodies,
            num_robot_bodies=num_robot,
            goal_xy_w=first.goal_xy_w,
            body_pos_w=pos.astype(np.float32),
            body_quat_w=quat.astype(np.float32),
            action=joined["action"],
            reward=joined["reward"],
            force_n=np.diff(joined["force_sum_n"], prepend=0.0).astype(np.float32),
            touches_movable=counts["interaction_steps"],
            touches_structure=counts["structure_steps"],
            metrics={name: float(values["metrics"][name]) for name in env.metric_names},
            small_objects=env.config.small_objects,
            objects=tuple(str(Path(folder).absolute()) for folder in env.config.objects),
            segmentation_classes=env.config.segmentation_classes,
            success_distance_m=env.success_distance_m,
            image_fov_deg=env.sensors.lens.fov_deg,
            waypoints_b=np.concatenate([first.waypoints_b[None], joined["waypoints"]]),
            reward_names=env.reward_names,
            reward_terms=np.stack([joined[name] for name in env.reward_names], -1),
        )


def replay_path(run: Path, policy: str, episode: int) -> Path:
    """Return where a run keeps a replay; `policy` as in `train.record --policy`, where a file has its stem as name."""
    name, equals, _ = policy.partition("=")
    name = Path(name).stem if name.endswith(".onnx") and not equals else name
    return run / "replays" / f"{name}-episode{episode}.npz"


def save_replay(replay: Replay, path: str | Path) -> None:
    """Write a replay as npz, whole or not at all."""
    fields = {f.name: getattr(replay, f.name) for f in dataclasses.fields(Replay)}
    header = {name: value for name, value in fields.items() if name not in _ARRAYS} | {"format": FORMAT}
    write_arrays(path, header=np.array(json.dumps(header)), **{name: fields[name] for name in _ARRAYS})


def load_replay(path: str | Path) -> Replay:
    """Read a replay; raise `ReplayError` if it is missing, damaged or of another format."""
    path = Path(path)
    with read_npz(path, ReplayError, "expected a replay (.npz); record the episode again") as stored:
        if "policies" in stored.files:
            raise ReplayError(
                f"{path}: holds paths that an evaluation recorded, expected a replay, which has the poses of all "
                f"bodies; draw the paths (python -m train.figures {typed(path.parent)}), or play the episode again "
                "(python -m train.replay RUN_DIR)"
            )
        header = json.loads(str(stored["header"]))
        if (form := header.pop("format", None)) != FORMAT:
            raise ReplayError(f"{path}: its format is {form}, expected {FORMAT}; record the episode again")
        arrays = {name: stored[name] for name in _ARRAYS}
    robot, moved = Path(header["robot"]), path.parent.parent / "robot" / Path(header["robot"]).name
    if robot.is_absolute() and not robot.is_file() and moved.is_file():
        header["robot"] = str(moved)  # the run's folder is elsewhere now
    for name in ("bodies", "objects", "reward_names"):
        header[name] = tuple(header[name])
    return Replay(**header, **arrays)
