"""Every setting of a training run: frozen dataclasses, checked on construction; docstrings are the help."""

from __future__ import annotations

import dataclasses
import math
from pathlib import Path
from typing import Any, Literal

from interactive_nav.config import NavConfig
from train.errors import ConfigError


def _require(config: Any, names: str, low: float, high: float = math.inf) -> None:
    """Refuses values (or elements of tuples) outside [low, high]; None is still to be chosen."""
    for name in names.split():
        values = getattr(config, name)
        for value in values if isinstance(values, tuple) else (values,):
            if value is not None and not low <= value <= high:
                interval = f"at least {low}" if high == math.inf else f"between {low} and {high}"
                raise ValueError(f"{name} is {value!r}, expected {interval}")


@dataclasses.dataclass(frozen=True)
class EnvConfig(NavConfig):
    """The task: every setting of the environment, and which robot and scenes to make it from."""

    robot: str = "turtlebot"
    """Robot to drive."""
    scenes: tuple[str, ...] = ()
    """Scene folders, relative to the current folder; each episode draws one."""

    def nav_fields(self) -> dict[str, Any]:
        """The keyword arguments of `interactive_nav.make` besides robot and scenes."""
        return {field.name: getattr(self, field.name) for field in dataclasses.fields(NavConfig)}


@dataclasses.dataclass(frozen=True)
class NetworkConfig:
    """Encoders of observations with images (reference benchmark, section 8.1); a vector alone needs none."""

    conv_channels: tuple[int, ...] = (32, 64, 64)
    """Channels of the convolutions."""
    conv_kernels: tuple[int, ...] = (8, 4, 3)
    """Sides of their kernels, pixels."""
    conv_strides: tuple[int, ...] = (4, 2, 1)
    """Their strides, pixels."""
    image_features: int = 256
    """Width of the layer behind the convolutions."""
    state_features: int = 256
    """Width of the layer that takes the vector."""
    action_features: int = 256
    """Width of the layer that takes the action of a critic."""
    share_encoder: bool = False
    """Actor and critic look through one encoder; SAC and DDPG train it with the critic."""
    critic_inputs: Literal["all", "state"] = "all"
    """state: the critic takes the vector alone, the actor everything (not with share_encoder)."""
    compute_dtype: Literal["float32", "bfloat16"] = "float32"
    """Arithmetic of the image encoder; parameters stay float32."""

    def __post_init__(self) -> None:
        _require(self, "conv_channels conv_kernels conv_strides image_features state_features action_features", 1)
        if not len(self.conv_channels) == len(self.conv_kernels) == len(self.conv_strides) > 0:
            raise ValueError(
                f"conv_channels, conv_kernels and conv_strides have {len(self.conv_channels)}, "
                f"{len(self.conv_kernels)} and {len(self.conv_strides)} entries, expected the same number, at least 1"
            )
        if self.share_encoder and self.critic_inputs != "all":
            raise ValueError(
                f"share_encoder is true and critic_inputs is {self.critic_inputs!r}, expected 'all': "
                "who shares an encoder sees the same"
            )


@dataclasses.dataclass(frozen=True)
class PPOConfig:
    """Proximal policy optimisation; names as in Brax's `ppo.train`."""

    num_envs: int | None = None
    """Environments stepped together."""
    unroll_length: int | None = None
    """Steps of one environment in one training sequence."""
    batch_size: int | None = None
    """Sequences in one minibatch."""
    num_minibatches: int | None = None
    """Minibatches in one pass over the collected data."""
    num_updates_per_batch: int = 4
    """Passes over the collected data."""
    learning_rate: float = 3e-4
    """Adam's step size; with adaptive_kl the first one."""
    learning_rate_schedule: Literal["constant", "adaptive_kl"] = "constant"
    """adaptive_kl moves the step size so that an update changes the policy by about desired_kl."""
    desired_kl: float = 0.01
    """Target of adaptive_kl."""
    discounting: float = 0.99
    """Discount of one control step."""
    gae_lambda: float = 0.95
    """Lambda of the generalised advantage estimate."""
    entropy_cost: float = 5e-3
    """Weight of the entropy bonus."""
    reward_scaling: float = 1.0
    """Factor on every reward inside the loss."""
    clipping_epsilon: float = 0.2
    """Clip range of the probability ratio."""
    vf_loss_coefficient: float = 0.5
    """Weight of the value loss."""
    max_grad_norm: float = 1.0
    """Gradients are scaled down to this global norm."""
    normalize_observations: bool = True
    """Normalise observations by their running mean and deviation."""
    normalize_advantage: bool = True
    """Normalise advantages within a minibatch."""
    policy_hidden_layer_sizes: tuple[int, ...] = (256, 256)
    """Widths of the policy network, behind its encoder if there are images."""
    value_hidden_layer_sizes: tuple[int, ...] = (256, 256)
    """Widths of the value network, behind its encoder if there are images."""

    def __post_init__(self) -> None:
        _require(self, "num_envs unroll_length batch_size num_minibatches num_updates_per_batch", 1)
        _require(self, "policy_hidden_layer_sizes value_hidden_layer_sizes", 1)
        _require(self, "entropy_cost vf_loss_coefficient", 0.0)
        _require(self, "discounting gae_lambda", 0.0, 1.0)
        for name in ["learning_rate", "desired_kl", "reward_scaling", "clipping_epsilon", "max_grad_norm"]:
            if not 0.0 < getattr(self, name) < math.inf:
                raise ValueError(f"{name} is {getattr(self, name)!r}, expected a positive number")


@dataclasses.dataclass(frozen=True)
class RunConfig:
    """The run: how long, from which seed, what is written where."""

    out_dir: str = "runs"
    """Folder of all runs."""
    name: str = ""
    """Folder of this run inside out_dir; empty: <config name>-seed<seed>."""
    seed: int = 0
    """The one seed of networks, environments and sampling."""
    num_timesteps: int = 20_000_000
    """Environment steps to train for, rounded up to whole updates."""
    log_every_steps: int = 100_000
    """Environment steps between two lines of metrics."""
    checkpoint_every_steps: int = 1_000_000
    """Environment steps between two checkpoints."""
    keep_checkpoints: int = 3
    """Newest checkpoints to keep; the best one is kept as well."""
    best_metric: str = "ins_0.5"
    """Episode score whose mean over a checkpoint interval makes the best checkpoint."""
    env_state_limit_mb: float = 256.0
    """Checkpoints hold the environments' state up to this size; beyond it, resuming begins new episodes."""
    tensorboard: bool = True
    """Write TensorBoard events beside metrics.jsonl."""
    wandb: bool = False
    """Log to Weights & Biases as well (WANDB_MODE=offline keeps it here)."""
    wandb_project: str = "interactive-nav"
    """Project there."""

    def __post_init__(self) -> None:
        _require(self, "seed", 0, 2**32 - 1)
        _require(self, "num_timesteps log_every_steps checkpoint_every_steps keep_checkpoints", 1)
        _require(self, "env_state_limit_mb", 0.0)
        if self.name != Path(self.name).name:
            raise ValueError(f"name is {self.name!r}, expected one folder name (out_dir says where it lies)")
        if self.checkpoint_every_steps < self.log_every_steps:
            raise ValueError(
                f"checkpoint_every_steps is {self.checkpoint_every_steps}, "
                f"expected at least log_every_steps ({self.log_every_steps})"
            )


@dataclasses.dataclass(frozen=True)
class TrainConfig:
    """All that decides a training run."""

    env: EnvConfig = dataclasses.field(default_factory=EnvConfig)
    """The task."""
    algorithm: Literal["ppo"] = "ppo"
    """Learner."""
    network: NetworkConfig = dataclasses.field(default_factory=NetworkConfig)
    """Encoders of images."""
    ppo: PPOConfig = dataclasses.field(default_factory=PPOConfig)
    """The learner's settings."""
    run: RunConfig = dataclasses.field(default_factory=RunConfig)
    """The run."""


AUTO_PPO: dict[str, dict[str, int]] = {
    "native": {"num_envs": 64, "unroll_length": 32, "batch_size": 16, "num_minibatches": 4},
    "jax": {"num_envs": 512, "unroll_length": 32, "batch_size": 128, "num_minibatches": 4},
    "warp": {"num_envs": 4096, "unroll_length": 20, "batch_size": 512, "num_minibatches": 8},
}
"""What None means in `PPOConfig`, per physics backend. A CPU collects a thousand steps a second, so it trains
on small batches often; Warp is fastest at thousands of worlds and has steps to spare."""


def resolve(config: TrainConfig, backend: str) -> TrainConfig:
    """The config with the backend named and every None of the learner filled in, checked across fields."""
    if backend not in AUTO_PPO:
        raise ConfigError(f"env.backend: no automatic sizes for {backend!r}; known: {', '.join(AUTO_PPO)}")
    filled = {key: value for key, value in AUTO_PPO[backend].items() if getattr(config.ppo, key) is None}
    resolved = dataclasses.replace(
        config,
        env=dataclasses.replace(config.env, backend=backend),
        ppo=dataclasses.replace(config.ppo, **filled),
    )
    validate(resolved)
    return resolved


def validate(config: TrainConfig) -> None:
    """Raises `ConfigError` where values exclude each other; what is still None is not looked at."""
    ppo = config.ppo
    if not config.env.scenes:
        raise ConfigError("env.scenes is empty, expected at least one scene folder: env.scenes=PATH[,PATH...]")
    if ppo.num_envs and ppo.batch_size and ppo.num_minibatches:
        collected = ppo.batch_size * ppo.num_minibatches
        if collected % ppo.num_envs:
            raise ConfigError(
                f"ppo.batch_size * ppo.num_minibatches is {collected} sequences, expected a multiple of "
                f"ppo.num_envs ({ppo.num_envs}); change one of the three"
            )
