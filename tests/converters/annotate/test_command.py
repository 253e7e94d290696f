"""The command: viser absent, a folder in use, a scan that is missing."""

from __future__ import annotations

import contextlib
import subprocess
import sys

import pytest

from converters.__main__ import main

NEEDS = "viser is not installed (pip install 'viser>=1.1,<1.2')"


def test_without_viser_the_command_names_what_to_install(scan2cad_raw, tmp_path, monkeypatch, capsys):
    monkeypatch.setitem(sys.modules, "viser", None)
    assert main(["annotate", str(scan2cad_raw), "-o", str(tmp_path / "mine"), "--port", "0"]) == 2
    expected = "annotate needs viser, which is not installed; pip install 'interactive-nav[annotate]'"
    assert expected in capsys.readouterr().err


def test_two_people_in_one_folder_and_a_missing_scan_are_one_line(scan2cad_raw, tmp_path, capsys):
    pytest.importorskip("viser", reason=NEEDS)
    words = [
        sys.executable,
        "-m",
        "converters",
        "annotate",
        str(scan2cad_raw),
        "-o",
        str(tmp_path / "mine"),
        "--port",
        "0",
    ]
    with subprocess.Popen(words, stdout=subprocess.PIPE, text=True) as first:
        try:
            assert first.stdout is not None
            assert any("Ctrl-C ends it" in line for line in first.stdout)
            assert main(words[3:]) == 2
            assert "works there; wait for it or choose another folder (-o)" in capsys.readouterr().err
        finally:
            first.terminate()
            first.communicate(timeout=60)  # it may print once more: a closed pipe would end it otherwise
    assert first.returncode == 143
    with contextlib.suppress(SystemExit):
        assert main(["annotate", str(tmp_path / "no.ply"), "-o", str(tmp_path / "other")]) == 2
    assert "no.ply" in capsys.readouterr().err
