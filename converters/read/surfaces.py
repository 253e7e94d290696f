"""A scan without semantic labels in; floor, wall and ceiling told by shape out. Also: which way is the floor?"""

import dataclasses
from pathlib import Path

import numpy as np

from converters.geometry.faces import face_vectors, sample_faces, vertex_vectors, weld
from converters.read.obj import TexturedMesh
from converters.records.errors import SceneRejected
from converters.records.limits import EXTENT_M
from converters.records.raw import CEILING, FLOOR, UNLABELLED, WALL

NEAR_FLOOR_M = 0.15
"""Faces this close to the floor's height may be floor."""
WALL_REACH_M = (0.2, 1.8)
"""A wall is seen at most heights between these."""
WALL_CELL_M = 0.10
WALL_SHARE = 0.6
"""Of the height bins of a cell that must show a steep surface."""
CEILING_FROM_M = 1.8
FLOOR_SHARE = 0.05
"""Least share of the scan's footprint that must lie level at the floor's height."""
FLOOR_BIN_M, LEVEL_SHARE = 0.05, 0.2
LONG_M, FINE_M = 0.5, 0.1
"""A face with an edge longer than the first is wall or not as a whole, by points so far apart on it as the second."""


def long_faces(vertices: np.ndarray, faces: np.ndarray) -> np.ndarray:
    """(m,) bool: faces with an edge longer than `LONG_M`. Scans have none, rooms that were modelled do."""
    corners = vertices[faces]
    return np.linalg.norm(corners - np.roll(corners, 1, axis=1), axis=2).max(axis=1) > LONG_M


def welded(mesh: TexturedMesh) -> TexturedMesh:
    """Return the mesh with vertices at equal positions joined; texture coordinates belong to corners and stay.

    Files split a surface at its texture seams, or give every triangle vertices of its own. Shapes are recognised by
    normals and neighbours, which must not depend on that.
    """
    first, group = weld(mesh.vertices)
    order = np.argsort(first)  # as in the file: labels refer to it
    return dataclasses.replace(mesh, vertices=mesh.vertices[first[order]], faces=np.argsort(order)[group[mesh.faces]])


def with_own_corners(mesh: TexturedMesh) -> TexturedMesh:
    """The mesh with corners of their own for long faces, after its vertices.

    Labels stand at vertices, and the corners of a modelled room belong to its floor and to two walls.
    """
    long = np.flatnonzero(long_faces(mesh.vertices, mesh.faces))
    faces = mesh.faces.copy()
    faces[long] = len(mesh.vertices) + np.arange(3 * len(long)).reshape(-1, 3)
    return dataclasses.replace(
        mesh, vertices=np.vstack([mesh.vertices, mesh.vertices[mesh.faces[long]].reshape(-1, 3)]), faces=faces
    )


def labelled(mesh: TexturedMesh, labels: np.ndarray, where: Path) -> tuple[TexturedMesh, np.ndarray]:
    """Return a mesh and its labels: one for each vertex, or for each that `with_own_corners` gives, `welded` or not."""
    choices = (mesh, with_own_corners(mesh), with_own_corners(welded(mesh)))
    own = next((choice for choice in choices if len(choice.vertices) == len(labels)), None)
    if own is None:
        raise SceneRejected(
            f"{where}: {len(labels)} labels for the {len(mesh.vertices)} vertices of the mesh, "
            "expected one for each; label the same mesh again"
        )
    return own, labels


def check_extent(where: str, vertices: np.ndarray) -> None:
    """Refuses scans of several buildings, in another unit, or with stray vertices."""
    low, high = vertices.min(axis=0), vertices.max(axis=0)
    if not (high - low).max() <= EXTENT_M:
        raise SceneRejected(
            f"{where}: reaches from {np.round(low, 1).tolist()} to {np.round(high, 1).tolist()} m, expected a building "
            f"of at most {EXTENT_M:g} m; remove stray vertices, check the unit, or split it"
        )


def floor_level(vertices: np.ndarray, faces: np.ndarray, where: str) -> float:
    """Height of the lowest level that has a fifth of the largest level's area, m; faces that look up count."""
    check_extent(where, vertices)
    area = face_vectors(vertices, faces) / 2
    level = area[:, 2] > 0.95 * np.maximum(np.linalg.norm(area, axis=1), 1e-12)
    height, size = vertices[faces[level], 2].mean(axis=1), area[level, 2]
    if not len(height):
        raise SceneRejected(f"{where}: has no level face that looks up; expected a floor, z up")
    bins, index = np.unique(np.round(height / FLOOR_BIN_M).astype(np.int64), return_inverse=True)
    total = np.bincount(index, size)
    lowest = bins[total >= LEVEL_SHARE * total.max()].min()
    near = np.abs(height - lowest * FLOOR_BIN_M) < FLOOR_BIN_M
    order = np.argsort(height[near])
    share = np.cumsum(size[near][order])
    return float(height[near][order][np.searchsorted(share, share[-1] / 2)])


def structure_labels(vertices: np.ndarray, faces: np.ndarray, floor_height_m: float) -> np.ndarray:
    """NYU40 labels by shape, for scans that come without: floor, wall, ceiling; everything else stays unlabelled.

    Floor is level, faces up and lies at the floor's height; ceiling faces down, 1.8 m above it or more; wall is
    steep in a column that shows steep surface over most of 0.2 to 1.8 m (furniture is lower). A long face, whose
    corners must be its own (`with_own_corners`), is wall if most of it is.

    Args:
        vertices: (n, 3) m, z up.
        faces: (m, 3).

    Returns:
        (n,) int64.
    """
    normal, area = vertex_vectors(vertices, faces), face_vectors(vertices, faces)
    length = np.linalg.norm(normal, axis=1)
    up = np.divide(normal[:, 2], length, out=np.zeros(len(vertices)), where=length > 0)
    z = vertices[:, 2] - floor_height_m
    labels = np.full(len(vertices), UNLABELLED, np.int64)
    labels[(up > 0.8) & (np.abs(z) < NEAR_FLOOR_M)] = FLOOR
    labels[(up < -0.7) & (z > CEILING_FROM_M)] = CEILING
    steep = (length > 0) & (np.abs(up) < 0.35)
    long = long_faces(vertices, faces)
    long = faces[long & (np.abs(area[:, 2]) < 0.35 * np.linalg.norm(area, axis=1))]
    points, of = sample_faces(vertices, long, FINE_M)
    upright = np.concatenate([steep, np.ones(len(points), bool)])
    wall = _in_wall_columns(np.vstack([vertices, points]), np.concatenate([z, points[:, 2] - floor_height_m]), upright)
    labels[steep & wall[: len(z)]] = WALL
    share = np.bincount(of, wall[len(z) :]) / np.bincount(of)
    mostly = long[share > 0.5].ravel()
    labels[mostly[labels[mostly] == UNLABELLED]] = WALL
    return labels


def _in_wall_columns(vertices: np.ndarray, z: np.ndarray, steep: np.ndarray) -> np.ndarray:
    """(n,) bool: vertices in columns whose steep surface reaches from near the floor to man's height."""
    low, high = WALL_REACH_M
    bins = round((high - low) / 0.2)
    cell = np.floor((vertices[:, :2] - vertices[:, :2].min(axis=0)) / WALL_CELL_M).astype(np.int64)
    columns = int(cell[:, 0].max(initial=0)) + 3
    rows = int(cell[:, 1].max(initial=0)) + 3
    flat = (cell[:, 1] + 1) * columns + cell[:, 0] + 1
    level = np.floor((z - low) / 0.2).astype(np.int64)
    chosen = steep & (level >= 0) & (level < bins)
    shown = np.zeros((columns * rows, bins), bool)
    shown[flat[chosen], level[chosen]] = True
    # Neighbouring columns count: scanned walls wave by some centimetres.
    grid = shown.reshape(rows, columns, bins)
    wide = grid.copy()
    for shift in (-1, 1):
        wide |= np.roll(grid, shift, 0) | np.roll(grid, shift, 1)
    wall = (wide.mean(axis=2) >= WALL_SHARE) & wide[..., -2:].any(axis=2)
    return wall.reshape(-1)[flat]


def check_upright(
    where: str, vertices: np.ndarray, faces: np.ndarray, labels: np.ndarray | None, height_m: float | None
):
    """Refuses meshes that are not z up, or whose floor faces down, by the floor that they show.

    Args:
        vertices: (n, 3) m.
        faces: (m, 3).
        labels: (n,) NYU40, or None: then the level faces at `height_m` are taken for floor.
    """
    check_extent(where, vertices)
    area = face_vectors(vertices, faces) / 2
    if labels is not None:
        is_floor = (labels[faces] == FLOOR).all(axis=1)
        seen = np.abs(area[is_floor]).sum(axis=0)
        if not is_floor.any() or not seen.sum():
            return  # no floor label at all is another error, told where the floor is needed
        if seen[2] < max(seen[0], seen[1]):
            axis = "xy"[int(np.argmax(seen[:2]))]
            raise SceneRejected(f"{where}: the floor lies across the {axis} axis: {_turn(axis)}")
        up = float(area[is_floor, 2].sum())
        _refuse_face_down(where, max(up, 0.0), max(-up, 0.0))
        return
    assert height_m is not None
    footprint = float(np.prod(np.ptp(vertices[:, :2], axis=0)))
    middle = vertices[faces].mean(axis=1)
    up, down = _level_area(area, middle, 2, height_m)
    if up + down >= FLOOR_SHARE * footprint:
        _refuse_face_down(where, up, down)
        return
    for axis in (1, 0):
        side = float(np.prod(np.delete(np.ptp(vertices, axis=0), axis)))
        if max(sum(_level_area(area, middle, axis, s * height_m)) for s in (1, -1)) >= FLOOR_SHARE * side:
            raise SceneRejected(
                f"{where}: nothing lies level at the floor's height of {height_m:g} m, but a floor lies across the "
                f"{'xy'[axis]} axis: {_turn('xy'[axis])}"
            )
    raise SceneRejected(
        f"{where}: {up + down:.2f} m2 lie level at the floor's height of {height_m:g} m, expected at least "
        f"{FLOOR_SHARE * footprint:.2f} m2; check floors.txt, the mesh's axes (z up) and its unit (m)"
    )


def _turn(axis: str) -> str:
    return (
        "the mesh is y up, expected z up; turn it: (x, y, z) becomes (x, -z, y)"
        if axis == "y"
        else "the mesh is x up, expected z up; turn it"
    )


def _level_area(area: np.ndarray, middle: np.ndarray, axis: int, height_m: float) -> tuple[float, float]:
    """Area (m2) of the faces square to an axis near a height that face along it, and against it."""
    size = np.linalg.norm(area, axis=1)
    level = (np.abs(area[:, axis]) > 0.9 * size) & (np.abs(middle[:, axis] - height_m) < NEAR_FLOOR_M)
    along = area[level, axis]
    return float(along[along > 0].sum()), float(-along[along < 0].sum())


def _refuse_face_down(where: str, up: float, down: float) -> None:
    if down > 2 * up:
        raise SceneRejected(
            f"{where}: the floor faces down ({down:.1f} m2 down, {up:.1f} m2 up): the mesh is left-handed (mirrored) "
            "or inside out; mirror one axis back, or turn the order of each face's corners if only that is wrong"
        )
