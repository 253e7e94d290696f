"""Read a raw Gibson folder (iGibson 0.0.4, `dataset.md`) or one of the interactive set; z up, metres.

Maps have 0.01 m a pixel, with the world's origin in the middle. `floors.txt` has one height a line; map numbers count
from the lowest. In the interactive set `mesh_z_up_cleaned.obj` is the scan without the annotated furniture,
`plane_z_up_<f>.obj` floor for the holes, `alignment_centered_<i>_<synset>.urdf` furniture with orientation and scale in
its mesh, and `pos_<i>_<synset>.txt` the x y z of its origin.
"""

import dataclasses
import math
from pathlib import Path

import numpy as np
from trimesh.remesh import subdivide_to_size

from converters.geometry.boxes import upright_box
from converters.geometry.faces import sample_faces
from converters.read.annotations import inside_scan, parse_annotations, read_cad
from converters.read.files import SourceFolder, read_image, read_json, read_labels, read_numbers
from converters.read.meshes import clean_surface
from converters.read.obj import TexturedMesh, join_meshes, read_scan_obj, scan_of
from converters.read.surfaces import check_extent, check_upright, label_storeys, labelled, with_split_corners
from converters.read.urdf import read_urdf
from converters.records.errors import SceneRejected
from converters.records.raw import (
    ATTRIBUTION,
    FLOOR,
    SYNSETS,
    UP,
    WINDOWS,
    Annotation,
    CadModel,
    GivenMap,
    RawScene,
    ScannedHinge,
    Storey,
    Window,
    category_of_id,
)
from interactive_nav_common.errors import readable
from interactive_nav_common.rotations import transform, transformed, yaw_matrix
from interactive_nav_common.untrusted.reading import read_npz

MESH = "mesh_z_up.obj"
LABELS = "mesh_z_up.labels.npz"
ALIGNMENTS = "alignments.json"
MAP_RESOLUTION_M = 0.01
"""Gibson's floor maps: 0.01 m a pixel, the middle of the image at the world's origin."""
STOREY_M = 1.0
"""Two floors are at least this far apart."""
MAP_SHARE = 0.5
"""Of a map's traversable area that must lie inside the mesh, and of the mesh's floor that must lie on the map."""


def read_gibson(root: Path, strict: bool = False) -> RawScene:
    """Read mesh, texture, labels, floor heights, maps, alignments and CAD models.

    Without labels, floor, walls and ceiling are recognised by shape; without alignments the scene has structure only.
    """
    source = SourceFolder(root, strict)
    mesh = read_scan_obj(source, MESH, "expected Gibson's textured z-up mesh")
    heights = read_floors(source)
    labels = None
    if source.has(LABELS):
        mesh, labels = labelled(mesh, read_labels(source.use(LABELS, "")), root / LABELS)
    check_upright(str(root / MESH), mesh.vertices, mesh.faces, labels, heights[0])
    if labels is None:
        source.note(f"{LABELS} is absent: floor, walls and ceiling are labelled by shape")
        mesh = with_split_corners(mesh)
        labels = label_storeys(mesh.vertices, mesh.faces, heights)
    cads, annotations = {}, ()
    if source.has(ALIGNMENTS):
        path = source.use(ALIGNMENTS, "")
        _, records = parse_annotations(read_json(path), path)
        cads = {a.cad_id: read_cad(source, synset, a.cad_id) for synset, a in records}
        annotations, cads = inside_scan(source, ALIGNMENTS, tuple(a for _, a in records), cads, mesh)
    else:
        source.note(f"{ALIGNMENTS} is absent: structure only, all furniture stays part of it")
    raw = building(source, "gibson", mesh, labels, heights, cads, annotations)
    furnished = np.array(True)
    if source.has(LABELS):  # the mesh shows what is annotated, unless the labels' file says otherwise
        path, expected = root / LABELS, "expected labels as an NPZ, furnished as true or false"
        with read_npz(path, SceneRejected, expected) as arrays:
            furnished = np.asarray(arrays["furnished"]) if "furnished" in arrays.files else furnished
        if furnished.dtype != bool or furnished.size != 1:
            was = f"{furnished.dtype} of shape {furnished.shape}"
            raise SceneRejected(f"{path}: furnished is {was}, expected one true or false")
    scan = dataclasses.replace(raw.scan, furnished=bool(furnished.all()))
    return dataclasses.replace(raw, scan=scan, windows=read_windows(source))


def building(source: SourceFolder, layout: str, mesh: TexturedMesh, labels, heights, cads, annotations) -> RawScene:
    """Return the record of a Gibson building: what was read with maps, licence and hashes."""
    floor = [mesh.vertices[(labels == FLOOR) & (np.abs(mesh.vertices[:, 2] - h) < STOREY_M / 2), :2] for h in heights]
    maps = [read_traversable(source, k, mesh.vertices[:, :2], floor[k]) for k in range(len(heights))]
    return source.scene(
        layout,
        scan_of(mesh, labels),
        cads=cads,
        annotations=annotations,
        floor_height_m=heights[0],
        given_map=maps[0],
        licence=read_licence(source),
        attribution=read_attribution(source),
        storeys=tuple(Storey(h, m) for h, m in zip(heights, maps, strict=True)) if len(heights) > 1 else (),
    )


def read_floors(source: SourceFolder) -> tuple[float, ...]:
    """Return the heights of the floors, m, lowest first."""
    path, heights = read_numbers(source, "floors.txt", "expected one floor height in metres a line")
    heights = sorted(heights)
    if not heights or not np.isfinite(heights).all() or max(map(abs, heights)) > 1e4:
        raise SceneRejected(f"{path}: holds {heights[:4]}, expected one floor height in metres a line")
    for low, high in zip(heights, heights[1:], strict=False):
        if high - low < STOREY_M:
            raise SceneRejected(
                f"{path}: floors at {low:g} m and {high:g} m are less than {STOREY_M:g} m apart; give each floor once"
            )
    return tuple(heights)


def read_windows(source: SourceFolder) -> tuple[Window, ...]:
    """Return the boxes along x and y that windows fill; none without the file."""
    if not source.has(WINDOWS):
        return ()
    path, remedy = source.use(WINDOWS, ""), "expected a lower and an upper corner a line, x y z x y z in metres"
    with readable(path, SceneRejected, remedy):
        corners = np.loadtxt(path, ndmin=2).reshape(-1, 2, 3)
    middle, half = corners.mean(axis=1), np.diff(corners, axis=1)[:, 0] / 2
    if not (np.isfinite(corners).all() and (half > 0).all()):
        raise SceneRejected(f"{path}: holds a box without volume, or one that is not finite; {remedy}")
    turned = half[:, 1] > half[:, 0]  # along the wall lies the longer side
    half[turned, :2] = half[turned, 1::-1]
    return tuple(Window(m, h, float(t) * np.pi / 2) for m, h, t in zip(middle, half, turned, strict=True))


def read_traversable(source: SourceFolder, number: int, mesh_xy: np.ndarray, floor_xy: np.ndarray) -> GivenMap | None:
    """Return a floor's traversable map less its obstacles, checked against the mesh; None without a file.

    The mesh's vertices are at `mesh_xy` (n, 2), those of this floor at `floor_xy` (k, 2), m.
    """
    name, obstacle_name = f"floor_trav_{number}.png", f"floor_{number}.png"
    if not source.has(name):
        return None
    path = source.use(name, "")
    image = read_image(path, "L")
    if image.shape[0] != image.shape[1]:
        raise SceneRejected(f"{path}: is {image.shape[1]} x {image.shape[0]}, expected a square image")
    free = image > 127
    if source.has(obstacle_name):
        obstacles = read_image(source.use(obstacle_name, ""), "L")
        if obstacles.shape != free.shape:
            raise SceneRejected(
                f"{source.root / obstacle_name}: is {obstacles.shape[1]} x {obstacles.shape[0]}, expected the "
                f"{free.shape[1]} x {free.shape[0]} of {name}; take both from one release"
            )
        free &= obstacles > 0
    half = image.shape[0] / 2 * MAP_RESOLUTION_M
    low, high = mesh_xy.min(axis=0) - 0.1, mesh_xy.max(axis=0) + 0.1
    row, column = np.nonzero(free)
    at = (np.stack([column, row], axis=1) + 0.5) * MAP_RESOLUTION_M - half
    inside = ((at > low) & (at < high)).all(axis=1).mean() if len(at) else 1.0
    covered = (np.abs(floor_xy) < half).all(axis=1).mean() if len(floor_xy) else 1.0
    if inside < MAP_SHARE or covered < MAP_SHARE:
        raise SceneRejected(
            f"{path}: covers {2 * half:.1f} x {2 * half:.1f} m around the origin, the mesh reaches from "
            f"({low[0] + 0.1:.1f}, {low[1] + 0.1:.1f}) to ({high[0] - 0.1:.1f}, {high[1] - 0.1:.1f}) m: "
            f"{inside:.0%} of the map's free area lies inside the mesh, {covered:.0%} of the mesh's floor on the map; "
            "expected maps of the same mesh at 0.01 m a pixel"
        )
    return GivenMap(free, MAP_RESOLUTION_M, (-half, -half))


def read_attribution(source: SourceFolder) -> str:
    """Return whose the models are, as the folder's file says."""
    has = source.has(ATTRIBUTION)
    return source.use(ATTRIBUTION, "").read_text(encoding="utf-8", errors="replace") if has else ""


def read_licence(source: SourceFolder) -> str:
    """Return the first 400 characters of the folder's LICENCE or LICENSE, on one line."""
    licence = "unknown: the source folder has no LICENCE file"
    name = "LICENCE" if source.has("LICENCE") else "LICENSE"
    if source.has(name):
        text = source.use(name, "").read_text(encoding="utf-8", errors="replace").strip()
        licence = " ".join(text.split())[:400] or licence
    return licence


CLEANED = "mesh_z_up_cleaned.obj"
PREFIX = "alignment_centered"
CLASSES = SYNSETS | {"00000001": "door"}
"""Synset ids of the release; doors had none."""
DOOR_BAND_M = (0.3, 1.8)
"""Heights above the door's foot at which walls stop a leaf."""
DOOR_MOST_RAD = math.radians(120)
SHOWN_M = 0.2
"""Between the points of a surface that stop a leaf; small faces have one."""
NEAR_HINGE_M = 0.15
"""A wall this close to the hinge carries the leaf and does not stop it."""
PLANE_CELL_M = 0.1
SAME_SHARE = 0.5
"""Two objects of one class that share this much of the smaller one's bounding box are one object."""


def read_interactive_gibson(root: Path, strict: bool = False) -> RawScene:
    """Read cleaned mesh, floor planes, furniture, floor heights and maps.

    Furniture keeps its mass, friction and collision meshes. A door's yaw moves from its mesh to its pose, so that the
    leaf lies along its body's x axis; `assume_hinge` adds the hinge.
    """
    source = SourceFolder(root, strict)
    mesh = read_scan_obj(source, CLEANED, "expected the scan without its furniture")
    heights = read_floors(source)
    check_upright(str(root / CLEANED), mesh.vertices, mesh.faces, None, heights[0])
    mesh = with_split_corners(mesh)
    labels = label_storeys(mesh.vertices, mesh.faces, heights)
    for k, height in enumerate(heights):
        mesh, labels = _with_plane(source, k, height, mesh, labels)
    points, _ = sample_faces(mesh.vertices, mesh.faces, SHOWN_M)
    pairs = [_furniture(source, path, points) for path in sorted(root.glob(f"{PREFIX}*.urdf"))]
    cads = {a.cad_id: c for a, c in pairs}
    annotations = _without_doubles(source, tuple(a for a, _ in pairs), cads)
    annotations, cads = inside_scan(source, f"{PREFIX}_*.urdf", annotations, cads, mesh)
    return building(source, "interactive-gibson", mesh, labels, heights, cads, annotations)


def _furniture(source: SourceFolder, path: Path, structure: np.ndarray) -> tuple[Annotation, CadModel]:
    """Return one piece of furniture and its model."""
    category = category_of_id(path.stem.rsplit("_", 1)[-1], f"{path}: category id is", CLASSES)
    name = path.name.replace(PREFIX, "pos")[: -len("urdf")] + "txt"
    place, position = read_numbers(source, name, f"expected x y z in metres, of {path.name}", lines=1)
    if len(position) != 3 or not np.isfinite(position).all():
        raise SceneRejected(f"{place}: holds {len(position)} numbers, expected x y z in metres, all finite")
    item = read_urdf(source, path.name, "")
    vertices, faces, colours = clean_surface(source, path.name, item.surface)
    turn, pieces = np.eye(3), item.pieces
    if category == "door":
        turn = leaf_turn(vertices)
        vertices = vertices @ turn
        pieces = None if pieces is None else tuple((v @ turn, f) for v, f in pieces)
    name = path.stem.removeprefix(PREFIX).strip("_")
    cad = CadModel(category, name, vertices, faces, colours, pieces, item.mass_kg, item.friction)
    pose = transform(turn, position)
    hinge = assume_hinge(vertices, pose, structure) if category == "door" else None
    return Annotation(category, name, pose, hinge=hinge), cad


def leaf_turn(leaf: np.ndarray) -> np.ndarray:
    """Return the (3, 3) yaw that a door's leaf, (n, 3), is turned by from the x axis."""
    box = upright_box(leaf)
    yaw = math.atan2(box.rotation[1, 0], box.rotation[0, 0])
    return yaw_matrix(yaw + math.pi / 2 if box.half[1] > box.half[0] else yaw)


def assume_hinge(leaf: np.ndarray, pose: np.ndarray, structure: np.ndarray) -> ScannedHinge:
    """Return the upright hinge of a door without one: at the end of the leaf with more structure around it.

    The leaf turns both ways until it meets structure, by 120 degrees at most; structure inside the leaf counts as the
    scanned leaf. `leaf` (n, 3) lies along x in the CAD frame, its `pose` (4, 4) is upright and unscaled; `structure`
    (m, 3) are points of the scan.
    """
    low, high = leaf.min(axis=0), leaf.max(axis=0)
    local = (structure - pose[:3, 3]) @ pose[:3, :3]
    height = local[:, 2] - low[2]
    local = local[(height > DOOR_BAND_M[0]) & (height < DOOR_BAND_M[1]), :2]
    across = (low[1] + high[1]) / 2
    half, length = (high[1] - low[1]) / 2 + 0.02, high[0] - low[0]
    choices = []
    for end, inward in ((low[0], 1.0), (high[0], -1.0)):
        # Distance from the hinge along the leaf as it stands, and across it.
        point = (local - [end, across]) * [inward, 1.0]
        radius, angle = np.hypot(*point.T), np.arctan2(point[:, 1], point[:, 0])
        reach = (radius > NEAR_HINGE_M) & (radius < length + 0.02)
        itself = (np.abs(point[:, 1]) < half + 0.02) & (point[:, 0] > 0)
        turns = np.arctan2(half, np.maximum(radius, half))  # a point stops the leaf this much before its middle line
        stops = np.asarray(angle - np.sign(angle) * turns)[reach & ~itself]
        # Three points make an obstacle; one or two are noise of the scan.
        most = [DOOR_MOST_RAD] * 3
        left, right = (np.sort([*some, *most])[2] for some in (stops[stops > 0], np.negative(stops[stops < 0])))
        span = (-right, left) if inward > 0 else (-left, right)
        choices.append((int((radius < NEAR_HINGE_M + half).sum()), left + right, (end, span)))
    end, span = max(choices, key=lambda c: c[:2])[2]
    return ScannedHinge(np.array([end, across, low[2]]), UP, (float(span[0]), float(span[1])), assumed=True)


def _without_doubles(
    source: SourceFolder, annotations: tuple[Annotation, ...], cads: dict[str, CadModel]
) -> tuple[Annotation, ...]:
    """Drop objects of one class that stand in an earlier one: the release annotates some furniture twice."""
    kept: list[tuple[Annotation, np.ndarray, np.ndarray]] = []
    for annotation in annotations:
        placed = transformed(cads[annotation.cad_id].vertices, annotation.pose)
        low, high = placed.min(axis=0), placed.max(axis=0)
        doubles = []
        for other, o_low, o_high in kept:
            shared = np.prod(np.maximum(np.minimum(high, o_high) - np.maximum(low, o_low), 0.0))
            smaller = max(min(np.prod(high - low), np.prod(o_high - o_low)), 1e-12)
            if other.category == annotation.category and shared > SAME_SHARE * smaller:
                doubles.append(other.cad_id)
        if not doubles:
            kept.append((annotation, low, high))
        else:
            source.note(f"{annotation.category} {annotation.cad_id} stands in {doubles[-1]}; it is left out")
    return tuple(a for a, _, _ in kept)


def _with_plane(
    source: SourceFolder, number: int, height_m: float, mesh: TexturedMesh, labels: np.ndarray
) -> tuple[TexturedMesh, np.ndarray]:
    """Return the scan with pieces, 0.1 m long, of the release's floor plane where mesh and map lack visible floor."""
    name = f"plane_z_up_{number}.obj"
    if not source.has(name):
        source.note(f"{name} is absent: the floor under the furniture is patched from the floor around it")
        return mesh, labels
    plane = read_scan_obj(source, name, "")
    floor_faces = mesh.faces[(labels[mesh.faces] == FLOOR).all(axis=1)]
    near = np.abs(mesh.vertices[floor_faces, 2].mean(axis=1) - height_m) < 0.5
    shown = set(map(tuple, _cells(sample_faces(mesh.vertices, floor_faces[near], PLANE_CELL_M / 2)[0]).tolist()))
    mesh_xy, floor_xy = mesh.vertices[:, :2], mesh.vertices[labels == FLOOR, :2]
    given = read_traversable(source, number, mesh_xy, floor_xy) if len(floor_xy) else None
    check_extent("a floor plane", plane.vertices)
    uv = np.zeros((len(plane.faces), 3, 2)) if plane.corner_uv is None else plane.corner_uv
    corners = np.dstack([plane.vertices[plane.faces], uv]).reshape(-1, 5)
    corners, faces, *_ = subdivide_to_size(corners, np.arange(len(corners)).reshape(-1, 3), PLANE_CELL_M, 12)
    middle = corners[faces, :2].mean(axis=1)
    wanted = ((middle > mesh_xy.min(axis=0)) & (middle < mesh_xy.max(axis=0))).all(axis=1)
    wanted &= [tuple(c) not in shown for c in _cells(middle).tolist()]
    if given is not None:
        index = np.floor((middle - given.origin) / given.resolution_m).astype(np.int64)
        wanted &= ((index >= 0) & (index < given.traversable.shape[::-1])).all(axis=1)
        wanted[wanted] = given.traversable[index[wanted, 1], index[wanted, 0]]
    if not wanted.any():
        return mesh, labels
    vertices, uv = np.split(corners[faces[wanted]].reshape(-1, 5), [3], axis=1)
    vertices[:, 2] = height_m
    patch = TexturedMesh(vertices, np.arange(len(vertices)).reshape(-1, 3), uv.reshape(-1, 3, 2), plane.texture)
    return join_meshes(mesh, patch), np.concatenate([labels, np.full(len(vertices), FLOOR, np.int64)])


def _cells(points: np.ndarray) -> np.ndarray:
    return np.floor(points[:, :2] / PLANE_CELL_M).astype(np.int64)
