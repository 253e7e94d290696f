"""Command lines become dataclasses; each mistake is one line that says what was expected."""

import dataclasses
import inspect
from pathlib import Path
from typing import Annotated, Literal

import pytest
from tyro import _errors as events

from interactive_nav_common.commands import Command, Flag, Repeated, Words, option, parse, word
from interactive_nav_common.config import AtLeastOne
from interactive_nav_common.errors import ConfigError


class Draw(Command):
    """Draw it."""

    places: Annotated[tuple[Path, ...], *word("PLACE")]
    """Where."""
    settings: Words = ()
    """Change settings."""
    count: Annotated[AtLeastOne, option("-n", metavar="N")] = 3
    """How many."""
    span: Annotated[tuple[float, float] | None, option(metavar="FROM TO")] = None
    """From and to."""
    kind: Literal["round", "square"] = "round"
    """Shape."""
    policy: Annotated[Repeated, option(metavar="[NAME=]PLACE")] = ()
    """Who."""
    scenes: tuple[str, ...] = ()
    """Scenes."""
    fast: Flag = False
    """Quick."""
    loud: bool = True
    """Noisy."""
    given: Annotated[str | None, option(name="from")] = None
    """Source."""

    @classmethod
    def epilog(cls):
        return "settings: a=1"


@dataclasses.dataclass
class Show(Command):
    """Show it."""


@dataclasses.dataclass
class Hide(Command):
    """Hide it."""


COMMANDS = {"draw": Draw, "more": {"show": Show, "hide": Hide}}


def draw(*words):
    return parse(COMMANDS, "tool", ["draw", *words])


def test_words_become_fields():
    assert draw("a", "b", "--from", "here") == Draw(places=(Path("a"), Path("b")), given="here")
    read = draw("a", "-n", "7", "--span", "1", "2", "--kind", "square", "--no-loud", "--fast")
    assert (read.count, read.span, read.kind, read.loud, read.fast) == (7, (1.0, 2.0), "square", False, True)
    assert draw("a", "--policy", "x=m:f", "--policy", "y").policy == ("x=m:f", "y")
    assert parse(COMMANDS, "tool", ["more", "show"]) == Show()


def test_settings_and_places_may_stand_anywhere(tmp_path):
    read = draw("a=1", "p", "--scenes", "A", "b.c=[1,2]", "B", "--fast", "d=x", "--policy", "e=f:g", "h=2")
    assert read.settings == ("a=1", "b.c=[1,2]", "d=x", "h=2")
    assert (read.places, read.scenes, read.policy) == ((Path("p"),), ("A", "B"), ("e=f:g",))
    assert draw("p", "-n", "2", "q", "--fast", "r").places == (Path("p"), Path("q"), Path("r"))
    assert draw("p", "a=" + "x" * 5000).settings == ("a=" + "x" * 5000,)  # longer than names of files may be
    (tmp_path / "a=b").mkdir()
    assert draw(f"{tmp_path}/a=b").places == (tmp_path / "a=b",)


@pytest.mark.parametrize(
    ("words", "message"),
    [
        (["p", "-n", "0"], "--count is 0, expected at least 1"),
        (["p", "-n", "x"], "--count is 'x', expected a whole number (--help lists all)"),
        (["p", "-n"], "--count lacks a value, expected N (--help lists all)"),
        (["p", "--span", "1", "x"], "--span is 'x', expected numbers (--help lists all)"),
        (["p", "--kind", "rund"], "--kind is 'rund', expected one of round, square, did you mean 'round'?"),
        (["p", "--fsat=3"], "unrecognized --fsat=3, did you mean '--fast'? (--help lists all)"),
        (["p", "--form", "x"], "unrecognized --form x, did you mean '--from'? (--help lists all)"),
        (["p", "--entirely"], "unrecognized --entirely (--help lists all)"),
    ],
)
def test_each_mistake_is_one_line(words, message, capsys):
    with pytest.raises(ConfigError) as error:
        draw(*words)
    assert str(error.value).startswith(message) and "\n" not in str(error.value)
    assert capsys.readouterr() == ("", "")


def test_a_missing_or_wrong_command_names_the_others():
    for words, message in (
        ([], "expected a command: draw, more (--help describes them)"),
        (["drwa"], "no command 'drwa', did you mean 'draw'?; expected one of draw, more"),
        (["more"], "expected a command: show, hide (--help describes them)"),
        (["--fast"], "expected"),
    ):
        with pytest.raises(ConfigError, match="^" + message.split("(")[0].replace("?", r"\?")):
            parse(COMMANDS, "tool", words)


def test_help_shows_fields_settings_and_what_follows(capsys):
    with pytest.raises(SystemExit, match="0"):
        draw("--help")
    text = " ".join(capsys.readouterr().out.split())
    for part in (
        "usage: tool draw",
        "Draw it.",
        "KEY=VALUE Change settings.",
        "-n N, --count N",
        "How many. (default: 3)",
    ):
        assert part in text
    assert text.endswith("settings: a=1") and "None" not in text and "(default: False)" not in text
    with pytest.raises(SystemExit, match="0"):
        parse(COMMANDS, "tool", ["--help"])
    text = " ".join(capsys.readouterr().out.split())
    assert "draw Draw it." in text and "more Commands: show, hide." in text


@pytest.mark.parametrize("shell", ["bash", "zsh", "fish"])
def test_shells_can_complete(shell, capsys):
    with pytest.raises(SystemExit):
        parse(COMMANDS, "tool", ["--tyro-print-completion", shell])
    text = capsys.readouterr().out
    assert "draw" in text and "count" in text and "square" in text


def test_tyro_reports_its_mistakes_as_data():
    """The hook is not in tyro's documentation: where this fails, look for a public one before the version rises."""
    assert "The hook receives one" in str(inspect.getdoc(events)) and "raise" in str(
        inspect.getdoc(events.ParseErrorHook)
    )
