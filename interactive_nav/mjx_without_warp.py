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
    """Find `NOISY` as always, to be loaded with a `print` that prints nothing."""

    def find_spec(self, name: str, path: Sequence[str] | None = None, target: Any = None) -> ModuleSpec | None:
        if name != NOISY:
            return None
        sys.meta_path.remove(self)  # type: ignore[arg-type]
        spec = importlib.util.find_spec(name)
        if spec is None or spec.loader is None:
            return spec
        execute = spec.loader.exec_module

        def execute_quietly(module: ModuleType) -> None:
            module.__dict__["print"] = lambda *_: None
            execute(module)
            del module.__dict__["print"]

        spec.loader.exec_module = execute_quietly
        return spec


def hush() -> None:
    """Let MJX be imported without a message about Warp where that is missing; a broken one still reports itself."""
    if NOISY not in sys.modules and importlib.util.find_spec("warp") is None:
        sys.meta_path.insert(0, _QuietPrint())  # type: ignore[arg-type]
