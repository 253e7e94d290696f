"""`python -m docs.studies.house [COMMIT...]`: how large the product is, and where a change of each kind has to be made.

For each commit it prints the product's lines and public names by package, and the modules that name one example of each
kind of change: whoever adds another one has to read these, and most likely to edit them.
"""

import ast
import io
import re
import subprocess
import tarfile
from collections import Counter
from pathlib import PurePosixPath

EXAMPLES = {
    "reward term": r"""["'](reward/)?interaction["']""", "metric with memory": r"\bstructure_steps\b",
    "observation with memory": r"\b_?odometry\b", "robot": r"(?i)jackrabbot",
    "scene source": r"\bscan2cad\b", "algorithm": r"\bddpg\b",
}  # fmt: skip
"""Kind of change -> what code that knows one of its kind matches."""


def product(commit: str) -> dict[str, str]:
    """Return the product's Python files of a commit, by path; tests and documentation are left out."""
    packed = subprocess.run(["git", "archive", commit, "*.py"], check=True, capture_output=True).stdout
    with tarfile.open(fileobj=io.BytesIO(packed)) as archive:
        files = [m for m in archive if m.isfile() and PurePosixPath(m.name).parts[0] not in ("tests", "docs")]
        return {m.name: archive.extractfile(m).read().decode() for m in files}  # type: ignore[union-attr]


def public_names(text: str) -> list[str]:
    """Return the functions and classes that a module defines at its top level, without an underscore."""
    kinds = ast.FunctionDef | ast.ClassDef
    return [node.name for node in ast.parse(text).body if isinstance(node, kinds) and node.name[0] != "_"]


def touched(files: dict[str, str], pattern: str) -> list[str]:
    """Return the modules that match a pattern, comments and docstrings included."""
    return sorted(path for path, text in files.items() if re.search(pattern, text))


def report(files: dict[str, str]) -> list[str]:
    """Return the lines that are printed for one commit."""
    lines, names = Counter(), Counter()
    for path, text in files.items():
        lines[path.partition("/")[0]] += text.count("\n")
        names[path.partition("/")[0]] += len(public_names(text))
    rows = [f"{package:22} {lines[package]:6,} lines {names[package]:5,} public names" for package in sorted(lines)]
    rows.append(f"{'in all':22} {lines.total():6,} lines {names.total():5,} public names")
    for kind, pattern in EXAMPLES.items():
        modules = touched(files, pattern)
        rows.append(f"{kind}: {len(modules)} modules: {', '.join(modules)}")
    return rows


def main(commits: list[str]) -> None:
    """Print the report of each commit."""
    for commit in commits or ["HEAD"]:
        print(commit, *report(product(commit)), sep="\n  ")
