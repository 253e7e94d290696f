"""The tiny raw room in both layouts, and one conversion of it, made once a test process."""

from __future__ import annotations

import shutil
from pathlib import Path

import pytest

from converters.pipeline import ConvertConfig, Converted, convert
from tests.converters import tiny_raw


@pytest.fixture(scope="session")
def pristine(tmp_path_factory) -> Path:
    """Both raw folders, written once."""
    base = tmp_path_factory.mktemp("pristine")
    tiny_raw.write_scan2cad(base / "scan2cad")
    tiny_raw.write_gibson(base / "gibson")
    return base


@pytest.fixture
def scan2cad_raw(tmp_path, pristine) -> Path:
    """A fresh Scan2CAD folder that a test may damage."""
    return Path(shutil.copytree(pristine / "scan2cad", tmp_path / "scan2cad"))


@pytest.fixture
def gibson_raw(tmp_path, pristine) -> Path:
    """A fresh raw Gibson folder that a test may damage."""
    return Path(shutil.copytree(pristine / "gibson", tmp_path / "gibson"))


@pytest.fixture(scope="session")
def hull_cache(shared) -> Path:
    """A cache that all tests share, in every test process: each tiny model is decomposed once."""
    return shared("hulls", lambda folder: None)


@pytest.fixture(scope="session")
def tiny_scene(tmp_path_factory, pristine, hull_cache) -> tuple[Path, Converted]:
    """The tiny Gibson room, converted."""
    base = tmp_path_factory.mktemp("tiny")
    config = ConvertConfig(structure_texture=128, object_texture=32)
    return base / "tiny", convert(pristine / "gibson", base / "tiny", config, cache=hull_cache)
