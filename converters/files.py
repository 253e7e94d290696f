"""Paths in; meshes, images, JSON and hashes out; a failure is one `SceneRejected` line."""

from __future__ import annotations

import hashlib
import json
from pathlib import Path
from typing import Any

import numpy as np
import trimesh
from PIL import Image

from converters.errors import SceneRejected


class SourceFolder:
    """A raw scene's folder; remembers the sha256 of every file that was read through it."""

    def __init__(self, root: Path) -> None:
        if not root.exists():
            raise SceneRejected(f"{root}: no such folder; give the folder that holds the raw scene")
        if not root.is_dir():
            raise SceneRejected(f"{root}: is a file, expected the folder that holds the raw scene")
        self.root = root
        self.sha256: dict[str, str] = {}

    def has(self, relative: str) -> bool:
        """True when the file exists."""
        return (self.root / relative).is_file()

    def use(self, relative: str, remedy: str) -> Path:
        """Path of a file that must exist; its hash goes into the record.

        Raises:
            SceneRejected: missing or unreadable; `remedy` ends the message.
        """
        path = self.root / relative
        if not path.is_file():
            raise SceneRejected(f"{path}: no such file; {remedy}")
        try:
            self.sha256[relative] = hashlib.sha256(path.read_bytes()).hexdigest()
        except OSError as error:
            raise SceneRejected(f"{path}: cannot be read ({error.strerror}); check its permissions") from error
        return path


def read_json(path: Path) -> Any:
    """Decodes one JSON file.

    Raises:
        SceneRejected: not JSON.
    """
    try:
        return json.loads(path.read_text(encoding="utf-8"))
    except (json.JSONDecodeError, UnicodeDecodeError) as error:
        raise SceneRejected(f"{path}: not readable as JSON ({error}); fetch the file again") from error


def read_npz(path: Path, name: str, remedy: str) -> np.ndarray:
    """One array of an NPZ file.

    Raises:
        SceneRejected: not an NPZ, damaged, or without the array.
    """
    try:
        with np.load(path, allow_pickle=False) as arrays:
            return np.asarray(arrays[name])
    except Exception as error:  # damaged archives fail in zipfile, zlib or NumPy, each in its own way
        reason = " ".join(str(error).split())
        raise SceneRejected(f"{path}: not readable ({type(error).__name__}: {reason}); {remedy}") from error


def read_image(path: Path, mode: str) -> np.ndarray:
    """Reads an image as uint8: mode 'RGB' gives (h, w, 3), mode 'L' gives (h, w).

    Raises:
        SceneRejected: not an image, or truncated.
    """
    try:
        with Image.open(path) as image:
            return np.asarray(image.convert(mode))
    except Exception as error:  # Pillow's decoders raise anything on a broken file
        raise SceneRejected(f"{path}: not readable as an image ({error}); fetch the file again") from error


def read_mesh(path: Path) -> trimesh.Trimesh:
    """Reads a single mesh in file order (no vertices merged or moved).

    Raises:
        SceneRejected: unreadable, truncated, empty, or with vertices that are not finite.
    """
    try:
        mesh = trimesh.load(path, process=False, force="mesh")
    except Exception as error:  # trimesh's loaders raise anything on a broken file
        raise SceneRejected(
            f"{path}: not readable as a mesh ({type(error).__name__}: {error}); fetch the file again"
        ) from error
    assert isinstance(mesh, trimesh.Trimesh)
    check_mesh(path, np.asarray(mesh.vertices), np.asarray(mesh.faces))
    return mesh


def vertex_colours(mesh: trimesh.Trimesh) -> np.ndarray:
    """(n, 3) uint8 colour of each vertex; grey where the file has none."""
    colours = getattr(mesh.visual, "vertex_colors", None)
    if colours is None or len(colours) != len(mesh.vertices):
        return np.full((len(mesh.vertices), 3), 170, np.uint8)
    return np.asarray(colours, np.uint8)[:, :3]


def check_mesh(path: Path, vertices: np.ndarray, faces: np.ndarray) -> None:
    """Refuses what no stage can use.

    Raises:
        SceneRejected: no faces, indices out of range, or vertices that are not finite.
    """
    if len(vertices) == 0 or len(faces) == 0:
        raise SceneRejected(
            f"{path}: {len(vertices)} vertices and {len(faces)} faces, expected a triangle mesh; fetch the file again"
        )
    if faces.min() < 0 or faces.max() >= len(vertices):
        raise SceneRejected(
            f"{path}: a face names vertex {int(faces.max())} of {len(vertices)}; the file is truncated, fetch it again"
        )
    bad = int((~np.isfinite(vertices).all(axis=1)).sum())
    if bad:
        raise SceneRejected(f"{path}: {bad} vertices are not finite numbers; repair or fetch the file again")


def read_textured_obj(path: Path) -> tuple[np.ndarray, np.ndarray, np.ndarray | None]:
    """Reads a triangle OBJ in its own vertex order (labels refer to it; mesh libraries reorder at seams).

    Returns:
        vertices (n, 3) float64, faces (m, 3) int64, corner_uv (m, 3, 2) float64 or None without `vt`.

    Raises:
        SceneRejected: a malformed line, a face that is not a triangle, or what `check_mesh` refuses.
    """
    positions: list[str] = []
    uvs: list[str] = []
    corners: list[str] = []
    try:
        with path.open(encoding="utf-8") as lines:
            for number, line in enumerate(lines, 1):
                if line.startswith("v "):
                    positions.append(" ".join(line.split()[1:4]))
                elif line.startswith("vt "):
                    uvs.append(" ".join(line.split()[1:3]))
                elif line.startswith("f "):
                    words = line.split()[1:]
                    if len(words) != 3:
                        raise SceneRejected(
                            f"{path}:{number}: a face has {len(words)} corners, expected 3; triangulate the mesh"
                        )
                    corners.extend(words)
        vertices = np.array(" ".join(positions).split(), float).reshape(-1, 3)
        uv = np.array(" ".join(uvs).split(), float).reshape(-1, 2)
        index = np.array([(c.split("/") + ["", ""])[:2] for c in corners]).reshape(-1, 2)
        faces = index[:, 0].astype(np.int64).reshape(-1, 3) if len(index) else np.zeros((0, 3), np.int64)
        has_uv = len(uv) > 0 and len(index) > 0 and bool((index[:, 1] != "").all())
        uv_index = index[:, 1].astype(np.int64) - 1 if has_uv else None
    except (ValueError, UnicodeDecodeError) as error:
        if isinstance(error, SceneRejected):
            raise
        raise SceneRejected(f"{path}: not readable as OBJ ({error}); the file is damaged, fetch it again") from error
    check_mesh(path, vertices, faces - 1)
    if uv_index is None:
        return vertices, faces - 1, None
    if uv_index.min() < 0 or uv_index.max() >= len(uv):
        raise SceneRejected(f"{path}: a face names texture coordinate {int(uv_index.max()) + 1} of {len(uv)}")
    return vertices, faces - 1, uv[uv_index].reshape(-1, 3, 2)
