"""One process at a time works in a run folder or a dataset."""

import os

import pytest

from interactive_nav_common.errors import FileError
from interactive_nav_common.files import alone_in, release, take_lock
from interactive_nav_common.runs.folder import claimed
from topological_nav.__main__ import main
from topological_nav.drives.dataset import draw_drives


def test_a_folder_in_use_is_refused_and_named(tmp_path):
    out = tmp_path / "run"
    busy = f"run: process {os.getpid()} on .* works there; wait for it"
    with claimed(out, {"seed": 1}), pytest.raises(FileError, match=busy), alone_in(out):
        pass
    with claimed(out, {"seed": 1}):  # free again
        pass


def test_drives_that_another_process_draws(painted, tmp_path):
    held = take_lock(tmp_path / ".lock")
    with pytest.raises(FileError, match=f"process {os.getpid()} on .* works there"):
        draw_drives([painted], tmp_path)
    release(held)


def test_a_folder_that_cannot_be_made(tmp_path):
    (tmp_path / "file").write_text("")
    for out in (tmp_path / "file", tmp_path / "file" / "run"):
        with pytest.raises(FileError, match="cannot create a folder there .*; choose another one"), alone_in(out):
            pass


def test_a_dataset_that_another_process_makes(painted, tmp_path, capsys):
    for words in (["data"], ["data", "--drives"]):
        held = take_lock(tmp_path / ".lock")
        assert held is not None
        assert main([*words, str(painted), "-o", str(tmp_path), "supersample=1"]) == 2
        release(held)
        error = capsys.readouterr().err
        assert error.count("\n") == 1 and f"process {os.getpid()} on " in error and "works there" in error
