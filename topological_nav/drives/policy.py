"""Embeddings in, classes of velocities out: the local policy's two memories, its forward model and their loss."""

from collections.abc import Mapping
from typing import Any

import flax.linen as nn
import jax
import jax.numpy as jnp
import optax

from topological_nav.learn.learning import initial

Memory = tuple[jax.Array, jax.Array]
"""Hidden states [B, H] of the cell for linear and of the one for angular velocity."""


class SummedCell(nn.Module):
    """A GRU cell (Cho et al. 2014, with the reset gate after the product) whose gates read a sum of memories.

    With the input x, the sum s and its own memory h: r, z = sigmoid(W x + U s + b) and n = tanh(V x + c + r (Q s + d))
    make the new memory (1 - z) n + z h. What it keeps is its own, so that memories stay within (-1, 1).
    """

    hidden: int

    @nn.compact
    def __call__(self, hidden: jax.Array, total: jax.Array, x: jax.Array) -> jax.Array:
        """[B, H] memory, [B, H] sum and [B, D] input to the new memory [B, H]."""
        from_x = jnp.split(nn.Dense(3 * self.hidden, name="inputs")(x), 3, -1)
        from_total = jnp.split(nn.Dense(3 * self.hidden, name="memory")(total), 3, -1)
        reset, keep = (nn.sigmoid(a + b) for a, b in zip(from_x[:2], from_total[:2], strict=True))
        new = nn.tanh(from_x[2] + reset * from_total[2])
        return (1.0 - keep) * new + keep * hidden


class Policy(nn.Module):
    """One cell for each velocity; both read the sum of both memories."""

    hidden: int = 500
    projection: int = 0
    linear_classes: int = 3
    angular_classes: int = 5

    def setup(self) -> None:
        """Makes the parts; flax calls it."""
        self.project = nn.Dense(self.projection) if self.projection else None
        self.cells = [SummedCell(self.hidden), SummedCell(self.hidden)]
        self.heads = [nn.Dense(self.linear_classes), nn.Dense(self.angular_classes)]

    def __call__(self, memory: Memory, x: jax.Array) -> tuple[Memory, tuple[jax.Array, jax.Array]]:
        """One control step.

        Args:
            x: [B, D] standardised embeddings.

        Returns:
            The memory after it, and logits of the linear [B, L] and the angular classes [B, A].
        """
        if self.project is not None:
            x = nn.relu(self.project(x))
        total = memory[0] + memory[1]
        new = tuple(cell(hidden, total, x) for cell, hidden in zip(self.cells, memory, strict=True))
        return new, tuple(head(h) for head, h in zip(self.heads, new, strict=True))  # type: ignore[return-value]

    def fresh(self, batch: int) -> Memory:
        """The memory at the beginning of a run."""
        return jnp.zeros((batch, self.hidden)), jnp.zeros((batch, self.hidden))


class Forward(nn.Module):
    """What the next embedding will be after an action: two layers that say how it changes."""

    hidden: int = 512

    @nn.compact
    def __call__(self, u: jax.Array, x: jax.Array, action: jax.Array, deviation: jax.Array) -> jax.Array:
        """[..., D].

        Args:
            u: [..., D] embeddings.
            x: [..., D] the same, standardised.
            action: [..., L + A] one-hot classes, or probabilities of them, linear then angular.
            deviation: [D] unit in which changes are told.
        """
        y = jnp.concatenate([x, action], -1)
        for _ in range(2):
            y = nn.relu(nn.Dense(self.hidden)(y))
        return u + jnp.broadcast_to(deviation, u.shape) * nn.Dense(u.shape[-1])(y)


def standardised(u: jax.Array, scale: dict[str, jax.Array]) -> jax.Array:
    """Embeddings [..., D] about their `mean` [D], in units of their `deviation` [D]."""
    mean, deviation = (jnp.broadcast_to(scale[name], u.shape) for name in ("mean", "deviation"))
    return (u - mean) / deviation


def unrolled(policy: Policy, params: Any, x: jax.Array) -> tuple[jax.Array, jax.Array]:
    """Logits [B, T, L] and [B, T, A] of runs of standardised embeddings [B, T, D], each begun with a fresh memory."""

    def step(memory, now):
        return policy.apply({"params": params}, memory, now)

    _, logits = jax.lax.scan(step, policy.fresh(len(x)), x.swapaxes(0, 1))
    return tuple(value.swapaxes(0, 1) for value in logits)  # type: ignore[return-value]


def mean_over(values: jax.Array, mask: jax.Array) -> jax.Array:
    """[] mean of values where the mask is true, 0 where it nowhere is."""
    return jnp.where(mask, values, 0.0).sum() / jnp.maximum(mask.sum(), 1)


def policy_loss(
    logits: tuple[jax.Array, jax.Array],
    truth: Mapping[str, jax.Array],
    guesses: tuple[jax.Array, jax.Array],
    following: jax.Array,
    alpha: jax.Array | float,
    lam: jax.Array | float,
    jointly: jax.Array | float = 1.0,
) -> tuple[jax.Array, dict[str, jax.Array]]:
    """alpha (CE_angular + CE_linear) + |u - f(u, a)|^2 + lambda |u - f(u, a_hat)|^2, means over steps.

    Args:
        logits: [B, T, L] and [B, T, A] of the policy.
        truth: `linear`, `angular` (the expert's classes), `valid` and `followed` of `sequences.Sequences`.
        guesses: [B, T, D] each: f(u, a), from the expert's action a, and f(u, a_hat), from the policy's.
        following: [B, T, D] u, the embedding of the next step.
        jointly: 0 leaves the forward model's own error alone.

    Returns:
        The loss, and its parts by name: ce_linear, ce_angular, forward, consistency.
    """
    cross = [
        mean_over(optax.softmax_cross_entropy_with_integer_labels(one, truth[name]), truth["valid"])
        for one, name in zip(logits, ("linear", "angular"), strict=True)
    ]
    forward, consistency = (mean_over(jnp.square(following - u).sum(-1), truth["followed"]) for u in guesses)
    loss = forward + jointly * (alpha * (cross[1] + cross[0]) + lam * consistency)
    return loss, {"ce_linear": cross[0], "ce_angular": cross[1], "forward": forward, "consistency": consistency}


def fresh_params(policy: Policy, forward: Forward, width: int, seed: int) -> dict[str, Any]:
    """First weights of policy and forward model for embeddings of `width` numbers; the latter predicts no change."""
    key, u = jax.random.PRNGKey(0), jax.ShapeDtypeStruct((1, width), jnp.float32)
    action = jax.ShapeDtypeStruct((1, policy.linear_classes + policy.angular_classes), jnp.float32)
    shapes = {
        "policy": jax.eval_shape(lambda k, x: policy.init(k, policy.fresh(1), x), key, u)["params"],
        "forward": jax.eval_shape(lambda k, x, a: forward.init(k, x, x, a, x[0]), key, u, action)["params"],
    }
    params = initial(shapes, seed)
    last = params["forward"]["Dense_2"]
    params["forward"]["Dense_2"] = {**last, "kernel": jnp.zeros_like(last["kernel"])}
    return params
