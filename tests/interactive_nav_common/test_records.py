"""Records: what is read, and what is refused with the file, the key, what stands there and what was expected."""

from __future__ import annotations

import dataclasses
import math
from typing import Annotated, Any, Literal

import pytest

from interactive_nav_common.config import Bounds, Natural
from interactive_nav_common.errors import FileError
from interactive_nav_common.records import Reader, read_packaged

READER = Reader(FileError, "make it again")


@dataclasses.dataclass(frozen=True)
class Wheel:
    radius_m: Annotated[float, Bounds(0, open=True)]


@dataclasses.dataclass(frozen=True)
class Robot:
    name: str
    kind: Literal["base", "arm"] = "base"
    wheels: tuple[Wheel, ...] = ()
    at: tuple[float, float] | None = None
    seeds: dict[str, Natural] = dataclasses.field(default_factory=dict)
    size: int | dict[str, list[int]] = 0
    moves: bool = True
    notes: Any = None


def test_lists_become_tuples_and_mappings_records():
    data = {
        "name": "a",
        "kind": "arm",
        "wheels": [{"radius_m": 1}],
        "at": [0, 1.5],
        "size": {"x": [2]},
        "notes": [None],
    }
    want = Robot("a", "arm", (Wheel(1),), (0, 1.5), {}, {"x": [2]}, True, [None])
    assert READER.record(data, Robot, "x") == want and READER.record({"name": "a"}, Robot, "x") == Robot("a")
    assert READER.record({"name": "a", "more": 1}, Robot, "x", others=True) == Robot("a")


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ([], "f: got [], expected a mapping"),
        ({"nam": 1}, "f: unknown key 'nam', did you mean 'name'?; known keys: at, kind, moves, name, notes, seeds, "),
        ({"name": None}, "f: name is null, expected a string; make it again"),
        ({"name": "x" * 99 * 99, "kind": "leg"}, "f: kind is 'leg', expected one of base, arm"),
        ({"kind": ["arm"]}, 'f: kind is ["arm"], expected one of base, arm'),
        ({"wheels": [{"radius_m": 1}, 3]}, "f: wheels[1]: got 3, expected a mapping"),
        ({"wheels": [{}]}, "f: wheels[0]: missing key 'radius_m'"),
        ({"wheels": [{"radius_m": 0}]}, "f: wheels[0]: radius_m is 0, expected a positive number"),
        ({"wheels": {"a": 1}}, 'f: wheels is {"a": 1}, expected a list'),
        ({"at": [1]}, "f: at is [1], expected a list of 2"),
        ({"at": [1, True]}, "f: at[1] is true, expected a number"),
        ({"seeds": {"a": -1}}, "f: seeds: a is -1, expected a whole number, 0 or more"),
        ({"seeds": {"a": 1.5}}, "f: seeds: a is 1.5, expected a whole number"),
        ({"size": "1"}, 'f: size is "1", expected a mapping'),
        ({"moves": 1}, "f: moves is 1, expected true or false"),
    ],
)
def test_what_does_not_fit_is_named(change, message):
    data = {"name": "a"} | change if isinstance(change, dict) else change
    with pytest.raises(FileError) as refused:
        READER.record(data, Robot, "f")
    assert str(refused.value).startswith(message) and "\n" not in str(refused.value)


@pytest.mark.parametrize(
    ("text", "kind", "message"),
    [
        ('{"a": [1, {"b": Infinity}]}', "JSON", "f: a[1]: b is Infinity, expected a finite number below 2**64"),
        ('{"a": NaN}', "JSON", "f: a is NaN, expected a finite number"),
        ('{"a": 1e999}', "JSON", "f: a is Infinity, expected a finite number"),
        ('{"a": 1%s}' % ("0" * 400), "JSON", "f: a is 1000000"),
        ('{"a": 1%s}' % ("0" * 9000), "JSON", "f: not readable as JSON (Exceeds the limit"),
        ('{"a": ', "JSON", "f: not readable as JSON ("),
        ("[" * 100_000, "JSON", "f: not readable as JSON ("),
        (b"\xff\xfe\x00", "JSON", "f: not readable as JSON ("),
        ("a: .inf", "YAML", "f: a is Infinity, expected a finite number"),
        ("a: 0x1%s" % ("0" * 9000), "YAML", "f: a is int, expected a finite number"),
        ("a: 2026-99-99", "YAML", "f: not readable as YAML (month must be in 1..12)"),
        (
            "a: &a [*a, .nan]",
            "YAML",
            "f: not readable as YAML (aliases repeat more than 10,000 values, or hold themselves",
        ),
        ("a: [&a 1, {b: *a, c: &b .nan}, *b]", "YAML", "f: a[2] is NaN, expected a finite number"),
        ("a: [", "YAML", "f: not readable as YAML ("),
    ],
)
def test_what_cannot_be_decoded_is_one_line(text, kind, message):
    with pytest.raises(FileError) as refused:
        READER.decoded(text, kind, "f")
    assert str(refused.value).startswith(message) and "\n" not in str(refused.value) and len(str(refused.value)) < 400


def test_files_that_may_be_absent_and_scores_that_may_be_none(tmp_path):
    path = tmp_path / "a.json"
    assert READER.json(path, {"b": 1}) == {"b": 1}
    with pytest.raises(FileError, match=r"a.json: cannot be read \(No such file or directory\); make it again"):
        READER.json(path)
    path.write_text('{"score": NaN}')
    assert math.isnan(dataclasses.replace(READER, finite=False).json(path)["score"])


def test_a_table_of_the_package_is_typed_and_may_be_unbounded(tmp_path):
    path = tmp_path / "masses.yaml"
    path.write_text("box: [0.01, .inf]\n")
    assert read_packaged(path, dict[str, tuple[float, float]]) == {"box": (0.01, math.inf)}
    path.write_text("box: [0.01]\n")
    with pytest.raises(FileError, match=r"masses\.yaml: box is \[0\.01\], expected a list of 2; install the package"):
        read_packaged(path, dict[str, tuple[float, float]])
