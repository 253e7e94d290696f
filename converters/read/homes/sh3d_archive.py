"""A Sweet Home 3D drawing (`.sh3d`, a ZIP) in; a folder with its files and the elements of its `Home.xml` out."""

import math
import re
import xml.etree.ElementTree as ElementTree
import zipfile
from pathlib import Path, PurePosixPath

import numpy as np

from converters.read.files import as_number
from converters.records.errors import SceneRejected
from converters.records.limits import ENTRIES, UNPACKED, check_count

HOME, JAVAS = "Home.xml", "Home"
MOST = 1e6
"""Of any number of a drawing: 10 km."""
MODELS = (".obj", ".dae")
"""Endings that are sought in an archive within the archive."""


def unpack(path: Path, folder: Path, budget: list[int] | None = None) -> None:
    """Writes the files of an archive into an empty folder.

    Args:
        budget: bytes that may still be written, of this archive and those within it; counted down.
    """
    budget = [UNPACKED] if budget is None else budget
    try:
        with zipfile.ZipFile(path) as archive:
            inside = archive.infolist()
            check_count(path, len(inside), ENTRIES, "files in its archive")
            budget[0] -= sum(i.file_size for i in inside)
            check_count(path, UNPACKED - budget[0], UNPACKED, "bytes once unpacked")
            for item in inside:
                name = PurePosixPath(item.filename)
                if name.is_absolute() or ".." in name.parts or set('\\:*?"<>|\0') & set(item.filename):
                    raise SceneRejected(f"{path}: holds a file '{name}', which leads out of it; save the home again")
                if item.is_dir() or item.filename == JAVAS:
                    continue
                (folder / name).parent.mkdir(parents=True, exist_ok=True)
                (folder / name).write_bytes(archive.read(item))
    except SceneRejected:
        raise
    except Exception as error:  # damaged archives fail in zipfile, zlib or the file system, each in its own way
        reason = " ".join(str(error).replace(str(folder), "").split())[:200] or type(error).__name__
        raise SceneRejected(f"{path}: not readable as a Sweet Home 3D file ({reason}); save the home again") from None


def read_xml(path: Path, folder: Path) -> ElementTree.Element:
    """The root of a drawing's `Home.xml`."""
    if not (folder / HOME).is_file():
        raise SceneRejected(f"{path}: has no {HOME}; open it in Sweet Home 3D 5.3 or later and save it again")
    data = (folder / HOME).read_bytes()
    try:
        if b"<!ENTITY" in data.replace(b"\0", b""):
            raise ElementTree.ParseError("it declares entities")
        root = ElementTree.fromstring(data)
    except (ElementTree.ParseError, ValueError, LookupError) as error:
        raise SceneRejected(f"{path}: {HOME} is not readable ({error}); save the home again") from None
    if root.tag != "home":
        raise SceneRejected(f"{path}: {HOME} holds <{root.tag[:40]}>, expected <home>; save the home again")
    return root


def model_path(folder: Path, name: str, budget: list[int]) -> str | None:
    """Path in the folder of the model or image that an element names, unpacked from an archive within if need be."""
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
    found = (p for p in sorted(within.rglob("*")) if p.suffix.lower() in MODELS)
    path = within / rest if rest else next(found, None)
    return path.relative_to(folder).as_posix() if path is not None and path.is_file() else None


def called(element: ElementTree.Element) -> str:
    """What messages call an element."""
    words = (element.get("name") or element.get("id") or "?")[:60]
    return f"<{element.tag}> {' '.join(words.split())}"


def number(element: ElementTree.Element, key: str, default: float | None = None) -> float:
    """A number of an element."""
    text = element.get(key)
    if text is None and default is not None:
        return default
    value = as_number(text)
    if not abs(value) <= MOST:
        raise SceneRejected(f"{called(element)}: {key} is {(text or '')[:40]!r}, expected a number; mend the drawing")
    return value


def metres(element: ElementTree.Element, *keys: str, default: float | None = None) -> np.ndarray:
    """Lengths of an element, m."""
    return np.array([number(element, key, default) for key in keys]) / 100


def point(element: ElementTree.Element, x: str = "x", y: str = "y") -> np.ndarray:
    """(2,) m: the drawing's y points down, the home's up."""
    return metres(element, x, y) * [1.0, -1.0]


def colour(text: str | None, default: np.ndarray) -> np.ndarray:
    """(1, 1, 3) uint8 of `AARRGGBB`."""
    if text is None or not re.fullmatch("[0-9A-Fa-f]{8}", text):
        return default
    return np.array([int(text[k : k + 2], 16) for k in (2, 4, 6)], np.uint8).reshape(1, 1, 3)


def _arc(start: np.ndarray, end: np.ndarray, radii: np.ndarray, large: bool, sweep: bool) -> np.ndarray:
    """(9, 2) points after the start of an SVG arc whose axes are not turned."""
    a, b = start / radii, end / radii
    half = (b - a) / 2
    squared = float(half @ half)
    if squared > 1 or squared < 1e-12:  # too small an ellipse is enlarged
        radii, squared = radii * max(math.sqrt(squared), 1e-6), 1.0
        a, b = start / radii, end / radii
        half = (b - a) / 2
    side = math.sqrt(max(1 / max(squared, 1e-12) - 1, 0.0)) * (1 if large == sweep else -1)
    centre = (a + b) / 2 + side * np.array([half[1], -half[0]])
    first, last = (math.atan2(*(p - centre)[::-1]) for p in (a, b))
    turn = (last - first) % math.tau if sweep else -((first - last) % math.tau)
    angle = first + turn * np.arange(1, 10) / 9
    return (centre + np.stack([np.cos(angle), np.sin(angle)], axis=1)) * radii


def outline(path: str | None) -> np.ndarray | None:
    """(n, 2) points of an SVG path of one outline in the unit square, y down; None: the square, or not understood."""
    taken = {"m": 2, "l": 2, "h": 1, "v": 1, "c": 6, "q": 4, "a": 7}
    at, points = np.zeros(2), []
    for word, rest in re.findall(r"([A-Za-z])([^A-Za-z]*)", (path or "")[:2000]):
        kind, own = word.lower(), word.islower()
        values = [float(v) for v in re.findall(r"[-+]?(?:\d+\.?\d*|\.\d+)", rest)]
        if kind == "z":
            break
        if kind not in taken or not values or len(values) % taken[kind]:
            return None
        for k in range(0, len(values), taken[kind]):
            some = values[k : k + taken[kind]]
            if kind in "hv":
                end = at.copy()
                end["hv".index(kind)] = some[0] + own * at["hv".index(kind)]
            else:
                end = np.array(some[-2:]) + own * at
            if kind in "cq":
                corners = np.array([at, *(np.reshape(some, (-1, 2)) + own * at)])
                for t in np.arange(1, 9) / 9:
                    left = corners
                    while len(left) > 1:
                        left = left[:-1] * (1 - t) + left[1:] * t
                    points.append(left[0])
            if kind == "a" and min(some[:2]) > 0:
                points.extend(_arc(at, end, np.array(some[:2]), some[3] != 0, some[4] != 0)[:-1])
            points.append(end)
            at = end
    found = np.array(points).reshape(-1, 2)
    return found if len(found) > 2 and np.abs(found).max() < 10 else None
