"""Write and read weights as safetensors: tensors by names such as `params/Dense_0/kernel`, and JSON about them.

The metadata has one entry, `about`: a mapping with `format`, `commit`, `digest` (see `digest_of`) and what the writer
adds, such as `task` or `observations`. Rounded weights are read back as f32; `.safetensors.xz` is the same, packed.
"""

import hashlib
import json
import lzma
import zlib
from collections.abc import Callable, Iterable, Mapping
from pathlib import Path
from typing import Any, TypeVar

import flax.serialization
import jax
import jax.numpy as jnp
import numpy as np
import safetensors.numpy
from flax.traverse_util import empty_node, flatten_dict, unflatten_dict

from interactive_nav_common.errors import FileError, UserError, readable
from interactive_nav_common.files import whole_file
from interactive_nav_common.untrusted import reading
from interactive_nav_common.versions import commit

Tensors = Mapping[str, Any]
"""Name -> array."""
Tree = TypeVar("Tree")
FORMAT, ABOUT = 1, "about"
SCALE, SHAPE = ":scale", ":shape"
"""End the names of what restores a rounded tensor: factors of its last axis, and the shape that its codes stand for."""
LARGE = 4_000
"""Policies round matrices with at least so many numbers; smaller ones are stored in half precision."""
_LEVELS = 127
_XZ = [{"id": lzma.FILTER_LZMA2, "preset": 9, "lc": 0, "lp": 1, "pb": 1}]
"""Models the two bytes of a number in half precision apart, which makes the file a seventh smaller."""


def flat(tree: Any) -> dict[str, Any]:
    """Return the arrays of a tree by their names; nodes without arrays are left out."""
    return flatten_dict(flax.serialization.to_state_dict(tree), sep="/")


def digest_of(tensors: Tensors) -> str:
    """Return the SHA-256 of the names, types, shapes and values."""
    sha256 = hashlib.sha256()
    for name, tensor in sorted(tensors.items()):
        array = np.asarray(tensor)
        sha256.update(f"{name} {array.dtype.str} {array.shape}\n".encode() + array.tobytes())
    return sha256.hexdigest()


def half(tensors: Tensors) -> dict[str, np.ndarray]:
    """Return floating-point tensors of two or more axes in half precision, the others as they are."""
    out = {name: np.asarray(tensor) for name, tensor in tensors.items()}
    for name, array in out.items():
        if array.ndim >= 2 and np.issubdtype(array.dtype, np.floating):
            with np.errstate(over="ignore"):
                out[name] = array.astype(np.float16)
            if not np.isfinite(out[name]).all():
                raise FileError(f"{name} holds {np.abs(array).max():.3g}, more than fp16 can; train again")
    return out


def rounded(tensors: Tensors, step: float, least: int = LARGE) -> dict[str, np.ndarray]:
    """Return matrices with at least `least` numbers as Huffman codes (u8) of i8, others as `half` does.

    Rounding is to multiples of `step` standard deviations of each output's weights, but not finer than 127 levels on
    either side. Rounded weights hold no repetitions, which is all that zip's methods would add: those take a tenth
    more.
    """
    out = {name: np.asarray(tensor) for name, tensor in tensors.items()}
    large = {n: x for n, x in out.items() if x.ndim >= 2 and x.size >= least and np.issubdtype(x.dtype, np.floating)}
    out = half({name: array for name, array in out.items() if name not in large})
    for name, array in large.items():
        inputs = tuple(range(array.ndim - 1))
        scale = np.maximum(step * array.std(inputs), np.abs(array).max(inputs) / _LEVELS).astype(np.float32)
        scale[scale == 0] = 1.0
        coder = zlib.compressobj(9, strategy=zlib.Z_HUFFMAN_ONLY)
        codes = coder.compress(np.rint(array / scale).astype(np.int8).tobytes()) + coder.flush()
        out[name], out[name + SCALE] = np.frombuffer(codes, np.uint8), scale
        out[name + SHAPE] = np.array(array.shape, np.int32)
    return out


def _restored(stored: Tensors) -> dict[str, np.ndarray]:
    """Return the tensors that `rounded` was given, to within half a scale."""
    out = {name: array for name, array in sorted(stored.items()) if not name.endswith((SCALE, SHAPE))}
    for name in out:
        if name + SHAPE in stored:
            codes = out[name].tobytes()  # of at least a bit each
            levels = np.frombuffer(reading.unpack(codes, "zlib", 8 * len(codes)), np.int8).reshape(stored[name + SHAPE])
            out[name] = np.multiply(levels, stored[name + SCALE], out=np.empty(levels.shape, np.float32))
    return out


def write_weights(path: Path, tensors: Tensors, about: Mapping[str, Any]) -> dict[str, Any]:
    """Write tensors, rounded or not, and return what the file says about them."""
    arrays = {name: np.asarray(tensor, order="C") for name, tensor in tensors.items()}
    header = {"format": FORMAT, "commit": about.get("commit") or commit(), **about, "digest": digest_of(arrays)}
    content = safetensors.numpy.save(arrays, {ABOUT: json.dumps(header)})
    with whole_file(path) as partial:
        partial.write_bytes(lzma.compress(content, filters=_XZ) if path.suffix == ".xz" else content)
    return header


def read_weights(path: Path, kind: type[UserError], remedy: str) -> tuple[dict[str, np.ndarray], dict[str, Any]]:
    """Return the tensors of a file and its header; raise `kind` with one line if the file cannot be used."""
    with readable(path, kind, remedy, " as safetensors"):
        size = path.stat().st_size
        if size > reading.MOST_ARRAYS:
            raise ValueError(f"it has {size >> 20:,} MiB, expected at most {reading.MOST_ARRAYS >> 20:,}")
        content = reading.read_bytes(path)
        content = reading.unpack(content, "xz") if path.suffix == ".xz" else content
        stored = safetensors.numpy.load(content)  # checks the header, too
        about = json.loads(json.loads(content[8 : 8 + int.from_bytes(content[:8], "little")])["__metadata__"][ABOUT])
        if about["format"] != FORMAT:
            raise ValueError(f"its format is {about['format']!r:.20}, expected {FORMAT}")
        if about["digest"] != digest_of(stored):
            raise ValueError("its tensors are not those that its digest is of")
        return _restored(stored), about


def fill(
    template: Tree,
    tensors: Tensors,
    path: Path,
    needed: Callable[[], Iterable[str]],
    kind: type[UserError],
    remedy: str,
) -> Tree:
    """Return the template with a file's tensors in the places of their names; those of `needed()` must be there."""
    state = flatten_dict(flax.serialization.to_state_dict(template), sep="/", keep_empty_nodes=True)
    unknown = [name for name in sorted(tensors) if state.get(name, empty_node) is empty_node]
    if unknown:
        raise kind(f"{path}: holds {unknown[0]}, which this network has not; use the config that it was trained with")
    missing = sorted(set(needed()) - set(tensors))
    if missing:
        raise kind(f"{path}: lacks {missing[0]}, which this network reads; {remedy}")
    return flax.serialization.from_state_dict(template, unflatten_dict({**state, **tensors}, sep="/"))  # type: ignore[return-value]


def fitting(template: Tree, tree: Any, path: Path, kind: type[UserError]) -> Tree:
    """Return a tree from a file as JAX arrays of the template's types; refuse other shapes and infinite numbers."""

    def leaf(name: Any, expected: Any, got: Any) -> jax.Array:
        if np.shape(got) != np.shape(expected):
            raise kind(
                f"{path}: {jax.tree_util.keystr(name)} has shape {np.shape(got)}, expected {np.shape(expected)}; "
                "use the config that it was trained with"
            )
        if jnp.issubdtype(jnp.asarray(got).dtype, jnp.inexact) and not np.isfinite(got).all():
            raise kind(f"{path}: {jax.tree_util.keystr(name)} has values that are not finite; use another one")
        return jnp.asarray(got, getattr(expected, "dtype", None))

    return jax.tree_util.tree_map_with_path(leaf, template, tree)


def write_state(path: Path, state: Any) -> None:
    """Write a tree of arrays, strings and numbers as msgpack, whole or not at all."""
    with whole_file(path) as partial:
        partial.write_bytes(flax.serialization.to_bytes(jax.device_get(state)))


def read_state(path: Path) -> dict[str, Any] | None:
    """Return a tree as plain mappings, or None where there is no file."""
    if not path.is_file():
        return None
    with readable(path, FileError, "delete it to start again"):
        return flax.serialization.msgpack_restore(path.read_bytes())  # type: ignore[return-value]


def restored(template: Tree, state: Any, path: Path) -> Tree:
    """Return plain mappings of `read_state` in the structure and types of a template."""
    try:
        tree = flax.serialization.from_state_dict(template, state)
    except (ValueError, KeyError) as error:
        raise FileError(f"{path}: does not fit the network ({error}); delete it to start again") from None
    return fitting(template, tree, path, FileError)
