"""Source files in, a drawn map of the rooms and of who imports whom out: `python docs/package_map.py`.

A room is a sub-package (`converters.read`) or a module that lies directly in a package (`train.config`). Programs
(`__main__`) are left out: nothing imports them.
"""

from __future__ import annotations

import ast
import dataclasses
import textwrap
from pathlib import Path

import numpy as np
from scipy.sparse import csr_matrix
from scipy.sparse.csgraph import connected_components

PACKAGES = (
    *("interactive_nav_common", "scenes_mjcf", "converters", "interactive_nav", "train", "topological_nav"),
    *("benchmarks", "docs"),
)
UNDRAWN = ("benchmarks", "docs")
"""Programs that measure: no package imports them."""
Graph = dict[str, set[str]]
"""Name -> names that it imports."""


@dataclasses.dataclass(frozen=True)
class Source:
    """One Python file of a package."""

    module: str
    path: Path
    """From the project's root."""
    text: str
    tree: ast.Module


def read_sources(root: Path) -> list[Source]:
    """Every Python file of the packages below a folder."""
    found = []
    for package in PACKAGES:
        for path in sorted((root / package).rglob("*.py")):
            local = path.relative_to(root)
            module = ".".join(local.with_suffix("").parts).removesuffix(".__init__")
            text = path.read_text(encoding="utf-8")
            found.append(Source(module, local, text, ast.parse(text)))
    return found


def import_graph(sources: list[Source]) -> Graph:
    """Which module imports which, inside of functions too."""
    known = {source.module for source in sources}
    graph: Graph = {source.module: set() for source in sources}
    for source in sources:
        for node in ast.walk(source.tree):
            if isinstance(node, ast.Import):
                names = [alias.name for alias in node.names]
            elif isinstance(node, ast.ImportFrom) and node.module:
                below = [f"{node.module}.{alias.name}" for alias in node.names]
                names = [name if name in known else node.module for name in below]
            else:
                continue
            graph[source.module] |= {name for name in names if name in known and name != source.module}
    return graph


def room_of(module: str) -> str:
    """The room that a module stands in."""
    return ".".join(module.split(".")[:2])


def room_graph(sources: list[Source]) -> Graph:
    """Which room imports which."""
    modules = import_graph(sources)
    programs = {module for module in modules if module.endswith("__main__")}
    graph: Graph = {room_of(module): set() for module in modules if module not in programs}
    for module, imported in modules.items():
        if module not in programs:
            graph[room_of(module)] |= {room_of(other) for other in imported} - {room_of(module)}
    return graph


def circles(graph: Graph) -> list[list[str]]:
    """Names that import each other, directly or by way of others."""
    names = sorted(graph)
    matrix = csr_matrix(np.array([[other in graph[name] for other in names] for name in names], np.int8))
    count, label = connected_components(matrix, directed=True, connection="strong")
    groups = [[name for name, k in zip(names, label, strict=True) if k == group] for group in range(count)]
    return sorted(group for group in groups if len(group) > 1)


def levels(graph: Graph) -> dict[str, int]:
    """Each name above all that it imports; 0 imports nothing."""
    known: dict[str, int] = {}

    def level(name: str) -> int:
        if name not in known:
            known[name] = 1 + max((level(other) for other in graph[name]), default=-1)
        return known[name]

    return {name: level(name) for name in sorted(graph)}


def svg(graph: Graph) -> str:
    """A column a package: its rooms in the order in which they build on each other, each with those that it imports.

    What a whole package builds on stands in the column's head.
    """
    level = levels(graph)
    packages = [p for p in PACKAGES if p not in UNDRAWN and any(room.partition(".")[0] == p for room in graph)]
    columns = {p: sorted((r for r in graph if r.startswith(f"{p}.")), key=lambda r: (level[r], r)) for p in packages}
    wide, high, gap, top = 236, 54, 8, 112
    height = top + (high + gap) * max(len(rooms) for rooms in columns.values()) + gap
    lines = [
        f'<svg xmlns="http://www.w3.org/2000/svg" viewBox="0 0 {wide * len(packages)} {height}" '
        'font-family="Helvetica, Arial, sans-serif">',
        f'<rect width="{wide * len(packages)}" height="{height}" fill="#ffffff"/>',
    ]

    def write(x: int, y: int, size: int, text: str, colour: str = "#000000", weight: str = "normal") -> None:
        lines.append(f'<text x="{x}" y="{y}" font-size="{size}" font-weight="{weight}" fill="{colour}">{text}</text>')

    for k, (package, rooms) in enumerate(columns.items()):
        x = wide * k + 8
        outside = {other.partition(".")[0] for room in rooms for other in graph[room]} - {package}
        write(x, 26, 16, package, weight="bold")
        below = textwrap.wrap("builds on " + (", ".join(p for p in packages if p in outside) or "nothing"), 38)
        for row, text in enumerate(below):
            write(x, 46 + 14 * row, 11, text, "#555555")
        for row, room in enumerate(rooms):
            y = top + (high + gap) * row
            inside = [other.partition(".")[2] for other in sorted(graph[room]) if other.startswith(f"{package}.")]
            lines.append(
                f'<rect x="{x}" y="{y}" width="{wide - 16}" height="{high}" rx="5" fill="#eef3f8" stroke="#7d93aa"/>'
            )
            write(x + 8, y + 18, 13, room.partition(".")[2])
            for line, text in enumerate(textwrap.wrap(", ".join(inside), 44)):
                write(x + 8, y + 33 + 12 * line, 9, text, "#33557a")
    return "\n".join([*lines, "</svg>", ""])


if __name__ == "__main__":
    root = Path(__file__).parents[1]
    (root / "docs" / "packages.svg").write_text(svg(room_graph(read_sources(root))), encoding="utf-8")
