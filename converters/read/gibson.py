"""Read a raw Gibson folder; labels, alignments and maps are taken where they are.

Files of the release: iGibson 0.0.4, `dataset.md`; z up, metres, maps of 0.01 m a pixel whose middle is
the world's origin. `floors.txt` has one height a line; number k of the map files counts them from the lowest.
"""

import dataclasses
from pathlib import Path

import numpy as np

from converters.read.annotations import inside_scan, parse_annotations, read_cad
from converters.read.files import SourceFolder, read_image, read_json, read_labels, read_numbers
from converters.read.obj import TexturedMesh, read_scan_obj, scan_of
from converters.read.surfaces import check_upright, label_storeys, labelled, with_split_corners
from converters.records.errors import SceneRejected
from converters.records.raw import ATTRIBUTION, FLOOR, WINDOWS, GivenMap, RawScene, Storey, Window
from interactive_nav_common.errors import readable
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
        source.note(f"{LABELS} is absent: floor, walls and ceiling are told by shape")
        mesh = with_split_corners(mesh)
        labels = label_storeys(mesh.vertices, mesh.faces, heights)
    cads, annotations = {}, ()
    if source.has(ALIGNMENTS):
        path = source.use(ALIGNMENTS, "")
        _, records = parse_annotations(read_json(path), path)
        cads = {a.cad_id: read_cad(source, synset, a.cad_id) for synset, a in records}
        annotations = inside_scan(source, ALIGNMENTS, tuple(a for _, a in records), cads, mesh)
        cads = {a.cad_id: cads[a.cad_id] for a in annotations}
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
    """Return a floor's traversable map less its obstacles; None without a file.

    It must fit the mesh, whose vertices are at `mesh_xy` (n, 2), those of this floor at `floor_xy` (k, 2), m.
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
