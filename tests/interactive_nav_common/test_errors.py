"""Errors: a user's are one line and exit code 2; our own keep their traceback and exit with 1."""

from __future__ import annotations

import io
import os
import subprocess
import sys
from pathlib import Path

import pytest
from rich.table import Table

import interactive_nav
from interactive_nav_common.errors import ConfigError, UserError, readable, reports_errors
from interactive_nav_common.jobs.progress import SafeConsole

ROOT = Path(__file__).parents[2]


@reports_errors("program")
def _program(error: Exception) -> int:
    raise error


def test_a_users_error_is_one_line_and_2(capsys):
    assert _program(ConfigError("seed is -1, expected 0 or more")) == 2
    assert capsys.readouterr().err == "program: seed is -1, expected 0 or more\n"


def test_control_characters_of_names_do_not_reach_the_terminal(capsys):
    assert _program(ConfigError("x\x1b[2Jy\u202e\n.png: Büro – missing")) == 2
    assert capsys.readouterr().err == "program: x\\x1b[2Jy\\u202e\\n.png: Büro – missing\n"


@pytest.mark.parametrize("kind", [ValueError, OSError, KeyError, RuntimeError])
def test_our_own_error_is_not_taken_for_the_users(kind):
    assert not issubclass(UserError, kind)
    with pytest.raises(kind, match="operands could not be broadcast"):
        _program(kind("operands could not be broadcast together"))


def test_our_own_error_in_a_program_is_not_reported_as_the_users(tmp_path, monkeypatch):
    """So that Python prints its traceback and exits with 1."""
    from train import __main__

    def broken(*_, **__):
        raise ValueError("operands could not be broadcast together")

    monkeypatch.setattr(interactive_nav, "make", broken)
    with pytest.raises(ValueError, match="operands could not be broadcast together"):
        __main__.main(["--config", "demo", f"run.out_dir={tmp_path}"])


def test_a_long_value_is_cut_out_of_a_message():
    text = str(ConfigError(f"seed is {'x' * 10**6}, expected a number"))
    assert len(text) < 2000 and text.startswith("seed is xxx") and text.endswith("xxx, expected a number")


PRINTS = """
import sys
from interactive_nav_common.errors import reports_errors
from interactive_nav_common.jobs.progress import SafeConsole

@reports_errors("program")
def main():
    for _ in range(10_000):
        {prints}
    return 0

sys.exit(main())
"""


@pytest.mark.parametrize("prints", ["print('m² ┏')", "SafeConsole().print('m² ┏')"])
@pytest.mark.parametrize("unbuffered", ["", "1"])
def test_output_that_nobody_takes_ends_a_program_in_one_line_or_none(tmp_path, prints, unbuffered):
    (tmp_path / "p.py").write_text(PRINTS.format(prints=prints))
    env = {**os.environ, "PYTHONPATH": str(ROOT), "PYTHONUNBUFFERED": unbuffered, "PYTHONIOENCODING": "ascii"}

    def run(out):
        return subprocess.run(
            [sys.executable, "p.py"], cwd=tmp_path, env=env, stdout=out, stderr=subprocess.PIPE, text=True
        )

    reading, writing = os.pipe()
    os.close(reading)
    broken = run(writing)
    os.close(writing)
    assert (broken.returncode, broken.stderr) == (141, "")
    with open("/dev/full", "w") as full:
        refused = run(full)
    assert (refused.returncode, refused.stderr) == (2, "program: output: No space left on device\n")
    with open(tmp_path / "out", "w") as file:
        assert run(file).returncode == 0
    assert (tmp_path / "out").read_text().startswith("m\\xb2 \\u250f\n")


def test_names_with_markup_or_control_characters_are_printed_as_they_are():
    out = io.StringIO()
    table = Table("[red]x[/]\x1b[2J")
    table.add_row("[/]\u202e")
    console = SafeConsole(file=out, width=60)
    console.print("[bold]a[/b]\x1b]0;t\x07\nb", table)
    assert all(text in out.getvalue() for text in ("[bold]a[/b]\\x1b]0;t\\x07\nb", "[red]x[/]\\x1b[2J", "[/]\\u202e"))
    assert "\x1b" not in out.getvalue()


def test_whether_a_file_may_be_missing_is_for_who_reads_it(tmp_path):
    with readable(tmp_path / "none", ConfigError, "make it again"):
        assert not (tmp_path / "none").is_file()
