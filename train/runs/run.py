"""Train a config into a run folder with checkpoints and metrics: wire environment, learner, files and signals."""

import contextlib
import dataclasses
import time
import warnings
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from rich.console import Console

import interactive_nav
from interactive_nav.config import WINDOW
from interactive_nav.physics import keep_programs, resolve_backend
from interactive_nav.robots import robot_name
from interactive_nav.task.privileged import PrivilegedEnv
from interactive_nav.task.wrappers import AutoResetEnv, ShardedEnv
from interactive_nav.types import FAILURES
from interactive_nav_common.config import flatten, replace
from interactive_nav_common.errors import ConfigError, UserError, typed
from interactive_nav_common.files import locked, write_json, writing
from interactive_nav_common.jobs.progress import progress_bar
from interactive_nav_common.records import cut_metrics, mean_over_episodes
from interactive_nav_common.runs.folder import append_metrics
from interactive_nav_common.runs.weights import write_state
from interactive_nav_common.signals import stop_signals
from interactive_nav_common.versions import versions
from scenes_mjcf.sets import scene_folders
from train import config_io
from train.config import EnvConfig, TrainConfig, resolve
from train.learners.algorithms import ALGORITHMS
from train.learners.learner import Snapshot, TrainResult, Update
from train.runs import checkpoint, processes, tracking
from train.runs.checkpoint import CheckpointError, CheckpointMeta
from train.runs.run_folder import RunFolder, claim
from train.runs.tracking import describe


def build_env(config: EnvConfig) -> Any:
    """Build the environment that a config describes: one, not batched, not resetting itself."""
    keep_programs()
    try:
        return interactive_nav.make(**flatten(config))
    except UserError as error:  # an unknown robot, an unusable scene, settings that exclude each other
        raise ConfigError(f"env: {error}") from error


OF_CRITIC = ("network.critic_inputs", "network.action_features", "network.compute_dtype")
"""Settings of networks that may differ where a run starts from another one's policy."""
OF_ACTIONS = ("env.control_mode", "env.symmetric_actions", "env.hook_force_n")
"""Settings that decide what an action commands."""
SIZES = (*WINDOW, "active_dofs")
"""Settings of MJX that `native` does not take."""


def config_to_play(
    folder: RunFolder, words: Sequence[str], scenes: Sequence[str] | None, console: Console
) -> TrainConfig:
    """Return a run's config with the environment to play in: the trained one with a command line's changes.

    If the run's backend is not available here, another replaces it. `scenes` are folders or sets; None: the run's own.
    """
    if "env.backend=native" in words:
        # It simulates everything, and takes no sizes of windows; those that the run learned with do no harm.
        words = [*(f"env.{name}=auto" for name in SIZES), *words]
    config = config_io.apply_overrides(folder.read_config(), words)
    env = dataclasses.replace(config.env, scenes=scene_folders(scenes) if scenes else config.env.scenes)
    if not any(word.startswith("env.backend=") for word in words):
        try:
            resolve_backend(env.backend)
        except ConfigError:
            there = resolve_backend("auto")
            note = f"{folder.path}: trained with backend {env.backend}, which is not here; played with {there}"
            console.print(note)
            sizes = dict.fromkeys(SIZES) if there == "native" else {}
            env = replace(env, backend=there, **sizes)
    return dataclasses.replace(config, env=env)


@dataclasses.dataclass(eq=False)
class FolderCallbacks:
    """Learner callbacks that write a run folder and show progress."""

    folder: RunFolder
    config: TrainConfig
    env: Any
    console: Console
    bar: Callable[..., None]
    stops: list[int]
    resume_from: str = "last"

    def __post_init__(self) -> None:
        self._scenes = {scene.name: scene.task_digest for scene in getattr(self.env, "scenes", ())}
        self._total_steps = 0
        self._wall_before_s = 0.0
        self._began_together = 0
        self._began = time.perf_counter()
        self._logs: list[tracking.Events | tracking.Tracker] = []

    def _wall_s(self) -> float:
        return self._wall_before_s + time.perf_counter() - self._began

    def restore(self, template: Snapshot) -> Snapshot | None:
        """Return the newest intact checkpoint of the folder, or the one that was requested; None: there is none."""
        checkpoint.remove_partial(self.folder.checkpoints)
        if self.resume_from == "last" and not any(self.folder.checkpoints.glob("[0-9]*")):
            if not self.config.run.init:
                return None
            config, path = check_init(self.config, self.env)
            old = checkpoint.load_learner(path, ALGORITHMS[config.algorithm].template(self.env, config))
            params = old.params.replace(value=template.learner.params.value)
            learner = template.learner.replace(params=params, normalizer_params=old.normalizer_params)
            return dataclasses.replace(template, learner=learner)
        with warnings.catch_warnings(record=True) as passed_over:
            path, meta = checkpoint.find(self.folder.checkpoints, self.resume_from)
        for warning in passed_over:
            self.console.print(str(warning.message), style="yellow", markup=False)
        checkpoint.check_fits(meta, path, self.config.env, self.env)
        for name, digest in meta.scenes.items():
            if self._scenes.get(name, digest) != digest:
                raise CheckpointError(
                    f"{path}: scene '{name}' has changed since: masses, places or maps differ; restore its folder, or "
                    "set run.name to begin another run"
                )
        for later in checkpoint.set_aside(self.folder.checkpoints, meta.env_steps):
            self.console.print(f"{later}: renamed to aside-{later.name}", markup=False)
        self._wall_before_s = meta.wall_s
        learner = checkpoint.load_learner(path, template.learner)
        env_state = checkpoint.load_env_state(path, template.env_state)
        self._began_together = meta.env_steps if env_state is None else meta.began_together
        if env_state is None and (reached_m := meta.curriculum_m):  # for what follows the first new episodes
            env_state = jax.tree.map_with_path(
                lambda path, x: jnp.full_like(x, reached_m) if ".limit_m" in jax.tree_util.keystr(path) else x,
                template.env_state,
            )
        return Snapshot(meta.env_steps, learner, env_state)

    def should_stop(self) -> bool:
        return bool(self.stops)

    def on_start(self, snapshot: Snapshot, total_steps: int) -> None:
        """Make room for checkpoints and cut what a killed run logged after its last one."""
        available = getattr(snapshot.env_state, "info", {}).get("episode_metrics", {})
        if self.config.run.best_metric not in available:
            raise ConfigError(
                f"run.best_metric is {self.config.run.best_metric!r}, expected one of {', '.join(sorted(available))}"
            )
        one_mb, env_mb = map(checkpoint.megabytes, (snapshot.learner, snapshot.env_state))
        env_mb = 2 * env_mb if env_mb <= self.config.run.env_state_limit_mb else 0.0
        claim(self.folder.path, one_mb * (self.config.run.keep_checkpoints + 2) + env_mb)
        cut_metrics(self.folder.metrics, lambda line: line["env_steps"] <= snapshot.env_steps)
        if snapshot.env_steps < total_steps:
            self.folder.summary.unlink(missing_ok=True)  # of a shorter run, which this one goes on from
        if self.config.run.tensorboard:
            self._logs.append(tracking.Events(self.folder.tensorboard, snapshot.env_steps))
        if note := getattr(snapshot.env_state, "note", ""):
            self.console.print(note)
        if self.config.run.wandb:
            self._logs.append(tracking.Tracker(self.folder.path, self.config, versions()))
        self._total_steps = total_steps
        self.bar(completed=snapshot.env_steps, total=total_steps)

    def on_update(self, env_steps: int) -> None:
        self.bar(completed=env_steps)

    def on_log(self, env_steps: int, metrics: dict[str, float]) -> None:
        """Write a line of metrics.jsonl and a TensorBoard point for each value; show a status on the console."""
        append_metrics(self.folder.path, {"env_steps": env_steps, "wall_s": round(self._wall_s(), 3), **metrics})
        for log in self._logs:
            log.log(env_steps, metrics)
        status, total = describe(metrics), self._total_steps
        self.bar(completed=env_steps, status=status)
        if not self.console.is_terminal:
            left_s = (total - env_steps) / max(metrics["env_steps_per_s"], 1e-9)
            share = 100.0 * env_steps / max(total, 1)
            reached = f"training {share:3.0f} %  {env_steps:,} of {total:,} steps  {left_s:.0f} s left"
            self.console.print(f"{reached}  {status}")

    def on_checkpoint(self, snapshot: Snapshot) -> None:
        """Write a checkpoint, scored by the mean over the episodes of at least one time limit.

        Environments that start together also fail together, one time limit later; shorter windows would hold only
        successes.
        """
        run = self.config.run
        limit = num_envs(self.config) * self.config.env.episode_steps
        since = snapshot.env_steps - max(run.checkpoint_every_steps, limit)
        lines = [line for line in self.folder.read_metrics() if line["env_steps"] > since]
        # Under a curriculum's limit scores are higher.
        easy = any(line.get("episode/curriculum_m", np.inf) < 0.999 * run.curriculum[1] for line in lines)
        fair = since >= self._began_together + limit and not easy
        course = getattr(snapshot.env_state, "info", {}).get("curriculum")
        meta = CheckpointMeta(
            env_steps=snapshot.env_steps,
            wall_s=self._wall_s(),
            score=mean_over_episodes(lines if fair else [], f"episode/{run.best_metric}"),
            began_together=self._began_together,
            curriculum_m=course and float(course.limit_m[0]),
            algorithm=self.config.algorithm,
            robot=robot_name(self.config.env.robot),
            observations=self.config.env.observations,
            observation_size=checkpoint.plain_size(self.env.observation_size),
            action_size=int(self.env.action_size),
            scenes=self._scenes,
        )
        checkpoint.save_snapshot(self.folder.checkpoints, snapshot, meta, run.keep_checkpoints, run.env_state_limit_mb)

    def on_diverged(self, before: Snapshot, update: Update) -> str:
        """Save the batch and the learner that met it."""
        path = self.folder.path / f"diverged-{before.env_steps:012d}"
        with writing(path, "make room"):
            path.mkdir(exist_ok=True)
            write_state(path / checkpoint.LEARNER, before.learner)
            named = jax.tree_util.tree_leaves_with_path(update.batch)
            arrays = {jax.tree_util.keystr(name): np.asarray(leaf) for name, leaf in named}
            np.savez_compressed(path / "batch.npz", **arrays)  # type: ignore[arg-type]
        return str(path)

    def close(self) -> None:
        """Finish TensorBoard's event file and the run of Weights & Biases."""
        for log in self._logs:
            log.close()


def check_alike(setting: str, folder: RunFolder, config: TrainConfig, names: Sequence[tuple[str, str]] = ()) -> None:
    """Raise `ConfigError` if the run that `setting` names commands other actions, or differs in a pair of `names`."""
    mine, theirs = flatten(config), flatten(folder.read_config())
    for name, there in [*((name, name) for name in OF_ACTIONS), *names]:
        if mine[name] != theirs[there]:
            problem = f"{setting}: {name} is {mine[name]!r}, expected {theirs[there]!r}, as in {folder.path}"
            raise ConfigError(f"{problem}; set it so, or choose another run")


def check_init(config: TrainConfig, env: Any) -> tuple[TrainConfig, Path]:
    """Return config and best checkpoint of the run `run.init`; raise `ConfigError` where its policy does not fit."""
    folder = RunFolder(Path(config.run.init))
    old = folder.read_config()
    if not {config.algorithm, old.algorithm} <= {"ppo", "clone"}:
        got = f"algorithm is {config.algorithm}, and that of {folder.path} {old.algorithm}"
        raise ConfigError(f"run.init: {got}, expected ppo or clone for both; leave it out")
    pairs = [(name, name) for name in flatten(config) if name.startswith("network.") and name not in OF_CRITIC]
    of_both = "policy_hidden_layer_sizes", "normalize_observations"
    pairs += [(f"{config.algorithm}.{name}", f"{old.algorithm}.{name}") for name in of_both]
    check_alike("run.init", folder, config, pairs)
    path, meta = checkpoint.find(folder.checkpoints, "best")
    checkpoint.check_fits(meta, path, config.env, env)
    return old, path


def check_resumable(folder: RunFolder) -> None:
    """Raise `CheckpointError` if the folder holds an exported run: its checkpoints are of the policy alone."""
    if not all(map(checkpoint.is_whole, folder.checkpoints.glob("[0-9]*"))):
        init = [f"run.init={folder.path}"] * (folder.read_config().algorithm in ("ppo", "clone"))
        again = typed("python", "-m", "train", "--config", folder.config, "run.name=NEW", *init)
        got = f"{folder.path}: holds the policy alone, as `train.sweep --export` writes it"
        raise CheckpointError(f"{got}, expected all of the learner to go on from; start a new run: {again}")


def train_run(
    config: TrainConfig, console: Console, build_env: Callable[[EnvConfig], Any] = build_env, resume_from: str = "last"
) -> tuple[TrainResult, RunFolder, int | None]:
    """Train as configured in a new or existing run folder; return result, folder, and signal that ended it, if any.

    An existing run continues from the checkpoint `resume_from`: `last`, `best` or env steps; later ones are renamed.
    Raise `ConfigError` for conflicting settings, `FileError` for a folder of another run or of one in training,
    `CheckpointError`, and `DivergedError` for non-finite numbers.
    """
    if config.run.wandb:
        tracking.import_wandb()
    folder = RunFolder(Path(config.run.out_dir) / config.run.name)
    with processes.beginning() as ready:
        if jax.process_index():
            env = build_env(config.env)
            config = resolve(config, env.backend)
            ready()
            with stop_signals() as stops:
                callbacks = processes.Together(None, stops, config.run.env_state_limit_mb)
                return learn(env, config, callbacks), folder, stops[0] if stops else None
        claim(folder.path)
        try:
            devices_here(config.run.devices)  # before tables are computed
            clone = config.clone
            if config.algorithm == "clone" and not clone.teacher and not Path(clone.demonstrations).is_file():
                got = f"clone.demonstrations is {clone.demonstrations!r}, expected the file that"
                raise ConfigError(f"{got} python -m train.evaluate --demonstrations FILE wrote; or set clone.teacher")
            check_resumable(folder)
            env = build_env(config.env)
            config = resolve(config, env.backend)
            if config.run.init and not folder.config.is_file():
                check_init(config, env)
        except UserError:
            # Nothing half-built stays behind: `rmdir` takes only empty folders.
            with contextlib.suppress(OSError):
                folder.path.rmdir()
                folder.path.parent.rmdir()
            raise
        busy = f"{folder.path}: {{holder}} trains this run; wait until it ends, or set run.name to begin another run"
        with locked(folder.lock, busy):
            return _train_in(folder, config, env, console, resume_from, ready)


def devices_here(number: int) -> list[Any]:
    """Return the first devices, or those of all processes; raise `ConfigError` where the number does not fit."""
    here, several = jax.devices(), jax.process_count()
    if several > 1 and number != len(here):
        raise ConfigError(f"run.devices is {number}, expected {len(here)}, all devices of {several} processes")
    if number > len(here):
        raise ConfigError(
            f"run.devices is {number}, expected at most {len(here)}, the {here[0].platform} devices here; lower it, or "
            "let the process use more (CUDA_VISIBLE_DEVICES)"
        )
    return here[:number]


def _train_in(
    folder: RunFolder, config: TrainConfig, env: Any, console: Console, resume_from: str, ready: Callable[[], None]
) -> tuple[TrainResult, RunFolder, int | None]:
    """Train in a folder that nobody else writes to."""
    exists, devices = folder.open(config), devices_here(config.run.devices)
    ready()
    console.print(
        f"{folder.path}: {'continuing' if exists else 'training'} {config.algorithm} on {config.env.robot}, "
        f"{len(config.env.scenes)} scene(s), backend {env.backend}, {num_envs(config)} environments"
        + (f" on {len(devices)} devices" if len(devices) > 1 else "")
    )
    each, limit = config.run.num_timesteps // num_envs(config), config.env.episode_steps
    if each < limit:
        note = f"{each:,} steps for each environment, and an episode has up to {limit:,}: none that fails comes to its"
        console.print(f"{note} end; lower env.episode_steps or train longer", style="yellow")
    with stop_signals() as stops, progress_bar(console, "training") as bar:
        bar(status="compiling")
        with contextlib.closing(FolderCallbacks(folder, config, env, console, bar, stops, resume_from)) as callbacks:
            several = jax.process_count() > 1
            limit_mb = config.run.env_state_limit_mb
            result = learn(env, config, processes.Together(callbacks, stops, limit_mb) if several else callbacks)
        last = (folder.read_metrics() or [{}])[-1]
        metrics = result.metrics or {k: v for k, v in last.items() if k not in ("env_steps", "wall_s")}
        write_json(folder.summary, summary(config, folder, result, metrics))
    best = checkpoint.best_checkpoint(checkpoint.list_checkpoints(folder.checkpoints))
    console.print(
        f"{folder.path}: {'done' if result.completed else 'stopped'} at {result.snapshot.env_steps:,} steps; "
        + (describe(metrics) if metrics else "nothing logged")
        + (f"; best checkpoint at {best.env_steps:,} steps" if best else "")
        + ("" if result.completed else "; the same command continues")
    )
    if lost := failures(folder):
        note = ", ".join(f"{name} {count:,.0f}" for name, count in lost.items())
        console.print(f"what physics lost, summed over ended episodes: {note}", style="yellow")
    return result, folder, stops[0] if stops else None


def learn(env: Any, config: TrainConfig, callbacks: Any) -> TrainResult:
    devices, privileged = devices_here(config.run.devices), config.network.critic_inputs == "privileged"
    batch = AutoResetEnv(PrivilegedEnv(env) if privileged else env)
    batch.curriculum = config.run.curriculum if config.run.curriculum[0] else None
    every = ShardedEnv(batch, devices) if len(devices) > 1 else batch
    return ALGORITHMS[config.algorithm].train(every, config, callbacks)


def num_envs(config: TrainConfig) -> int:
    """Return the number of environments that the config's learner steps together."""
    return getattr(config, config.algorithm).num_envs


def failures(folder: RunFolder) -> dict[str, float]:
    """Return the steps (episodes for `nonfinite`) in which physics failed, over all logged episodes, where not 0."""
    lines, each = folder.read_metrics(), "episode/{}".format
    totals = {name: sum(line.get(each(name), 0.0) * line.get("episodes", 0) for line in lines) for name in FAILURES}
    return {name: round(total, 3) for name, total in totals.items() if total > 0}


def summary(config: TrainConfig, folder: RunFolder, result: TrainResult, metrics: dict[str, Any]) -> dict[str, Any]:
    """Return how a run ended, for tables over many runs."""
    saved = checkpoint.list_checkpoints(folder.checkpoints)
    best = checkpoint.best_checkpoint(saved)
    return {
        "run": config.run.name,
        "algorithm": config.algorithm,
        "robot": robot_name(config.env.robot),
        "k_int": config.env.k_int,
        "seed": config.run.seed,
        "completed": result.completed,
        "env_steps": result.snapshot.env_steps,
        "wall_s": saved[-1].wall_s if saved else None,
        "failures": failures(folder),
        "best": dataclasses.asdict(best) if best else None,
        "metrics": metrics,
    }
