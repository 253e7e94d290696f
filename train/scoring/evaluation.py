"""Play fixed episodes of an environment with every policy of a run, as rows and recorded paths."""

import dataclasses
import time
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import Any

import jax
import numpy as np
import pyarrow as pa
from rich.console import Console

from interactive_nav.episodes import EpisodeFile, starts_of
from interactive_nav.ros.commands import need_ros
from interactive_nav.task.rollout import HostPolicy, Player, PolicyFn, Recorder, episode_keys
from interactive_nav.types import OF_OBJECTS
from interactive_nav_common.files import write_arrays
from interactive_nav_common.jobs.progress import progress_bar
from interactive_nav_common.versions import versions
from train.config import TrainConfig
from train.learners import demonstrations
from train.learners.algorithms import ALGORITHMS
from train.learners.memory import RecurrentPolicy
from train.runs import checkpoint
from train.runs.checkpoint import CheckpointMeta, check_fits
from train.runs.run_folder import EvaluationRequest, RunFolder
from train.scoring import AUTO_BATCH, LEARNED
from train.scoring.brought import BroughtPolicy
from train.scoring.driver import Driver
from train.scoring.policies import make_baseline
from train.scoring.rows import OF_TRAINING, Paths, PlayedEpisodes, episode_table

OF_LEARNED = ("algorithm", "seed", "deterministic", *OF_TRAINING)
"""Columns that are empty for a policy that never learned."""


RECORDERS = {
    "metrics": Recorder(lambda state, action: dict(state.metrics)),
    "of_objects": Recorder(lambda state, action: {name: state.info["nav"].memory[name] for name in OF_OBJECTS}),
    "object_end_w": Recorder(lambda state, action: state.info["nav"].object_pos_w),
    "robot_xy_w": Recorder(lambda state, action: state.info["nav"].robot_pos_w[:, :2], "step"),
}


class BatchPlayer(Player):
    """Plays episodes of one environment for their scores."""

    def __init__(self, env: Any, demonstrate: bool = False):
        super().__init__(env, RECORDERS | (demonstrations.RECORDERS if demonstrate else {}))
        self.demonstrate, self.played = demonstrate, None
        """Whether all control steps are kept, and those of the last policy, a `Rollout`."""
        self.cached: dict[Any, Any] = {}
        """Functions of learned policies, by kind: see `load_policy`."""

    def play(self, policy: PolicyFn | HostPolicy, keys: jax.Array, record: int = 0, **how: Any) -> PlayedEpisodes:
        """Play every episode to its end; `how` and the rest are as `Player.rollout` takes them."""
        played = self.rollout(policy, keys, record=None if self.demonstrate else record, **how)
        first, values, xy = played.first, played.values, played.values["robot_xy_w"][:record]
        self.played = played if self.demonstrate else None
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


def load_policy(
    folder: RunFolder,
    config: TrainConfig,
    env: Any,
    which: str,
    deterministic: bool,
    cached: dict[Any, Any] | None = None,
) -> tuple[PolicyFn | RecurrentPolicy, CheckpointMeta]:
    """Load a checkpoint's policy (`which`: best, last or env steps) to act in `env`; raise `CheckpointError`.

    A `deterministic` one takes the mode of its actions. `cached` lets policies of equal networks in the same
    environment share a compiled function.
    """
    path, meta = checkpoint.find(folder.checkpoints, which)
    check_fits(meta, path, dataclasses.replace(config.env, robot=env.robot.name), env)
    algorithm = ALGORITHMS[config.algorithm]
    learner = checkpoint.load_learner(path, algorithm.template(env, config))
    remembers = config.network.memory != "none"

    def act(learner: Any, *inputs: Any) -> Any:
        if remembers:
            return algorithm.make_agent(env, config).recurrent_policy(learner, deterministic)(*inputs)
        return algorithm.policy(env, config, learner, deterministic)(*inputs)[0]

    kind = (config.algorithm, config.network, getattr(config, config.algorithm), deterministic)
    made = act if cached is None else cached.setdefault(kind, act)
    size = config.network.memory_size
    return RecurrentPolicy(learner, made, size) if remembers else jax.tree_util.Partial(made, learner), meta


def make_policies(
    names: Sequence[str],
    folder: RunFolder | None,
    config: TrainConfig,
    env: Any,
    which: str,
    deterministic: bool,
    cached: dict[Any, Any] | None = None,
) -> dict[str, tuple[Any, CheckpointMeta | None]]:
    """Build policies by name; see `load_policy`, `make_baseline`, and `BroughtPolicy` for `name=module:factory`."""

    def build(name: str) -> tuple[Any, CheckpointMeta | None]:
        if name == LEARNED and folder:
            return load_policy(folder, config, env, which, deterministic, cached)
        if name == "keyboard":
            return Driver(env), None
        if name == "ros":
            need_ros("policy ros")
            from interactive_nav.ros.remote import RosPolicy

            return RosPolicy(env), None
        return BroughtPolicy(name, env) if "=" in name else make_baseline(name, env), None

    return {name.partition("=")[0]: build(name) for name in names}


def evaluate(
    folder: RunFolder | None,
    config: TrainConfig,
    player: BatchPlayer,
    request: EvaluationRequest,
    record: int,
    console: Console,
    fixed: EpisodeFile | None = None,
    batch: int | None = None,
) -> Iterator[tuple[pa.Table, dict[str, PlayedEpisodes]]]:
    """Play the same episodes, drawn from a seed or `fixed` ones of a file, with each policy of the request.

    Yield after each policy the rows of all so far, one an episode, and their episodes by policy, `record` of them with
    paths. The folder is None for policies without learning. `batch` episodes are played at a time.
    """
    env = player.env
    # Everything that can be refused is refused before the first episode.
    policies = make_policies(
        request.policies, folder, config, env, request.checkpoint, request.deterministic, player.cached
    )
    starts = starts_of(fixed, env, "--episode-file") if fixed else None
    turns = np.arange(request.episodes, dtype=np.int32) % len(env.scenes) if request.balanced and not fixed else None
    keys = episode_keys(request.seed, request.episodes)
    batch = batch or AUTO_BATCH[env.backend]
    where = _origin(folder, config, env, request)
    tables, played = [], {}
    for name, (policy, meta) in policies.items():
        began = time.perf_counter()
        with progress_bar(console, name, request.episodes, transient=True) as update:
            update(status="compiling")

            def on_progress(over: int, step: int, update: Any = update) -> None:
                update(completed=over, status=f"{over} of {request.episodes} episodes over, step {step}")

            how = {"starts": starts, "scene_index": turns, "batch": batch, "on_note": console.print}
            played[name] = player.play(policy, keys, record, on_progress=on_progress, **how)
        wall_s = time.perf_counter() - began
        constants = {**where, "policy": name, "evaluation_wall_s": wall_s}
        if meta:
            constants["checkpoint_steps"] = meta.env_steps
        else:
            constants |= dict.fromkeys(OF_LEARNED)
        table = episode_table(played[name], env.scenes, env.world.slots.categories, constants)
        if fixed:
            needed = [row["push_needed"] for row in fixed.episodes]
            table = table.append_column("push_needed", pa.array(needed, pa.bool_()))
        tables.append(table)
        note = f" ({policy.note})" if isinstance(policy, HostPolicy) and policy.note else ""
        console.print(f"{name}: {request.episodes} episodes in {wall_s:.0f} s{note}")
        yield pa.concat_tables(tables), played


def _origin(folder: RunFolder | None, config: TrainConfig, env: Any, request: EvaluationRequest) -> dict[str, Any]:
    """Return the columns that say where rows come from, in their order; those that differ by policy are empty."""
    here, trained = versions(), folder.origin() if folder else {}
    return {
        "run": config.run.name,
        "robot": env.robot.name,
        "algorithm": config.algorithm,
        "policy": None,
        "k_int": float(config.env.k_int),
        "seed": config.run.seed,
        "checkpoint_steps": None,
        "deterministic": request.deterministic,
        "evaluation_seed": request.seed,
        "backend": env.backend,
        "device": here["device"]["kind"],
        "commit": here["commit"],
        "versions": " ".join(f"{package}={number}" for package, number in here["packages"].items()),
        "evaluation_wall_s": None,
        **{f"train_{name}": trained.get(name) for name in ("env_steps", "wall_s", "device", "commit")},
    }


def write_paths(path: Path, played: dict[str, PlayedEpisodes], env: Any) -> None:
    """Write the recorded paths with the scenes' maps, so that a figure needs no scene folder."""
    arrays: dict[str, Any] = {"policies": np.array(list(played))}
    for policy, episodes in played.items():
        for name, value in dataclasses.asdict(episodes.paths).items():
            arrays[f"{policy}/{name}"] = value
        arrays[f"{policy}/success"] = episodes.metrics["success"][: len(episodes.paths.scene_index)]
    for i, scene in enumerate(env.scenes):
        arrays[f"scene/{i}/name"] = np.array(scene.name)
        arrays[f"scene/{i}/traversable"] = scene.maps.traversable
        arrays[f"scene/{i}/furniture"] = env.furniture_map(i)
        arrays[f"scene/{i}/resolution_m"] = np.array(scene.maps.resolution_m)
        arrays[f"scene/{i}/origin_w"] = np.array(scene.maps.origin_w)
        arrays[f"scene/{i}/object_names"] = np.array(env.world.slots.names[i], dtype=str)
    write_arrays(path, **arrays)
