"""Tables for the terminal."""

from __future__ import annotations

import io

from converters.__main__ import gate_table
from converters.check.gates import judge
from interactive_nav_common.jobs.progress import SafeConsole


def test_verdicts_are_words_without_markup():
    out = io.StringIO()
    SafeConsole(file=out, width=120).print(gate_table((judge("walls", 4.0), judge("walls", 1000.0))))
    rows = [line.split("│")[1:-1] for line in out.getvalue().splitlines() if line.startswith("│")]
    assert [[cell.strip() for cell in row] for row in rows] == [
        ["walls", "4 count", "<= 200", "PASS"],
        ["walls", "1000 count", "<= 200", "FAIL"],
    ]
