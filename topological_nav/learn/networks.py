"""Map images to room logits, passage logits and localisation embeddings, and score localisation.

Image batches are u8 [N, H, W, 3] of at least 16 pixels a side. `width` scales every layer of a backbone (the originals
have 64). Batch normalisation and the stem's two halvings follow the originals.
"""

from collections.abc import Mapping
from typing import Any, NamedTuple

import flax.linen as nn
import jax
import jax.numpy as jnp
import numpy as np
from sklearn.metrics import pairwise_distances_argmin

_EPSILON = 1e-6


class ResNet18(nn.Module):
    """Define the ResNet-18 of He et al. 2016, table 1: stem, then four stages of two residual blocks."""

    width: int = 64
    first_stage: int = 2

    @nn.compact
    def __call__(self, x: jax.Array, train: bool) -> tuple[jax.Array, jax.Array]:
        """Return feature maps after conv3_x and the last stage: [N, h, w, 2 width] and [N, h', w', 8 width]."""
        x = _conv(self.width, 7, 2)(x)
        x = nn.relu(_norm(train)(x))
        x = nn.max_pool(x, window_shape=(3, 3), strides=(2, 2), padding="SAME")
        stages = []
        for stage in range(4):
            for block in range(2):
                x = _Block(self.width * 2**stage, 2 if stage and not block else 1)(x, train)
            stages.append(x)
        return stages[self.first_stage - 1], stages[3]


class _Block(nn.Module):
    channels: int
    stride: int

    @nn.compact
    def __call__(self, x: jax.Array, train: bool) -> jax.Array:
        y = nn.relu(_norm(train)(_conv(self.channels, 3, self.stride)(x)))
        y = _norm(train)(_conv(self.channels, 3, 1)(y))
        if x.shape != y.shape:
            x = _norm(train)(_conv(self.channels, 1, self.stride)(x))
        return nn.relu(x + y)


class AlexNet(nn.Module):
    """Define the five convolutions of Krizhevsky 2014 (one column), padded to accept small images."""

    width: int = 64

    @nn.compact
    def __call__(self, x: jax.Array, train: bool) -> tuple[jax.Array, jax.Array]:
        """Return feature maps of the third and the fifth convolution: [N, h, w, 6 width] and [N, h', w', 4 width]."""
        maps = []
        for i, (factor, kernel, stride) in enumerate(((1, 11, 4), (3, 5, 1), (6, 3, 1), (4, 3, 1), (4, 3, 1))):
            x = nn.relu(nn.Conv(factor * self.width, (kernel, kernel), (stride, stride), padding="SAME")(x))
            maps.append(x)
            if i in (0, 1, 4):
                x = nn.max_pool(x, window_shape=(3, 3), strides=(2, 2), padding="SAME")
        return maps[2], x


class Network(nn.Module):
    """Join a backbone and a task's head."""

    task: str
    """passages: an output a length, never more for a longer one; after AlexNet two layers with dropout."""
    backbone: str = "resnet18"
    width: int = 64
    hidden: int = 512
    """Units of each of two layers with leaky ReLU; 0: none."""
    outputs: int = 1
    first_stage: int = 2

    def setup(self) -> None:
        of_resnet = {"first_stage": self.first_stage} if self.backbone == "resnet18" else {}
        self.body = {"resnet18": ResNet18, "alexnet": AlexNet}[self.backbone](self.width, **of_resnet)
        self.drops = self.task == "passages" and self.backbone == "alexnet"
        units = 64 * self.width if self.drops else self.hidden
        self.layers = [nn.Dense(units), nn.Dense(units)] if units else []
        self.drop = nn.Dropout(0.5)
        self.last = nn.Dense(self.outputs)

    def __call__(self, images: jax.Array, train: bool = False) -> jax.Array:
        """Return logits [N, outputs]; those of passages never increase."""
        _, x = self.body(normalised(images), train)
        x = x.reshape(len(x), -1) if self.backbone == "alexnet" else x.mean((1, 2))
        for layer in self.layers:
            x = nn.relu(layer(self.drop(x, deterministic=not train))) if self.drops else nn.leaky_relu(layer(x))
        x = self.last(x)
        return falling(x) if self.task == "passages" else x

    def embed(self, images: jax.Array) -> jax.Array:
        """Return [N, D] f32: both feature maps max-pooled over space, scaled to unit length and concatenated."""
        return joined(self.body(normalised(images), False))


def falling(x: jax.Array) -> jax.Array:
    """Map [N, L] to decreasing logits by softplus of the differences: a path free to 2 m is free to 1 m."""
    return x[:, :1] - jnp.cumsum(jnp.pad(nn.softplus(x[:, 1:]), ((0, 0), (1, 0))), axis=1)


def joined(maps: tuple[jax.Array, jax.Array]) -> jax.Array:
    """Join feature maps [N, h, w, c1] and [N, h', w', c2] to an embedding [N, c1 + c2] of length sqrt(2)."""
    parts = [m.max((1, 2)) for m in maps]
    return jnp.concatenate([p / jnp.maximum(jnp.linalg.norm(p, axis=-1, keepdims=True), _EPSILON) for p in parts], -1)


def normalised(images: jax.Array) -> jax.Array:
    """Scale grey levels 0 to 255 (u8 or f32) to f32 about 0."""
    return (images.astype(jnp.float32) / 255.0 - 0.5) / 0.25


def augmented(key: jax.Array, images: jax.Array, flip: bool) -> jax.Array:
    """Vary brightness, contrast, colour and shift of each of the images [N, H, W, 3] u8; return f32, 0 to 255."""
    n, height, width, _ = images.shape
    key_gain, key_offset, key_shift, key_flip = jax.random.split(key, 4)
    x = images.astype(jnp.float32)
    gain = jax.random.uniform(key_gain, (n, 2, 1, 3), minval=0.8, maxval=1.25)
    mean = x.mean((1, 2, 3), keepdims=True)
    offset = jax.random.uniform(key_offset, (n, 1, 1, 1), minval=-20.0, maxval=20.0)
    x = (x - mean) * gain[:, :1, :, :1] + mean * gain[:, 1:] + offset
    dy, dx = max(height // 16, 1), max(width // 16, 1)
    padded = jnp.pad(x, ((0, 0), (dy, dy), (dx, dx), (0, 0)), mode="edge")
    places = jnp.broadcast_to(jnp.asarray([2 * dy + 1, 2 * dx + 1]), (n, 2))
    at = jax.random.randint(key_shift, (n, 2), 0, places)
    x = jax.vmap(lambda p, a: jax.lax.dynamic_slice(p, (a[0], a[1], 0), (height, width, 3)))(padded, at)
    if flip:
        x = jnp.where(jax.random.bernoulli(key_flip, 0.5, (n, 1, 1, 1)), x[:, :, ::-1], x)
    return jnp.clip(x, 0.0, 255.0)


def _conv(channels: int, kernel: int, stride: int) -> Any:
    pad = [(kernel // 2, kernel // 2)] * 2
    return nn.Conv(channels, (kernel, kernel), (stride, stride), pad, use_bias=False)


def _norm(train: bool) -> Any:
    return nn.BatchNorm(use_running_average=not train, momentum=0.9, epsilon=1e-5)


def in_words(scores: Mapping[str, float]) -> str:
    """Format scores of `localisation_scores`, or means of them."""
    return (
        f"nearest node {scores['node']:.3f}, right room {scores['room']:.3f}, "
        f"median error {scores['error_m']:.2f} m (least possible {scores['least_error_m']:.2f} m)"
    )


def nearest_turn(angle_rad: np.ndarray, count: int) -> np.ndarray:
    """Return the index [...] of the heading nearest to each angle; headings start at the world's x axis."""
    return np.rint(angle_rad / (2 * np.pi) * count).astype(int) % count


class Places(NamedTuple):
    """Group embeddings [N, K, D] of K images at each of N places, their positions [N, 2] (m) and rooms [N]."""

    embeddings: np.ndarray
    xy_w: np.ndarray
    room: np.ndarray


def localisation_scores(queries: Places, nodes: Places) -> dict[str, float]:
    """Score localisation of queries in one scene by the nearest embedding among all images of all nodes.

    `node` is the share of queries assigned to the truly nearest node, `room` to a node of the same room. `error_m` is
    the median distance to the assigned node, `least_error_m` to the truly nearest.
    """
    each = queries.embeddings.shape[1]
    xy_w, room = np.repeat(queries.xy_w, each, 0), np.repeat(queries.room, each)
    # In double precision: images of neighbouring nodes differ by less than single precision loses here.
    looked, shown = (of.embeddings.reshape(-1, of.embeddings.shape[-1]).astype(float) for of in (queries, nodes))
    node = pairwise_distances_argmin(looked, shown) // nodes.embeddings.shape[1]
    away = np.linalg.norm(xy_w[:, None] - nodes.xy_w, axis=-1)
    return {
        "node": float((node == away.argmin(1)).mean()),
        "room": float((nodes.room[node] == room).mean()),
        "error_m": float(np.median(away[np.arange(len(node)), node])),
        "least_error_m": float(np.median(away.min(1))),
    }
