"""Define every setting of a training run: frozen dataclasses, checked on construction; docstrings are the help."""

import dataclasses
from pathlib import Path
from typing import Annotated, Any, Literal

import yaml

from interactive_nav.config import IMAGES, NavConfig
from interactive_nav_common.config import AtLeastOne, Bounds, NotNegative, Positive, Seed, Settings, Share, replace
from interactive_nav_common.errors import ConfigError
from interactive_nav_common.files import check_name

AUTO: dict[str, dict[str, dict[str, int]]] = yaml.safe_load((Path(__file__).parent / "sizes.yaml").read_text())
"""Algorithm, and the section of its settings -> backend -> the sizes that None means."""


@dataclasses.dataclass(frozen=True)
class EnvConfig(NavConfig):
    """The task: every setting of the environment, and which robot and scenes to make it from."""

    robot: str = "turtlebot"
    """Robot to drive: a name, a URDF or MJCF file, or path.py:function."""
    scenes: tuple[str, ...] = ()
    """Scene folders, relative to the current folder, or sets (`sparse/train`); each episode draws one scene."""


@dataclasses.dataclass(frozen=True)
class NetworkConfig(Settings):
    """Encoders of observations with images (reference benchmark, section 8.1), and memory; a vector needs neither."""

    conv_channels: tuple[AtLeastOne, ...] = (32, 64, 64)
    """Number of channels of each convolution."""
    conv_kernels: tuple[AtLeastOne, ...] = (8, 4, 3)
    """Side of each convolution's kernel in pixels."""
    conv_strides: tuple[AtLeastOne, ...] = (4, 2, 1)
    """Stride of each convolution in pixels."""
    image_features: AtLeastOne = 256
    """Width of the layer after the convolutions."""
    state_features: AtLeastOne = 256
    """Width of the layer that takes the vector."""
    action_features: AtLeastOne = 256
    """Width of the layer that takes a critic's action."""
    share_encoder: bool = False
    """Share one encoder between actor and critic; SAC and DDPG train it with the critic."""
    critic_inputs: Literal["all", "state", "privileged"] = "all"
    """Inputs of the critic: all that the actor has, the vector alone, or the vector and the true state (ppo only)."""
    compute_dtype: Literal["float32", "bfloat16"] = "float32"
    """Arithmetic of the image encoder; parameters stay float32."""
    memory: Literal["none", "gru"] = "none"
    """Recurrent layer between encoder and head (gru), or none; not for clone."""
    memory_size: AtLeastOne = 128
    """Size of the state that the recurrent layer keeps from step to step, for actor and critic each."""

    IDLE = (("memory_size", "memory 'gru'", lambda c: c.memory == "gru"),)

    def __post_init__(self) -> None:
        super().__post_init__()
        if not len(self.conv_channels) == len(self.conv_kernels) == len(self.conv_strides) > 0:
            raise ConfigError(
                f"conv_channels, conv_kernels and conv_strides have {len(self.conv_channels)}, "
                f"{len(self.conv_kernels)} and {len(self.conv_strides)} entries, expected the same number, at least 1"
            )
        if self.share_encoder and self.critic_inputs != "all":
            got = f"share_encoder is true and critic_inputs is {self.critic_inputs!r}"
            raise ConfigError(f"{got}, expected 'all': who shares an encoder sees the same")


OF_MEMORY = ("memory", "memory_size", "state_features", "share_encoder")
"""Settings of `NetworkConfig` that have an effect on a vector alone, if the network has memory."""


@dataclasses.dataclass(frozen=True)
class PPOConfig(Settings):
    """Proximal policy optimisation; names as in Brax's `ppo.train`."""

    num_envs: AtLeastOne | None = None
    """Number of environments that step together."""
    unroll_length: AtLeastOne | None = None
    """Number of steps of one environment in a training sequence."""
    batch_size: AtLeastOne | None = None
    """Number of sequences in a minibatch."""
    num_minibatches: AtLeastOne | None = None
    """Number of minibatches in a pass over the collected data."""
    num_updates_per_batch: AtLeastOne = 4
    """Number of passes over the collected data."""
    learning_rate: Positive = 3e-4
    """Adam's step size."""
    final_learning_rate: NotNegative | None = None
    """Adam's step size at run.num_timesteps, approached in equal steps; auto: it stays the same."""
    discounting: Share = 0.99
    """Discount factor of one control step."""
    gae_lambda: Share = 0.95
    """Lambda of the generalised advantage estimate."""
    entropy_cost: NotNegative = 5e-3
    """Weight of the entropy bonus."""
    reward_scaling: Positive = 1.0
    """Factor on every reward in the loss."""
    clipping_epsilon: Positive = 0.2
    """Clip range of the probability ratio."""
    vf_loss_coefficient: NotNegative = 0.5
    """Weight of the value loss."""
    max_grad_norm: Positive = 1.0
    """Global norm to which larger gradients are scaled down."""
    normalize_observations: bool = True
    """Normalise observations by their running mean and standard deviation."""
    normalize_advantage: bool = True
    """Normalise advantages within a minibatch."""
    policy_hidden_layer_sizes: tuple[AtLeastOne, ...] = (256, 256)
    """Widths of the policy network's layers, after its encoder if there are images."""
    value_hidden_layer_sizes: tuple[AtLeastOne, ...] = (256, 256)
    """Widths of the value network's layers, after its encoder if there are images."""


@dataclasses.dataclass(frozen=True)
class OffPolicyConfig(Settings):
    """What SAC and DDPG share: many environments, a replay on the device, a few large gradient steps an update."""

    num_envs: AtLeastOne | None = None
    """Number of environments that step together."""
    steps_per_update: AtLeastOne | None = None
    """Number of steps of every environment in one update."""
    grad_steps_per_update: AtLeastOne | None = None
    """Number of gradient steps in one update."""
    batch_size: AtLeastOne | None = None
    """Number of transitions in a gradient step."""
    min_replay_size: AtLeastOne | None = None
    """Number of transitions to collect, at random in a new run, before learning starts."""
    max_replay_size: AtLeastOne | None = None
    """Number of transitions to keep, rounded down to the same number for each environment."""
    replay_limit_gb: Positive = 16.0
    """Largest replay in GB (1e9 bytes) of device memory; larger ones are refused."""
    n_steps: AtLeastOne = 1
    """Number of rewards to sum before the critic's estimate."""
    unroll_length: AtLeastOne = 16
    """Transitions in a sequence, with memory; a batch has batch_size / unroll_length sequences, at least one."""
    burn_in: Annotated[int, Bounds(0)] = 8
    """Number of steps before each sequence that bring stored memory up to the newest parameters."""
    discounting: Share = 0.99
    """Discount factor of one control step."""
    reward_scaling: Positive = 1.0
    """Factor on every reward in the loss."""
    normalize_observations: bool = True
    """Normalise observations by their running mean and standard deviation."""
    policy_hidden_layer_sizes: tuple[AtLeastOne, ...] = (256, 256)
    """Widths of the policy network's layers, after its encoder if there are images."""
    q_hidden_layer_sizes: tuple[AtLeastOne, ...] = (256, 256)
    """Widths of each critic's layers, after its encoder if there are images."""
    q_layer_norm: bool = False
    """Normalise the layers of critics: they stay stable at larger step sizes."""

    @property
    def replay_slots(self) -> int:
        """Return the steps of each environment that the replay keeps."""
        assert self.max_replay_size and self.num_envs, "the config must be resolved"
        return self.max_replay_size // self.num_envs

    def younger_slots(self, remembers: bool) -> int:
        """Return the steps that must have followed a step before a batch can begin with it."""
        return self.n_steps + remembers * (self.burn_in + self.unroll_length - 1)


@dataclasses.dataclass(frozen=True)
class SACConfig(OffPolicyConfig):
    """Soft actor-critic; names as in Brax's `sac.train` where it has them."""

    actor_learning_rate: Positive = 3e-4
    """Adam's step size for the policy."""
    critic_learning_rate: Positive = 3e-4
    """Adam's step size for the critics, and for a shared encoder."""
    alpha_learning_rate: Positive = 3e-4
    """Adam's step size for the temperature."""
    tau: Share = 0.005
    """Share of the critics that is mixed into their targets at each gradient step."""
    initial_alpha: Positive = 0.01
    """Initial temperature; 1 in the original, but here rewards are a few centimetres of progress a step."""
    target_entropy_per_action: Annotated[float, Bounds(-1e6, 1e6)] = -1.0
    """Target of the policy's entropy per action: -1 in the original, -0.5 in Brax."""


@dataclasses.dataclass(frozen=True)
class DDPGConfig(OffPolicyConfig):
    """Deep deterministic policy gradient; defaults are the original benchmark's."""

    actor_learning_rate: Positive = 1e-4
    """Adam's step size for the policy."""
    critic_learning_rate: Positive = 1e-3
    """Adam's step size for the critic, and for a shared encoder."""
    tau: Share = 0.05
    """Share of the networks that is mixed into their targets at each target update."""
    target_update_period: AtLeastOne = 5
    """Number of gradient steps between two target updates."""
    num_critics: AtLeastOne = 1
    """Number of critics; the least of their values is the target, the first trains the policy."""
    noise: Literal["ou", "gaussian"] = "ou"
    """Exploration noise: an Ornstein-Uhlenbeck process for each environment, or a new Gaussian in each step."""
    noise_sd: tuple[NotNegative, ...] = (0.2,)
    """Standard deviation that a step adds to the noise: one, or least and largest, spread over environments."""
    noise_damping: Share = 0.15
    """Share of the Ornstein-Uhlenbeck noise that a step removes."""

    def __post_init__(self) -> None:
        super().__post_init__()
        if len(self.noise_sd) not in (1, 2) or tuple(sorted(self.noise_sd)) != self.noise_sd:
            raise ConfigError(f"noise_sd is {self.noise_sd!r}, expected one number, or the least and the largest")


@dataclasses.dataclass(frozen=True)
class CloneConfig(Settings):
    """Behavioural cloning: PPO's policy network learns recorded actions, or a teacher's, by maximum likelihood."""

    demonstrations: str = ""
    """Parquet file that `python -m train.evaluate --demonstrations` wrote."""
    teacher: str = ""
    """Policy that labels the states that the student visits (DAgger): avoider, namo:W, follower, or a run folder."""
    student_share: Share = 1.0
    """Share of control steps that the student drives; the teacher drives the others."""
    buffer_steps: AtLeastOne = 100_000
    """Number of the newest labelled control steps to keep."""
    episodes: Literal["successful", "all"] = "successful"
    """Episodes to learn from."""
    num_envs: AtLeastOne | None = None
    """Number of environments that step together, to score the policy during training."""
    unroll_length: AtLeastOne | None = None
    """Number of steps of every environment between two updates."""
    grad_steps_per_update: AtLeastOne | None = None
    """Number of gradient steps in one update."""
    batch_size: AtLeastOne | None = None
    """Number of recorded steps in a gradient step."""
    learning_rate: Positive = 1e-3
    """Adam's step size."""
    max_grad_norm: Positive = 1.0
    """Global norm to which larger gradients are scaled down."""
    normalize_observations: bool = True
    """Normalise observations by their mean and standard deviation in the file."""
    policy_hidden_layer_sizes: tuple[AtLeastOne, ...] = (256, 256)
    """Widths of the policy network's layers, after its encoder if there are images."""

    IDLE = (
        ("student_share buffer_steps", "a teacher", lambda c: c.teacher),
        ("demonstrations episodes", "no teacher", lambda c: not c.teacher),
    )


@dataclasses.dataclass(frozen=True)
class RunConfig(Settings):
    """The run: how long, from which seed, what is written where."""

    out_dir: str = "runs"
    """Folder of all runs."""
    name: str = ""
    """Folder of this run in out_dir; empty: <config name>-seed<seed>."""
    seed: Seed = 0
    """Random seed of networks, environments and sampling."""
    init: str = ""
    """Run folder (ppo or clone) whose best policy a new run starts with; critic and optimiser are new."""
    curriculum: tuple[NotNegative, NotNegative, Share] = (0.0, 0.0, 0.8)
    """Largest path to the goal at first in m (0: any), largest before any is drawn, and success at which it grows."""
    devices: AtLeastOne = 1
    """Number of devices that share environments and minibatches, with a process per GPU; ppo only."""
    num_timesteps: AtLeastOne = 20_000_000
    """Number of environment steps to train for, rounded up to whole updates."""
    log_every_steps: AtLeastOne = 100_000
    """Number of environment steps between two lines of metrics."""
    checkpoint_every_steps: AtLeastOne = 1_000_000
    """Number of environment steps between two checkpoints."""
    keep_checkpoints: AtLeastOne = 3
    """Number of newest checkpoints to keep; the best one is kept as well."""
    best_metric: str = "ins_0.5"
    """Episode score whose mean between two checkpoints decides which one is best."""
    env_state_limit_mb: NotNegative = 256.0
    """Largest state of environments in MB that checkpoints include; beyond it, resuming starts new episodes."""
    tensorboard: bool = True
    """Write TensorBoard events beside metrics.jsonl."""
    wandb: bool = False
    """Log to Weights & Biases as well (WANDB_MODE=offline keeps it here)."""
    wandb_project: str = "interactive-nav"
    """Project at Weights & Biases."""

    IDLE = (("wandb_project", "wandb true", lambda c: c.wandb),)

    def __post_init__(self) -> None:
        super().__post_init__()
        if self.name:
            check_name(self.name, "name", ConfigError)
        if self.checkpoint_every_steps < self.log_every_steps:
            least = f"expected at least log_every_steps ({self.log_every_steps})"
            raise ConfigError(f"checkpoint_every_steps is {self.checkpoint_every_steps}, {least}")


@dataclasses.dataclass(frozen=True)
class TrainConfig(Settings):
    """All that decides a training run."""

    env: EnvConfig = dataclasses.field(default_factory=EnvConfig)
    """The task."""
    algorithm: Literal[tuple(AUTO)] = "ppo"  # type: ignore[valid-type]
    """Learning algorithm; the section of its name holds its settings."""
    network: NetworkConfig = dataclasses.field(default_factory=NetworkConfig)
    """Encoders of images."""
    ppo: PPOConfig = dataclasses.field(default_factory=PPOConfig)
    """Settings of PPO."""
    sac: SACConfig = dataclasses.field(default_factory=SACConfig)
    """Settings of SAC."""
    ddpg: DDPGConfig = dataclasses.field(default_factory=DDPGConfig)
    """Settings of DDPG."""
    clone: CloneConfig = dataclasses.field(default_factory=CloneConfig)
    """Settings of behavioural cloning."""
    run: RunConfig = dataclasses.field(default_factory=RunConfig)
    """The run."""


def resolve(config: TrainConfig, backend: str) -> TrainConfig:
    """Return the config with the backend named and every None of the learners filled in; raise as `validate` does."""
    sections: dict[str, Any] = {}
    for name, auto in AUTO.items():
        if backend not in auto:
            raise ConfigError(f"env.backend: no automatic sizes for {backend!r}; available: {', '.join(auto)}")
        section = getattr(config, name)
        filled = {key: value for key, value in auto[backend].items() if getattr(section, key) is None}
        sections[name] = dataclasses.replace(section, **filled)
    resolved = dataclasses.replace(config, env=replace(config.env, backend=backend), **sections)
    validate(resolved)
    return resolved


def validate(config: TrainConfig) -> None:
    """Raise `ConfigError` where values exclude each other; what is still None is not looked at."""
    if not config.env.scenes:
        raise ConfigError("env.scenes is empty, expected at least one scene folder: env.scenes=PATH[,PATH...]")
    least_m, (first_m, full_m, _) = config.env.min_goal_distance_m, config.run.curriculum
    if first_m and not (least_m < first_m < full_m and config.run.devices == 1):
        got = f"run.curriculum is {config.run.curriculum}, expected two rising distances above env.min_goal_distance_m"
        raise ConfigError(f"{got} ({least_m}) and a success, with run.devices=1; or leave it out")
    images = any(name in config.env.observations for name in IMAGES)
    for name in ("network", *AUTO):
        section, auto = getattr(config, name), AUTO.get(name, {}).values()
        if images if name == "network" else name == config.algorithm:
            continue
        used = OF_MEMORY if name == "network" and config.network.memory != "none" else ()
        used += ("action_features",) if used and config.algorithm != "ppo" else ()
        used += ("critic_inputs",) * (config.network.critic_inputs == "privileged")
        for field in dataclasses.fields(section):
            value = getattr(section, field.name)
            known = (field.default, *(sizes.get(field.name) for sizes in auto))  # `resolve` fills all sections
            if field.name not in used and value not in known:
                needs = "images among env.observations" if name == "network" else f"algorithm {name}"
                problem = f"{name}.{field.name} is {value!r}, which changes nothing here"
                raise ConfigError(f"{problem}: expected {needs}; or leave it out")
    section, remembers = getattr(config, config.algorithm), config.network.memory != "none"
    for name, value, able in (("memory", "gru", ("ppo", "sac", "ddpg")), ("critic_inputs", "privileged", ("ppo",))):
        if getattr(config.network, name) == value and config.algorithm not in able:
            got = f"network.{name} is {value!r} with algorithm {config.algorithm}"
            raise ConfigError(f"{got}, expected algorithm {' or '.join(able)}; change one of the two")
    if isinstance(section, OffPolicyConfig):
        _validate_replay(config.algorithm, section, config.run.num_timesteps, remembers)
    ppo, devices = config.ppo, config.run.devices
    if devices > 1 and config.algorithm != "ppo":
        got = f"run.devices is {devices}, expected 1 with algorithm {config.algorithm}"
        raise ConfigError(f"{got}: its replay stays on one device; set run.devices=1, or algorithm=ppo")
    for key, value in (("num_envs", ppo.num_envs), ("batch_size", ppo.batch_size)):
        if value and value % devices:
            raise ConfigError(
                f"ppo.{key} is {value}, expected a multiple of run.devices ({devices}), since devices take equal "
                f"shares; take {devices * max(1, value // devices)}"
            )
    collected = (ppo.batch_size or 0) * (ppo.num_minibatches or 0)
    if ppo.num_envs and collected % ppo.num_envs:
        raise ConfigError(
            f"ppo.batch_size * ppo.num_minibatches is {collected} sequences, expected a multiple of "
            f"ppo.num_envs ({ppo.num_envs}); change one of the three"
        )


def _validate_replay(name: str, config: OffPolicyConfig, num_timesteps: int, remembers: bool) -> None:
    for key in () if remembers else ("unroll_length", "burn_in"):
        if (value := getattr(config, key)) != getattr(OffPolicyConfig, key):
            problem = f"{name}.{key} is {value!r}, which changes nothing here"
            raise ConfigError(f"{problem}: expected network.memory 'gru'; or leave it out")
    if config.min_replay_size and config.min_replay_size >= num_timesteps:
        got = f"{name}.min_replay_size is {config.min_replay_size}, expected less than run.num_timesteps"
        raise ConfigError(f"{got} ({num_timesteps}): nothing would be learned")
    if not (config.num_envs and config.min_replay_size and config.max_replay_size and config.steps_per_update):
        return
    slots, sampled = config.replay_slots, config.younger_slots(remembers) + 1
    least = max(sampled, config.steps_per_update, -(-config.min_replay_size // config.num_envs))
    if slots < least:
        raise ConfigError(
            f"{name}.max_replay_size is {config.max_replay_size}, {slots} steps of {config.num_envs} environments, "
            f"expected at least {least * config.num_envs}: it must hold {name}.min_replay_size "
            f"({config.min_replay_size}), one update ({config.steps_per_update} steps) and a sample "
            f"({'burn_in + unroll_length + n_steps' if remembers else 'n_steps + 1'}, {sampled} steps)"
        )
