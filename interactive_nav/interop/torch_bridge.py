"""Convert JAX arrays and PyTorch tensors into one another through DLPack, which shares the memory.

Both sides then look at the same bytes on the same device. JAX takes its arrays to be constant, so write into
a tensor that came from JAX only after `clone()`, and into one that was handed to JAX not at all.
"""

from typing import Any

import jax
import jax.numpy as jnp

from interactive_nav_common.errors import ConfigError, optional

MISSING = "PyTorch is not installed; follow https://pytorch.org/get-started"


def to_torch(tree: Any) -> Any:
    """Convert JAX arrays to PyTorch tensors on the same device, without a copy.

    Args:
        tree: an array, or any pytree of arrays (dictionaries, tuples, flax structs).

    Returns:
        The same structure with a tensor for each JAX array; other leaves are left alone.

    Raises:
        MissingPackage: PyTorch is not installed.
    """
    torch = optional("torch", MISSING)
    return jax.tree.map(lambda x: torch.from_dlpack(x) if isinstance(x, jax.Array) else x, tree)


def to_jax(tree: Any) -> Any:
    """Convert PyTorch tensors to JAX arrays on the same device, without a copy.

    Tensors must be contiguous (others are copied into it) and carry no gradient: detach them. JAX
    copies a CPU tensor whose memory is not aligned to 64 bytes, such as a slice.

    Args:
        tree: a tensor, or any pytree of tensors.

    Returns:
        The same structure with a JAX array for each tensor; other leaves are left alone.

    Raises:
        MissingPackage: PyTorch is not installed.
        ConfigError: a tensor that requires a gradient.
    """
    torch = optional("torch", MISSING)

    def convert(x: Any) -> Any:
        if not isinstance(x, torch.Tensor):
            return x
        if x.requires_grad:
            raise ConfigError(
                f"tensor of shape {tuple(x.shape)} requires a gradient, expected a detached one: .detach()"
            )
        return jnp.from_dlpack(x.contiguous())

    return jax.tree.map(convert, tree)
