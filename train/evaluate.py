"""`python -m train.evaluate`: run folders in; Parquet rows, recorded paths and tables of scores out."""

from __future__ import annotations

import argparse
import dataclasses
import hashlib
import json
import sys
import time
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

import jax
import numpy as np
import pyarrow as pa
from rich.console import Console
from rich.progress import Progress, SpinnerColumn, TextColumn, TimeElapsedColumn

from interactive_nav.episodes import EpisodeFile, EpisodeFileError, starts_of
from interactive_nav.episodes import load as load_episodes
from interactive_nav_common.errors import ConfigError, UserError
from interactive_nav_common.files import whole_file
from interactive_nav_common.rows import write_parquet
from interactive_nav_common.versions import versions
from train import config_io
from train.config import EnvConfig, TrainConfig
from train.learners.algorithms import ALGORITHMS
from train.runs import checkpoint
from train.runs.checkpoint import CheckpointMeta
from train.runs.run import check_fits, config_to_play, make_env
from train.runs.run_folder import FAILURES, RunFolder, claim
from train.scoring.planners import Planner
from train.scoring.policies import PLANNERS, YARDSTICKS, PolicyFn, make_yardstick
from train.scoring.rollout import Episodes, Player, episode_keys
from train.scoring.row_files import EvaluationAsked, paths_beside
from train.scoring.rows import episode_table, score_table

LEARNED = "learned"
ROWS = "evaluation/episodes.parquet"
"""Of a run folder's own evaluation."""
AUTO_BATCH = {"native": 4096, "jax": 1024, "warp": 4096}
"""Episodes played at a time, per physics backend."""


def load_policy(
    folder: RunFolder,
    config: TrainConfig,
    env: Any,
    which: str,
    deterministic: bool,
    known: dict[Any, Any] | None = None,
) -> tuple[PolicyFn, CheckpointMeta]:
    """The policy of a checkpoint.

    Args:
        folder: of the run.
        config: of the run.
        env: to act in.
        which: best, last or env steps.
        deterministic: take the mode of the actions.
        known: filled and used by calls for the same environment: policies of equal networks then share one function,
            and what is compiled for it.

    Raises:
        CheckpointError: no such checkpoint, or one of another robot or other observations than `env`'s.
    """
    path, meta = checkpoint.find(folder.checkpoints, which)
    check_fits(meta, path, dataclasses.replace(config.env, robot=env.robot.name), env)
    algorithm = ALGORITHMS[config.algorithm]
    learner = checkpoint.load_learner(path, algorithm.template(env, config))

    def act(learner: Any, observation: Any, key: jax.Array) -> jax.Array:
        return algorithm.policy(env, config, learner, deterministic)(observation, key)[0]

    kind = (config.algorithm, config.network, getattr(config, config.algorithm), deterministic)
    act = act if known is None else known.setdefault(kind, act)
    return jax.tree_util.Partial(act, learner), meta


def evaluate(
    folder: RunFolder | None,
    config: TrainConfig,
    player: Player,
    asked: EvaluationAsked,
    record: int,
    console: Console,
    fixed: EpisodeFile | None = None,
    batch: int | None = None,
) -> tuple[pa.Table, dict[str, Episodes]]:
    """Plays the same fixed episodes with each policy: drawn from a seed, or those of a file.

    Args:
        folder: of the run; None for policies that never learned.
        config: of the run, with the environment to evaluate in.
        player: of that environment.
        asked: what to play.
        record: episodes to return paths of.
        console: for progress.
        fixed: episodes to play instead of drawn ones.
        batch: episodes played at a time; None: by backend.

    Returns:
        Rows of all policies, one an episode; and the episodes by policy.
    """
    env = player.env
    # Everything that can be refused is refused before the first episode.
    made: dict[str, tuple[PolicyFn | Planner, CheckpointMeta | None]] = {}
    for name in asked.policies:
        if name == LEARNED and folder:
            made[name] = load_policy(folder, config, env, asked.checkpoint, asked.deterministic, player.known)
        else:
            made[name] = (make_yardstick(name, env), None)
    starts, scene_index = None, None
    if fixed:
        try:
            starts = starts_of(fixed, env, "--episode-file")
        except EpisodeFileError as error:
            raise ConfigError(str(error)) from None
    elif asked.balanced:
        scene_index = np.arange(asked.episodes, dtype=np.int32) % len(env.scenes)
    keys = episode_keys(asked.seed, asked.episodes)
    batch = batch or AUTO_BATCH[env.backend]
    here, trained = versions(), folder.origin() if folder else {}
    tables, played = [], {}
    for name, (policy, meta) in made.items():
        began = time.perf_counter()
        with _progress(console, name, asked.episodes) as on_progress:
            played[name] = player.play(
                policy, keys, record, on_progress, starts, scene_index, batch, lambda note: console.print(note)
            )
        wall_s = time.perf_counter() - began
        learned = meta is not None
        constants = {
            "run": config.run.name,
            "robot": env.robot.name,
            "algorithm": config.algorithm if learned else None,
            "policy": name,
            "k_int": float(config.env.k_int),
            "seed": config.run.seed if learned else None,
            "checkpoint_steps": meta.env_steps if meta else None,
            "deterministic": asked.deterministic if learned else None,
            "evaluation_seed": asked.seed,
            "backend": env.backend,
            "device": here["device"]["kind"],
            "commit": here["commit"],
            "versions": " ".join(f"{package}={number}" for package, number in here["packages"].items()),
            "evaluation_wall_s": wall_s,
            "train_env_steps": trained.get("env_steps") if learned else None,
            "train_wall_s": trained.get("wall_s") if learned else None,
            "train_device": trained.get("device") if learned else None,
            "train_commit": trained.get("commit") if learned else None,
        }
        tables.append(episode_table(played[name], env.scenes, constants))
        note = f" ({policy.note})" if isinstance(policy, Planner) and policy.note else ""
        console.print(f"{name}: {asked.episodes} episodes in {wall_s:.0f} s{note}", highlight=False)
    return pa.concat_tables(tables), played


def write_paths(path: Path, played: dict[str, Episodes], env: Any) -> None:
    """Writes the recorded paths with the scenes' maps, so that a figure needs no scene folder."""
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
        arrays[f"scene/{i}/object_names"] = np.array(env.world.names[i], dtype=str)
    with whole_file(path) as partial, open(partial, "wb") as file:
        np.savez_compressed(file, **arrays)


class _progress:
    """A line that says how many episodes are over."""

    def __init__(self, console: Console, name: str, episodes: int):
        columns = (
            SpinnerColumn(),
            TextColumn(name),
            TextColumn("{task.fields[status]}"),
            TimeElapsedColumn(),
        )
        self._bar = Progress(*columns, console=console, transient=True, disable=not console.is_terminal)
        self._task = self._bar.add_task("", status="compiling")
        self._episodes = episodes

    def __enter__(self) -> Callable[[int, int], None]:
        self._bar.start()
        return self._show

    def _show(self, finished: int, step: int) -> None:
        self._bar.update(self._task, status=f"{finished} of {self._episodes} episodes over, step {step}")

    def __exit__(self, *_: object) -> None:
        self._bar.stop()


def _read_episodes(path: str) -> EpisodeFile:
    try:
        return load_episodes(path)
    except EpisodeFileError as error:
        raise ConfigError(f"--episode-file: {error}") from None


def _config_of_yardsticks(policies: Sequence[str], arguments: argparse.Namespace) -> TrainConfig:
    """The default config, for policies that need no run folder."""
    if LEARNED in policies or not arguments.scenes:
        raise ConfigError(
            "RUN_DIR is missing; without one, expected --scenes and --policies without learned, "
            "for example --policies random,follower,avoider,namo:0.5"
        )
    return dataclasses.replace(TrainConfig(), run=dataclasses.replace(TrainConfig().run, name="yardsticks"))


def parser() -> argparse.ArgumentParser:
    """The command line."""
    made = argparse.ArgumentParser(prog="python -m train.evaluate", description="Plays fixed episodes.")
    made.add_argument(
        "words",
        nargs="*",
        metavar="RUN_DIR | env.key=value",
        help="folders that `python -m train` wrote (several share what is compiled; without one, --scenes, --out and "
        "--policies say what to play), and environment settings to change",
    )
    made.add_argument("--scenes", nargs="+", metavar="SCENE_DIR", help="default: the scenes it was trained on")
    made.add_argument("--episodes", type=int, default=200, help="fixed episodes for each policy (default 200)")
    made.add_argument("--episode-file", metavar="FILE", help="play these (python -m interactive_nav.episodes make)")
    made.add_argument("--seed", type=int, default=1_000_000, help="which episodes (default 1000000)")
    made.add_argument("--balanced", action="store_true", help="scenes take turns; otherwise each episode draws one")
    names = ",".join((LEARNED, *YARDSTICKS))
    made.add_argument(
        "--policies",
        default=names,
        help=f"comma-separated choice from {','.join((names, *PLANNERS))} (default: {names})",
    )
    made.add_argument("--checkpoint", default="best", metavar="best|last|STEPS", help="default: best")
    made.add_argument(
        "--stochastic",
        action=argparse.BooleanOptionalAction,
        default=True,
        help="sample the learned policy's actions, as the original did (default), or take their mode",
    )
    made.add_argument("--record", type=int, default=8, help="episodes to record paths of (default 8)")
    sizes = ", ".join(f"{backend} {size}" for backend, size in AUTO_BATCH.items())
    made.add_argument("--batch", type=int, metavar="N", help=f"episodes played at a time (default: {sizes})")
    made.add_argument("--out", metavar="PATH", help=f"Parquet file (default RUN_DIR/{ROWS})")
    made.add_argument("--dataset", metavar="DIR", help="add a file for each run and evaluation to this folder instead")
    return made


def _place(
    arguments: argparse.Namespace, folder: RunFolder | None, config: TrainConfig, asked: EvaluationAsked
) -> Path:
    """Where rows go; those without a run go where those of a run of their name would."""
    if arguments.dataset:
        return Path(arguments.dataset) / asked.file_name(config.run.name)
    home = folder.path if folder else Path(config.run.out_dir) / config.run.name
    return Path(arguments.out or home / ROWS)


def _wanted(
    folder: RunFolder | None, policies: Sequence[str], arguments: argparse.Namespace, console: Console
) -> TrainConfig:
    """A run's config with the environment that the command line asks for."""
    words = [word for word in arguments.words if "=" in word]
    if folder:
        return config_to_play(folder, words, arguments.scenes, console)
    config = config_io.apply_overrides(_config_of_yardsticks(policies, arguments), words)
    return dataclasses.replace(config, env=dataclasses.replace(config.env, scenes=tuple(arguments.scenes)))


def main(argv: Sequence[str] | None = None, build_env: Callable[[EnvConfig], Any] = make_env) -> int:
    """Evaluates; 0 when done, 2 on a user's error."""
    arguments = parser().parse_intermixed_args(argv)
    console = Console()
    try:
        for name, value in (("--episodes", arguments.episodes), ("--batch", arguments.batch)):
            if value is not None and value < 1:
                raise ConfigError(f"{name} is {value}, expected at least 1")
        if arguments.record < 0 or not -(2**63) <= arguments.seed < 2**63:
            raise ConfigError(f"--record {arguments.record} --seed {arguments.seed}: expected 0 or more and 64 bits")
        policies = tuple(name for name in arguments.policies.split(",") if name)
        if not policies:
            raise ConfigError(f"--policies is {arguments.policies!r}, expected at least one, such as {LEARNED}")
        for word in arguments.words:
            if "=" in word and not word.startswith("env."):
                raise ConfigError(f"override {word!r}: expected env.<setting>=value: the rest is the run's own")
        runs = [RunFolder(Path(word)) for word in arguments.words if "=" not in word]
        if len(runs) > 1 and arguments.out:
            raise ConfigError("--out is for one run; several write into a folder: --dataset DIR")
        folders = runs or [None]
        configs = [_wanted(folder, policies, arguments, console) for folder in folders]
        fixed = _read_episodes(arguments.episode_file) if arguments.episode_file else None
        # Runs of one environment one after the other: it is built and compiled once. k_int is in no score.
        kinds = [dataclasses.replace(config.env, k_int=0.0) for config in configs]
        order = sorted(range(len(folders)), key=lambda i: kinds.index(kinds[i]))
        player, built = None, None
        for i in order:
            folder, config = folders[i], configs[i]
            asked = EvaluationAsked(
                scenes=tuple(Path(scene).name for scene in config.env.scenes),
                policies=policies,
                episodes=len(fixed.episodes) if fixed else arguments.episodes,
                seed=fixed.seed if fixed else arguments.seed,
                balanced=arguments.balanced and fixed is None,
                checkpoint=arguments.checkpoint,
                deterministic=not arguments.stochastic,
                settings=tuple(sorted(word for word in arguments.words if "=" in word)),
                episode_file=_digest(arguments.episode_file) if fixed else "",
            )
            out = _place(arguments, folder, config, asked)
            claim(out.parent)
            if player is None or kinds[i] != built:
                player = None  # the old one's memory goes before the new one's comes
                player, built = Player(build_env(config.env)), kinds[i]
            rows, played = evaluate(folder, config, player, asked, arguments.record, console, fixed, arguments.batch)
            trained_steps = folder.origin().get("env_steps") if folder else None
            write_paths(paths_beside(out), played, player.env)  # first: rows are never without paths as new as they
            write_parquet(rows, out, {"asked": json.dumps(asked.plain()), "trained_steps": json.dumps(trained_steps)})
            _tell(console, rows, config, player.env, out)
    except UserError as error:
        print(f"train.evaluate: {error}", file=sys.stderr)
        return 2
    return 0


def _digest(path: str) -> str:
    return hashlib.sha256(Path(path).read_bytes()).hexdigest()[:16]


def _tell(console: Console, rows: pa.Table, config: TrainConfig, env: Any, out: Path) -> None:
    """The table of scores, and whether they are in doubt."""
    console.print(score_table(rows, f"{config.run.name}: {', '.join(scene.name for scene in env.scenes)}"))
    # A solve that met its iteration limit is inexact, not lost.
    for name in FAILURES[:3]:
        bad = int((rows[name].to_numpy() > 0).sum())
        if bad:
            console.print(f"[yellow]{bad} of {len(rows)} episodes with {name} > 0: their scores are in doubt[/]")
    console.print(f"rows: {out}", highlight=False, soft_wrap=True)


if __name__ == "__main__":
    sys.exit(main())
