"""A lock has one holder, who is named; looking does not take it; a process that ends frees it."""

from __future__ import annotations

import os
import subprocess
import sys
import threading
from concurrent.futures import ThreadPoolExecutor

import pytest

from interactive_nav_common.errors import FileError
from interactive_nav_common.files import holder, is_locked, locked, release, take_lock


@pytest.mark.parametrize("kind", ["file", "folder"])
def test_one_holder_at_a_time(tmp_path, kind):
    path = tmp_path / "lock"
    if kind == "folder":
        path.mkdir()
    assert not is_locked(path)
    held = take_lock(path)
    assert held is not None and is_locked(path) and take_lock(path) is None
    release(held)
    again = take_lock(path)
    assert again is not None
    release(again)


def test_who_looks_never_keeps_one_from_taking_it(tmp_path):
    path, looking = tmp_path / "lock", threading.Event()
    looking.set()

    def look() -> None:
        while looking.is_set():
            is_locked(path)

    taken = []
    with ThreadPoolExecutor(2) as threads:
        lookers = [threads.submit(look) for _ in range(2)]
        try:
            for _ in range(50):
                descriptor = take_lock(path)
                taken.append(descriptor is not None)
                release(descriptor)
        finally:
            looking.clear()
    assert all(taken) and [looker.result() for looker in lookers] == [None, None]


def test_a_lock_made_while_one_looks_was_not_held(tmp_path, monkeypatch):
    path, opens = tmp_path / "lock", os.open

    def late(name, *arguments):
        try:
            return opens(name, *arguments)
        except FileNotFoundError:
            path.touch()  # another makes it just then
            raise

    monkeypatch.setattr(os, "open", late)
    assert not is_locked(path) and path.exists()


def test_a_lock_that_cannot_be_opened_is_told(tmp_path):
    (tmp_path / "lock").symlink_to("lock")
    with pytest.raises(FileError, match="lock: cannot be opened"):
        is_locked(tmp_path / "lock")


def test_the_other_process_is_named_and_frees_it_by_ending(tmp_path):
    path = tmp_path / "lock"
    code = (
        "import sys, pathlib; from interactive_nav_common.files import take_lock; take_lock(pathlib.Path(sys.argv[1]))"
    )
    code += "; print('held', flush=True); sys.stdin.read()"
    with subprocess.Popen(
        [sys.executable, "-c", code, str(path)], stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True
    ) as other:
        assert other.stdout is not None and other.stdout.readline() == "held\n"
        assert holder(path).startswith(f"process {other.pid} on ")
        with pytest.raises(FileError, match=f"in use by process {other.pid} on"), locked(path, "in use by {holder}"):
            pass
        other.kill()
    with locked(path, "in use by {holder}"):
        assert holder(path).startswith(f"process {os.getpid()} on ")
