"""Errors: a user's are one line and exit code 2; our own keep their traceback and exit with 1."""

from __future__ import annotations

import subprocess
import sys
from pathlib import Path

import pytest

from interactive_nav_common.errors import ConfigError, UserError, reports_errors

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


def test_our_own_error_in_a_program_prints_its_traceback_and_exits_with_1(tmp_path):
    code = (
        "import sys, interactive_nav; from train import __main__\n"
        "def broken(*a, **k): raise ValueError('operands could not be broadcast together')\n"
        "interactive_nav.make = broken\n"
        "sys.exit(__main__.main(['--config', 'demo', f'run.out_dir={sys.argv[1]}']))"
    )
    ran = subprocess.run(
        [sys.executable, "-c", code, str(tmp_path)], cwd=ROOT, capture_output=True, text=True, timeout=120
    )
    assert ran.returncode == 1 and "Traceback" in ran.stderr and "broadcast" in ran.stderr
