"""Turn the placed parts of a home into a scan of its structure, and models and annotations of its furniture.

A part moves if its name is that of a movable category and its size fits, even if its source fixes it to the world;
objects on such a part move with it.
"""

import collections
import dataclasses
import math
import re
from collections.abc import Collection, Mapping
from pathlib import Path
from typing import Any

import numpy as np
import shapely

from converters.geometry.boxes import MAX_PIECES, convex_pieces
from converters.geometry.faces import face_vectors, merge_vertices, sample_faces, triangulated
from converters.read.files import SourceFolder
from converters.read.gibson import SHOWN_M, assume_hinge, leaf_turn, read_attribution, read_licence
from converters.read.meshes import clean_surface, colours_of_faces
from converters.read.obj import TexturedMesh, at_most, join_meshes, scan_of, textured_by_face
from converters.read.surfaces import check_extent, floor_level, label_storeys, storey_of, with_split_corners
from converters.read.urdf import joined, placed
from converters.records.errors import MOVABLES, SceneRejected, check_count
from converters.records.raw import UNLABELLED, Annotation, CadModel, RawScene, ScannedHinge, Storey
from interactive_nav_common.records import read_packaged
from interactive_nav_common.rotations import transform, transformed, yaw_matrix
from scenes_mjcf.categories import CATEGORIES, Category

ALIASES = read_packaged(Path(__file__).with_suffix(".yaml"), dict[str, str])
"""Names that others give to our categories."""
FRONTS = ("cabinet_door", "drawer")
"""Categories of what opens of furniture; no name says them, but a joint."""
BY_NAME = {c.name.replace("_", ""): c for c in CATEGORIES.values() if c.name not in ("robot", "other", *FRONTS)}
BY_NAME |= {word: CATEGORIES[of] for word, of in ALIASES.items()}
OTHER_STRUCTURE, OTHER_FURNITURE = 38, 39
"""NYU40's words for what is built in and nothing else, and for what need not reach the ceiling."""
TEXTURE_PX = 512
STANDS_M = 0.15
"""Of its base above the floor: what is higher stands on something else, or hangs."""
RAISED_M = 0.03
"""What begins lower lies on the floor, and on nothing else."""
RESTS_M = 0.10
"""What stands on a part may begin so far above the part's top."""
DOOR_MOST_M, DOOR_LEAST_M = 1.3, 1.5
"""Wider leaves fold or slide: they stay where they are. Lower ones on a joint are furniture's."""
SLAB_M, TOUCH_M, HIDDEN_SHARE = 0.3, 0.005, 0.8
"""A level face is hidden if so much lies below another one that is higher by up to the first."""
COLUMN_M, SHOWN = 0.1, 100_000
"""Side of the columns that level faces are compared in, and how many of these they take at most."""
MASS_FACTOR = 2.0
"""A mass that far outside of its category's range is a placeholder."""
HEAVY = 10.0
"""A mass that many times the greatest of its category is no placeholder: the part is something else."""
MOST_M, MOST_KG = (4.0, 3.0), 300.0
"""Greatest horizontal side, height and mass of what is moved."""
LEVEL = 0.9999
"""Least cosine between the normal of a level plane and the upright."""
PLINTH_M, FLOOR_SHARE = 0.4, 0.25
"""The floor of a home on a plane lies up to the first above it, over at least the second of the home's extent."""


@dataclasses.dataclass(frozen=True)
class HomePart:
    """Hold one rigid object."""

    name: str
    pose: np.ndarray
    """(4, 4) local frame -> home, unscaled."""
    surface: TexturedMesh
    """Local frame, m."""
    collision: TexturedMesh | None
    static: bool
    mass_kg: float | None = None
    friction: float | None = None
    held: bool = False
    """It stays where it is whatever its name says."""
    category_name: str = ""
    """Name of its category; empty: the one that `name` says."""
    hinge: ScannedHinge | None = None
    """What it opens on, local frame; None: nothing, or where its category is a door an assumed one."""
    low: bool = False
    """Built in, and no higher than it shows."""
    endless: bool = False
    """A level plane at its pose, which has no end; its surface gives the colour."""

    @property
    def category(self) -> Category | None:
        """Return the category, if there is one."""
        return CATEGORIES[self.category_name] if self.category_name else category_of(self.name)


def category_of(name: str) -> Category | None:
    """Return the category given by the last word of a part's name: `KitchenTable_01` is a table.

    Numbers, single letters and RoboCasa's additions are ignored: `stool_1_island_group_main` is a stool.
    """
    bare = re.sub(r"(_[a-z]+_group)?(_(main|root))+$", "", name)
    words = [w.lower() for w in re.findall(r"[A-Z]+(?![a-z])|[A-Z]?[a-z]+", bare) if len(w) > 1]
    return by_last_words(words, BY_NAME)


def by_last_words(words: list[str], table: Mapping[str, Any]) -> Any:
    """Return the entry of as many last words as the table has one for, also in the plural; None without any."""
    tails = ("".join(words[first:]) for first in range(len(words)))
    return next((hit for tail in tails if (hit := table.get(tail) or table.get(tail.removesuffix("s")))), None)


def home(source: SourceFolder, layout: str, parts: list[HomePart], floors_m: tuple[float, ...] = ()) -> RawScene:
    """Return the record of a home from its parts."""
    parts, floors_m = _on_floors(source, parts, floors_m)
    parts = [p if p.hinge is None or p.category_name else _front(source, p, p.hinge) for p in parts]
    parts = _by_size(source, parts, weighed=layout == "sdf")
    bounds = [_bounds(part) for part in parts]
    floor_m = np.array(floors_m)[storey_of(np.array([low[2] for low, _ in bounds]), floors_m)]
    moves = [_moves(part, low, high, z) for part, (low, high), z in zip(parts, bounds, floor_m, strict=True)]
    check_count(source.root, sum(moves), MOVABLES, "pieces of furniture on its floor")
    fast = [moving or part.held for moving, part in zip(moves, parts, strict=True)]
    carry = [moving and part.category_name not in FRONTS for moving, part in zip(moves, parts, strict=True)]
    carried = _carriers(bounds, carry, fast, floor_m)
    structure = [p for p, moving, by in zip(parts, moves, carried, strict=True) if not moving and by is None]
    if not structure:
        raise SceneRejected(f"{source.root}: no part is built in; expected floor and walls")
    shells = [placed(_small(p.surface), p.pose) for p in structure]
    mesh = with_split_corners(join_meshes(*shells))
    labels = label_storeys(mesh.vertices, mesh.faces, floors_m)
    labels[labels == UNLABELLED] = OTHER_STRUCTURE
    low = np.repeat([part.low for part in structure], [len(shell.faces) for shell in shells])
    labels[mesh.faces[low]] = OTHER_FURNITURE
    points, _ = sample_faces(mesh.vertices, mesh.faces, SHOWN_M)
    pairs = [
        _furniture(source, part, [parts[k] for k, by in enumerate(carried) if by == i], points)
        for i, (part, moving) in enumerate(zip(parts, moves, strict=True))
        if moving
    ]
    stay = [p.name for p, m, by in zip(parts, moves, carried, strict=True) if not (p.static or m) and by is None]
    if stay:
        names = ", ".join(sorted(stay)[:5])
        source.note(f"{len(stay)} loose objects stand on no furniture that moves, and stay fixed: {names}")
    if riders := sum(by is not None for by in carried):
        source.note(f"{riders} objects stand on furniture and move with it")
    return source.scene(
        layout,
        scan_of(mesh, labels),
        cads={a.cad_id: c for a, c in pairs},
        annotations=tuple(a for a, _ in pairs),
        floor_height_m=floors_m[0],
        storeys=tuple(Storey(z, None) for z in floors_m) if len(floors_m) > 1 else (),
        licence=read_licence(source),
        attribution=read_attribution(source),
        picture=tuple((shell.vertices, shell.faces) for shell in shells),
    )


def built_in(raw: RawScene, beside: Mapping[int, str], named: Collection[int] = ()) -> RawScene:
    """Return a source in which some pieces are structure; warnings say what those stand beside that are not `named`."""
    end = {k: "its joint is welded shut" if raw.annotations[k].category in FRONTS else "is built in" for k in beside}
    rows = [(raw.annotations[k].cad_id, other, end[k]) for k, other in beside.items() if k not in named]
    words = [f"{cad_id} cannot be parted from {other}, and {what}" for cad_id, other, what in rows]
    stay = tuple(a for k, a in enumerate(raw.annotations) if k not in beside)
    cads = {a.cad_id: raw.cads[a.cad_id] for a in stay}
    rest = dataclasses.replace(raw, annotations=stay, cads=cads, warnings=(*raw.warnings, *words))
    if not raw.picture:
        return rest
    shells = []
    for k in beside:
        surface = raw.cads[raw.annotations[k].cad_id].surface
        assert surface is not None
        shells.append(placed(_small(surface), raw.annotations[k].pose))
    mesh = with_split_corners(join_meshes(*shells))
    whole = join_meshes(raw.scan, mesh)
    fresh = len(whole.vertices) - len(raw.scan.vertices)
    labels = np.concatenate([raw.scan.labels, np.full(fresh, OTHER_STRUCTURE)])
    return dataclasses.replace(
        rest,
        scan=dataclasses.replace(scan_of(whole, labels), furnished=raw.scan.furnished),
        picture=raw.picture + tuple((shell.vertices, shell.faces) for shell in shells),
    )


def _front(source: SourceFolder, part: HomePart, hinge: ScannedHinge) -> HomePart:
    """Return what opens upright, as a room door, a door of furniture or a drawer, and a knob as built in."""
    sides, turn, said = np.ptp(_bounds(part), axis=0), part.pose[:3, :3], category_of(part.name)
    tall = sides[2] >= DOOR_LEAST_M and not hinge.slides and abs(turn[2] @ hinge.axis) > 0.99
    room = tall and (said is CATEGORIES["door"] or (said is None and "door" in part.name.lower()))
    if knob := bool(np.sort(sides)[1] < 0.1):
        source.note(f"joint of {part.name}: carries a knob or handle of less than 0.1 m; welded")
    pose = transform(yaw_matrix(math.atan2(turn[1, 0] - turn[0, 1], turn[0, 0] + turn[1, 1])), part.pose[:3, 3])
    if sum(hinge.range_rad) < 0:  # the lower end is where it is shut
        hinge = dataclasses.replace(hinge, axis=-hinge.axis, range_rad=(-hinge.range_rad[1], -hinge.range_rad[0]))
    by, kind = np.linalg.inv(pose) @ part.pose, "structure" if knob else "door" if room else FRONTS[hinge.slides]
    solid, place = part.collision and placed(part.collision, by), {"pose": pose, "surface": placed(part.surface, by)}
    about = {"collision": solid, "hinge": hinge.moved(by), "static": not room, "held": knob, "category_name": kind}
    return dataclasses.replace(part, **place, **about)


def _bounds(part: HomePart) -> tuple[np.ndarray, np.ndarray]:
    points = transformed(part.surface.vertices, part.pose)
    return points.min(axis=0), points.max(axis=0)


def _shown(vertices: np.ndarray, faces: np.ndarray) -> np.ndarray:
    """Return the faces that look up, less those below others by up to `SLAB_M`: the slab under a floor is no floor."""
    area = face_vectors(vertices, faces) / 2
    chosen = area[:, 2] > 0.95 * np.maximum(np.linalg.norm(area, axis=1), 1e-12)
    level = faces[chosen]
    # Samples are compared within columns: pairs of faces would be too many where thousands lie on one another.
    cell = max(COLUMN_M, math.sqrt(area[chosen, 2].sum() / SHOWN))
    points, of = sample_faces(vertices, level, cell / 2)
    column = np.unique(np.floor(points[:, :2] / cell), axis=0, return_inverse=True)[1].reshape(-1)
    z = points[:, 2] - vertices[:, 2].min()
    key = column * (z.max(initial=0.0) + 1.0) + z
    order = np.argsort(key)
    above = np.append(order, -1)[np.searchsorted(key[order], key + TOUCH_M, "right")]
    hidden = (above >= 0) & (column[above] == column) & (z[above] - z < SLAB_M)
    return level[np.bincount(of, hidden, len(level)) <= HIDDEN_SHARE * np.bincount(of, minlength=len(level))]


def _on_floors(
    source: SourceFolder, parts: list[HomePart], floors_m: tuple[float, ...]
) -> tuple[list[HomePart], tuple[float, ...]]:
    """Return the parts, with an infinite plane cut to the extent of the others, and the heights of the floors.

    The plane is the floor unless other parts slightly above cover enough of it: then it is the ground outside, drawn
    only if it is at most a doorstep lower.
    """
    planes = [p for p in parts if p.endless]
    rest = [p for p in parts if not p.endless] or planes
    whole = _whole(rest)
    if whole is None:
        raise SceneRejected(f"{source.root}: holds no part; expected a floor")
    shown = whole.vertices, _shown(whole.vertices, whole.faces)
    if not planes or rest is planes:
        return rest, floors_m or (floor_level(*shown, str(source.root)),)
    # A plane above most of what stands there is a ceiling.
    base_m = float(np.median([_bounds(part)[0][2] for part in rest]))
    low_planes = [p for p in planes if p.pose[2, 3] < base_m + PLINTH_M]
    plane = max(low_planes, key=lambda p: p.pose[2, 3]) if low_planes else min(planes, key=lambda p: p.pose[2, 3])
    if others := sum(abs(p.pose[2, 3] - plane.pose[2, 3]) > TOUCH_M for p in planes):
        source.note(f"{others} more level planes at other heights than the floor: not read")
    ground_m = float(plane.pose[2, 3])
    check_extent(str(source.root), whole.vertices)
    height = shown[0][shown[1], 2].mean(axis=1)
    above = height > ground_m - TOUCH_M
    near = shown[1][above & (height < ground_m + PLINTH_M)]
    low, high = whole.vertices[:, :2].min(axis=0), whole.vertices[:, :2].max(axis=0)
    area_m2 = float(face_vectors(whole.vertices, near)[:, 2].sum()) / 2
    floor_m = ground_m
    if area_m2 > FLOOR_SHARE * float(np.prod(high - low)):
        floor_m = floor_level(whole.vertices, shown[1][above], str(source.root))
    if floor_m > ground_m + STANDS_M:
        return rest, (floor_m,)
    fixed = _whole([p for p in rest if p.static and (p.category is None or not p.category.is_object)])
    covers = np.zeros((0, 3, 3)) if fixed is None else fixed.vertices[_shown(fixed.vertices, fixed.faces)]
    off = covers[..., 2].mean(axis=1) - ground_m
    covers = shapely.polygons(covers[(off > -TOUCH_M) & (off < SLAB_M)][..., :2])
    ground = shapely.get_parts(shapely.difference(shapely.box(*low, *high), shapely.union_all(covers)))
    corners = triangulated(ground[(shapely.get_type_id(ground) == 3) & (shapely.area(ground) > 1e-6)])
    if len(corners):
        vertices = np.column_stack([corners.reshape(-1, 2), np.zeros(3 * len(corners))])
        faces = np.arange(len(vertices)).reshape(-1, 3)
        colour = np.tile(colours_of_faces(plane.surface)[:1], (len(faces), 1))
        place = transform(np.eye(3), (0.0, 0.0, ground_m))
        rest = [*rest, dataclasses.replace(plane, pose=place, surface=textured_by_face(vertices, faces, colour))]
    return rest, (floor_m,)


def _by_size(source: SourceFolder, parts: list[HomePart], weighed: bool) -> list[HomePart]:
    """Return the parts, reclassified if their sizes or masses do not fit the category of their name.

    A static part becomes built in; a loose one becomes `other`, or built in if it is too large or too heavy to move.
    Masses count only if `weighed`, as many formats have placeholders.
    """
    result, changed = [], collections.defaultdict(list)
    for part in parts:
        category = part.category
        if not part.held and (not part.static if category is None else category.is_object and category.name != "door"):
            low, high = _bounds(part)
            size_m, mass_kg = np.array([max((high - low)[:2]), high[2] - low[2]]), (weighed and part.mass_kg) or 0.0
            most_m, most_kg = MOST_M, MOST_KG
            if category is not None and category.most_m is not None and category.material is not None:
                most_m, most_kg = category.most_m, HEAVY * category.material.mass_range_kg[1]
            fits = (size_m <= most_m).all() and mass_kg <= most_kg
            if not fits and (part.static or (size_m > MOST_M).any() or mass_kg > MOST_KG):
                part = dataclasses.replace(part, held=True)
                changed["too large or heavy for furniture, and built in"].append(part.name)
            elif not fits:
                part = dataclasses.replace(part, category_name="other")
                changed["too large or heavy for their names, and of the category 'other'"].append(part.name)
        result.append(part)
    for what, names in changed.items():
        source.note(f"{len(names)} parts are {what}: {', '.join(sorted(names)[:5])}")
    return result


def _whole(parts: list[HomePart]) -> TexturedMesh | None:
    return joined([placed(TexturedMesh(p.surface.vertices, p.surface.faces, None, None), p.pose) for p in parts])


def _small(mesh: TexturedMesh) -> TexturedMesh:
    return mesh if mesh.texture is None else dataclasses.replace(mesh, texture=at_most(mesh.texture, TEXTURE_PX))


def _moves(part: HomePart, low: np.ndarray, high: np.ndarray, floor_m: float) -> bool:
    """Return True for furniture that stands on the floor."""
    category = part.category
    movable = not part.static if category is None else category.is_object
    folds = category is not None and category.name == "door" and max((high - low)[:2]) > DOOR_MOST_M
    return movable and not (part.held or folds) and (part.category_name in FRONTS or abs(low[2] - floor_m) < STANDS_M)


def _carriers(
    bounds: list[tuple[np.ndarray, np.ndarray]], moves: list[bool], fast: list[bool], floor_m: np.ndarray
) -> list[int | None]:
    """Return for each part the number of the movable one that it stands on or in, if any; none for those `fast`."""
    carried: list[int | None] = [None] * len(bounds)
    movers = np.flatnonzero(moves)
    base, top = np.array([bounds[k] for k in movers]).reshape(-1, 2, 3).transpose(1, 0, 2)
    top = top + [0.0, 0.0, RESTS_M]
    for i, (low, high) in enumerate(bounds):
        if fast[i] or low[2] - floor_m[i] < RAISED_M:
            continue
        foot = np.array([*(low + high)[:2] / 2, low[2]])
        under = movers[((base < foot) & (foot < top)).all(axis=1)]
        carried[i] = int(under[-1]) if len(under) else None
    return carried


def _furniture(
    source: SourceFolder, part: HomePart, riders: list[HomePart], structure: np.ndarray
) -> tuple[Annotation, CadModel]:
    """Return the annotation and the model of one movable part with what stands on it."""
    members = [(part, np.eye(4)), *((rider, np.linalg.inv(part.pose) @ rider.pose) for rider in riders)]
    surface = join_meshes(*(placed(_small(p.surface), by) for p, by in members))
    every = []
    for p, by in members:  # the convex pieces of each collision mesh; None where it has none or is not convex in parts
        solid = None if p.collision is None else placed(p.collision, by)
        every.append(None if solid is None else convex_pieces(*merge_vertices(solid.vertices, solid.faces)[:2]))
    pieces = None if None in every else tuple(piece for some in every for piece in some or ())
    pieces = None if pieces is None or len(pieces) > MAX_PIECES else pieces
    vertices, faces, colours = clean_surface(source, part.name, surface)
    category = part.category
    name, pose, hinge = "other" if category is None else category.name, part.pose, part.hinge
    if name == "door":
        turn = leaf_turn(vertices)
        if hinge is not None and ((vertices.mean(axis=0) - hinge.origin) @ turn)[0] < 0:
            turn = turn * [-1.0, -1.0, 1.0]  # one of its two frames: a leaf lies along x from its hinge
        vertices, pose = vertices @ turn, pose.copy()
        surface = dataclasses.replace(surface, vertices=surface.vertices @ turn)
        pose[:3, :3] = pose[:3, :3] @ turn
        pieces = None if pieces is None else tuple((v @ turn, f) for v, f in pieces)
        hinge = assume_hinge(vertices, pose, structure) if hinge is None else hinge.moved(transform(turn.T))
    cad_id = re.sub(r"[^A-Za-z0-9_-]", "_", "-".join(p.name for p in (part, *riders)))[:100]
    material, mass_kg = CATEGORIES[name].material, part.mass_kg
    assert material is not None
    least, most = material.mass_range_kg
    if mass_kg is not None and not least / MASS_FACTOR <= mass_kg <= most * MASS_FACTOR:
        # The category's density gives it then.
        source.note(f"{part.name}: {mass_kg:g} kg is a placeholder; a {name} weighs {least:g} to {most:g} kg")
        mass_kg = None
    cad = CadModel(name, cad_id, vertices, faces, colours, pieces, mass_kg, part.friction, surface)
    return Annotation(name, cad_id, pose, hinge=hinge), cad
