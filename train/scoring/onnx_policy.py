"""Play policies from ONNX files that describe themselves."""

import json
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np

from interactive_nav.sensing.description import KEY, describe, difference, inputs_of
from interactive_nav_common.errors import UserError, missing, optional, regular

NEEDED = missing("an ONNX policy", "onnxruntime", "onnx")


class OnnxError(UserError):
    """An ONNX file that is damaged, or that belongs to another robot or to other observations."""


class OnnxPolicy:
    """A policy of an ONNX file that `interactive-nav export` wrote, for the environments that it fits."""

    def __init__(self, path: str | Path, env: Any):
        runtime = optional("onnxruntime", NEEDED)
        try:
            content = regular(Path(path)).read_bytes()
            self._session = runtime.InferenceSession(content, providers=["CPUExecutionProvider"])
        except OSError as error:
            raise OnnxError(f"{path}: cannot be read ({error.strerror})") from None
        except Exception as error:  # onnxruntime's have no common base
            raise OnnxError(f"{path}: no ONNX model ({' '.join(str(error).split())[:200]})") from None
        self._env, here = env, describe(env)
        try:
            about = json.loads(self._session.get_modelmeta().custom_metadata_map[KEY])
            differs = difference(about, here)
        except (KeyError, TypeError, AttributeError, ValueError):
            raise OnnxError(f"{path}: has no description, expected a file of interactive-nav export") from None
        if differs:
            raise OnnxError(f"{path}: {differs}; choose a policy of this robot and these observations, or set env.*")

    def __call__(self, observations: Mapping[str, np.ndarray], first: Any) -> np.ndarray:
        """Return actions [B, A]."""
        return self._session.run(["action"], inputs_of(self._env, observations))[0]
