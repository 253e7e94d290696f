"""Import MJX quietly if the optional Warp is missing: `mujoco.mjx.warp` would print a line on stdout.

Brax imports MJX too, so catching it in this package's modules that use MJX would be too late.
"""

import importlib.util
import sys
from collections.abc import Sequence
from importlib.machinery import ModuleSpec
from types import ModuleType
from typing import Any

NOISY = "mujoco.mjx.warp"


class _QuietPrint:
    """Find and load `NOISY` as always, with a `print` that prints nothing."""

    def find_spec(self, name: str, path: Sequence[str] | None = None, target: Any = None) -> ModuleSpec | None:
        if name != NOISY:
            return None
        sys.meta_path.remove(self)  # type: ignore[arg-type]
        spec = importlib.util.find_spec(name)
        if spec is not None:
            self._loader, spec.loader = spec.loader, self  # type: ignore[assignment]
        return spec

    def create_module(self, spec: ModuleSpec) -> ModuleType | None:
        return None

    def exec_module(self, module: ModuleType) -> None:
        module.__dict__["print"] = lambda *_: None
        self._loader.exec_module(module)  # type: ignore[union-attr]
        del module.__dict__["print"]


def hush() -> None:
    """Let MJX be imported without a message about Warp where that is missing; a broken one still reports itself."""
    if NOISY not in sys.modules and importlib.util.find_spec("warp") is None:
        sys.meta_path.insert(0, _QuietPrint())  # type: ignore[arg-type]
