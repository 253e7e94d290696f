"""What acting needs of a learner, small: a checkpoint of 9 to 18 MiB in, a file of a quarter MiB out, and back.

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


def acting_part(learner: Mapping[str, Any], algorithm: str) -> dict[str, Any]:
    """The leaves of a learner that its policy reads.

    Returns:
        "params/policy/..." -> array.
    """
    flat: dict[str, Any] = flax.traverse_util.flatten_dict(dict(learner), sep="/")
    if algorithm == "ppo":
        return {k: v for k, v in flat.items() if k.startswith(("params/", "normalizer_params/")) and "/value/" not in k}
    wanted = ["policy_params/", "normalizer_params/"]
    if not any(k.startswith("policy_params/encoder/") for k in flat):  # it looks through the critics'
        wanted.append("q_params/encoder/")
    return {k: v for k, v in flat.items() if k.startswith(tuple(wanted))}


def packed(leaves: Mapping[str, Any], step: float = STEP) -> dict[str, np.ndarray]:
    """Large weights as Huffman codes (u8) of i8, with their shapes under `<name>:shape` and the f32 scales of their
    last axis under `<name>:scale`; others as f16; vectors as is.

    Rounded weights hold no repetitions, which is all that zip's own methods would add: those take a tenth more.

    Args:
        step: of the rounding, in standard deviations of each output's weights.
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
    """Back from `packed`, to within half a scale."""
    out: dict[str, np.ndarray] = {}
    for name, array in arrays.items():
        if name + SHAPE in arrays:
            levels = np.frombuffer(unpack(array.tobytes(), "zlib"), np.int8).reshape(arrays[name + SHAPE])
            out[name] = levels.astype(np.float32) * arrays[name + SCALE]
        elif not name.endswith((SHAPE, SCALE)):
            out[name] = array
    return out


def write(source: Path, algorithm: str, target: Path, step: float = STEP) -> None:
    """A `learner.msgpack` as a `policy.npz`."""
    learner = flax.serialization.msgpack_restore(regular(source).read_bytes())
    with whole_file(target) as partial, open(partial, "wb") as file:
        np.savez(file, **packed(acting_part(learner, algorithm), step))  # type: ignore[arg-type]


def read(path: Path, template: Any) -> Any:
    """A learner in the template's structure whose policy is the file's; what acting does not read is the template's."""
    with read_npz(path, CheckpointError, "export the run again") as stored:
        leaves = unpacked({name: stored[name] for name in stored.files})
    own = flax.serialization.to_state_dict(template)
    flat = flax.traverse_util.flatten_dict(own, sep="/", keep_empty_nodes=True)
    unknown = sorted(set(leaves) - set(flat))
    if unknown:
        raise CheckpointError(
            f"{path}: holds {unknown[0]}, which this learner has not; use the config that it was trained with"
        )
    missing = sorted(set(acting_part(own, "ppo" if "params" in own else "")) - set(leaves))
    if missing:
        raise CheckpointError(f"{path}: lacks {missing[0]}, which this learner's policy reads; export the run again")
    nested = flax.traverse_util.unflatten_dict({**flat, **leaves}, sep="/")
    return flax.serialization.from_state_dict(template, nested)
