"""Build actor and critic networks for the shapes of observations, as Brax's losses take them.

Vectors go through Brax's multi-layer perceptrons. With images the networks are the original benchmark's (reference
benchmark, section 8.1): images stacked as channels into three convolutions, the vector into a separate layer, both
concatenated, then the head. An action enters a critic through a separate layer. Their parameters are `{"encoder": ...,
"head": ...}`, so that learners can share the encoder: a `Split` holds both. Images are u8 (divided by 255 here) or
floats in [-1, 1]; only the vector is normalised.
"""

import dataclasses
import functools
from collections.abc import Callable, Mapping, Sequence
from typing import Any

import jax
import jax.numpy as jnp
from brax.training import distribution
from brax.training.acme import running_statistics, specs
from brax.training.agents.ppo import networks as ppo_networks
from brax.training.networks import FeedForwardNetwork, make_policy_network, make_value_network
from flax import linen

from interactive_nav.task.privileged import PRIVILEGED, without_privileged
from interactive_nav_common.errors import ConfigError
from train.config import NetworkConfig

ObservationSize = int | Mapping[str, tuple[int, ...]]
"""Length of the vector, or with images the shape under each key (`interactive_nav.sensing.sensors`)."""
PIXELS = "pixels/"
GLOROT = jax.nn.initializers.glorot_uniform()


def critic_output_init(key: jax.Array, shape: Sequence[int], dtype: Any = jnp.float32) -> jax.Array:
    """Draw uniformly within 0.003: a new critic predicts about nothing (reference benchmark, section 8.1)."""
    return jax.random.uniform(key, tuple(shape), dtype, -0.003, 0.003)


def vector_part(observation: Any) -> Any:
    """Return what is normalised of an observation: the vector itself, or the dict without its images."""
    observation = without_privileged(observation)
    if not isinstance(observation, Mapping):
        return observation
    return {name: value for name, value in observation.items() if not name.startswith(PIXELS)}


def init_normalizer(size: ObservationSize) -> running_statistics.RunningStatisticsState:
    """Return the running mean and deviation of the vector part before any observation."""
    sizes = vector_part(size) if isinstance(size, Mapping) else {"": (size,)}
    arrays: Any = {name: specs.Array(tuple(shape), jnp.dtype("float32")) for name, shape in sizes.items()}
    return running_statistics.init_state(arrays if isinstance(size, Mapping) else arrays[""])


def update_normalizer(
    statistics: running_statistics.RunningStatisticsState, observation: Any
) -> running_statistics.RunningStatisticsState:
    """Return the statistics after a batch of observations [..., N]."""
    with jax.numpy_rank_promotion("allow"):  # Brax's statistics promote
        return running_statistics.update(statistics, vector_part(observation))


def normalize(observation: Any, statistics: running_statistics.RunningStatisticsState) -> Any:
    """Return the policy's part of an observation with its vector normalised; images pass."""
    observation = without_privileged(observation)
    with jax.numpy_rank_promotion("allow"):  # as above
        part = running_statistics.normalize(vector_part(observation), statistics)  # type: ignore[arg-type]
    return {**observation, **part} if isinstance(observation, Mapping) else part  # type: ignore[dict-item]


def preprocess(enabled: bool) -> Callable[[Any, Any], Any]:
    """Return `normalize`, or a function that only takes the policy's part."""
    return normalize if enabled else lambda observation, _: without_privileged(observation)


def conv_as_product(images: jax.Array, kernel: jax.Array, strides: Sequence[int]) -> jax.Array:
    """Return the convolution of [N, H, W, C] without padding by [k, k, C, F], as one product of matrices."""
    k, step = kernel.shape[0], strides[0]
    height, width = ((size - k) // step * step + 1 for size in images.shape[1:3])
    parts = [images[:, i : i + height : step, j : j + width : step] for i in range(k) for j in range(k)]
    return jnp.concatenate(parts, -1) @ kernel.reshape(-1, kernel.shape[-1])


@functools.partial(jax.custom_vjp, nondiff_argnums=(2,))
def conv_for_cpu(images: Any, kernel: Any, strides: tuple[int, ...]) -> Any:
    """Return the same, as the product where gradients are wanted and by XLA where not. On a CPU within a loop, where
    learners learn and act, XLA's gradients take 20 to 30 times as long, the product 3 times as long as XLA's values."""
    return jax.lax.conv_general_dilated(images, kernel, strides, "VALID", dimension_numbers=("NHWC", "HWIO", "NHWC"))


def _as_product(images: Any, kernel: Any, strides: tuple[int, ...]) -> Any:
    return jax.vjp(lambda images, kernel: conv_as_product(images, kernel, strides), images, kernel)


conv_for_cpu.defvjp(_as_product, lambda _, back, by_result: back(by_result))


def conv_in_blocks(images: jax.Array, kernel: jax.Array, strides: Sequence[int], *_: Any, **__: Any) -> jax.Array:
    """Return the `VALID` convolution of [N, H, W, C] and [K, K, C, F], for GPUs.

    Tensor cores process channels by eights, so images of fewer become blocks: a stride's pixels become one pixel with
    more channels, and the stride 1. Only the order of the sums differs.
    """
    k, step, channels = kernel.shape[0], strides[0], images.shape[-1]
    dimensions = ("NHWC", "HWIO", "NHWC")
    if channels % 8 == 0 or step == 1:
        return jax.lax.conv_general_dilated(images, kernel, strides, "VALID", dimension_numbers=dimensions)
    blocks = -(-k // step)
    high, wide = ((side - k) // step + blocks for side in images.shape[1:3])
    images = images[:, : high * step, : wide * step]
    short = [(0, 0), *((0, n * step - side) for n, side in zip((high, wide), images.shape[1:3], strict=True)), (0, 0)]
    images = jnp.pad(images, short).reshape(-1, high, step, wide, step, channels).swapaxes(2, 3)
    kernel = jnp.pad(kernel, [(0, blocks * step - k)] * 2 + [(0, 0)] * 2)
    kernel = kernel.reshape(blocks, step, blocks, step, channels, -1).swapaxes(1, 2)
    images, kernel = (
        images.reshape(-1, high, wide, step**2 * channels),
        kernel.reshape(blocks, blocks, -1, kernel.shape[-1]),
    )
    return jax.lax.conv_general_dilated(images, kernel, (1, 1), "VALID", dimension_numbers=dimensions)


class ImageEncoder(linen.Module):
    """Encode images [..., H, W, C] as features [..., F]."""

    config: NetworkConfig

    @linen.compact
    def __call__(self, images: jax.Array) -> jax.Array:
        c = self.config
        dtype = jnp.dtype(c.compute_dtype)
        x = images.astype(dtype)

        def for_cpu(images: jax.Array, kernel: jax.Array, strides: Sequence[int], *_: Any, **__: Any) -> jax.Array:
            return conv_for_cpu(images, kernel, tuple(strides))

        by = for_cpu if jax.default_backend() == "cpu" else conv_in_blocks
        for channels, kernel, stride in zip(c.conv_channels, c.conv_kernels, c.conv_strides, strict=True):
            settings: Any = {"kernel_init": GLOROT, "dtype": dtype, "conv_general_dilated": by}
            x = linen.relu(linen.Conv(channels, (kernel,) * 2, stride, "VALID", **settings)(x))
        x = x.reshape((*x.shape[:-3], -1))
        x = linen.relu(linen.Dense(c.image_features, kernel_init=GLOROT, dtype=dtype)(x))
        return x.astype(jnp.float32)


class Encoder(linen.Module):
    """Encode a dict observation: images and vector each through separate layers, concatenated."""

    config: NetworkConfig
    images: bool = True
    """False: the vector alone."""

    @linen.compact
    def __call__(self, observation: Mapping[str, jax.Array]) -> jax.Array:
        parts = []
        pixels = [observation[name] for name in sorted(observation) if name.startswith(PIXELS)]
        # One of them may be u8 and another not.
        dtype = jnp.dtype(self.config.compute_dtype)
        pixels = [x.astype(dtype) / 255 if x.dtype == jnp.uint8 else x.astype(dtype) for x in pixels]
        if self.images:
            parts.append(ImageEncoder(self.config, name="image")(jnp.concatenate(pixels, -1)))
        if "state" in observation:
            dense = linen.Dense(self.config.state_features, kernel_init=GLOROT, name="state")
            parts.append(linen.relu(dense(observation["state"])))
        return jnp.concatenate(parts, -1)


class Head(linen.Module):
    """Map features, and for a critic of actions the action, to outputs."""

    layer_sizes: Sequence[int]
    outputs: int
    action_features: int = 0
    output_init: Callable[..., Any] = GLOROT
    layer_norm: bool = False

    @linen.compact
    def __call__(self, features: jax.Array, action: jax.Array | None = None) -> jax.Array:
        x = features
        if action is not None:
            dense = linen.Dense(self.action_features, kernel_init=GLOROT, name="action")
            x = jnp.concatenate([x, linen.relu(dense(action))], -1)
        for i, size in enumerate(self.layer_sizes):
            x = linen.relu(linen.Dense(size, kernel_init=GLOROT, name=f"hidden_{i}")(x))
            x = linen.LayerNorm()(x) if self.layer_norm else x
        return linen.Dense(self.outputs, kernel_init=self.output_init, name="output")(x)


class TwinHead(linen.Module):
    """Evaluate independent critics side by side: [..., critics]."""

    layer_sizes: Sequence[int]
    action_features: int
    critics: int = 2
    layer_norm: bool = False

    @linen.compact
    def __call__(self, features: jax.Array, action: jax.Array) -> jax.Array:
        heads = [
            Head(self.layer_sizes, 1, self.action_features, critic_output_init, self.layer_norm, name=f"critic_{i}")
            for i in range(self.critics)
        ]
        return jnp.concatenate([head(features, action) for head in heads], -1)


@dataclasses.dataclass
class Split(FeedForwardNetwork):
    """A network in two parts, with parameters `{"encoder": ..., "head": ...}`."""

    encoder: FeedForwardNetwork
    """init(key), apply(normalizer, params, observation) -> features [..., F]."""
    head: FeedForwardNetwork
    """init(key), apply(None, params, features, *action)."""
    remember: Callable[[Any, jax.Array, jax.Array], jax.Array] | None = None
    """(encoder's params, memory [N, H], features [N, F]) -> new memory [N, H], which the head takes for features; None:
    the network has no memory. With memory, `encoder` gives what goes into it, and `apply` takes no memory along."""


def make_split(
    config: NetworkConfig,
    size: ObservationSize,
    images: bool,
    prepare: Callable[[Any, Any], Any],
    head: linen.Module,
    action_size: int = 0,
    squeeze: bool = False,
) -> Split:
    """Build an encoder with a head behind it."""
    if not isinstance(size, Mapping):
        vector, size = prepare, {"state": (size,)}
        prepare = lambda observation, statistics: {"state": vector(observation, statistics)}  # noqa: E731
    sides = {shape[0] for name, shape in size.items() if name.startswith(PIXELS)}
    if len(sides) > 1:
        raise ConfigError(f"images have sides of {sorted(sides)} pixels, expected one of all cameras (env.cameras)")
    for side in sides:
        left = side
        for kernel, stride in zip(config.conv_kernels, config.conv_strides, strict=True):
            left = (left - kernel) // stride + 1
        if left < 1:
            raise ConfigError(
                f"images of {side} x {side} pixels are too small for kernels {config.conv_kernels} with strides "
                f"{config.conv_strides}; expected larger images (env.image_size) or smaller kernels (network)"
            )
    if not images and "state" not in size:
        raise ConfigError(
            "network.critic_inputs is 'state', but the observation holds images only; expected 'all', or "
            "observations with a vector (env.observations=waypoints,goal,velocity,depth,...)"
        )
    module, zeros = Encoder(config, images), {name: jnp.zeros((1, *shape)) for name, shape in size.items()}
    features = jnp.zeros((1, images * config.image_features + ("state" in size) * config.state_features))
    remembers, memory = config.memory == "gru", jnp.zeros((1, config.memory_size))
    cell = linen.GRUCell(config.memory_size)
    read = memory if remembers else features
    inputs = (read, jnp.zeros((1, action_size))) if action_size else (read,)

    def encode(statistics: Any, params: Any, observation: Any) -> Any:
        return module.apply(params["features"] if remembers else params, prepare(observation, statistics))

    def remember(params: Any, memory: jax.Array, features: jax.Array) -> jax.Array:
        new, _ = cell.apply(params["memory"], memory, features)
        return new

    def first_encoder(key: jax.Array) -> Any:
        if not remembers:
            return module.init(key, zeros)
        key_features, key_memory = jax.random.split(key)
        return {"features": module.init(key_features, zeros), "memory": cell.init(key_memory, memory, features)}

    def decide(_: Any, params: Any, features: jax.Array, *action: jax.Array) -> jax.Array:
        out = head.apply(params, features, *action)
        assert isinstance(out, jax.Array)
        return out[..., 0] if squeeze else out

    # Each init as one program, not one for each operation.
    init_encoder, init_head = jax.jit(first_encoder), jax.jit(lambda key: head.init(key, *inputs))

    def init(key: jax.Array) -> dict[str, Any]:
        key_encoder, key_head = jax.random.split(key)
        return {"encoder": init_encoder(key_encoder), "head": init_head(key_head)}

    def apply(statistics: Any, params: Any, observation: Any, *action: jax.Array) -> jax.Array:
        return decide(None, params["head"], encode(statistics, params["encoder"], observation), *action)

    parts = FeedForwardNetwork(init_encoder, encode), FeedForwardNetwork(init_head, decide)
    return Split(init, apply, *parts, remember if remembers else None)


def _behind(prepare: Callable[[Any, Any], jax.Array], network: FeedForwardNetwork) -> FeedForwardNetwork:
    """Return Brax's network of vectors behind `prepare`; Brax itself takes dicts only with statistics of each part."""

    def apply(statistics: Any, params: Any, observation: Any) -> Any:
        return network.apply(None, params, prepare(observation, statistics))

    return FeedForwardNetwork(network.init, apply)


def make_ppo_networks(
    config: NetworkConfig,
    size: ObservationSize,
    action_size: int,
    policy_sizes: Sequence[int],
    value_sizes: Sequence[int],
    normalize_observations: bool,
    privileged_size: int = 0,
) -> ppo_networks.PPONetworks:
    """Build policy (mean and deviation of a Gaussian before tanh) and value network; `Split`s with images or memory.

    `size` is that of the policy's observation. If `privileged_size` is above 0, the critic takes the vector and the
    true state.
    """
    of_policy, images = preprocess(normalize_observations), isinstance(size, Mapping)
    of_critic, critic_size, critic_images = of_policy, size, images and config.critic_inputs == "all"
    if privileged_size:

        def true_state(observation: Any, statistics: Any) -> jax.Array:
            vector = vector_part(of_policy(observation, statistics))
            return jnp.concatenate([*jax.tree.leaves(vector), observation[PRIVILEGED]], -1)

        of_critic, critic_images = true_state, False
        critic_size = privileged_size + (size.get("state", (0,))[0] if isinstance(size, Mapping) else size)

    actions = distribution.NormalTanhDistribution(event_size=action_size)
    if not images and config.memory == "none":
        # As Brax's PPO builds them.
        actor = make_policy_network(actions.param_size, size, hidden_layer_sizes=policy_sizes, activation=linen.swish)
        critic = make_value_network(critic_size, hidden_layer_sizes=value_sizes, activation=linen.swish)
        policy, value = _behind(of_policy, actor), _behind(of_critic, critic)
    else:
        policy = make_split(config, size, images, of_policy, Head(policy_sizes, actions.param_size))
        value_head = Head(value_sizes, 1, output_init=critic_output_init)
        value = make_split(config, critic_size, critic_images, of_critic, value_head, squeeze=True)
    return ppo_networks.PPONetworks(policy, value, actions)  # type: ignore[call-arg]
