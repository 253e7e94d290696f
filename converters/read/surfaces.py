"""Find a scan's up axis and unit, label floor, wall and ceiling by shape, check its floor, and split it by storeys."""

import dataclasses
from pathlib import Path

import numpy as np
from scipy import ndimage
from scipy.spatial.transform import Rotation

from converters.geometry import faces as geometry
from converters.read.obj import TexturedMesh
from converters.records.errors import EXTENT_M, SceneRejected
from converters.records.raw import CEILING, FLOOR, UNLABELLED, WALL, RawScene

NEAR_FLOOR_M = 0.15
"""Faces this close to the floor's height may be floor."""
WALL_REACH_M = (0.2, 1.8)
"""A wall shows at most heights between these."""
WALL_CELL_M = 0.10
WALL_SHARE = 0.6
"""Of the height bins of a cell that must show a steep surface."""
CROSS = np.array([[0, 1, 0], [1, 1, 1], [0, 1, 0]])
"""A column and those beside it."""
CEILING_FROM_M = 1.8
FLOOR_SHARE = 0.05
"""Least share of the scan's footprint that must lie level at the floor's height."""
FLOOR_BIN_M, LEVEL_SHARE = 0.05, 0.2
LONG_M, FINE_M = 0.5, 0.1
"""A face with an edge longer than the first is wall or not as a whole, by points so far apart on it as the second."""
BELOW_FLOOR_M = 0.25
"""What lies this far below a floor still belongs to it (thresholds, waves); deeper is the storey below."""
STANDS_ABOVE_M = 0.5
"""An object's base may lie this far below its floor: annotations are off by centimetres, not by half a metre."""


def long_faces(vertices: np.ndarray, faces: np.ndarray) -> np.ndarray:
    """Return (m,) bool: faces with an edge longer than `LONG_M`. Scans have none, modelled rooms do."""
    corners = vertices[faces]
    return np.linalg.norm(corners - np.roll(corners, 1, axis=1), axis=2).max(axis=1) > LONG_M


def welded(mesh: TexturedMesh) -> TexturedMesh:
    """Return the mesh with vertices at equal positions joined, so that normals and neighbours ignore texture seams."""
    first, group = geometry.weld(mesh.vertices)
    order = np.argsort(first)  # as in the file: labels refer to it
    return dataclasses.replace(mesh, vertices=mesh.vertices[first[order]], faces=np.argsort(order)[group[mesh.faces]])


def with_split_corners(mesh: TexturedMesh) -> TexturedMesh:
    """Return the mesh with separate corners for its long faces, after its vertices.

    Labels are stored at vertices, and a modelled room's corners belong to its floor and two walls.
    """
    long = np.flatnonzero(long_faces(mesh.vertices, mesh.faces))
    faces = mesh.faces.copy()
    faces[long] = len(mesh.vertices) + np.arange(3 * len(long)).reshape(-1, 3)
    return dataclasses.replace(
        mesh, vertices=np.vstack([mesh.vertices, mesh.vertices[mesh.faces[long]].reshape(-1, 3)]), faces=faces
    )


def labelled(mesh: TexturedMesh, labels: np.ndarray, where: Path) -> tuple[TexturedMesh, np.ndarray]:
    """Return a mesh and its labels: one for each vertex, of the mesh or `with_split_corners`, `welded` or not."""
    choices = (mesh, with_split_corners(mesh), with_split_corners(welded(mesh)))
    match = next((choice for choice in choices if len(choice.vertices) == len(labels)), None)
    if match is None:
        raise SceneRejected(
            f"{where}: {len(labels)} labels for the {len(mesh.vertices)} vertices of the mesh, "
            "expected one for each; label the same mesh again"
        )
    return match, labels


def check_extent(where: str, vertices: np.ndarray) -> None:
    """Refuse scans of several buildings, in another unit, or with stray vertices."""
    low, high = vertices.min(axis=0), vertices.max(axis=0)
    if not (high - low).max() <= EXTENT_M:
        raise SceneRejected(
            f"{where}: reaches from {np.round(low, 1).tolist()} to {np.round(high, 1).tolist()} m, expected a building "
            f"of at most {EXTENT_M:g} m; remove stray vertices, check the unit, or split it"
        )


def floor_level(vertices: np.ndarray, faces: np.ndarray, where: str) -> float:
    """Return the height (m) of the lowest level that has a fifth of the largest one's area, facing up."""
    check_extent(where, vertices)
    area = geometry.face_vectors(vertices, faces) / 2
    level = area[:, 2] > 0.95 * np.maximum(np.linalg.norm(area, axis=1), 1e-12)
    height, size = vertices[faces[level], 2].mean(axis=1), area[level, 2]
    if not len(height):
        raise SceneRejected(f"{where}: has no level face that looks up; expected a floor, z up")
    bins, index = np.unique(np.round(height / FLOOR_BIN_M).astype(np.int64), return_inverse=True)
    total = np.bincount(index, size)
    lowest = bins[total >= LEVEL_SHARE * total.max()].min()
    near = np.abs(height - lowest * FLOOR_BIN_M) < FLOOR_BIN_M
    return float(np.quantile(height[near], 0.5, weights=size[near], method="inverted_cdf"))


def structure_labels(vertices: np.ndarray, faces: np.ndarray, floor_height_m: float) -> np.ndarray:
    """Return (n,) NYU40 labels of z-up vertices (n, 3) m by shape: floor, wall, ceiling or unlabelled.

    Floor is level, faces up and lies at the floor's height; ceiling faces down, 1.8 m above it or more; wall is steep,
    in a column that is steep over most of 0.2 to 1.8 m (furniture is lower). A long face, whose corners must be
    separate (`with_split_corners`), is wall if most of it is.
    """
    normal, area = geometry.vertex_vectors(vertices, faces), geometry.face_vectors(vertices, faces)
    length = np.linalg.norm(normal, axis=1)
    up = np.divide(normal[:, 2], length, out=np.zeros(len(vertices)), where=length > 0)
    z = vertices[:, 2] - floor_height_m
    labels = np.full(len(vertices), UNLABELLED, np.int64)
    labels[(up > 0.8) & (np.abs(z) < NEAR_FLOOR_M)] = FLOOR
    labels[(up < -0.7) & (z > CEILING_FROM_M)] = CEILING
    steep = (length > 0) & (np.abs(up) < 0.35)
    long = long_faces(vertices, faces)
    long = faces[long & (np.abs(area[:, 2]) < 0.35 * np.linalg.norm(area, axis=1))]
    points, of = geometry.sample_faces(vertices, long, FINE_M)
    upright = np.concatenate([steep, np.ones(len(points), bool)])
    wall = _in_wall_columns(np.vstack([vertices, points]), np.concatenate([z, points[:, 2] - floor_height_m]), upright)
    labels[steep & wall[: len(z)]] = WALL
    share = np.bincount(of, wall[len(z) :]) / np.bincount(of)
    mostly = long[share > 0.5].ravel()
    labels[mostly[labels[mostly] == UNLABELLED]] = WALL
    return labels


def _in_wall_columns(vertices: np.ndarray, z: np.ndarray, steep: np.ndarray) -> np.ndarray:
    """Return (n,) bool: vertices in columns whose steep surface reaches from near the floor to man's height."""
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
    wide = np.asarray(ndimage.binary_dilation(shown.reshape(rows, columns, bins), CROSS[..., None]), bool)
    wall = (wide.mean(axis=2) >= WALL_SHARE) & wide[..., -2:].any(axis=2)
    return wall.reshape(-1)[flat]


def check_upright(
    where: str, vertices: np.ndarray, faces: np.ndarray, labels: np.ndarray | None, height_m: float
) -> None:
    """Refuse a mesh that is not z up or has a floor facing down, by NYU40 `labels` or level faces at `height_m`."""
    check_extent(where, vertices)
    area, axis, shows = geometry.face_vectors(vertices, faces) / 2, None, "the floor"
    if labels is not None:
        is_floor = (labels[faces] == FLOOR).all(axis=1)
        across = np.abs(area[is_floor]).sum(axis=0)
        if not is_floor.any() or not across.sum():
            return  # the stage that needs a floor reports that no face has its label
        axis = int(np.argmax(across[:2])) if across[2] < max(across[0], across[1]) else None
        sum_m2 = float(area[is_floor, 2].sum())
        up, down = max(sum_m2, 0.0), max(-sum_m2, 0.0)
    else:
        middle, spans = vertices[faces].mean(axis=1), np.ptp(vertices, axis=0)
        least = [FLOOR_SHARE * float(np.prod(np.delete(spans, k))) for k in range(3)]
        up, down = _level_area(area, middle, 2, height_m)
        if up + down < least[2]:
            shows = f"nothing lies level at the floor's height of {height_m:g} m, but a floor"
            sides = ((k, sum(_level_area(area, middle, k, sign * height_m))) for k in (1, 0) for sign in (1, -1))
            axis = next((k for k, size in sides if size >= least[k]), None)
            if axis is None:
                raise SceneRejected(
                    f"{where}: {up + down:.2f} m2 lie level at the floor's height of {height_m:g} m, expected at least "
                    f"{least[2]:.2f} m2; check floors.txt, the mesh's axes (z up) and its unit (m)"
                )
    if axis is not None:
        raise SceneRejected(
            f"{where}: {shows} lies across the {'xy'[axis]} axis: the mesh is {'xy'[axis]} up, expected z up; turn it"
            + ": (x, y, z) becomes (x, -z, y)" * axis
        )
    if down > 2 * up:
        raise SceneRejected(
            f"{where}: the floor faces down ({down:.1f} m2 down, {up:.1f} m2 up): the mesh is left-handed (mirrored) "
            "or inside out; mirror one axis back, or turn the order of each face's corners if only that is wrong"
        )


def _level_area(area: np.ndarray, middle: np.ndarray, axis: int, height_m: float) -> tuple[float, float]:
    """Return the area (m2) of the faces square to an axis near a height that face along it, and against it."""
    size = np.linalg.norm(area, axis=1)
    level = (np.abs(area[:, axis]) > 0.9 * size) & (np.abs(middle[:, axis] - height_m) < NEAR_FLOOR_M)
    along = area[level, axis]
    return float(along[along > 0].sum()), float(-along[along < 0].sum())


def storey_of(z: np.ndarray, heights_m: tuple[float, ...], below_m: float = BELOW_FLOOR_M) -> np.ndarray:
    """Return the number of the storey that each height lies in; all below the lowest floor belongs to the first."""
    return np.searchsorted(np.array(heights_m[1:]) - below_m, z, side="right")


def label_storeys(vertices: np.ndarray, faces: np.ndarray, heights_m: tuple[float, ...]) -> np.ndarray:
    """Return (n,) labels by shape (`structure_labels`) of a building, each storey by its own floor."""
    of_vertex = storey_of(vertices[:, 2], heights_m)
    of_face = storey_of(vertices[faces, 2].mean(axis=1), heights_m)
    long = long_faces(vertices, faces)
    of_vertex[faces[long]] = of_face[long, None]
    labels = np.zeros(len(vertices), np.int64)
    for k, height in enumerate(heights_m):
        mine = of_vertex == k
        labels[mine] = structure_labels(vertices, faces[of_face == k], height)[mine]
    return labels


def split_storeys(raw: RawScene) -> tuple[RawScene, ...]:
    """Return one scene for each floor, from the lowest up, in the building's frame.

    A face belongs to the storey of its middle, a long one to all storeys that it touches, and an object to the highest
    floor that is at most half a metre above its base.
    """
    if len(raw.storeys) < 2:
        return (raw,)
    heights, scan = tuple(s.height_m for s in raw.storeys), raw.scan
    placed = [(raw.cads[a.cad_id].vertices, a.pose) for a in raw.annotations]
    base = [float((vertices @ pose[2, :3]).min() + pose[2, 3]) for vertices, pose in placed]
    of_object = storey_of(np.array(base), heights, STANDS_ABOVE_M)
    parts = [(scan.vertices, scan.faces), *raw.picture]
    within, number = [], np.arange(len(heights))[:, None]
    for vertices, faces in parts:
        z = vertices[faces, 2]
        low, of, high = (storey_of(some, heights) for some in (z.min(axis=1), z.mean(axis=1), z.max(axis=1)))
        within.append((of == number) | (long_faces(vertices, faces) & (low <= number) & (number <= high)))
    scenes = []
    for k, storey in enumerate(raw.storeys):
        mine, *drawn = (np.flatnonzero(on[k]) for on in within)
        used, faces = np.unique(scan.faces[mine], return_inverse=True)
        pairs = zip(raw.picture, drawn, strict=True)
        annotations = tuple(a for a, of in zip(raw.annotations, of_object, strict=True) if of == k)
        scenes.append(
            dataclasses.replace(
                raw,
                name=f"{raw.name}_{k}",
                scan=dataclasses.replace(
                    scan,
                    vertices=scan.vertices[used],
                    faces=faces.reshape(-1, 3),
                    labels=scan.labels[used],
                    vertex_colours=None if scan.vertex_colours is None else scan.vertex_colours[used],
                    corner_uv=None if scan.corner_uv is None else scan.corner_uv[mine],
                ),
                annotations=annotations,
                cads={a.cad_id: raw.cads[a.cad_id] for a in annotations},
                floor_height_m=storey.height_m,
                given_map=storey.given_map,
                storeys=(),
                lamps=tuple(p for p in raw.lamps if storey_of(p.at[2], heights, 0.0) == k),
                windows=tuple(w for w in raw.windows if storey_of(w.middle[2], heights, 0.0) == k),
                picture=tuple(geometry.compacted(v, f[on]) for (v, f), on in pairs if len(on)),
                warnings=(
                    *raw.warnings,
                    f"floor {k} of {len(heights)}, at {storey.height_m:g} m of the building's frame",
                ),
            )
        )
    return tuple(scenes)


AXES = {word: sign * np.eye(3)[k] for k, axis in enumerate("xyz") for word, sign in ((axis, 1.0), (f"-{axis}", -1.0))}
"""`--up`: axis of the file that points up."""
UNITS_M = {"m": 1.0, "cm": 0.01, "mm": 0.001, "ft": 0.3048, "in": 0.0254}
HEIGHTS_M = (1.0, 6.0)
"""Plausible heights of one storey's scan; partial ones are low."""
DRAWS = 300
ALONG, ACROSS = np.cos(np.radians(8.0)), np.sin(np.radians(8.0))
"""Faces count as level or as steep within 8 degrees."""
SMALLER = 0.85
"""A storey is lower than this share of its shorter side; else its extents do not show its height."""
EDGE_SHARE = 0.12
"""Of the height: what lies this near to the lowest or highest level may be floor or ceiling."""
BIN_M, MAIN_SHARE, SLAB_M = 0.05, 0.5, 1.0
"""Of level surface: height of a bin, share of the largest that counts as floor or ceiling, thickest slab."""
SURE = 1.25
"""Ratio of evidence for one sense over the other."""


def _extent(values: np.ndarray, area: np.ndarray) -> tuple[float, float]:
    """Return the values that all but 1 % of the area lies between, on either side: strays do not count."""
    weights = area if area.any() else None
    low, high = np.quantile(values, (0.01, 0.99), weights=weights, method="inverted_cdf")
    return float(low), float(high)


def find_up(vertices: np.ndarray, faces: np.ndarray, where: str) -> np.ndarray:
    """Return the unit vector (3,) that points up in a room's scan of any unit, whose faces' front is to the room.

    The height is the shortest extent along three orthogonal directions that most area faces. The floor is the end with
    far more area facing inwards, else the one that furniture tops face away from. Up is the floor's mean normal.
    """
    normal, area = geometry.unit_normals(vertices, faces), geometry.face_areas(vertices, faces)
    if not area.sum() > 0:
        raise SceneRejected(f"{where}: its faces enclose no area; fetch it again")
    middle = vertices[faces].mean(axis=1)
    rng = np.random.default_rng(0)
    drawn = normal[rng.choice(len(area), DRAWS, p=area / area.sum())]
    cosine = np.abs(drawn @ normal.T)
    score = ((cosine > ALONG) | (cosine < ACROSS)) @ area
    axes: list[np.ndarray] = []
    for k in np.argsort(-score, kind="stable"):
        if all(abs(drawn[k] @ axis) < 0.3 for axis in axes):
            axis = drawn[k]
            for _ in range(3):  # the principal direction of the normals near it
                near = np.abs(normal @ axis) > ALONG
                axis = np.linalg.eigh((normal[near] * area[near, None]).T @ normal[near])[1][:, 2]
            axes.append(axis)
    if len(axes) == 2:
        axes.append(np.cross(axes[0], axes[1]))
    if len(axes) < 2:
        raise SceneRejected(f"{where}: shows one direction of surface only; say which axis points up with --up")
    spans = [np.ptp(_extent(middle @ axis, area)) for axis in axes]
    order = np.argsort(spans)
    if spans[order[0]] > SMALLER * spans[order[1]]:
        extents = ", ".join(f"{span:.3g}" for span in sorted(spans))
        raise SceneRejected(
            f"{where}: its extents of {extents} do not tell which is its height; say which axis points up with --up"
        )
    up = axes[order[0]]
    height = middle @ up
    low, high = _extent(height, area)
    level = normal @ up
    edge = EDGE_SHARE * (high - low)
    inner = (height > low + edge) & (height < high - edge)
    top_up, top_down = (area[inner & (sign * level > ALONG)].sum() for sign in (1, -1))
    floors = (height <= low + edge) & (level > ALONG), (height >= high - edge) & (level < -ALONG)
    floor_up, floor_down = (area[floor].sum() for floor in floors)
    # A ceiling is about as large as the floor; then furniture's tops, though small, show the sense.
    if max(floor_up, floor_down) > SURE**2 * min(floor_up, floor_down):
        right = floor_up > floor_down
    elif max(top_up, top_down) > SURE * min(top_up, top_down):
        right = top_up > top_down
    else:
        raise SceneRejected(f"{where}: its floor and its ceiling look alike; say which axis points up with --up")
    floor = floors[0 if right else 1]
    if not floor.any():
        return up if right else -up
    up = area[floor] @ normal[floor]
    return up / np.linalg.norm(up)


def turn_upright(up: np.ndarray) -> np.ndarray:
    """Return (3, 3) the smallest turn that brings `up` to z; never a mirror image."""
    return Rotation.align_vectors([[0.0, 0.0, 1.0]], [up])[0].as_matrix()


def faces_away(vertices: np.ndarray, faces: np.ndarray) -> bool:
    """Return whether a room's floor faces down or its ceiling up: it is mirrored, or its faces' order is wrong.

    Outer sides of slabs, which have an opposite side nearby, do not count. `vertices`: m, z up or down.
    """
    normal, area = geometry.unit_normals(vertices, faces), geometry.face_areas(vertices, faces)
    height = vertices[faces, 2].mean(axis=1)
    middle = np.mean(_extent(height, area))
    level = np.abs(normal[:, 2]) > ALONG
    bins, index = np.unique(np.round(height[level] / BIN_M), return_inverse=True)
    total = np.bincount(index, area[level])
    for z in BIN_M * bins[total >= MAIN_SHARE * total.max(initial=0.0)]:
        inwards = 1.0 if z < middle else -1.0
        from_m = (height - z) * inwards
        away = area[level & (normal[:, 2] * inwards < 0) & (np.abs(from_m) < 2 * BIN_M)].sum()
        if away > 2 * area[level & (normal[:, 2] * inwards > 0) & (from_m > -2 * BIN_M) & (from_m < SLAB_M)].sum():
            return True
    return False


def find_unit(vertices: np.ndarray, faces: np.ndarray, where: str) -> str:
    """Return the word of `UNITS_M` in which a storey's height (z up) is plausible, of m, cm and mm."""
    low, high = _extent(vertices[faces, 2].mean(axis=1), geometry.face_areas(vertices, faces))
    fits = [word for word in ("m", "cm", "mm") if HEIGHTS_M[0] <= (high - low) * UNITS_M[word] <= HEIGHTS_M[1]]
    if len(fits) == 1:
        return fits[0]
    raise SceneRejected(
        f"{where}: is {high - low:.3g} units high, expected a storey of {HEIGHTS_M[0]:g} to {HEIGHTS_M[1]:g} m in "
        "m, cm or mm; say its unit with --unit"
    )
