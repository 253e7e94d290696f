"""Unpack a Sweet Home 3D drawing (`.sh3d`, a ZIP) and read the elements of its `Home.xml`."""

import contextlib
import itertools
import re
import xml.etree.ElementTree as ElementTree
import zipfile
from pathlib import Path, PurePosixPath

import numpy as np
from fontTools.pens.recordingPen import RecordingPen
from fontTools.svgLib.path import parse_path
from scipy.interpolate import BPoly

from converters.read.files import as_number
from converters.read.urdf import parse_xml
from converters.records.errors import ENTRIES, UNPACKED, SceneRejected, check_count
from interactive_nav_common.errors import readable

HOME, JAVAS = "Home.xml", "Home"
MOST = 1e6
"""Of any number of a drawing: 10 km."""
MODELS = (".obj", ".dae")
"""Endings of the models in an archive within the archive."""


def unpack(path: Path, folder: Path, budget: list[int] | None = None) -> None:
    """Write the files of an archive into an empty folder; count down the `budget` of bytes that it shares."""
    budget = [UNPACKED] if budget is None else budget
    with (
        readable(path, SceneRejected, "save the home again", " as a Sweet Home 3D file"),
        zipfile.ZipFile(path) as archive,
    ):
        inside = archive.infolist()
        check_count(path, len(inside), ENTRIES, "files in its archive")
        budget[0] -= sum(i.file_size for i in inside)
        check_count(path, UNPACKED - budget[0], UNPACKED, "bytes once unpacked")
        for item in inside:
            name = PurePosixPath(item.filename)
            if name.is_absolute() or ".." in name.parts or set('\\:*?"<>|\0') & set(item.filename):
                raise SceneRejected(f"{path}: holds a file '{name}', which leads out of it; save the home again")
            if item.filename != JAVAS:
                archive.extract(item, folder)


def read_xml(path: Path, folder: Path) -> ElementTree.Element:
    """Return the root of a drawing's `Home.xml`."""
    if not (folder / HOME).is_file():
        raise SceneRejected(f"{path}: has no {HOME}; open it in Sweet Home 3D 5.3 or later and save it again")
    if b"<!ENTITY" in (folder / HOME).read_bytes().replace(b"\0", b""):
        raise SceneRejected(f"{path}: {HOME} is not readable (it declares entities); save the home again")
    root = parse_xml(folder / HOME, "the XML of a drawing", "save the home again")
    if root.tag != "home":
        raise SceneRejected(f"{path}: {HOME} holds <{root.tag[:40]}>, expected <home>; save the home again")
    return root


def model_path(folder: Path, name: str, budget: list[int]) -> str | None:
    """Return the path of the model or image that an element names; unpack it from an archive within if need be."""
    first, _, rest = name.partition("/")
    if not first or ".." in PurePosixPath(name).parts or PurePosixPath(name).is_absolute() or "\0" in name:
        return None
    try:
        whole, within = folder / name, folder / f"{first}.unpacked"
        if not (folder / first).is_file():
            return name if whole.is_file() else None
        with (folder / first).open("rb") as file:
            if file.read(2) != b"PK":
                return None if rest else first
    except OSError:  # a name too long for the file system
        return None
    if not within.exists():
        within.mkdir()
        unpack(folder / first, within, budget)
    models = (p for p in sorted(within.rglob("*")) if p.suffix.lower() in MODELS)
    path = within / rest if rest else next(models, None)
    return path.relative_to(folder).as_posix() if path is not None and path.is_file() else None


def called(element: ElementTree.Element) -> str:
    """Return what messages call an element."""
    words = (element.get("name") or element.get("id") or "?")[:60]
    return f"<{element.tag}> {' '.join(words.split())}"


def number(element: ElementTree.Element, key: str, default: float | None = None) -> float:
    """Return a number of an element."""
    text = element.get(key)
    return default if text is None and default is not None else parsed(element, key, text)


def parsed(element: ElementTree.Element, key: str, text: str | None) -> float:
    """Return the number in a text of an element."""
    value = as_number(text)
    if not abs(value) <= MOST:
        raise SceneRejected(f"{called(element)}: {key} is {(text or '')[:40]!r}, expected a number; mend the drawing")
    return value


def metres(element: ElementTree.Element, *keys: str, default: float | None = None) -> np.ndarray:
    """Return lengths of an element, m."""
    return np.array([number(element, key, default) for key in keys]) / 100


def point(element: ElementTree.Element, x: str = "x", y: str = "y") -> np.ndarray:
    """Return (2,) m: the drawing's y points down, the home's up."""
    return metres(element, x, y) * [1.0, -1.0]


def colour(text: str | None, default: np.ndarray) -> np.ndarray:
    """Return the (1, 1, 3) uint8 of `AARRGGBB`."""
    if text is None or not re.fullmatch("[0-9A-Fa-f]{8}", text):
        return default
    return np.array([int(text[k : k + 2], 16) for k in (2, 4, 6)], np.uint8).reshape(1, 1, 3)


def outline(path: str | None) -> np.ndarray | None:
    """Return (n, 2) points of an SVG path of one outline in the unit square, y down; None: the square or unreadable."""
    pen = RecordingPen()
    with contextlib.suppress(ValueError):
        parse_path((path or "")[:2000], pen)
    points: list[np.ndarray] = []
    for word, ends in itertools.takewhile(lambda step: step[0] != "closePath", pen.value):
        if word in ("curveTo", "qCurveTo"):
            curve = BPoly(np.array([points[-1], *ends])[:, None], [0.0, 1.0])
            points.extend(curve(np.linspace(0.0, 1.0, 10)[1:]))
        elif ends:
            points.append(np.array(ends[0]))
    if len(points) > 1 and np.allclose(points[0], points[-1]):
        points.pop()  # a closed path ends where it starts
    return np.array(points) if len(points) > 2 and np.abs(points).max() < 10 else None
