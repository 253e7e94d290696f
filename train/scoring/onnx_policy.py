"""Play policies from ONNX files that describe themselves."""

from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np

from interactive_nav.interop.onnx_file import OnnxError, OnnxFile
from interactive_nav.sensing.description import describe, difference, inputs_of


class OnnxPolicy:
    """A policy of an ONNX file that `interactive-nav export` wrote, for the environments that it fits."""

    def __init__(self, path: str | Path, env: Any):
        self._file, self._env = OnnxFile(path), env
        try:
            differs = difference(self._file.about, describe(env))
        except (KeyError, TypeError, AttributeError):
            raise OnnxError(f"{path}: has no description, expected a file of interactive-nav export") from None
        if differs:
            raise OnnxError(f"{path}: {differs}; choose a policy of this robot and these observations, or set env.*")

    def __call__(self, observations: Mapping[str, np.ndarray], first: Any) -> np.ndarray:
        """Return actions [B, A]."""
        return self._file.run("action", inputs_of(self._env, observations))
