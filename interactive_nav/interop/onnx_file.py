"""Read ONNX files of `interactive-nav export`: a policy with a description of what it takes and gives."""

import json
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np

from interactive_nav.sensing.description import KEY
from interactive_nav_common.errors import UserError, missing, optional, regular

NEEDED = missing("an ONNX policy", "onnxruntime", "onnx")


class OnnxError(UserError):
    """An ONNX file that is damaged, or that belongs to another robot or to other observations."""


class OnnxFile:
    """A policy of an ONNX file."""

    def __init__(self, path: str | Path):
        runtime, self.path = optional("onnxruntime", NEEDED), path
        try:
            content = regular(Path(path)).read_bytes()
            self._session = runtime.InferenceSession(content, providers=["CPUExecutionProvider"])
        except OSError as error:
            raise OnnxError(f"{path}: cannot be read ({error.strerror})") from None
        except Exception as error:  # onnxruntime's have no common base
            raise OnnxError(f"{path}: no ONNX model ({' '.join(str(error).split())[:200]})") from None
        try:
            self.about: dict[str, Any] = json.loads(self._session.get_modelmeta().custom_metadata_map[KEY])
            if not all(isinstance(self.about[part], dict) for part in ("robot", "inputs", "outputs")):
                raise ValueError
        except (KeyError, TypeError, ValueError):
            raise OnnxError(f"{path}: has no description, expected a file of interactive-nav export") from None

    def run(self, output: str, inputs: Mapping[str, np.ndarray]) -> np.ndarray:
        """Return an output [B, n] for inputs [B, ...]."""
        return self._session.run([output], dict(inputs))[0]
