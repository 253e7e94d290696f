"""Play episodes and return every episode's scores, and some of the paths."""

import dataclasses
from collections.abc import Callable
from typing import Any

import jax
import numpy as np

from interactive_nav.task.rollout import HostPolicy, Player, PolicyFn, Recorder
from interactive_nav.types import OF_OBJECTS
from interactive_nav_common.rows import Rows


@dataclasses.dataclass(frozen=True)
class Paths(Rows):
    """Where the robot went and what it moved, in the first E episodes; world frame, m."""

    scene_index: np.ndarray
    """[E] i32."""
    start_xy_w: np.ndarray
    """[E, 2]."""
    goal_xy_w: np.ndarray
    """[E, 2]."""
    robot_xy_w: np.ndarray
    """[E, T + 1, 2], NaN after the episode's end."""
    object_start_w: np.ndarray
    """[E, M, 3]."""
    object_end_w: np.ndarray
    """[E, M, 3]."""


@dataclasses.dataclass(frozen=True)
class PlayedEpisodes:
    """N finished episodes."""

    scene_index: np.ndarray
    """[N] i32."""
    metrics: dict[str, np.ndarray]
    """name -> [N], the environment's metrics at the step that ended the episode."""
    of_objects: dict[str, np.ndarray]
    """name of `OF_OBJECTS` -> [N, M]."""
    paths: Paths


RECORDERS = {
    "metrics": Recorder(lambda state, action: dict(state.metrics)),
    "of_objects": Recorder(lambda state, action: {name: state.info["nav"].memory[name] for name in OF_OBJECTS}),
    "object_end_w": Recorder(lambda state, action: state.info["nav"].object_pos_w),
    "robot_xy_w": Recorder(lambda state, action: state.info["nav"].robot_pos_w[:, :2], "step"),
}


class BatchPlayer(Player):
    """Plays episodes of one environment for their scores."""

    def __init__(self, env: Any):
        super().__init__(env, RECORDERS)
        self.cached: dict[Any, Any] = {}
        """Functions of learned policies, by kind: see `train.scoring.evaluation.load_policy`."""

    def play(
        self,
        policy: PolicyFn | HostPolicy,
        keys: jax.Array,
        record: int = 0,
        on_progress: Callable[[int, int], None] = lambda finished, step: None,
        starts: Any = None,
        scene_index: np.ndarray | None = None,
        batch: int | None = None,
        on_note: Callable[[str], None] = lambda note: None,
    ) -> PlayedEpisodes:
        """Play every episode to its end; see `Player.rollout`."""
        played = self.rollout(policy, keys, starts, scene_index, record, batch, on_progress, on_note)
        first, values, xy = played.first, played.values, played.values["robot_xy_w"]
        over = np.arange(xy.shape[1]) >= played.num_steps[:record, None]
        xy = np.where(over[..., None], np.float32(np.nan), xy)
        paths = Paths(
            scene_index=first.scene_index[:record],
            start_xy_w=first.start_xy_w[:record],
            goal_xy_w=first.goal_xy_w[:record],
            robot_xy_w=np.concatenate([first.robot_pos_w[:record, None, :2], xy], 1),
            object_start_w=first.object_pos_w[:record],
            object_end_w=values["object_end_w"][:record],
        )
        return PlayedEpisodes(first.scene_index, values["metrics"], values["of_objects"], paths)
