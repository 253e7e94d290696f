"""Tables of command lines: what argparse makes of a row, and that every packaged row is one."""

import argparse
from pathlib import Path

import pytest

from interactive_nav_common.words import Parser, add_words, program, read_commands

TABLE = """
draw:
  help: draw it
  writes: ['{}/*']
  words:
    places: {nargs: +, type: path}
    -n, --count: {type: positive, default: "{cores}", help: "so many (default {cores})"}
    --span: {nargs: 2, type: float, metavar: [FROM, TO], help: from and to}
    --loud: {action: yes_or_no, default: true}
    --share: {type: positive_number, choices: "{shares}"}
"""


def test_a_row_becomes_words_of_a_parser(tmp_path):
    (tmp_path / "words.yaml").write_text(TABLE)
    row = read_commands(tmp_path / "words.yaml")["draw"]
    parser = argparse.ArgumentParser()
    add_words(parser, row.words, cores=3, shares=(0.5, 2.0))
    arguments = parser.parse_args(["a", "b", "--share", "0.5"])
    assert arguments == argparse.Namespace(places=[Path("a"), Path("b")], count=3, span=None, loud=True, share=0.5)
    assert parser.parse_args(["a", "-n", "7"]).count == 7
    assert parser.parse_args(["a", "--span", "1", "2"]).span == [1.0, 2.0] and "--span FROM TO" in parser.format_help()
    assert not parser.parse_args(["a", "--no-loud"]).loud
    assert "so many (default 3)" in parser.format_help() and row.writes == ("{}/*",)


@pytest.mark.parametrize("words", [["-n", "0"], ["-n", "x"], ["--share", "-1"], ["--share", "3"]])
def test_values_that_a_row_does_not_allow_are_refused(words, tmp_path):
    (tmp_path / "words.yaml").write_text(TABLE)
    parser = argparse.ArgumentParser()
    add_words(parser, read_commands(tmp_path / "words.yaml")["draw"].words, cores=3, shares=(0.5, 2.0))
    with pytest.raises(SystemExit, match="2"):
        parser.parse_args(["a", *words])


def test_a_row_becomes_a_programs_parser(tmp_path):
    (tmp_path / "words.yaml").write_text(TABLE)
    made = program(tmp_path / "words.yaml", "draw", "told\n  as it is", cores=3, shares=(0.5, 2.0))
    assert made.prog == f"python -m {tmp_path.name}.draw" and made.description == "draw it"
    assert made.format_help().endswith("told\n  as it is\n") and made.parse_args(["a"]).count == 3


def test_a_wrong_option_of_a_command_says_which_it_looks_like(capsys):
    parser = Parser(prog="tool")
    command = parser.add_subparsers().add_parser("convert")
    command.add_argument("--segment", action="store_true")
    with pytest.raises(SystemExit, match="2"):
        parser.parse_args(["convert", "--segmnt=3"])
    assert "tool: error: unrecognized arguments: --segmnt=3, did you mean '--segment'?" in capsys.readouterr().err
    with pytest.raises(SystemExit, match="2"):
        parser.parse_args(["convert", "--unlike"])
    assert "did you mean" not in capsys.readouterr().err


def test_a_setting_behind_scenes_is_no_scene(tmp_path):
    parser = Parser()
    parser.add_argument("run")
    parser.add_argument("--scenes", nargs="+")
    parser.add_argument("--seed", type=int)
    parser.add_argument("overrides", nargs="*")
    read = parser.parse_intermixed_args(["r", "env.b=1", "--scenes", "A", "env.x=[1,2]", "B", "--seed", "3", "env.c=2"])
    assert (read.run, read.scenes, read.seed) == ("r", ["A", "B"], 3)
    assert read.overrides == ["env.b=1", "env.x=[1,2]", "env.c=2"]
    (tmp_path / "a=b").mkdir()
    assert parser.parse_intermixed_args(["r", "--scenes", str(tmp_path / "a=b")]).scenes == [str(tmp_path / "a=b")]
    with pytest.raises(SystemExit, match="2"):  # a scene is still needed
        parser.parse_intermixed_args(["r", "--scenes", "env.x=1"])
