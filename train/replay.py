"""Run `python -m train.replay RUN_DIR --episodes 0,1 --policies learned,follower`: record episodes step by step.

Episode K starts as row K of `python -m train.evaluate` with the same seed or file. A network's numbers may differ in
their last bits with the batch size, so close calls may end otherwise; a replay carries its scores.
"""

import sys
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Annotated, Any

import jax
from rich.console import Console

from interactive_nav.episodes import load_episode_file, starts_of
from interactive_nav.pictures import replay
from interactive_nav.task.rollout import episode_keys
from interactive_nav_common.commands import Command, Words, option, parse, word
from interactive_nav_common.config import Bounds, refuse_unused
from interactive_nav_common.errors import ConfigError, reports_errors
from interactive_nav_common.jobs.progress import SafeConsole
from scenes_mjcf.sets import installed
from train.config import EnvConfig
from train.runs.run import build_env, config_to_play
from train.runs.run_folder import RunFolder, claim
from train.scoring import SEED
from train.scoring.brought import named
from train.scoring.evaluation import make_policies


class OfRun(Command):
    """Base of the commands that record episodes of a run."""

    run: Annotated[Path, *word("RUN_DIR")]
    """Run folder that `python -m train` wrote."""
    settings: Words = ()
    """Override environment settings: env.NAME=VALUE."""
    checkpoint: Annotated[str, option(metavar="best|last|STEPS")] = "best"
    """Checkpoint to play."""
    episode_file: Annotated[str | None, option(metavar="FILE")] = None
    """Episode file to play from, made by `python -m interactive_nav.episodes make`."""

    def play(
        self,
        episodes: Sequence[int],
        policies: str,
        console: Console,
        build_env: Callable[[EnvConfig], Any] = build_env,
        scenes: Sequence[str] = (),
        seed: int = SEED,
        deterministic: bool = False,
    ) -> None:
        """Write a replay of each of the episodes by each of the policies, `NAME,...`, into the run's folder."""
        folder = RunFolder(self.run)
        config = config_to_play(folder, self.settings, scenes, console)
        claim(folder.path / "replays")
        env, starts = build_env(config.env), None
        if self.episode_file:
            file = load_episode_file(installed(self.episode_file))
            if max(episodes) >= len(file.episodes):
                raise ConfigError(f"--episodes has {max(episodes)}, expected less than the file's {len(file.episodes)}")
            seed, starts = file.seed, starts_of(file, env, "--episode-file")
        keys = episode_keys(seed, max(episodes) + 1)
        names = [named(name) if name.endswith(".onnx") else name for name in policies.split(",")]
        players = make_policies(names, folder, config, env, self.checkpoint, deterministic)
        for name, (policy, meta) in players.items():
            label = f"{config.run.name}, {meta.env_steps:,} steps" if meta else ""
            player = replay.EpisodePlayer(env, policy, name, label)
            for episode in episodes:
                with console.status(f"{name}, episode {episode}: compiling") as status:
                    played = player.play(
                        keys[episode],
                        episode,
                        lambda step, n=name, k=episode: status.update(f"{n}, episode {k}: step {step}"),
                        None if starts is None else jax.tree.map(lambda x, k=episode: x[k : k + 1], starts),
                    )
                path = replay.replay_path(folder.path, name, episode)
                replay.save_replay(played, path)
                score = played.metrics["ins_0.5"]
                console.print(f"{path}: {played.num_steps} steps, INS_0.5 {score:.2f}")


class Replay(OfRun):
    """Record replays of episodes of a run, step by step."""

    episodes: Annotated[str, option(metavar="K,K,...")] = "0"
    """Numbers of the fixed episodes, starting at 0."""
    policies: Annotated[str, option(metavar="NAME,...")] = "learned"
    """Policies to play."""
    scenes: Annotated[tuple[str, ...], option(metavar="SCENE_DIR")] = ()
    """Scenes to play in (default: those that the policy was trained in)."""
    seed: Annotated[int | None, Bounds(-(2**63), 2**63 - 1), option()] = None
    """Random seed of the fixed episodes (default: that of `python -m train.evaluate`)."""
    stochastic: bool = True
    """Sample the learned policy's actions, as the original code did, or take the most likely ones."""


@reports_errors("train.replay")
def main(argv: Sequence[str] | None = None, build_env: Callable[[EnvConfig], Any] = build_env) -> int:
    arguments = parse(Replay, "python -m train.replay", argv)
    if not all(number.isdecimal() for number in arguments.episodes.split(",")):
        raise ConfigError(f"--episodes is {arguments.episodes!r}, expected numbers from 0 on, such as 0,1,5")
    if arguments.episode_file:
        refuse_unused(arguments, "--seed", "with --episode-file, whose episodes are fixed")
    episodes = [int(number) for number in arguments.episodes.split(",")]
    seed, deterministic = SEED if arguments.seed is None else arguments.seed, not arguments.stochastic
    arguments.play(episodes, arguments.policies, SafeConsole(), build_env, arguments.scenes, seed, deterministic)
    return 0


if __name__ == "__main__":
    sys.exit(main())
