"""Many raw folders at once: a row each, what is there is kept, one that fails or is killed costs no other."""

from __future__ import annotations

import dataclasses
import json
import os
import shutil
import signal
import subprocess
import sys
import time
from pathlib import Path

import numpy as np
import pyarrow.parquet as pq
import pytest

from converters import many
from converters.__main__ import main
from converters.clock import STAGES, peak_memory_mib
from converters.many import ROWS, convert_many, digest_of
from converters.pipeline import ConvertConfig
from interactive_nav_common.jobs.processes import Launcher
from scenes_mjcf.schema import load_manifest
from tests.converters.read.test_single_mesh import tall_room

QUICK = ConvertConfig(jobs=2, structure_texture=64, object_texture=32)


class Killing(Launcher):
    """Runs commands; that of `killed` ends as the kernel would end it that is out of memory."""

    def __init__(self) -> None:
        super().__init__(2)
        self.tasks = []

    def start(self, job):
        own, kills = job.command, (sys.executable, "-c", "import os; os.kill(os.getpid(), 9)")
        begun = super().start(dataclasses.replace(job, command=kills) if job.name == "killed" else job)
        self.tasks += [json.loads(own[-1])] if begun else []
        return begun


def rows_of(into: Path) -> dict[str, dict]:
    return {row["name"]: row for row in pq.read_table(into / ROWS).to_pylist()}


@pytest.fixture(scope="module")
def sources(tmp_path_factory, pristine) -> dict[str, Path]:
    base = tmp_path_factory.mktemp("sources")
    for name in ("first", "second", "broken", "killed"):
        shutil.copytree(pristine / "gibson", base / name)
    next((base / "broken").glob("*.obj")).unlink()
    return {path.name: path for path in sorted(base.iterdir())}


@pytest.fixture(scope="module")
def converted(sources, tmp_path_factory) -> tuple[Path, list[str], Killing, list[str]]:
    into, runner, lines = tmp_path_factory.mktemp("many") / "scenes", Killing(), []
    failed = convert_many([*sources.values()], into, QUICK, runner, 2, lambda *_: None, lines.append)
    return into, failed, runner, lines


def test_a_row_each_and_no_other_is_lost(converted, sources):
    into, failed, runner, lines = converted
    assert sorted(failed) == ["broken", "killed"] and {task["config"]["jobs"] for task in runner.tasks} == {1}
    rows = rows_of(into)
    codes = {name: row["exit_code"] for name, row in rows.items()}
    assert codes == {"first": 0, "second": 0, "broken": 2, "killed": -9}
    assert rows["killed"]["error"] == "killed by signal 9" and rows["killed"]["area_m2"] is None
    assert "broken" in rows["broken"]["error"] and rows["broken"]["scenes"] is None
    assert sorted(p.name for p in into.iterdir()) == [ROWS, "first", "second"]
    first, manifest = rows["first"], load_manifest(into / "first")
    assert first["error"] is None and first["scenes"] == ["first"] and first["source"] == str(sources["first"])
    assert first["area_m2"] == manifest.floor_area_m2 and first["movables"] == len(manifest.objects) == 2
    assert first["warnings"] == list(manifest.warnings) and first["gates_failed"] == []
    assert "drift_boxes" in first["gates_passed"]
    stages = sum(first[f"{stage}_s"] for stage in STAGES)
    assert 0 < stages <= first["seconds"] < stages + 5
    assert 50 < first["peak_memory_mib"] < 5000 and first["worker_memory_mib"] < 5000
    assert "killed: killed by signal 9" in lines


def test_what_is_there_is_kept_until_its_options_or_inputs_change(converted, sources, monkeypatch):
    into, _, _, _ = converted
    lines = []
    chosen = [sources[name] for name in ("first", "second", "killed")]

    def again(config):
        runner = Killing()
        convert_many(chosen, into, config, runner, 1, lambda *_: None, lines.append)
        return {Path(task["target"]).name: task["config"]["overwrite"] for task in runner.tasks}

    monkeypatch.setattr(many.sys, "executable", "/bin/false")  # what would be converted fails at once
    assert again(QUICK) == {"killed": False}
    assert lines[:2] == ["first: is there, kept", "second: is there, kept"]
    assert "broken" in rows_of(into)  # not asked for: stays
    file = next(sources["second"].glob("*.json"))
    os.utime(file, (1, 1))
    assert again(QUICK) == {"second": True, "killed": False}
    rows = rows_of(into)
    assert rows["second"]["exit_code"] == 1 and rows["second"]["error"].startswith("exit code 1")
    assert rows["second"]["scenes"] == ["second"] and (into / "second").is_dir()  # still that of before


def test_the_digest_is_of_options_and_inputs(gibson_raw):
    first = digest_of(gibson_raw, QUICK)
    assert first == digest_of(gibson_raw, dataclasses.replace(QUICK, jobs=9, overwrite=True))
    assert first != digest_of(gibson_raw, dataclasses.replace(QUICK, seed=1))
    (gibson_raw / "more.txt").write_text("x")
    assert first != digest_of(gibson_raw, QUICK)


@pytest.mark.heavy
def test_a_file_that_the_source_names_is_one_of_its_inputs(tmp_path):
    tall_room().export(tmp_path / "room.obj")
    text = (tmp_path / "room.obj").read_text()
    (tmp_path / "room.obj").write_text("mtllib paint.mtl\nusemtl wall\n" + text)
    (tmp_path / "paint.mtl").write_text("newmtl wall\nKd 0.5 0.5 0.5\n")
    lines: list[str] = []

    def convert():
        lines.clear()
        runner, into = Killing(), tmp_path / "o"
        assert convert_many([tmp_path / "room.obj"], into, QUICK, runner, 1, lambda *_: None, lines.append) == []
        return len(runner.tasks)

    assert convert() == 1 and convert() == 0 and lines[0] == "room: is there, kept"
    (tmp_path / "paint.mtl").write_text("newmtl wall\nKd 0.9 0.1 0.1\n")
    assert convert() == 1 and convert() == 0
    (tmp_path / "o" / "room" / "scene.json").write_text("{")  # what is damaged is made again, and stops nothing
    assert convert() == 1 and convert() == 0


def test_of_the_command(tmp_path, monkeypatch, capsys):
    """SRC... and lists of them reach the function; its failures are told last and the exit code is 1."""
    asked = {}

    def convert_many(sources, into, config, runner, side_by_side, report, log):
        asked.update(sources=sources, into=into, config=config, side_by_side=side_by_side)
        return ["b"]

    monkeypatch.setattr(many, "convert_many", convert_many)
    listed = tmp_path / "list.txt"
    listed.write_text("a\nb\n\n")
    assert main(["convert", f"@{listed}", "--strict", "c", "--into", str(tmp_path / "o"), "--jobs", "2"]) == 1
    assert asked["sources"] == [Path("a"), Path("b"), Path("c")] and asked["into"] == tmp_path / "o"
    assert asked["config"].strict and asked["config"].jobs == 2 and asked["side_by_side"] == 2
    assert capsys.readouterr().out.rstrip().endswith("not converted, or with gates that fail: b")


@pytest.mark.parametrize(
    ("words", "message"),
    [
        (["a"], "got 1 folders, expected SRC OUT, or SRC... --into DIR"),
        (["a", "b", "c"], "got 3 folders, expected SRC OUT"),
        (["@nowhere.txt", "--into", "o"], "nowhere.txt"),
    ],
)
def test_wrong_words(words, message, capsys):
    assert main(["convert", *words]) == 2
    assert message in capsys.readouterr().err


def test_two_of_one_name_and_damaged_rows_are_one_line(tmp_path, capsys):
    for place in ("x/a", "y/a"):
        (tmp_path / place).mkdir(parents=True)
    words = ["--into", str(tmp_path / "o")]
    assert main(["convert", str(tmp_path / "x" / "a"), str(tmp_path / "y" / "a"), *words]) == 2
    assert capsys.readouterr().err == "error: --into: two sources are named a, expected one; rename a folder\n"
    (tmp_path / "o").mkdir()
    (tmp_path / "o" / ROWS).write_text("x")
    assert main(["convert", str(tmp_path / "x" / "a"), *words]) == 2
    assert "not readable as Parquet" in capsys.readouterr().err


@pytest.mark.parametrize(
    ("number", "code"), [pytest.param(signal.SIGINT, 130, marks=pytest.mark.heavy), (signal.SIGTERM, 143)]
)
def test_a_signal_ends_what_runs_and_leaves_no_part(sources, tmp_path, number, code):
    into = tmp_path / "scenes"
    command = [sys.executable, "-m", "converters", "convert", str(sources["first"]), "--into", str(into), "--jobs", "1"]
    running = subprocess.Popen(command, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True)
    until = time.monotonic() + 60
    while not list(into.glob(".first.part-*")) and time.monotonic() < until:
        time.sleep(0.05)
    running.send_signal(number)
    _, said = running.communicate(timeout=60)
    assert running.returncode == code and "nothing was written" in said
    assert list(into.iterdir()) == []


def test_the_memory_of_a_process_is_its_own_and_not_that_of_the_large_one_which_started_it():
    held = np.ones(400 * 2**17)  # 400 MiB
    code = "from converters.clock import peak_memory_mib; print(peak_memory_mib())"
    child = float(subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True).stdout)
    assert 5 < child < 100 and peak_memory_mib() > held.nbytes / 2**20
    assert peak_memory_mib(2**22 + 1) == 0  # no such process
