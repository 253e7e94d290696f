"""Extras: whatever needs a package that is not installed says in one line how to install it."""

from __future__ import annotations

import ast
import importlib
import sys
import tomllib
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest

from converters.read.datasets.scanned import read_scan
from docs.studies.pybullet_peer import BulletScene
from interactive_nav import view
from interactive_nav.interop.onnx_file import OnnxFile
from interactive_nav.interop.torch_bridge import to_torch
from interactive_nav.physics import resolve_backend
from interactive_nav.record import Picture
from interactive_nav.ros.commands import need_ros
from interactive_nav_common.errors import UserError, optional
from interactive_nav_common.jobs.on_ray import RayLauncher
from interactive_nav_common.untrusted.guard import guarded_server
from topological_nav.scenes.rendering import need_engine
from train.runs.tracking import import_wandb

ROOT = Path(__file__).parents[2]
EXTRAS = tomllib.loads((ROOT / "pyproject.toml").read_text())["project"]["optional-dependencies"]
FOLDERS = ("interactive_nav_common", "interactive_nav", "converters", "train", "topological_nav", "benchmarks", "docs")
GYM_ENV = "interactive_nav.interop.gym_env"
USES: list[tuple[str, str, Callable[[], Any]]] = [
    ("annotate", "viser", lambda: guarded_server("localhost", 0, "label", "annotate")),
    ("datasets", "scenezoo", lambda: read_scan("3rscan", ROOT / "docs")),
    ("gymnasium", "gymnasium", lambda: importlib.import_module(GYM_ENV)),
    ("gymnasium", "gymnasium", lambda: importlib.import_module("interactive_nav.interop.sb3_env")),
    ("onnx", "onnxruntime", lambda: OnnxFile("policy.onnx")),
    ("pybullet", "pybullet", lambda: BulletScene(None, None)),  # type: ignore[arg-type]
    ("ray", "ray", lambda: RayLauncher("auto")),
    ("rerun", "rerun", lambda: Picture(rerun=Path("episode.rrd"))),
    ("ros2", "rclpy", lambda: need_ros("ros")),
    ("view", "mjviser", lambda: view.choose_viewer("browser")),
    ("wandb", "wandb", import_wandb),
    ("warp", "warp", lambda: resolve_backend("warp")),
    ("warp", "warp", lambda: need_engine("warp")),
]
"""Extra, the module that it brings, and a use of it."""
GUARDED = {
    "docs/conf.py": {"sphinx"},
    "docs/program_help.py": {"sphinx"},  # which imports it
    "interactive_nav/interop/gym_env.py": {"gymnasium"},  # says the line
    "interactive_nav/physics/warp_callbacks.py": {"warp"},  # after `resolve_backend`, as the next
    "interactive_nav/sensing/meshes.py": {"warp"},
    "benchmarks/steps_per_second.py": {"warp"},  # if it is in use
    "interactive_nav/ros/drive.py": {"rclpy"},  # after `need_ros`, as the next
    "interactive_nav/ros/driving.py": {"rclpy"},
    "interactive_nav/ros/messages.py": {"rclpy"},
    "interactive_nav/ros/nodes.py": {"rclpy"},
    "topological_nav/ros/nodes.py": {"rclpy"},
}
"""File -> what it may import with a statement."""


@pytest.mark.parametrize(("extra", "module", "use"), USES)
def test_a_missing_package_is_one_line_with_the_command(monkeypatch, extra, module, use):
    for name in ("gym_env", "sb3_env"):
        monkeypatch.delitem(sys.modules, f"interactive_nav.interop.{name}", raising=False)
    monkeypatch.setitem(sys.modules, module, None)
    with pytest.raises(UserError) as caught:
        use()
    told = str(caught.value)
    assert f"{module}" in told and f"is not installed; pip install 'interactive-nav[{extra}]'" in told
    assert "\n" not in told


def test_every_extra_of_users_is_among_them():
    assert {extra for extra, *_ in USES} == set(EXTRAS) - {"dev", "docs", "gpu"}  # gpu: JAX tells; its Warp is `warp`


def test_what_the_import_said_is_told_and_what_is_there_is_imported(monkeypatch, tmp_path):
    assert optional("json", "line").dumps([1]) == "[1]"
    (tmp_path / "broken_extra.py").write_text("raise ImportError('libGL.so.1:\\n cannot open')")
    monkeypatch.syspath_prepend(tmp_path)
    with pytest.raises(ImportError, match=r"^line \(libGL.so.1: cannot open\)$"):
        optional("broken_extra", "line")


def test_without_pytorch_its_own_page_is_named(monkeypatch):
    monkeypatch.setitem(sys.modules, "torch", None)
    with pytest.raises(ImportError, match="^PyTorch is not installed; follow https://pytorch.org/get-started"):
        to_torch({})


def test_no_other_statement_imports_an_optional_package():
    optional_modules = {module for _, module, _ in USES} | {"sphinx"}
    paths = [path for folder in FOLDERS for path in (ROOT / folder).rglob("*.py")]
    found: dict[str, set[str]] = {}
    for path in paths:
        for node in ast.walk(ast.parse(path.read_text())):
            names = [alias.name for alias in node.names] if isinstance(node, ast.Import) else []
            names += [node.module or ""] if isinstance(node, ast.ImportFrom) and not node.level else []
            if roots := {name.partition(".")[0] for name in names} & optional_modules:
                found.setdefault(path.relative_to(ROOT).as_posix(), set()).update(roots)
    assert found == GUARDED
