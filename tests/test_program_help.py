"""The page of commands names every program, and shows what its parser says."""

from __future__ import annotations

import contextlib
import importlib
import re
import sys
import tomllib
from pathlib import Path

import pytest

from docs.package_map import read_sources
from docs.program_help import help_of
from interactive_nav.__main__ import PROGRAMS, main
from interactive_nav_common.commands import TYPED

ROOT = Path(__file__).parents[1]
PAGE = ROOT / "docs" / "commands.md"
INNER = {"converters.many", "converters.bodies.coacd_worker"}
"""Started by other programs; nobody types them."""


def programs(root: Path) -> set[str]:
    """Modules that `python -m` runs, studies and examples of the documentation left out."""
    sources = [source for source in read_sources(root) if source.path.parts[0] != "docs"]
    run = {s.module for s in sources if '\nif __name__ == "__main__":' in s.text or s.path.name == "__main__.py"}
    return {module.removesuffix(".__main__") for module in run} - INNER


def shown(text: str) -> set[str]:
    """Programs whose help a page shows."""
    return set(re.findall(r"^```\{help-of\} (\S+)$", text, re.MULTILINE))


def test_the_page_shows_every_program():
    assert {"train", "benchmarks.steps_per_second"} < programs(ROOT)
    assert shown(PAGE.read_text(encoding="utf-8")) == programs(ROOT)


def test_a_program_that_is_missing_is_found(tmp_path):
    (tmp_path / "train").mkdir()
    (tmp_path / "train" / "__main__.py").write_text("")
    (tmp_path / "train" / "extra.py").write_text('x = 1\n\nif __name__ == "__main__":\n    pass\n')
    (tmp_path / "train" / "plain.py").write_text("x = 1\n")
    assert programs(tmp_path) == {"train", "train.extra"}
    assert shown("```{help-of} train\n```\n\n`train.extra`\n") == {"train"}


def test_help_is_that_of_the_parser_and_of_its_commands():
    told = help_of("interactive_nav.episodes")
    assert list(told) == ["python -m interactive_nav.episodes", "python -m interactive_nav.episodes make"]
    assert "--num-objects" in told["python -m interactive_nav.episodes make"]
    assert max(len(line) for text in told.values() for line in text.splitlines()) <= 100
    assert "generate-scenes" in help_of("interactive_nav")["python -m interactive_nav"]
    with pytest.raises(AttributeError):
        help_of("train.config")


@pytest.mark.parametrize("command", ["train", "evaluate", "convert"])
def test_help_shows_what_was_typed(command, capsys, monkeypatch):
    module, _ = PROGRAMS[command]
    monkeypatch.setitem(TYPED, f"python -m {module}", "")  # set again by `main`, and removed after the test
    monkeypatch.setattr(sys, "argv", ["interactive-nav", command, "--help"])
    with pytest.raises(SystemExit) as ended:
        main()
    assert not ended.value.code and capsys.readouterr().out.startswith(f"usage: interactive-nav {command} ")


@pytest.mark.parametrize("module", sorted(programs(ROOT)))
def test_every_program_prints_its_version(module, capsys, monkeypatch):
    monkeypatch.setattr(sys, "argv", [module, "--version"])
    package = (ROOT / module.replace(".", "/")).is_dir()
    program = importlib.import_module(f"{module}.__main__" if package else module)
    with contextlib.suppress(SystemExit):
        program.main()
    number = tomllib.loads((ROOT / "pyproject.toml").read_text())["project"]["version"]
    assert capsys.readouterr().out == f"interactive-nav {number}\n"
