"""The page of commands names every program, and shows what its parser says."""

from __future__ import annotations

import contextlib
import importlib
import re
import sys
import tomllib
from collections.abc import Iterable
from pathlib import Path

import pytest

from docs.package_map import read_sources
from docs.program_help import help_of
from interactive_nav.__main__ import PROGRAMS, main
from interactive_nav.ros.__main__ import Simulate
from interactive_nav_common.commands import TYPED
from topological_nav.__main__ import KINDS, Listed
from train.__main__ import Train
from train.sweep.__main__ import Sweep

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


def test_long_descriptions_keep_their_column():
    lines = help_of("converters")["python -m converters"].splitlines()
    (first,) = (k for k, line in enumerate(lines) if line.startswith("  convert "))
    assert max(map(len, lines)) <= 100
    assert lines[first + 1].index("folder") == lines[first].index("Convert")
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


UNITS = {"m": "m", "s": "s", "deg": "degrees", "px": "pixels", "gb": "GB", "mb": "MB", "mib": "MiB", "n": "N"}
UNITS |= {"m_s": "m/s", "rad_s": "rad/s", "m_s2": "m/s^2", "rad_s2": "rad/s^2"}
"""Ending of a setting's name -> its unit in the text."""


def badly_told(texts: Iterable[tuple[str, str]]) -> list[str]:
    """Settings whose text is no sentence or lacks the unit of the name; `features: ...` says what it is for."""

    def fits(name: str, text: str) -> bool:
        said = re.sub(r"^(features|passages|map): (.)", lambda match: match[2].upper(), text)
        unit = next((UNITS[end] for end in sorted(UNITS, key=len, reverse=True) if name.endswith(f"_{end}")), "")
        return said[:1].isupper() and said.endswith(".") and unit in re.split(r"[ (),;:]+|\.$", said)

    return sorted(f"{name}: {text}" for name, text in set(texts) if not fits(name, text))


def listed(text: str) -> list[tuple[str, str]]:
    """Settings that a program lists below its options, each with its text and without its choices."""
    found = re.findall(r"^  ([\w.]+)(?:=|: )\S* *(\S.*)$", text, re.MULTILINE)
    return [(name, re.sub(r" \[[^\[\]]*\]$", "", said)) for name, said in found]


def test_lists_of_settings_are_sentences_with_units():
    kinds = (Train, Sweep, Simulate, *(kind for kind in KINDS if issubclass(kind, Listed)))
    texts = [pair for kind in kinds for pair in listed(kind.epilog())]
    assert {"env.hook_force_n", "ppo.num_envs", "launch.grace_s", "run_s", "fine_tune"} <= {name for name, _ in texts}
    assert badly_told(texts) == []
    wrong = [("c.x", "of all."), ("d_m", "Length."), ("d_s", "Time in ms.")]
    assert badly_told([*wrong, ("d_m", "Length in m."), ("e_m_s2", "Gravity in m/s^2.")]) == [
        "c.x: of all.",
        "d_m: Length.",
        "d_s: Time in ms.",
    ]
