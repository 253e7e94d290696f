"""The house: rooms import one way, folders, files and functions stay small, and the drawn map shows what is there."""

from __future__ import annotations

import ast
import re
import subprocess
from pathlib import Path

import pytest
import yaml
from markdown_it import MarkdownIt

from docs.package_map import PACKAGES, Source, circles, import_graph, read_sources, room_graph, svg

ROOT = Path(__file__).parents[1]
MAY_IMPORT = {
    "interactive_nav_common": set(),
    "scenes_mjcf": {"interactive_nav_common"},
    "converters": {"scenes_mjcf", "interactive_nav_common"},
    "interactive_nav": {"scenes_mjcf", "interactive_nav_common"},
    "train": {"interactive_nav", "scenes_mjcf", "interactive_nav_common"},
    "topological_nav": {"interactive_nav", "train", "scenes_mjcf", "interactive_nav_common"},
    "benchmarks": set(PACKAGES) - {"benchmarks", "docs"},
    "docs": set(PACKAGES),
}
CHECKOUT_KIB = 34_816
"""Most that tracked files may take."""
MODULES_A_FOLDER, LINES_A_FILE, LINES_A_FUNCTION = 12, 400, 80
"""A cohesive function may have 80 lines; beyond that it holds several thoughts."""


@pytest.fixture(scope="module")
def sources() -> list[Source]:
    return read_sources(ROOT)


def back_edges(sources: list[Source]) -> list[str]:
    """'module imports module' for each import, or program named to be run, against the grain of the packages."""
    graph, found = import_graph(sources), []
    for source in sources:
        words = {node.value for node in ast.walk(source.tree) if isinstance(node, ast.Constant)}
        named = {word for word in words if isinstance(word, str) and re.fullmatch(r"\w+(\.\w+)+", word)}
        named = set() if source.module == "interactive_nav.__main__" else named  # the door to every program
        package = source.module.partition(".")[0]
        for other in sorted(graph[source.module] | named):
            top = other.partition(".")[0]
            if top in MAY_IMPORT and top != package and top not in MAY_IMPORT[package]:
                found.append(f"{source.module} imports {other}")
    return found


def crowded_folders(sources: list[Source]) -> list[str]:
    """Folders of more modules than one takes in at a glance; `__init__` and `__main__` are not counted."""
    count: dict[str, int] = {}
    for source in sources:
        if not source.path.stem.startswith("__"):
            count[str(source.path.parent)] = count.get(str(source.path.parent), 0) + 1
    return [f"{folder}: {n} modules" for folder, n in count.items() if n > MODULES_A_FOLDER]


def long_files(sources: list[Source]) -> list[str]:
    """Files too long to be one room."""
    lengths = {str(source.path): len(source.text.splitlines()) for source in sources}
    return [f"{path}: {n} lines" for path, n in lengths.items() if n > LINES_A_FILE]


def long_functions(sources: list[Source]) -> list[str]:
    """Functions too long to be read at once."""
    found = []
    for source in sources:
        for node in ast.walk(source.tree):
            if isinstance(node, ast.FunctionDef | ast.AsyncFunctionDef):
                lines = (node.end_lineno or node.lineno) - node.lineno + 1
                if lines > LINES_A_FUNCTION:
                    found.append(f"{source.path}:{node.lineno} {node.name}: {lines} lines")
    return found


def test_no_import_runs_backwards(sources):
    assert back_edges(sources) == []


def test_no_modules_import_each_other_in_a_circle(sources):
    assert circles(import_graph(sources)) == []


def test_no_rooms_import_each_other_in_a_circle(sources):
    assert circles(room_graph(sources)) == []


def test_no_folder_is_crowded(sources):
    assert crowded_folders(sources) == []


def test_no_file_is_long(sources):
    assert long_files(sources) == []


def test_no_function_is_long(sources):
    assert long_functions(sources) == []


def test_the_drawn_map_is_that_of_the_imports(sources):
    drawn = (ROOT / "docs" / "packages.svg").read_text(encoding="utf-8")
    assert drawn == svg(room_graph(sources)), "python docs/package_map.py draws it anew"


def test_no_link_is_tracked():
    """A link to a folder of one machine replaces that folder wherever the branch is merged."""
    listed = subprocess.run(("git", "ls-files", "-s"), cwd=ROOT, capture_output=True, text=True)
    if listed.returncode:
        pytest.skip("not a Git checkout")
    lines = listed.stdout.splitlines()
    assert lines and [line for line in lines if line.startswith("120000")] == []


def test_the_checkout_is_small():
    listed = subprocess.run(("git", "ls-files", "-z"), cwd=ROOT, capture_output=True, text=True)
    if listed.returncode:
        pytest.skip("not a Git checkout")
    sizes = {name: (ROOT / name).lstat().st_size for name in listed.stdout.split("\0") if (ROOT / name).is_file()}
    # Each file counts in whole KiB: thousands of small ones are not for nothing.
    assert sum(-(-size // 1024) for size in sizes.values()) <= CHECKOUT_KIB, sorted(sizes, key=sizes.__getitem__)[-10:]


def test_the_gates_fail_where_they_should(tmp_path):
    room = tmp_path / "interactive_nav" / "crowd"
    room.mkdir(parents=True)
    for k in range(MODULES_A_FOLDER + 1):
        (room / f"m{k}.py").write_text("")
    (room / "m0.py").write_text("def f():\n    from interactive_nav.crowd import m1\n")
    (room / "m1.py").write_text("import interactive_nav.crowd.m0\nfrom train.config import TrainConfig\n")
    (room / "m2.py").write_text("def long():\n" + "    pass\n" * LINES_A_FILE)
    (tmp_path / "train").mkdir()
    (tmp_path / "train" / "config.py").write_text("from interactive_nav.crowd.m2 import long\n")
    sources = read_sources(tmp_path)
    assert back_edges(sources) == ["interactive_nav.crowd.m1 imports train.config"]
    (room / "m3.py").write_text('subprocess.run([sys.executable, "-m", "train.replay"])\n')
    assert back_edges(read_sources(tmp_path))[1:] == ["interactive_nav.crowd.m3 imports train.replay"]
    assert circles(import_graph(sources)) == [["interactive_nav.crowd.m0", "interactive_nav.crowd.m1"]]
    assert circles(room_graph(sources)) == [["interactive_nav.crowd", "train.config"]]
    assert crowded_folders(sources) == ["interactive_nav/crowd: 13 modules"]
    assert long_files(sources) == ["interactive_nav/crowd/m2.py: 401 lines"]
    assert long_functions(sources) == ["interactive_nav/crowd/m2.py:1 long: 401 lines"]


def dialect(text: str) -> list[str]:
    """Return the phrases of a page, without its code, that docs/styles/House/Dialect.yml replaces."""
    swap = yaml.safe_load((ROOT / "docs/styles/House/Dialect.yml").read_text("utf-8"))["swap"]
    inline = [t.children or [] for t in MarkdownIt().enable("table").parse(text) if t.type == "inline"]
    lines = [" ".join("".join(c.content if c.type == "text" else " " for c in line).split()) for line in inline]
    return [m.group() for line in lines for old in swap for m in re.finditer(rf"(?i)\b(?:{old})\b", line)]


def test_pages_are_in_plain_english():
    pages = [ROOT / "README.md", ROOT / "benchmarks" / "README.md", *ROOT.glob("docs/*.md")]
    said = {p.name: dialect(p.read_text("utf-8")) for p in pages}
    assert {name: words for name, words in said.items() if words} == {}
    planted = "It arrives in\n0.97 of 60 episodes; `anew` is code."
    assert dialect(planted) == ["arrives", "0.97 of 60 episodes"]
