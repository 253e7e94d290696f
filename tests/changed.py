"""Files changed of late in, the heavy tests to run in `make test` out."""

from __future__ import annotations

import re
import subprocess
from collections.abc import Iterable
from pathlib import Path, PurePosixPath

HOURS = 4
AT_MOST = 1
"""Heavy tests that `make test` takes on."""
INSTALLED = {
    "tests/test_wheel.py": {"pyproject.toml", "interactive_nav/__main__.py"},
    "tests/converters/test_sample_scan.py": {"converters/pipeline.py", "converters/bodies/decompose.py"},
}
"""Tests of the whole, and what of it concerns them."""
COMMANDS = (
    ("diff", "--name-only", "HEAD"),
    ("ls-files", "--others", "--exclude-standard"),
    ("log", f"--since={HOURS} hours ago", "--name-only", "--pretty=format:"),
)


def changed_files(root: Path) -> set[str]:
    """Paths below a checkout's root that are not committed or were in the last hours; none where there is no Git."""
    found: set[str] = set()
    for words in COMMANDS:
        try:
            done = subprocess.run(("git", *words), cwd=root, capture_output=True, text=True)
        except OSError:
            return set()
        found |= set(done.stdout.splitlines()) if done.returncode == 0 else set()
    return found - {""}


def chosen(tests: Iterable[str], changed: set[str], most: int = AT_MOST) -> list[str]:
    """The first `most` of tests 'tests/a/test_b.py::...' whose file, module a/b.py or page ('...[b.md]') changed."""

    def touched(test: str) -> bool:
        path = PurePosixPath(test.partition("::")[0])
        module = PurePosixPath(*path.parts[1:-1], path.name.removeprefix("test_"))
        pages = {f"docs/{page}" for page in re.findall(r"\[([\w-]+\.md)\]", test)}
        return not changed.isdisjoint({str(path), str(module), *pages, *INSTALLED.get(str(path), ())})

    return [test for test in tests if touched(test)][:most]
