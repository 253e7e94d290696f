"""Old module names import the modules of the new names."""

from __future__ import annotations

import importlib

import pytest


@pytest.mark.parametrize(
    ("old", "new", "name"),
    [
        ("interactive_nav.wrappers", "interactive_nav.task.wrappers", "AutoResetEnv"),
        ("interactive_nav.gym_env", "interactive_nav.interop.gym_env", "InteractiveNavEnv"),
        ("interactive_nav.rendering.camera", "interactive_nav.pictures.camera", "Camera"),
        ("train.rows", "interactive_nav_common.rows", "read_rows"),
    ],
)
def test_an_old_name_is_the_same_module(old, new, name):
    module = importlib.import_module(new)
    assert getattr(importlib.import_module(old), name) is getattr(module, name)
    assert importlib.import_module(old) is module
    assert module.__name__ == new and module.__spec__ is not None and module.__spec__.name == new


def test_other_names_are_still_unknown():
    with pytest.raises(ModuleNotFoundError):
        importlib.import_module("interactive_nav.wrapper")
