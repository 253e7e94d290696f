"""`python -m tests.train.toy_run OUT_DIR [key=value ...]`: training on the toy, for tests to kill."""

from __future__ import annotations

import sys
import time
from typing import Any

if __name__ == "__main__":
    sys.modules["torch"] = None  # type: ignore[assignment]  # tensorboardX would import it, which takes seconds

from rich.console import Console

from tests.train.toy_env import ToyConfig, ToyEnv
from train.config import EnvConfig, PPOConfig, RunConfig, TrainConfig
from train.config_io import apply_overrides
from train.runs.run import FolderCallbacks, train_run

UPDATE_STEPS = 16 * 2 * 8


def toy_config(out_dir: Any, updates: int = 4, **run: Any) -> TrainConfig:
    """Updates of 256 steps each, logged one by one, a checkpoint every two."""
    return TrainConfig(
        env=EnvConfig.of(scenes=("toy",), backend="native", episode_steps=60),
        ppo=PPOConfig(
            num_envs=16,
            unroll_length=8,
            batch_size=16,
            num_minibatches=2,
            num_updates_per_batch=2,
            policy_hidden_layer_sizes=(16,),
            value_hidden_layer_sizes=(16,),
        ),
        run=RunConfig(
            out_dir=str(out_dir),
            name="toy",
            num_timesteps=updates * UPDATE_STEPS,
            log_every_steps=UPDATE_STEPS,
            checkpoint_every_steps=2 * UPDATE_STEPS,
            **run,
        ),
    )


def build_toy(config: EnvConfig) -> Any:
    """The toy for a config."""
    return ToyEnv(ToyConfig(episode_steps=config.episode_steps, k_int=config.k_int))


if __name__ == "__main__":
    usual = FolderCallbacks.on_update

    def slow(self: FolderCallbacks, env_steps: int) -> None:
        time.sleep(0.05)
        usual(self, env_steps)

    FolderCallbacks.on_update = slow  # so that a signal finds it at work
    config = apply_overrides(toy_config(sys.argv[1], updates=10_000), sys.argv[2:])
    _, _, stopped_by = train_run(config, Console(), build_env=build_toy)
    sys.exit(128 + stopped_by if stopped_by else 0)
