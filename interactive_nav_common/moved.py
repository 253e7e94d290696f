"""Modules that moved: their old names still import, and are the same modules."""

from __future__ import annotations

import importlib
import importlib.abc
import importlib.machinery
import importlib.util
import sys
from collections.abc import Mapping, Sequence
from types import ModuleType


class _Moved(importlib.abc.MetaPathFinder, importlib.abc.Loader):
    """Finds old names of a table, and answers with the module of the new name."""

    def __init__(self, names: Mapping[str, str]):
        self._names = names

    def find_spec(
        self, fullname: str, path: Sequence[str] | None, target: ModuleType | None = None
    ) -> importlib.machinery.ModuleSpec | None:
        return importlib.util.spec_from_loader(fullname, self) if fullname in self._names else None

    def create_module(self, spec: importlib.machinery.ModuleSpec) -> ModuleType:
        module = importlib.import_module(self._names[spec.name])
        spec.loader_state = module.__spec__  # the import system puts the old name's in its place
        return module

    def exec_module(self, module: ModuleType) -> None:
        assert module.__spec__ is not None
        module.__spec__ = module.__spec__.loader_state


def keep_old_names(names: Mapping[str, str]) -> None:
    """Lets old module names import: `old -> new`, both with their package."""
    sys.meta_path.append(_Moved(names))
