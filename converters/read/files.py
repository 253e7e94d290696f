"""Read meshes, images and JSON, and hash them; a failure is one `SceneRejected` line."""

import collections
import contextlib
import dataclasses
import functools
import hashlib
import math
import os
import re
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np
import shapely
import trimesh
from PIL import Image

from converters.geometry.faces import triangulated
from converters.records.errors import SceneRejected
from converters.records.raw import RawScene, ScanMesh
from interactive_nav_common.errors import printable, readable
from interactive_nav_common.records import Reader
from interactive_nav_common.untrusted.reading import read_npz

LARGEST = 1e12
"""Of a coordinate, whatever its unit: products of larger ones overflow."""


class SourceFolder:
    """A raw scene's folder; remembers the sha256 of every file that was read through it, and what was repaired."""

    def __init__(self, root: Path, strict: bool = False, remedy: str = "put a copy of the file there") -> None:
        """Open the folder; with `strict`, every repair is an error; `remedy` is for files that lie outside."""
        if not root.exists():
            raise SceneRejected(f"{root}: no such folder; give the folder that holds the raw scene")
        if not root.is_dir():
            raise SceneRejected(f"{root}: is a file, expected the folder that holds the raw scene")
        self.root, self.strict, self.remedy = root, strict, remedy
        self.resolve = functools.cache(_resolve)
        self.sha256: dict[str, str] = {}
        self.warnings: list[str] = []
        self.surfaces: dict[str, Any] = {}
        """Path -> what `read_surface` returned."""

    def scene(self, layout: str, scan: ScanMesh, **more: Any) -> RawScene:
        """Return the record of what was read, with the folder's name, hashes and warnings."""
        about = {"name": self.root.resolve().name, "source_format": layout, "scan": scan} | more
        return RawScene(**about, sources=dict(sorted(self.sha256.items())), warnings=tuple(self.warnings))

    def has(self, relative: str) -> bool:
        """Return True when the file exists."""
        return os.path.isfile(self.root / relative)

    def use(self, relative: str, remedy: str) -> Path:
        """Return the path of a file that must exist; its hash goes into the record."""
        path = self.root / relative
        if os.path.isfile(path) or os.path.islink(path):
            self.inside(path)
        if not os.path.isfile(path):
            raise SceneRejected(f"{path}: no such file; {remedy}")
        try:
            self.sha256[relative] = hashlib.sha256(path.read_bytes()).hexdigest()
        except OSError as error:
            raise SceneRejected(f"{path}: cannot be read ({error.strerror}); check its permissions") from error
        return path

    def relative(self, path: Path) -> str | None:
        """Return the path relative to the folder, or None where it leads out of it."""
        try:
            return self.inside(path)
        except SceneRejected:
            return None

    def inside(self, path: Path) -> str:
        """Return the path relative to the folder, links followed."""
        try:
            end, root = self.resolve(path), self.resolve(self.root)
        except (ValueError, OSError, RuntimeError) as error:  # Python 3.11 and 3.12 raise RuntimeError at a loop
            reason = error.strerror if isinstance(error, OSError) else error
            raise SceneRejected(f"{path}: leads nowhere ({reason}); put the file itself there") from error
        if not end.is_relative_to(root):
            raise SceneRejected(f"{path}: leads out of the source folder, to {end}; {self.remedy}")
        return end.relative_to(root).as_posix()

    def note(self, message: str) -> None:
        """Record something the user should know; it goes into scene.json, so it names no absolute path."""
        message = printable(message)
        if message not in self.warnings:
            self.warnings.append(message)

    def note_counts(self, where: str, counts: Mapping[str, int], times: str = " x ") -> None:
        """Record the count of each kind of content that is not read or not used."""
        for what, count in sorted(counts.items()):
            self.note(f"{where} {count}{times}{what}")

    def repaired(self, message: str) -> None:
        """Record a defect that was mended."""
        if self.strict:
            raise SceneRejected(f"{self.root}: {message}; --strict refuses what would be repaired")
        self.note(message)


def _resolve(path: Path) -> Path:
    """Follow all links of a path, which need not exist."""
    end = path.resolve()
    with contextlib.suppress(FileNotFoundError, NotADirectoryError, PermissionError):
        end.lstat()  # raises OSError for names that no file system takes
    return end


def only_file(
    root: Path, files: list[Path], what: str, expected: str = "one; give the file of one", ending: str = ""
) -> Path:
    """Return the only one of the files that may be meant."""
    if len(files) != 1:
        names = ", ".join(p.name.removesuffix(ending) for p in files[:5]) or "none"
        more = f" and {len(files) - 5} more" if len(files) > 5 else ""
        raise SceneRejected(f"{root}: {what} are {names}{more}, expected {expected}")
    return files[0]


def read_json(path: Path) -> Any:
    """Decode one JSON file."""
    return Reader(SceneRejected, "fetch the file again").json(path)


def read_numbers(source: SourceFolder, name: str, remedy: str, lines: int | None = None) -> tuple[Path, list[float]]:
    """Return the path of a text file, and the numbers in it or in its first lines."""
    path = source.use(name, remedy)
    text = path.read_text(encoding="utf-8", errors="replace")
    try:
        return path, [float(word) for line in text.split("\n")[:lines] for word in line.split()]
    except ValueError as error:
        raise SceneRejected(f"{path}: {error}; {remedy}") from error


def read_labels(path: Path) -> np.ndarray:
    """Return (n,) int64 NYU40 ids: the array `label` of an NPZ."""
    with read_npz(path, SceneRejected, "expected an NPZ with the array 'label' of NYU40 ids") as arrays:
        labels = np.asarray(arrays["label"])
    if labels.dtype.kind not in "iu":
        raise SceneRejected(f"{path}: labels are {labels.dtype}, expected whole NYU40 ids")
    return labels.reshape(-1).astype(np.int64)


def read_image(path: Path, mode: str) -> np.ndarray:
    """Read an image as uint8: mode 'RGB' gives (h, w, 3), mode 'L' gives (h, w)."""
    with readable(path, SceneRejected, "fetch the file again", " as an image"), Image.open(path) as image:
        return np.asarray(image.convert(mode))


def read_mesh(path: Path) -> trimesh.Trimesh:
    """Read a single mesh in file order (no vertices merged or moved)."""
    with readable(path, SceneRejected, "fetch the file again", " as a mesh"):
        mesh = trimesh.load(path, process=False, force="mesh")
    assert isinstance(mesh, trimesh.Trimesh)
    check_mesh(path, np.asarray(mesh.vertices), np.asarray(mesh.faces))
    return mesh


def check_mesh(path: Path, vertices: np.ndarray, faces: np.ndarray) -> None:
    """Refuse what no stage can use."""
    if len(vertices) == 0 or len(faces) == 0:
        raise SceneRejected(
            f"{path}: {len(vertices)} vertices and {len(faces)} faces, expected a triangle mesh; export its surface"
        )
    if faces.min() < 0 or faces.max() >= len(vertices):
        raise SceneRejected(
            f"{path}: a face names vertex {int(faces.max())} of {len(vertices)}; the file is truncated, fetch it again"
        )
    bad = int((~(np.abs(vertices) < LARGEST).all(axis=1)).sum())
    if bad:
        raise SceneRejected(
            f"{path}: {bad} vertices are not finite numbers below {LARGEST:g}; remove them in a mesh editor, and their "
            "faces"
        )


@dataclasses.dataclass(frozen=True)
class ObjMesh:
    """Hold the content of an OBJ file, polygons cut into triangles."""

    vertices: np.ndarray
    """(n, 3) float64."""
    faces: np.ndarray
    """(m, 3) int64."""
    corner_uv: np.ndarray | None
    """(m, 3, 2) float64, or None where a face has no texture coordinates."""
    material: np.ndarray
    """(m,) int64 into `materials`; -1 before the first `usemtl`."""
    materials: tuple[str, ...]
    libraries: tuple[str, ...]
    """Names of MTL files."""
    group: np.ndarray
    """(m,) int64 into `groups`; -1 before the first `g` or `o`."""
    groups: tuple[str, ...]
    colours: np.ndarray | None
    """(n, 3) uint8 of the vertices, or None."""
    unused: dict[str, int]
    """Keyword that is not read -> how many lines begin with it."""


def read_text(path: Path) -> str:
    """Return the text of a file, which older exporters write in Latin-1."""
    data = path.read_bytes()
    try:
        text = data.decode("utf-8-sig")
    except UnicodeDecodeError:
        text = data.decode("latin-1")
    return text.replace("\r\n", "\n").replace("\r", "\n").replace("\\\n", " ")


def read_obj(path: Path) -> ObjMesh:
    """Read a polygon OBJ in its vertex order (labels refer to it; mesh libraries reorder at seams)."""
    positions: list[str] = []
    tints: dict[int, list[str]] = {}
    uvs: list[str] = []
    corners: list[int] = []
    uv_corners: list[int] = []
    has_uv = False
    sizes: list[int] = []
    material: list[tuple[int, int]] = []
    names: dict[str, int] = {}
    groups: dict[str, int] = {}
    libraries: dict[str, int] = {}
    tables = {"usemtl": names, "mtllib": libraries, "g": groups, "o": groups}
    unused: collections.Counter[str] = collections.Counter()
    current = group = -1
    try:
        for number, line in enumerate(read_text(path).split("\n"), 1):
            key, *words = line.partition("#")[0].split() or [""]
            if key == "v":
                if len(words) > 5:
                    tints[len(positions) // 3] = words[-3:]
                positions.extend(words[:3])
                if len(words) < 3:
                    raise SceneRejected(
                        f"{path}:{number}: a vertex has fewer than 3 coordinates{_comma(line)}; export it again"
                    )
            elif key == "vt":
                uvs.extend((*words, "0", "0")[:2])
            elif key == "f":
                if len(words) == 2:
                    continue  # an edge: it has no surface, and other programs pass over it
                if len(words) < 3:
                    raise SceneRejected(f"{path}:{number}: a face has {len(words)} corners, expected at least 3")
                for at, named, *_ in ((*word.split("/"), "") for word in words):
                    corners.append(_index(at, len(positions) // 3))
                    # A corner without one takes the first, which is correct for faces of plain colour.
                    uv_corners.append(_index(named, len(uvs) // 2) if named else 1)
                    has_uv = has_uv or bool(named)
                sizes.append(len(words))
                material.append((current, group))
            elif key in tables:
                index = tables[key].setdefault(line.strip()[len(key) :].strip(), len(tables[key]))
                current, group = index if key == "usemtl" else current, index if key in "go" else group
            elif key not in ("", "vn", "s"):
                unused[key[:20]] += 1
        vertices = np.array(positions, float).reshape(-1, 3)
        uv = np.array(uvs, float).reshape(-1, 2)
        index_of, uv_index = np.array(corners, np.int64), np.array(uv_corners, np.int64)
    except (ValueError, OverflowError) as error:
        raise SceneRejected(f"{path}: not readable as OBJ ({error}{_comma(str(error))}); export it again") from error
    count = np.array(sizes, np.int64)
    face = np.repeat(np.arange(len(count)), count - 2)  # of each triangle around its polygon's first corner
    step = np.arange(len(face)) - np.repeat(np.cumsum(count - 2) - (count - 2), count - 2)
    corner = (np.cumsum(count) - count)[face][:, None] + np.stack([0 * step, step + 1, step + 2], axis=1)
    check_mesh(path, vertices, index_of[corner] - 1)
    _unfold(vertices, index_of - 1, corner, face)
    of = np.array(material, np.int64)[face].T
    corner_uv = None
    if has_uv and len(uv):
        if uv_index.min() < 1 or uv_index.max() > len(uv):
            raise SceneRejected(
                f"{path}: a face names texture coordinate {int(uv_index.max())} of {len(uv)}; fetch the file again"
            )
        corner_uv = np.nan_to_num(uv[uv_index - 1][corner], posinf=0.0, neginf=0.0)
    colours = None
    if tints:  # 0 to 1, or bytes; white where a line has none
        values = np.nan_to_num([[as_number(word) for word in words] for words in tints.values()])
        colours = np.full((len(vertices), 3), 255, np.uint8)
        colours[list(tints)] = np.clip(np.round(values if values.max() > 1 else 255 * values), 0, 255)
    named = of[0], tuple(names), tuple(libraries), of[1], tuple(groups)
    return ObjMesh(vertices, index_of[corner] - 1, corner_uv, *named, colours, dict(unused))


def _comma(text: str) -> str:
    """Return a hint where numbers are written with decimal commas."""
    hint = ": it has decimal commas, expected points, which exporters write under English number settings"
    return hint * bool(re.search(r"\d,\d", text))


def _index(text: str, count: int) -> int:
    """Return an index from 1; negative ones count from the end of what there is so far, -1 being the last."""
    value = int(text)
    return value + count + 1 if value < 0 else value


def _unfold(vertices: np.ndarray, index: np.ndarray, corner: np.ndarray, face: np.ndarray) -> None:
    """Cut polygons again, in place, whose fans cover what they do not: door frames, rings and other hollow outlines."""
    a, b, c = (vertices[index[corner[:, k]]] for k in range(3))
    normal = np.cross(b - a, c - a)
    whole = np.stack([np.bincount(face, normal[:, k]) for k in range(3)], axis=1)
    size = np.linalg.norm(normal, axis=1) * np.linalg.norm(whole, axis=1)[face]
    for polygon in np.unique(face[np.einsum("ij,ij->i", normal, whole[face]) < -1e-6 * np.maximum(size, 1e-30)]):
        first, end = np.searchsorted(face, (polygon, polygon + 1))
        start, count = corner[first, 0], end - first + 2
        axis = int(np.abs(whole[polygon]).argmax())
        flat = np.delete(vertices[index[start : start + count]], axis, axis=1)
        flat = flat if (whole[polygon, axis] > 0) == (axis != 1) else flat[:, ::-1]
        at = {tuple(point): k for k, point in enumerate(flat.tolist())}
        cut = triangulated(shapely.make_valid(shapely.Polygon(flat))).reshape(-1, 2)
        numbers = [at.get(tuple(point), -1) for point in cut.tolist()]
        if len(numbers) == 3 * (end - first) and min(numbers) >= 0:  # else its outline crosses itself
            corner[first:end] = start + np.reshape(numbers, (-1, 3))


def as_number(text: str | None) -> float:
    """Return a number; NaN where the text is none."""
    try:
        return float(text or "")
    except ValueError:
        return math.nan
