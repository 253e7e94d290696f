"""Furniture libraries: what a catalogue says of its pieces, and what of a broken one is told."""

from __future__ import annotations

import hashlib
import zipfile
from pathlib import Path

import numpy as np
import pytest

from converters.library import build
from converters.library.build import PROPERTIES, libraries_in, parse_properties, read_catalogue, unpack_model
from converters.records.errors import SceneRejected
from interactive_nav_common.errors import FileError

ENTRY = {
    "name": "Caf\\u00e9 chair", "category": "Kitchen", "model": "/small/chair/chair.obj", "width": "50",
    "depth": "60.5", "height": "90",
    "movable": "true", "doorOrWindow": "false", "creator": "Ada", "modelRotation": "0 0 1 0 1 0 -1 0 0",
}  # fmt: skip


def write_library(path: Path, **changes: str | None) -> Path:
    """A library of one chair; a change to None leaves its key out."""
    entry = {k: v for k, v in {**ENTRY, **changes}.items() if v is not None}
    lines = ["# a comment", "license=Public domain", *(f"{k}#1={v}" for k, v in entry.items())]
    with zipfile.ZipFile(path, "w") as archive:
        archive.writestr(PROPERTIES, "\n".join(lines))
        archive.writestr("small/chair/chair.obj", "v 0 0 0\nv 2 0 0\nv 0 3 1\nf 1 2 3\n")
        archive.writestr("small/chair/wood.png", b"png")
        archive.writestr("small/other.obj", "v 0 0 0\n")
    return path


def test_properties_are_javas():
    text = b"! note\nname#1 = \\u0041rm\\\n    chair\nwidth#1:50\nempty#1=\n"
    assert parse_properties(text) == {"name#1": "Armchair", "width#1": "50", "empty#1": ""}


def test_a_piece_is_read_in_metres(tmp_path):
    (piece,) = read_catalogue(write_library(tmp_path / "Small.sh3f"))
    assert piece.licence == "Public domain" and piece.key == "Small/chair"
    assert (piece.name, piece.creator) == ("Café chair", "Ada")
    assert piece.size_m == (0.5, 0.9, 0.605)
    np.testing.assert_array_equal(piece.rotation @ [0, 0, 1], [1, 0, 0])
    (tmp_path / "out").mkdir()
    model = unpack_model(piece, tmp_path / "out")
    assert model.name == "chair.obj" and sorted(p.name for p in (tmp_path / "out").iterdir()) == [
        "chair.obj",
        "wood.png",
    ]


def test_a_broken_archive_is_one_line(tmp_path):
    data = write_library(tmp_path / "Small.sh3f").read_bytes()
    for broken in (b"", data[:100], b"PK" + data[2:60]):
        (tmp_path / "broken.sh3f").write_bytes(broken)
        with pytest.raises(SceneRejected, match="not readable as a furniture library"):
            read_catalogue(tmp_path / "broken.sh3f")


def test_every_library_must_be_there_in_the_version_of_the_digests(tmp_path, monkeypatch):
    (tmp_path / "usr").mkdir()
    with pytest.raises(FileError, match="holds no BlendSwap-CC-0.sh3f; give the folder of its .sh3f files"):
        libraries_in(tmp_path)
    path = write_library(tmp_path / "usr" / "BlendSwap-CC-0.sh3f")
    with pytest.raises(FileError, match=r"BlendSwap-CC-0.sh3f: is not that of version 1.8 \(sha256 differs\)"):
        libraries_in(tmp_path)
    digest = hashlib.sha256(path.read_bytes()).hexdigest()
    monkeypatch.setattr(build, "FILES", {"BlendSwap-CC-0": digest})
    assert libraries_in(tmp_path) == (path,)
