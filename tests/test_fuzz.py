"""2,000 damaged files over all readers: read or refused in one line, nothing read outside, within 60 s and 6 GiB."""

from __future__ import annotations

import collections
import subprocess
import sys

import pytest

from tests.fuzz import GROUPS, ROOT

SEEDS = 80
"""For each of the 28 targets: more than 2,000 in all."""
SHORT = SEEDS // 5


def lines_of(group: str, first: int, last: int) -> list[str]:
    """What a process prints that damages the files of a group."""
    words = [sys.executable, "-m", "tests.fuzz", group, str(first), str(last)]
    done = subprocess.run(words, cwd=ROOT, capture_output=True, text=True)
    lines = done.stdout.splitlines()
    assert done.returncode == 0, f"{lines[-1:]}: {done.stderr[-3000:]}"
    return lines


def wrong(lines: list[str], count: int) -> list[str]:
    """What is neither read nor refused, and numbers of either that cannot be right."""
    told = collections.Counter(line.rpartition(": ")[2] for line in lines)
    found = [line for line in lines if not line.endswith((": read", ": refused"))]
    if len(lines) != count or told["read"] <= 0.05 * count or told["refused"] <= 0.2 * count:
        found.append(f"{len(lines)} of {count}, {dict(told)}")
    return found


@pytest.mark.parametrize("group", GROUPS)
def test_a_fifth_of_them(group):
    assert wrong(lines_of(group, 0, SHORT), SHORT * GROUPS[group][1]) == []


@pytest.mark.heavy
@pytest.mark.parametrize("group", GROUPS)
def test_the_others(group):
    assert wrong(lines_of(group, SHORT, SEEDS), (SEEDS - SHORT) * GROUPS[group][1]) == []


def test_a_traceback_and_a_lack_of_refusals_are_told():
    assert wrong(["a 1: read", "a 2: refused"], 2) == []
    assert wrong(["a 1: read", "a 2: KeyError"], 2) == ["a 2: KeyError", "2 of 2, {'read': 1, 'KeyError': 1}"]


def test_there_are_two_thousand():
    assert SEEDS * sum(count for _, count in GROUPS.values()) >= 2000
