"""Call functions of whole batches for one element: any number of `vmap`s becomes one call with all elements."""

from collections.abc import Callable
from typing import Any

import jax
import jax.numpy as jnp
from jax import custom_batching


def _flatten(tree: Any, outer: int, inner: int) -> Any:
    return jax.tree.map(lambda x: x.reshape((outer * inner, *x.shape[2:])), tree)


def _broadcast(tree: Any, batched: Any, size: int) -> Any:
    return jax.tree.map(lambda x, b: x if b else jnp.broadcast_to(x, (size, *x.shape)), tree, batched)


def _many(batch: Callable[..., Any], args: tuple) -> Any:
    @custom_batching.custom_vmap
    def many(*args):
        return batch(*args)

    @many.def_vmap
    def rule(axis_size, in_batched, *args):
        args = _broadcast(args, tuple(in_batched), axis_size)
        inner = jax.tree.leaves(args)[0].shape[1]
        out = _many(batch, _flatten(args, axis_size, inner))
        out = jax.tree.map(lambda x: x.reshape((axis_size, inner, *x.shape[1:])), out)
        return out, jax.tree.map(lambda _: True, out)

    return many(*args)


def one_of_batch(batch: Callable[..., Any], args: tuple) -> Any:
    """Return a batch function's result for one element; vmaps of it call the batch function once, with all elements."""

    @custom_batching.custom_vmap
    def single(*args):
        return jax.tree.map(lambda x: x[0], _many(batch, jax.tree.map(lambda x: x[None], args)))

    @single.def_vmap
    def rule(axis_size, in_batched, *args):
        out = _many(batch, _broadcast(args, tuple(in_batched), axis_size))
        return out, jax.tree.map(lambda _: True, out)

    return single(*args)
