"""Names of algorithms -> the learners behind them: one face for training, checkpoints and evaluation."""

from __future__ import annotations

from typing import Any, Protocol

from brax.training import types

from train.config import TrainConfig
from train.learners import ddpg, ppo, sac
from train.learners.learner import Callbacks, TrainResult


class Algorithm(Protocol):
    """What a learner's module offers."""

    def train(self, env: Any, config: TrainConfig, callbacks: Callbacks) -> TrainResult:
        """Trains on a batched, resetting environment with a resolved config."""
        ...

    def template(self, env: Any, config: TrainConfig) -> Any:
        """A learner in the shapes that its checkpoints have."""
        ...

    def policy(self, env: Any, config: TrainConfig, learner: Any, deterministic: bool) -> types.Policy:
        """(observation [N, ...], key) -> (action [N, A] in [-1, 1], extras)."""
        ...


ALGORITHMS: dict[str, Algorithm] = {"ppo": ppo, "sac": sac, "ddpg": ddpg}
