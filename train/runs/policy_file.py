"""Write the policy of a checkpoint of 9 to 18 MiB as a file of a quarter MiB, and read it back.

Optimisers, critics and targets are left out, and large weights are rounded to multiples of a share of their spread. A
policy read from such a file acts nearly as the original did (docs/results.md says how nearly); it cannot be trained
further.
"""

import zlib
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import flax.serialization
import flax.traverse_util
import numpy as np

from interactive_nav_common.errors import regular
from interactive_nav_common.files import whole_file
from interactive_nav_common.untrusted.reading import read_npz, unpack
from train.errors import CheckpointError

POLICY = "policy.npz"
LARGE = 4_000
"""Weight matrices with at least so many numbers are rounded; smaller ones are stored in half precision."""
STEP = 0.5
"""What they are rounded to, in standard deviations of an output's weights: about 3 bits a weight."""
SCALE, SHAPE = ":scale", ":shape"
_LEVELS = 127


def policy_leaves(path: Path, learner: Mapping[str, Any], algorithm: str) -> dict[str, Any]:
    """Return the leaves of a learner that its policy reads, by names such as "params/policy/..."."""
    from train.learners.algorithms import ALGORITHMS  # takes seconds, and `--help` needs none

    try:
        return flax.traverse_util.flatten_dict(ALGORITHMS[algorithm].policy_part(learner), sep="/")
    except (AttributeError, KeyError, TypeError):
        names = ", ".join(ALGORITHMS)
        raise CheckpointError(f"{path}: holds no policy of {algorithm!r}, expected one of {names}") from None


def packed(leaves: Mapping[str, Any], step: float = STEP) -> dict[str, np.ndarray]:
    """Return large weights as Huffman codes (u8) of i8, with their shapes under `<name>:shape` and the f32 scales of
    their last axis under `<name>:scale`; others as f16; vectors as is.

    Rounding is to multiples of `step` standard deviations of each output's weights. Rounded weights hold no
    repetitions, which is all that zip's methods would add: those take a tenth more.
    """
    out: dict[str, np.ndarray] = {}
    for name, leaf in leaves.items():
        array = np.asarray(leaf)
        if array.ndim < 2 or not np.issubdtype(array.dtype, np.floating):
            out[name] = array
            continue
        if array.size < LARGE:
            out[name] = array.astype(np.float16)
            continue
        inputs = tuple(range(array.ndim - 1))
        scale = np.maximum(step * array.std(inputs), np.abs(array).max(inputs) / _LEVELS).astype(np.float32)
        scale[scale == 0] = 1.0
        coder = zlib.compressobj(9, strategy=zlib.Z_HUFFMAN_ONLY)
        codes = coder.compress(np.rint(array / scale).astype(np.int8).tobytes()) + coder.flush()
        out[name] = np.frombuffer(codes, np.uint8)
        out[name + SHAPE], out[name + SCALE] = np.array(array.shape, np.int32), scale
    return out


def unpacked(arrays: Mapping[str, np.ndarray]) -> dict[str, np.ndarray]:
    """Return the leaves that `packed` was given, to within half a scale."""
    out: dict[str, np.ndarray] = {}
    for name, array in arrays.items():
        if name + SHAPE in arrays:
            levels = np.frombuffer(unpack(array.tobytes(), "zlib"), np.int8).reshape(arrays[name + SHAPE])
            out[name] = levels.astype(np.float32) * arrays[name + SCALE]
        elif not name.endswith((SHAPE, SCALE)):
            out[name] = array
    return out


def write(source: Path, algorithm: str, target: Path, step: float = STEP) -> None:
    """Write the policy of a `learner.msgpack` as a `policy.npz`."""
    learner = flax.serialization.msgpack_restore(regular(source).read_bytes())
    with whole_file(target) as partial, open(partial, "wb") as file:
        np.savez(file, **packed(policy_leaves(source, learner, algorithm), step))  # type: ignore[arg-type]


def read(path: Path, template: Any, algorithm: str) -> Any:
    """Return a learner with the file's policy in the template's structure; the rest is the template's."""
    with read_npz(path, CheckpointError, "export the run again") as stored:
        leaves = unpacked({name: stored[name] for name in stored.files})
    state = flax.serialization.to_state_dict(template)
    flat = flax.traverse_util.flatten_dict(state, sep="/", keep_empty_nodes=True)
    unknown = sorted(set(leaves) - set(flat))
    if unknown:
        raise CheckpointError(
            f"{path}: holds {unknown[0]}, which this learner has not; use the config that it was trained with"
        )
    missing = sorted(set(policy_leaves(path, state, algorithm)) - set(leaves))
    if missing:
        raise CheckpointError(f"{path}: lacks {missing[0]}, which this learner's policy reads; export the run again")
    nested = flax.traverse_util.unflatten_dict({**flat, **leaves}, sep="/")
    return flax.serialization.from_state_dict(template, nested)
