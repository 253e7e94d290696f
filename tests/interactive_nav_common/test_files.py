"""Files and folders appear whole or not at all; an older one stays where the new one cannot be written."""

from __future__ import annotations

import errno
import os
import shutil
import signal
import time
from pathlib import Path

import pytest

from interactive_nav_common import files
from interactive_nav_common.errors import FileError
from interactive_nav_common.files import (
    append_text,
    check_name,
    part_folder,
    publish,
    remove_partial,
    remove_stale,
    whole_file,
    whole_folder,
    write_text,
)


@pytest.mark.parametrize("name", ["", ".", "..", ".a", "a/b", "a\\b", "/", "a\0b", "a\nb", "é" * 51])
def test_what_is_no_single_part_of_a_path_is_no_name(name):
    with pytest.raises(FileError, match=r"^x: name is .*expected one folder name.*$"):
        check_name(name, "x: name")


def test_other_names_are_names():
    assert [check_name(n, "") for n in ("a..b", "two words", "é" * 50, "-1")] == ["a..b", "two words", "é" * 50, "-1"]


def test_publishing_is_all_or_nothing(tmp_path, monkeypatch):
    parts, targets = [tmp_path / "p0", tmp_path / "p1"], [tmp_path / "t0", tmp_path / "t1"]
    for k, folder in enumerate((*parts, targets[1])):
        folder.mkdir()
        (folder / "file").write_text(f"{k}")
    rename = Path.rename

    def failing(self, target):
        if self == parts[1]:
            raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))
        return rename(self, target)

    monkeypatch.setattr(Path, "rename", failing)
    with pytest.raises(FileError, match="No space left"):
        publish(dict(zip(parts, targets, strict=True)))
    assert not targets[0].exists() and (targets[1] / "file").read_text() == "2"
    monkeypatch.setattr(Path, "rename", rename)
    shutil.rmtree(parts[0], ignore_errors=True)
    parts[0].mkdir()
    publish(dict(zip(parts, targets, strict=True)))
    assert sorted(p.name for p in tmp_path.iterdir()) == ["t0", "t1"] and (targets[1] / "file").read_text() == "1"


def folder_of(path: Path, text: str) -> Path:
    path.mkdir()
    (path / "file").write_text(text)
    return path


def test_two_writers_that_may_not_replace_leave_the_first_ones(tmp_path):
    first, second, target = folder_of(tmp_path / "a", "first"), folder_of(tmp_path / "b", "second"), tmp_path / "t"
    publish({first: target}, overwrite=False)
    with pytest.raises(FileError, match="t: exists already"):
        publish({second: target}, overwrite=False)
    assert (target / "file").read_text() == "first"
    with pytest.raises(FileError, match="made: exists already"), whole_folder(tmp_path / "made"):
        folder_of(tmp_path / "made", "somebody else's")
    assert (tmp_path / "made" / "file").read_text() == "somebody else's"
    (tmp_path / "empty").mkdir()
    publish({second: tmp_path / "empty"}, overwrite=False)
    assert (tmp_path / "empty" / "file").read_text() == "second"


def test_of_two_that_replace_at_once_the_last_stands_whole(tmp_path, monkeypatch):
    mine, other, target = (folder_of(tmp_path / name, name) for name in ("mine", "other", "old"))
    rename = Path.rename

    def between(self, to):
        result = rename(self, to)
        if self == target and other.exists():
            rename(other, target)  # the other one's, while the older is moved aside
        return result

    monkeypatch.setattr(Path, "rename", between)
    publish({mine: target})
    assert (target / "file").read_text() == "mine" and [p.name for p in tmp_path.iterdir()] == ["old"]


def test_a_failing_writer_leaves_what_another_has_put_there(tmp_path, monkeypatch):
    mine, other, target = (folder_of(tmp_path / name, name) for name in ("mine", "other", "old"))
    rename = Path.rename

    def failing(self, to):
        if self == mine and not other.exists():
            raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))
        result = rename(self, to)
        if self == target and other.exists():
            rename(other, target)
        return result

    monkeypatch.setattr(Path, "rename", failing)
    with pytest.raises(FileError, match="No space left"):
        publish({mine: target})
    assert (target / "file").read_text() == "other"


def test_a_signal_waits_for_the_renames(tmp_path, monkeypatch):
    (tmp_path / "part").mkdir()
    rename = Path.rename

    def signalled(self, target):
        os.kill(os.getpid(), signal.SIGINT)
        return rename(self, target)

    monkeypatch.setattr(Path, "rename", signalled)
    with pytest.raises(KeyboardInterrupt):
        publish({tmp_path / "part": tmp_path / "whole"})
    assert [p.name for p in tmp_path.iterdir()] == ["whole"]


def test_a_file_that_cannot_be_written_stays_as_it_was(tmp_path):
    path = tmp_path / "rows.txt"
    write_text(path, "old")
    with (
        pytest.raises(FileError, match=r"rows.txt: cannot be written \(No space left on device\)"),
        whole_file(path) as part,
    ):
        part.write_text("half")
        raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))
    with pytest.raises(KeyboardInterrupt), whole_file(path) as part:
        part.write_text("half")
        raise KeyboardInterrupt
    assert path.read_text() == "old" and list(tmp_path.iterdir()) == [path]


def test_two_writers_of_one_file_do_not_meet(tmp_path):
    path = tmp_path / "rows.txt"
    with whole_file(path) as first, whole_file(path) as second:
        assert first != second and first.suffix == ".txt"
        first.write_text("first")
        second.write_text("second")
    assert path.read_text() == "first"  # the outer block ends last


def test_a_folder_replaces_an_older_one_only_when_asked_and_whole(tmp_path):
    target = tmp_path / "made"
    with whole_folder(target) as folder:
        (folder / "file").write_text("1")
    with pytest.raises(FileError, match="made: exists already"), whole_folder(target):
        pass
    with pytest.raises(RuntimeError), whole_folder(target, overwrite=True) as folder:
        (folder / "file").write_text("2")
        raise RuntimeError
    assert (target / "file").read_text() == "1"
    with whole_folder(target, overwrite=True) as folder:
        (folder / "file").write_text("3")
    assert (target / "file").read_text() == "3" and [p.name for p in tmp_path.iterdir()] == ["made"]


def test_what_a_killed_writer_left_goes_and_what_runs_stays(tmp_path):
    target = tmp_path / "made"
    with part_folder(target) as running:
        os.utime(running, (0, 0))
        (tmp_path / ".made.part-7").mkdir()
        os.utime(tmp_path / ".made.part-7", (0, 0))
        remove_stale(target)
        assert running.is_dir() and not (tmp_path / ".made.part-7").exists()
    (tmp_path / ".made.old-7").mkdir()
    remove_stale(target)  # killed between two renames: the older one is put back
    assert [p.name for p in tmp_path.iterdir()] == ["made"]


def test_a_signal_while_a_folder_is_locked_leaves_nothing(tmp_path, monkeypatch):
    def stopped(path):
        assert path.is_dir()
        raise KeyboardInterrupt

    monkeypatch.setattr(files, "take_lock", stopped)
    with pytest.raises(KeyboardInterrupt), part_folder(tmp_path / "made"):
        pass
    assert list(tmp_path.iterdir()) == []


def test_a_second_writer_of_a_new_folder_is_told_at_once(tmp_path):
    with part_folder(tmp_path / "made"):
        with (
            pytest.raises(FileError, match=rf"made: process {os.getpid()} is making it; wait for it or give"),
            part_folder(tmp_path / "made"),
        ):
            pass
        with part_folder(tmp_path / "made", overwrite=True), part_folder(tmp_path / "made.x"):
            pass  # of two that replace one, the last stands; another name is another folder


def test_files_of_killed_writers_go_and_those_of_running_ones_stay(tmp_path):
    path = tmp_path / "rows.txt"
    with whole_file(path) as running:
        running.write_text("half")
        left = tmp_path / ".partial-01234567-rows.txt"
        for half in (running, left):
            half.touch()
            os.utime(half, (0, 0))
        remove_partial(tmp_path)
        assert running.read_text() == "half" and not left.exists()
    remove_partial(tmp_path)
    assert path.read_text() == "half" and list(tmp_path.iterdir()) == [path]
    remove_partial(tmp_path / "nowhere")


@pytest.mark.parametrize("mode", [0o600, 0o640, 0o664])
def test_a_file_that_is_replaced_keeps_its_mode(tmp_path, mode):
    usual = os.umask(0o022)
    try:
        write_text(tmp_path / "new", "a")
        assert (tmp_path / "new").stat().st_mode & 0o777 == 0o644
        (tmp_path / "new").chmod(mode)
        write_text(tmp_path / "new", "b")
    finally:
        os.umask(usual)
    assert (tmp_path / "new").stat().st_mode & 0o777 == mode and (tmp_path / "new").read_text() == "b"


def test_a_device_or_fifo_is_not_replaced_and_a_link_is_not_appended_to(tmp_path):
    os.mkfifo(tmp_path / "pipe")
    with pytest.raises(FileError, match=r"pipe: cannot be written \(no regular file but a FIFO"):
        write_text(tmp_path / "pipe", "a")
    assert (tmp_path / "pipe").is_fifo() and [p.name for p in tmp_path.iterdir()] == ["pipe"]
    (tmp_path / "precious").write_text("mine")
    (tmp_path / "log").symlink_to("precious")
    with pytest.raises(OSError):
        append_text(tmp_path / "log", "more")
    append_text(tmp_path / "precious", " and more")
    assert (tmp_path / "precious").read_text() == "mine and more"


def test_the_longest_names_are_written_and_longer_ones_are_one_line(tmp_path):
    write_text(tmp_path / f"{'n' * 250}.txt", "a")
    assert [p.name for p in tmp_path.iterdir()] == [f"{'n' * 250}.txt"]
    with pytest.raises(FileError, match="cannot be written .File name too long"):
        write_text(tmp_path / ("n" * 300), "a")


def test_what_comes_from_the_future_was_left_by_a_killed_writer(tmp_path):
    partial, part = tmp_path / ".partial-0-a", tmp_path / ".scene.part-1-01234567"
    partial.write_text("")
    part.mkdir()
    for path in (partial, part):
        os.utime(path, (time.time() + 1e6, time.time() + 1e6))
    remove_partial(tmp_path)
    remove_stale(tmp_path / "scene")
    assert list(tmp_path.iterdir()) == []
