"""Imports, and programs run by name, go one way.

Converters and interactive_nav know only the schema; train knows interactive_nav; and so on.
"""

import ast
import re
from pathlib import Path

ROOT = Path(__file__).parents[1]
MAY_IMPORT = {
    "interactive_nav_common": set(),
    "scenes_mjcf": {"interactive_nav_common"},
    "converters": {"scenes_mjcf", "interactive_nav_common"},
    "interactive_nav": {"scenes_mjcf", "interactive_nav_common"},
    "train": {"interactive_nav", "scenes_mjcf", "interactive_nav_common"},
    "topological_nav": {"interactive_nav", "train", "scenes_mjcf", "interactive_nav_common"},
}


def back_edges(root: Path) -> list[str]:
    """'file imports package' for each import against the grain, or module that is named to be run."""
    found = []
    for package, allowed in MAY_IMPORT.items():
        for path in (root / package).rglob("*.py"):
            for node in ast.walk(ast.parse(path.read_text(encoding="utf-8"))):
                names = [a.name for a in node.names] if isinstance(node, ast.Import) else []
                if isinstance(node, ast.ImportFrom) and node.module:
                    names = [node.module]
                if isinstance(node, ast.Constant) and re.fullmatch(r"\w+(\.\w+)+", str(node.value)):
                    names = [str(node.value)]
                for name in names:
                    top = name.split(".")[0]
                    if top in MAY_IMPORT and top != package and top not in allowed:
                        found.append(f"{path.relative_to(root)} imports {top}")
    return found


def test_no_import_runs_backwards():
    assert back_edges(ROOT) == []


def test_the_gate_fails_on_a_back_edge(tmp_path):
    for package in MAY_IMPORT:
        (tmp_path / package).mkdir()
    (tmp_path / "interactive_nav" / "bad.py").write_text("from train.config import TrainConfig\n")
    assert back_edges(tmp_path) == ["interactive_nav/bad.py imports train"]
    (tmp_path / "interactive_nav" / "bad.py").write_text('subprocess.run([sys.executable, "-m", "train.replay"])\n')
    assert back_edges(tmp_path) == ["interactive_nav/bad.py imports train"]
