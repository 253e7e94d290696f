"""Import functions that users name, from modules or files."""

import importlib
import importlib.util
import os
import sys
from collections.abc import Callable
from pathlib import Path
from typing import Any

from interactive_nav_common.config import nearest
from interactive_nav_common.errors import UserError


def first_line(error: BaseException) -> str:
    """Return an exception's type and the first line of its message."""
    return f"{type(error).__name__}: {next(iter(str(error).splitlines()), '')}"


def import_function(place: str, word: str, expected: str, kind: type[UserError]) -> Callable[..., Any]:
    """Return the function at `module:name` or `path/to/file.py:name`; modules of the current folder count."""
    module, _, name = place.rpartition(":")
    is_file = module.endswith(".py")
    folder = str(Path(module).resolve().parent) if is_file else os.getcwd()
    if folder not in sys.path:
        sys.path.insert(0, folder)
    try:
        if is_file:
            spec = importlib.util.spec_from_file_location(f"file_{Path(module).stem}", module)
            assert spec and spec.loader
            loaded = sys.modules[spec.name] = importlib.util.module_from_spec(spec)
            spec.loader.exec_module(loaded)
        else:
            loaded = importlib.import_module(module)
    except (Exception, SystemExit) as error:
        raise kind(f"{word}: cannot import {module} ({first_line(error)}); {expected}") from error
    function = getattr(loaded, name, None)
    if not callable(function):
        names = [n for n, v in vars(loaded).items() if callable(v) and getattr(v, "__module__", "") == loaded.__name__]
        has = hasattr(loaded, name)
        got = f"{name!r} of type {type(function).__name__}" if has else f"no {name!r}{nearest(name, names)}"
        raise kind(f"{word}: {module} has {got}; expected one of its functions: {', '.join(names) or 'it has none'}")
    return function
