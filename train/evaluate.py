"""`python -m train.evaluate`: a run folder in; Parquet rows, recorded paths and a table of scores out."""

from __future__ import annotations

import argparse
import dataclasses
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
from train import checkpoint, config_io
from train.algorithms import ALGORITHMS
from train.checkpoint import CheckpointMeta
from train.config import EnvConfig, TrainConfig
from train.errors import ConfigError, TrainError
from train.files import whole_file
from train.planners import Planner
from train.policies import PLANNERS, YARDSTICKS, PolicyFn, make_learned, make_yardstick
from train.rollout import Episodes, episode_keys, run_episodes
from train.rows import episode_table, score_table, write_parquet
from train.run import check_fits, make_env
from train.run_folder import FAILURES, RunFolder, claim, commit

LEARNED = "learned"


def load_policy(
    folder: RunFolder, config: TrainConfig, env: Any, which: str, deterministic: bool
) -> tuple[PolicyFn, CheckpointMeta]:
    """The policy of a checkpoint.

    Raises:
        CheckpointError: no such checkpoint, or one of another robot or other observations than `env`'s.
    """
    path, meta = checkpoint.find(folder.checkpoints, which)
    check_fits(meta, path, dataclasses.replace(config.env, robot=env.robot.name), env)
    algorithm = ALGORITHMS[config.algorithm]
    learner = checkpoint.load_learner(path, algorithm.template(env, config))
    return make_learned(algorithm.policy(env, config, learner, deterministic)), meta


def evaluate(
    folder: RunFolder | None,
    config: TrainConfig,
    env: Any,
    policies: Sequence[str],
    episodes: int,
    seed: int,
    which: str,
    deterministic: bool,
    record: int,
    console: Console,
    fixed: EpisodeFile | None = None,
) -> tuple[pa.Table, dict[str, Episodes]]:
    """Plays the same fixed episodes with each policy: `episodes` drawn from `seed`, or those of a file.

    Returns:
        Rows of all policies, one an episode; and the episodes by policy.
    """
    # Everything that can be refused is refused before the first episode.
    made: dict[str, tuple[PolicyFn | Planner, CheckpointMeta | None]] = {}
    for name in policies:
        if name == LEARNED and folder:
            made[name] = load_policy(folder, config, env, which, deterministic)
        else:
            made[name] = (make_yardstick(name, env), None)
    starts = None
    if fixed:
        try:
            starts = starts_of(fixed, env, "--episode-file")
        except EpisodeFileError as error:
            raise ConfigError(str(error)) from None
        episodes, seed = len(fixed.episodes), fixed.seed
    keys = episode_keys(seed, episodes)
    tables, played = [], {}
    for name, (policy, meta) in made.items():
        began = time.perf_counter()
        with _progress(console, name, episodes) as on_progress:
            played[name] = run_episodes(env, policy, keys, record, on_progress, starts)
        constants = {
            "run": config.run.name,
            "robot": env.robot.name,
            "algorithm": config.algorithm if meta else None,
            "policy": name,
            "k_int": float(config.env.k_int),
            "seed": config.run.seed if meta else None,
            "checkpoint_steps": meta.env_steps if meta else None,
            "deterministic": deterministic if meta else None,
            "evaluation_seed": seed,
            "backend": env.backend,
            "device": jax.devices()[0].device_kind,
            "commit": commit(),
        }
        table = episode_table(played[name], env.scenes, constants)
        tables.append(table.cast(_schema(table.schema)))
        note = f" ({policy.note})" if isinstance(policy, Planner) and policy.note else ""
        console.print(f"{name}: {episodes} episodes in {time.perf_counter() - began:.0f} s{note}", highlight=False)
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


def _schema(schema: pa.Schema) -> pa.Schema:
    """Columns that are empty for yardsticks get the type they have for learned policies."""
    types: dict[str, pa.DataType] = {
        "algorithm": pa.string(),
        "commit": pa.string(),
        "deterministic": pa.bool_(),
    }
    types |= {"seed": pa.int64(), "checkpoint_steps": pa.int64()}
    return pa.schema([pa.field(f.name, types.get(f.name, f.type)) for f in schema])


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


def _config_of_yardsticks(policies: Sequence[str], scenes: Sequence[str] | None, out: str | None) -> TrainConfig:
    """The default config, for policies that need no run folder."""
    if LEARNED in policies or not scenes or not out:
        raise ConfigError(
            "RUN_DIR is missing; without one, expected --scenes, --out and --policies without learned, "
            "for example --policies random,follower,avoider,namo:0.5"
        )
    return dataclasses.replace(TrainConfig(), run=dataclasses.replace(TrainConfig().run, name="yardsticks"))


def parser() -> argparse.ArgumentParser:
    """The command line."""
    made = argparse.ArgumentParser(prog="python -m train.evaluate", description="Plays fixed episodes.")
    made.add_argument(
        "run",
        nargs="?",
        metavar="RUN_DIR",
        help="folder that `python -m train` wrote; without one, --scenes, --out and --policies say what to play",
    )
    made.add_argument("--scenes", nargs="+", metavar="SCENE_DIR", help="default: the scenes it was trained on")
    made.add_argument("--episodes", type=int, default=200, help="fixed episodes for each policy (default 200)")
    made.add_argument("--episode-file", metavar="FILE", help="play these (python -m interactive_nav.episodes make)")
    made.add_argument("--seed", type=int, default=1_000_000, help="which episodes (default 1000000)")
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
    made.add_argument("--out", metavar="PATH", help="Parquet file (default RUN_DIR/evaluation/episodes.parquet)")
    made.add_argument("overrides", nargs="*", metavar="env.key=value", help="environment settings to change")
    return made


def main(argv: Sequence[str] | None = None, build_env: Callable[[EnvConfig], Any] = make_env) -> int:
    """Evaluates; 0 when done, 2 on a user's error."""
    arguments = parser().parse_intermixed_args(argv)
    console = Console()
    try:
        if arguments.episodes < 1:
            raise ConfigError(f"--episodes is {arguments.episodes}, expected at least 1")
        policies = [name for name in arguments.policies.split(",") if name]
        if arguments.run and "=" in arguments.run:
            arguments.overrides.insert(0, arguments.run)
            arguments.run = None
        if arguments.run:
            folder = RunFolder(Path(arguments.run))
            config = folder.read_config()
        else:
            folder, config = None, _config_of_yardsticks(policies, arguments.scenes, arguments.out)
        for word in arguments.overrides:
            if not word.startswith("env."):
                raise ConfigError(f"override {word!r}: expected env.<setting>=value: the rest is the run's own")
        config = config_io.apply_overrides(config, arguments.overrides)
        if arguments.scenes:
            config = dataclasses.replace(config, env=dataclasses.replace(config.env, scenes=tuple(arguments.scenes)))
        out = Path(arguments.out) if arguments.out or not folder else folder.path / "evaluation" / "episodes.parquet"
        fixed = _read_episodes(arguments.episode_file) if arguments.episode_file else None
        claim(out.parent)
        env = build_env(config.env)
        rows, played = evaluate(
            folder,
            config,
            env,
            policies,
            arguments.episodes,
            arguments.seed,
            arguments.checkpoint,
            not arguments.stochastic,
            arguments.record,
            console,
            fixed,
        )
        write_parquet(rows, out)
        write_paths(out.with_suffix(".npz"), played, env)
    except TrainError as error:
        print(f"train.evaluate: {error}", file=sys.stderr)
        return 2
    console.print(score_table(rows, f"{config.run.name}: {', '.join(scene.name for scene in env.scenes)}"))
    # A solve that met its iteration limit is inexact, not lost.
    for name in FAILURES[:3]:
        bad = int((rows[name].to_numpy() > 0).sum())
        if bad:
            console.print(f"[yellow]{bad} of {len(rows)} episodes with {name} > 0: their scores are in doubt[/]")
    console.print(f"rows: {out}", highlight=False, soft_wrap=True)
    return 0


if __name__ == "__main__":
    sys.exit(main())
