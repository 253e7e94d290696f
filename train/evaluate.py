"""Run `python -m train.evaluate`: evaluate run folders; write Parquet rows, recorded paths and tables of scores."""

import dataclasses
import json
import signal
import sys
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Annotated, Any

import pyarrow as pa
from rich.console import Console

from interactive_nav.episodes import EpisodeFile, EpisodeFileError, load_episode_files
from interactive_nav.types import FAILURES
from interactive_nav_common.commands import Command, Flag, Repeated, Words, option, parse, word
from interactive_nav_common.config import AtLeastOne, Natural, refuse_unused, replace
from interactive_nav_common.errors import ConfigError, reports_errors
from interactive_nav_common.jobs.progress import SafeConsole
from interactive_nav_common.rows import write_parquet
from interactive_nav_common.signals import STOPS, interrupts_heard, number_of, raise_stop
from scenes_mjcf.sets import installed, scene_folders
from train import config_io
from train.config import EnvConfig, TrainConfig
from train.runs.run import build_env, config_to_play
from train.runs.run_folder import EvaluationRequest, RunFolder, claim, paths_beside
from train.scoring.brought import named
from train.scoring.evaluation import AUTO_BATCH, LEARNED, POLICIES, SEED, BatchPlayer, evaluate, write_paths
from train.scoring.evaluation import load_policy as load_policy
from train.scoring.policies import PLANNERS
from train.scoring.rows import score_table

EPISODES = 200
ROWS = "evaluation/episodes.parquet"
"""Of a run folder's default evaluation."""


def _read_episodes(paths: Sequence[str], most: int | None) -> tuple[EpisodeFile, str]:
    """Return the first episodes of files, or all, and the files' digest."""
    try:
        file, digest = load_episode_files([str(installed(path)) for path in paths])
    except EpisodeFileError as error:
        raise ConfigError(f"--episode-file: {error}") from None
    if most is not None and most > len(file.episodes):
        raise ConfigError(f"--episodes is {most}, expected at most {len(file.episodes)}, which --episode-file has")
    return dataclasses.replace(file, episodes=file.episodes[:most]), digest


@dataclasses.dataclass
class Evaluate(Command):
    """Play fixed episodes."""

    runs: Annotated[tuple[str, ...], *word("RUN_DIR")] = ()
    """Folders that `python -m train` wrote; several share what is compiled. Without one, --scenes, --out and --policies
    say what to play."""
    settings: Words = ()
    """Environment settings to change: env.NAME=VALUE."""
    robot: Annotated[str | None, option(metavar="NAME|FILE")] = None
    """Sets env.robot: a name, a URDF or MJCF file, or path.py:function."""
    episodes: Annotated[AtLeastOne | None, option(metavar="N")] = None
    """Episodes of each policy (default: 200; of files, all)."""
    episode_file: Annotated[Repeated, option(metavar="FILE")] = ()
    """Play these (python -m interactive_nav.episodes make)."""
    balanced: Flag = False
    """Scenes take turns; otherwise each episode draws one."""
    policies: Annotated[str | None, option(metavar="NAME,...")] = None
    """Policies and planners to play (default: all policies; with --policy none)."""
    policy: Annotated[Repeated, option(metavar="[NAME=]MODULE:FACTORY")] = ()
    """Also play what this function of your module, or of path/to/file.py, returns."""
    scenes: Annotated[tuple[str, ...], option(metavar="SCENE_DIR")] = ()
    """Where to play (default: the scenes that the policy was trained on)."""
    seed: Annotated[int | None, option()] = None
    """Of the fixed episodes."""
    checkpoint: Annotated[str, option(metavar="best|last|STEPS")] = "best"
    """Which checkpoint plays."""
    stochastic: bool = True
    """Sample the learned policy's actions, as the original did, or take their mode."""
    record: Natural = 8
    """Episodes to record paths of."""
    batch: Annotated[AtLeastOne | None, option(metavar="N")] = None
    """Episodes played at a time (default: by the backend)."""
    out: Annotated[Path | None, option(metavar="PATH")] = None
    """Parquet file of rows (default: RUN_DIR/evaluation/episodes.parquet)."""
    dataset: Annotated[Path | None, option(metavar="DIR")] = None
    """Add a file for each run and evaluation to this folder instead."""

    @classmethod
    def epilog(cls) -> str:
        """Return what --policies may name and the default sizes."""
        batches = ", ".join(f"{backend} {size}" for backend, size in AUTO_BATCH.items())
        return f"policies: {', '.join(POLICIES)}\nplanners: {', '.join(PLANNERS)}\nseed: {SEED}\nbatch: {batches}"


def _policies(arguments: Evaluate) -> tuple[str, ...]:
    """Return what --policies names, then `name=module:factory` of each --policy."""
    brought = [named(given) for given in arguments.policy]
    given = arguments.policies
    if given is None:
        given = "" if brought else ",".join(POLICIES)
    policies = tuple(dict.fromkeys(name for name in given.split(",") if name))
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


def _checked_seed(arguments: Evaluate) -> int:
    """Return the seed of drawn episodes, once numbers are in range and no word is without effect."""
    seed = SEED if arguments.seed is None else arguments.seed
    if not -(2**63) <= seed < 2**63:
        raise ConfigError(f"--seed is {seed}, expected a number of 64 bits")
    if arguments.episode_file:
        refuse_unused(arguments, "--balanced --seed", "with --episode-file, whose episodes are fixed")
    if arguments.dataset:
        refuse_unused(arguments, "--out", "with --dataset, where each file has its name")
    return seed


@reports_errors("train.evaluate")
def main(argv: Sequence[str] | None = None, build_env: Callable[[EnvConfig], Any] = build_env) -> int:
    """Evaluate; return 0 when done, 2 on a user's error, 128 + signal when stopped, which keeps what is played."""
    kept: dict[Path, str] = {}
    try:
        with interrupts_heard(*STOPS, at_once=False):  # progress raises it, between two chunks
            code = _run(parse(Evaluate, "python -m train.evaluate", argv), build_env, kept)
            raise_stop()
            return code
    except KeyboardInterrupt as stop:
        saved = "; ".join(kept.values()) or "nothing, no policy had played all"
        number = number_of(stop)
        print(f"train.evaluate: stopped by {signal.Signals(number).name}; kept: {saved}", file=sys.stderr)
        return 128 + number


def _run(arguments: Evaluate, build_env: Callable[[EnvConfig], Any], kept: dict[Path, str]) -> int:
    """Fill `kept` with what has been written: a run's file of rows -> how to say it."""
    console = SafeConsole()
    arguments.settings = tuple(config_io.with_robot(arguments.settings, arguments.robot))
    seed = _checked_seed(arguments)
    policies = _policies(arguments)
    for setting in arguments.settings:
        if not setting.startswith("env."):
            raise ConfigError(f"override {setting!r}: expected env.<setting>=value: the run decides the rest")
    runs = [RunFolder(Path(run)) for run in arguments.runs]
    if len(runs) > 1 and arguments.out:
        raise ConfigError("--out is for one run; several write into a folder: --dataset DIR")
    folders = runs or [None]
    configs = [_wanted(folder, policies, arguments, console) for folder in folders]
    if arguments.policies is None and not all("waypoints" in c.env.observations for c in configs):
        policies = tuple(name for name in policies if name != "follower")  # nobody requested it
    given = arguments.episode_file
    file, digest = _read_episodes(given, arguments.episodes) if given else (None, "")
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
            seed=file.seed if file else seed,
            balanced=arguments.balanced and file is None,
            checkpoint=arguments.checkpoint,
            deterministic=not arguments.stochastic,
            settings=tuple(sorted(arguments.settings)),
            episode_file=digest,
        )
        out = _place(arguments, folder, config, request)
        claim(out.parent)
        summary = f"{request.episodes} episodes by each of {', '.join(policies)} in {', '.join(request.scenes)}"
        console.print(f"{config.run.name}: {summary}; loading and compiling first", highlight=False, soft_wrap=True)
        if player is None or kinds[i] != built:
            player = None  # the old one's memory goes before the new one's comes
            env = build_env(config.env)
            raise_stop()
            player, built = BatchPlayer(env), kinds[i]
        trained_steps = folder.origin().get("env_steps") if folder else None
        notes = {"asked": json.dumps(dataclasses.asdict(request)), "trained_steps": json.dumps(trained_steps)}
        rows, stood = pa.table({}), out.exists()
        unfinished = out.with_name(f".unfinished-{out.name}")  # which figures and sweeps pass over
        for rows, played in evaluate(folder, config, player, request, arguments.record, console, file, arguments.batch):
            # What is stopped keeps what has been played; whole rows that stood there give way to whole ones only.
            place = out if len(played) == len(policies) or not stood else unfinished
            write_paths(paths_beside(place), played, player.env)  # first: rows are never without paths as new as they
            write_parquet(rows, place, notes)
            kept[out] = f"rows of {', '.join(played)} in {place}"
            if place == unfinished:
                console.print(f"until all have played: {place}; {out} stays as it is", highlight=False, soft_wrap=True)
        for path in (unfinished, paths_beside(unfinished)):
            path.unlink(missing_ok=True)
        _report(console, rows, config, player.env, out)
    return 0


def _report(console: Console, rows: pa.Table, config: TrainConfig, env: Any, out: Path) -> None:
    """Print the table of scores, and whether they are in doubt."""
    console.print(score_table(rows, f"{config.run.name}: {', '.join(scene.name for scene in env.scenes)}"))
    # A solve that met its iteration limit is inexact, not lost.
    for name in FAILURES[:3]:
        bad = int((rows[name].to_numpy() > 0).sum())
        if bad:
            console.print(f"{bad} of {len(rows)} episodes with {name} > 0: their scores are in doubt", style="yellow")
    console.print(f"rows: {out}", highlight=False, soft_wrap=True)


if __name__ == "__main__":
    sys.exit(main())
