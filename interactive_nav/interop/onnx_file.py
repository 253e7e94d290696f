"""Write and read ONNX files: a policy or a network with a description of what it takes and gives."""

import json
import logging
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from interactive_nav.sensing.description import KEY
from interactive_nav_common.errors import UserError, missing, optional, readable

NEEDED = missing("an ONNX policy", "onnxruntime", "onnx")
TOLERANCE = 1e-5
"""Largest difference of each output from JAX: of its largest number, or of 1 where all are smaller."""


class OnnxError(UserError):
    """An ONNX file that is damaged, or that belongs to another robot or to other observations."""


class OnnxFile:
    """A policy of an ONNX file."""

    def __init__(self, path: str | Path):
        runtime, self.path = optional("onnxruntime", NEEDED), path
        with readable(path, OnnxError, "expected a file of interactive-nav export", " as an ONNX model"):
            content = Path(path).read_bytes()
            self._session = runtime.InferenceSession(content, providers=["CPUExecutionProvider"])
            self.about: dict[str, Any] = json.loads(self._session.get_modelmeta().custom_metadata_map.get(KEY, "{}"))
            if not all(isinstance(self.about.get(part), dict) for part in ("robot", "inputs", "outputs")):
                raise ValueError("it has no description")

    def run(self, output: str, inputs: Mapping[str, np.ndarray]) -> np.ndarray:
        """Return an output [B, n] for inputs [B, ...]."""
        return self._session.run([output], dict(inputs))[0]


def convert(
    graph: Callable[..., Any],
    inputs: Mapping[str, np.ndarray],
    expected: Mapping[str, np.ndarray],
    about: Mapping[str, Any],
) -> bytes:
    """Return a function of named arrays [N, ...] as an ONNX model, or raise `OnnxError` if it misses `expected`."""
    jax2onnx = optional("jax2onnx", missing("export", "jax2onnx", "onnx"))
    runtime = optional("onnxruntime", NEEDED)
    logging.getLogger("onnx_ir").setLevel(logging.ERROR)  # it warns of values that it leaves out
    passes = optional("jax2onnx.converter.ir_optimizations", NEEDED)
    # jax2onnx 0.17 takes transpositions out of sums of residual blocks whose other terms then do not fit.
    passes._OPTIMIZER_PASSES = tuple(one for one in passes._OPTIMIZER_PASSES if "transpose_" not in one.name)
    names, outputs = list(inputs), list(expected)
    shapes = [jax.ShapeDtypeStruct(("batch", *x.shape[1:]), x.dtype) for x in inputs.values()]
    cumsum = jnp.cumsum
    with jax.numpy_rank_promotion("allow"):  # jax2onnx's layers promote
        model = jax2onnx.to_onnx(graph, shapes, model_name=KEY, input_names=names, output_names=outputs)
    jnp.cumsum = cumsum  # jax2onnx 0.17 leaves a function of its own there, which takes no axis by position
    model.metadata_props.add(key=KEY, value=json.dumps(about))
    content = model.SerializeToString()
    session = runtime.InferenceSession(content, providers=["CPUExecutionProvider"])
    for name, a in zip(outputs, session.run(outputs, dict(inputs)), strict=True):
        b = expected[name]
        difference = np.max(np.abs(a - b)) / max(1.0, np.max(np.abs(b)))
        if not difference <= TOLERANCE:
            raise OnnxError(
                f"output {name} differs by {difference:.1e} between ONNX and JAX over {len(a)} observations, "
                f"expected at most {TOLERANCE:.0e}; nothing was written"
            )
    return content
