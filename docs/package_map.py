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


COLUMNS = (("interactive_nav_common", "scenes_mjcf", "converters"), ("interactive_nav", "train", "topological_nav"))
WIDE, HIGH, LETTER = 360, 22, 7.8
"""Of a column, of a room, of a letter of its name: pixels of a page 720 wide."""


def svg(graph: Graph) -> str:
    """Packages with their rooms, a line a step: each room builds on rooms of lines above it, never of those below."""
    shapes: list[str] = []
    heights = []
    for k, column in enumerate(COLUMNS):
        y = 0
        for package in column:
            if any(room.partition(".")[0] == package for room in graph):
                y = _draw_package(shapes, graph, package, WIDE * k + 8, y)
        heights.append(y)
    size = f'width="{WIDE * len(COLUMNS)}" height="{max(heights) + 8}"'
    return "\n".join(
        [
            f'<svg xmlns="http://www.w3.org/2000/svg" {size} font-family="sans-serif" font-size="13">',
            f'<rect {size} fill="#fff"/>',
            "<style>.room { fill: #e6f1f8; stroke: #0072b2 } .name { text-anchor: middle }</style>",
            *shapes,
            "</svg>",
            "",
        ]
    )


def _draw_package(shapes: list[str], graph: Graph, package: str, x: int, y: int) -> int:
    """Adds a package's head and rooms from y down; returns where the next one may begin."""
    rooms = {room for room in graph if room.startswith(f"{package}.")}
    outside = {other.partition(".")[0] for room in rooms for other in graph[room]} - {package}
    below = [other for other in PACKAGES if other in outside]
    shapes.append(f'<text x="{x}" y="{y + 26}" font-size="16" font-weight="bold">{package}</text>')
    for text in textwrap.wrap("builds on " + (", ".join(below) or "no other package"), 54):
        shapes.append(f'<text x="{x}" y="{y + 43}" font-size="12" fill="#444">{text}</text>')
        y += 15
    y += 37
    level = levels({room: graph[room] & rooms for room in rooms})
    for step in range(max(level.values(), default=-1) + 1):
        right = x
        for room in sorted(room for room in rooms if level[room] == step):
            name = room.partition(".")[2]
            wide = round(LETTER * len(name)) + 18
            if right + wide > x + WIDE - 16:
                right, y = x + 16, y + HIGH + 2
            shapes.append(f'<rect x="{right}" y="{y}" width="{wide}" height="{HIGH}" rx="4" class="room"/>')
            shapes.append(f'<text x="{right + wide // 2}" y="{y + 15}" class="name">{name}</text>')
            right += wide + 6
        y += HIGH + 6
    return y + 6


if __name__ == "__main__":
    root = Path(__file__).parents[1]
    (root / "docs" / "packages.svg").write_text(svg(room_graph(read_sources(root))), encoding="utf-8")
