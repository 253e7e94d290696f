"""Play the episodes that a command line of `train.evaluate` asks for."""

import dataclasses
import json
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

import pyarrow as pa
from rich.console import Console

from interactive_nav.episodes import EpisodeFile, EpisodeFileError, load_episode_files
from interactive_nav.types import LOST
from interactive_nav_common.config import refuse_unused, replace
from interactive_nav_common.errors import ConfigError
from interactive_nav_common.jobs.progress import SafeConsole
from interactive_nav_common.rows import write_parquet
from interactive_nav_common.signals import raise_stop
from scenes_mjcf.sets import installed, scene_folders
from train import config_io
from train.config import EnvConfig, TrainConfig
from train.learners.demonstrations import table_of, write_demonstrations
from train.runs import run as runs
from train.runs.run import config_to_play
from train.runs.run_folder import EvaluationRequest, RunFolder, claim, paths_beside
from train.scoring import LEARNED, POLICIES, SEED
from train.scoring.brought import named
from train.scoring.command import Evaluate
from train.scoring.evaluation import BatchPlayer, evaluate, write_paths
from train.scoring.rows import score_table

EPISODES = 200
ROWS = "evaluation/episodes.parquet"
"""Of a run folder's default evaluation."""


def read_episodes(paths: Sequence[str], most: int | None) -> tuple[EpisodeFile, str]:
    """Return the first episodes of files, or all, and the files' digest."""
    try:
        file, digest = load_episode_files([str(installed(path)) for path in paths])
    except EpisodeFileError as error:
        raise ConfigError(f"--episode-file: {error}") from None
    if most is not None and most > len(file.episodes):
        raise ConfigError(f"--episodes is {most}, expected at most {len(file.episodes)}, which --episode-file has")
    return dataclasses.replace(file, episodes=file.episodes[:most]), digest


def _policies(arguments: Evaluate) -> tuple[str, ...]:
    """Return what --policies names, then `name=PLACE` of each --policy; ONNX files have names in both."""
    brought = [named(given) for given in arguments.policy]
    given = arguments.policies
    if given is None:
        given = "" if brought else ",".join(POLICIES)
    words = [named(name) if name.endswith(".onnx") else name for name in given.split(",") if name]
    policies = tuple(dict.fromkeys(words))
    if not policies and not brought:
        raise ConfigError(f"--policies is {given!r}, expected at least one, such as {LEARNED}")
    names = [word.partition("=")[0] for word in (*policies, *brought)]
    twice = [name for name in names if names.count(name) > 1]
    if twice:
        raise ConfigError(f"--policy: name {twice[0]!r} is taken, expected another one, as in mine=module:factory")
    return (*policies, *brought)


def _place(arguments: Evaluate, folder: RunFolder | None, config: TrainConfig, request: EvaluationRequest) -> Path:
    """Return where rows go; those without a run go where those of a run of their name would."""
    if arguments.dataset:
        return arguments.dataset / request.file_name(config.run.name)
    home = folder.path if folder else Path(config.run.out_dir) / config.run.name
    return Path(arguments.out or home / ROWS)


def _wanted(folder: RunFolder | None, policies: Sequence[str], arguments: Evaluate, console: Console) -> TrainConfig:
    """Return a run's config with the environment that the command line requests."""
    if folder:
        return config_to_play(folder, arguments.settings, arguments.scenes, console)
    if LEARNED in policies or not arguments.scenes:
        raise ConfigError(
            "RUN_DIR is missing; without one, expected --scenes and --policies without learned, "
            "for example --policies random,follower,avoider,namo:0.5"
        )
    config = dataclasses.replace(TrainConfig(), run=dataclasses.replace(TrainConfig().run, name="baselines"))
    config = config_io.apply_overrides(config, arguments.settings)
    return dataclasses.replace(config, env=dataclasses.replace(config.env, scenes=scene_folders(arguments.scenes)))


def run(arguments: Evaluate, build_env: Callable[[EnvConfig], Any] | None, kept: dict[Path, str]) -> int:
    """Play and write; fill `kept` with what has been written: a run's file of rows -> how to say it."""
    console, build_env = SafeConsole(), build_env or runs.build_env
    arguments.settings = tuple(config_io.with_robot(arguments.settings, arguments.robot))
    if arguments.episode_file:
        refuse_unused(arguments, "--balanced --seed", "with --episode-file, whose episodes are fixed")
    if arguments.dataset:
        refuse_unused(arguments, "--out", "with --dataset, where each file has its name")
    policies = _policies(arguments)
    for setting in arguments.settings:
        if not setting.startswith("env."):
            raise ConfigError(f"override {setting!r}: expected env.<setting>=value: the run decides the rest")
    folders = [RunFolder(Path(path)) for path in arguments.runs]
    if len(folders) > 1 and arguments.out:
        raise ConfigError("--out is for one run; several write into a folder: --dataset DIR")
    if len(folders) > 1 and arguments.demonstrations:
        raise ConfigError("--demonstrations is for one run; evaluate them one by one")
    folders = folders or [None]
    configs = [_wanted(folder, policies, arguments, console) for folder in folders]
    if arguments.policies is None and not all("waypoints" in c.env.observations for c in configs):
        policies = tuple(name for name in policies if name != "follower")  # nobody requested it
    given = arguments.episode_file
    file, digest = read_episodes(given, arguments.episodes) if given else (None, "")
    # Runs of one environment one after the other: it is built and compiled once. k_int is in no score.
    kinds = [replace(config.env, k_int=0.0) for config in configs]
    order = sorted(range(len(folders)), key=lambda i: kinds.index(kinds[i]))
    player, built = None, None
    for i in order:
        folder, config = folders[i], configs[i]
        request = EvaluationRequest(
            scenes=tuple(Path(scene).name for scene in config.env.scenes),
            policies=policies,
            episodes=len(file.episodes) if file else arguments.episodes or EPISODES,
            seed=file.seed if file else SEED if arguments.seed is None else arguments.seed,
            balanced=arguments.balanced and file is None,
            checkpoint=arguments.checkpoint,
            deterministic=not arguments.stochastic,
            settings=tuple(sorted(arguments.settings)),
            episode_file=digest,
        )
        out = _place(arguments, folder, config, request)
        claim(out.parent)
        summary = f"{request.episodes} episodes by each of {', '.join(policies)} in {', '.join(request.scenes)}"
        console.print(f"{config.run.name}: {summary}; loading and compiling first")
        if player is None or kinds[i] != built:
            player = None  # the old one's memory goes before the new one's comes
            env = build_env(config.env)
            raise_stop()
            player, built = BatchPlayer(env, bool(arguments.demonstrations)), kinds[i]
        trained_steps = folder.origin().get("env_steps") if folder else None
        notes = {"asked": json.dumps(dataclasses.asdict(request)), "trained_steps": json.dumps(trained_steps)}
        rows, stood, steps = pa.table({}), out.exists(), []
        unfinished = out.with_name(f".unfinished-{out.name}")  # which figures and sweeps pass over
        for rows, played in evaluate(folder, config, player, request, arguments.record, console, file, arguments.batch):
            # A stopped evaluation keeps what has been played; only complete rows replace complete rows.
            place = out if len(played) == len(policies) or not stood else unfinished
            write_paths(paths_beside(place), played, player.env)  # first: rows are never without paths as new as they
            write_parquet(rows, place, notes)
            if player.played and arguments.demonstrations:
                name, first = list(played)[-1], len(steps) * request.episodes
                steps.append(table_of(player.env, player.played, played[name].metrics["success"], name, first))
                write_demonstrations(steps, player.env, arguments.demonstrations)
            kept[out] = f"rows of {', '.join(played)} in {place}"
            if place == unfinished:
                console.print(f"until all have played: {place}; {out} stays as it is")
        for path in (unfinished, paths_beside(unfinished)):
            path.unlink(missing_ok=True)
        _report(console, rows, config, player.env, out)
        if steps:
            text = f"demonstrations: {arguments.demonstrations}, {sum(map(len, steps)):,} control steps"
            console.print(text)
    return 0


def _report(console: Console, rows: pa.Table, config: TrainConfig, env: Any, out: Path) -> None:
    console.print(score_table(rows, f"{config.run.name}: {', '.join(scene.name for scene in env.scenes)}"))
    # A solve that met its iteration limit is inexact, not lost.
    for name in ("nonfinite", *LOST):
        bad = int((rows[name].to_numpy() > 0).sum())
        if bad:
            console.print(f"{bad} of {len(rows)} episodes with {name} > 0: their scores are in doubt", style="yellow")
    console.print(f"rows: {out}")
