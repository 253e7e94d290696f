"""2,000 damaged files over all readers: read or refused in one line, nothing read outside, within 60 s and 6 GiB."""

from __future__ import annotations

import collections
import subprocess
import sys

import pytest

from tests.fuzz import GROUPS, ROOT

SEEDS = 87
"""For each of the 23 targets: 2,001 in all."""
SHORT = SEEDS // 5


def lines_of(group: str, first: int, last: int) -> list[str]:
    """What a process prints that damages the files of a group."""
    words = [sys.executable, "-m", "tests.fuzz", group, str(first), str(last)]
    done = subprocess.run(words, cwd=ROOT, capture_output=True, text=True)
    lines = done.stdout.splitlines()
    assert done.returncode == 0, f"{lines[-1:]}: {done.stderr[-3000:]}"
    return lines


def check(lines: list[str], count: int) -> None:
    told = collections.Counter(line.rpartition(": ")[2] for line in lines)
    bad = [line for line in lines if not line.endswith((": read", ": refused"))]
    assert not bad, "\n".join(bad)
    assert len(lines) == count and told["read"] > 0.05 * count and told["refused"] > 0.2 * count


@pytest.mark.parametrize("group", GROUPS)
def test_a_fifth_of_them(group):
    check(lines_of(group, 0, SHORT), SHORT * GROUPS[group][1])


@pytest.mark.heavy
@pytest.mark.parametrize("group", GROUPS)
def test_the_others(group):
    check(lines_of(group, SHORT, SEEDS), (SEEDS - SHORT) * GROUPS[group][1])


def test_there_are_two_thousand():
    assert SEEDS * sum(count for _, count in GROUPS.values()) >= 2000
