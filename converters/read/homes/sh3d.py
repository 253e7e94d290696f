"""Read a Sweet Home 3D drawing (`.sh3d` with the `Home.xml` of version 5.3 or later).

Walls, rooms and openings become structure, levels storeys, and door leaves hinged; catalogue ids or names classify
furniture.
"""

import collections
import dataclasses
import hashlib
import math
import re
import tempfile
import unicodedata
import xml.etree.ElementTree as ElementTree
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
import shapely

from converters.geometry.boxes import convex_hull
from converters.read.files import SourceFolder, only_file
from converters.read.homes import sh3d_walls
from converters.read.homes.parts import HomePart, category_of, home
from converters.read.homes.sh3d_archive import called, colour, metres, number, point, read_xml, unpack
from converters.read.homes.sh3d_models import LEAF, WHITE, DrawnModels, mean_colour, part_of
from converters.read.meshes import colours_of_faces
from converters.read.obj import TexturedMesh
from converters.read.surfaces import check_extent
from converters.read.urdf import count_unread, report_unread
from converters.records.errors import DRAWN, UNPACKED, SceneRejected, check_count
from converters.records.raw import UP, Lamp, RawScene, ScannedHinge
from interactive_nav_common.records import read_packaged
from interactive_nav_common.rotations import transform, transformed, yaw_matrix
from scenes_mjcf.categories import CATEGORIES

ENDING = ".sh3d"
PIECES = ("pieceOfFurniture", "doorOrWindow", "light", "shelfUnit")
DROPPED = {
    "dimensionLine": "dimensions",
    "label": "labels",
    "polyline": "polylines",
    "backgroundImage": "background images",
}
DOOR_M = (0.1, 1.5)
"""A door's foot is lower than the first and its height more than the second; else its leaves stay shut: a window."""
STOREY_M = 1.8
"""Levels closer to one another are one storey."""
SLIDES = re.compile("(?i)_on_rail|sliding|slider|folding")
LEAF_M = 0.04
REBATE_M = 0.012
TURN_MOST_RAD = math.radians(120)
AJAR_RAD = math.radians(10)
"""A leaf that is drawn farther from both ends of its swing stands ajar."""
LOW_TABLE_M = 0.5
OURS = "interactive_nav#"
"""Ids of drawings that `converters.write.sh3d` makes: their ids name categories."""
BLOCKS = ("texturablebox", "texturablecylinder", "texturabletriangle", "texturablesphere", "texturablecone")
"""Ids, less what stands before #, of shapes from which people build all kinds of objects."""
_TABLES: dict[str, dict[str, Any]] = read_packaged(Path(__file__).with_suffix(".yaml"), dict[str, dict[str, Any]])
FOREIGN = dict(sorted(((w, c) for c, words in _TABLES["words"].items() for w in words), key=lambda p: -len(p[0])))


def read_sh3d(root: Path, strict: bool = False, chosen: Path | None = None) -> RawScene:
    """Read the only drawing of a folder, or the chosen one."""
    files = [root] if root.is_file() else [p for p in sorted(root.glob(f"*{ENDING}")) if p.is_file()]
    path = chosen or only_file(root, files, "drawings")
    with tempfile.TemporaryDirectory(prefix="sh3d-") as scratch:
        folder = Path(scratch).resolve() / path.stem
        folder.mkdir()
        budget = [UNPACKED]
        unpack(path, folder, budget)
        source = SourceFolder(folder, strict)
        try:
            raw = _Drawing(source, read_xml(path, folder), budget).scene()
        except SceneRejected as error:
            text = str(error).replace(str(folder), str(path))
            raise SceneRejected(text if text.startswith(str(path)) else f"{path}: {text}") from None
    digest = hashlib.sha256(path.read_bytes()).hexdigest()
    return dataclasses.replace(raw, name=path.stem, sources={path.name: digest})


def kind_of(catalogue_id: str, name: str, height_m: float = 1.0) -> str:
    """Return the category of a piece by its catalogue id, else by its name in some languages, else `other`."""
    catalogued = catalogue_id.rpartition("#")[2]
    if catalogue_id.startswith(OURS) and catalogued in CATEGORIES:
        return catalogued
    bare = re.sub("[^a-z]", "", catalogued.lower())
    if bare in BLOCKS or "stair" in bare:
        return "structure"
    kind = _TABLES["ids"].get(bare) or next(
        (c.name for words in (catalogued, name) if (c := category_of(words)) is not None), None
    )
    plain = unicodedata.normalize("NFKD", name).encode("ascii", "ignore").decode().lower()
    for word in re.findall("[a-z]{3,}", plain) if kind is None else ():
        # In compounds of German and Dutch the last part says what it is.
        ends = (key for key in FOREIGN if word == key or (len(key) > 4 and word.endswith(key)))
        kind = kind or FOREIGN.get(next(ends, ""))
    if kind == "table" and height_m < LOW_TABLE_M and not catalogue_id.startswith(OURS):
        return "coffee_table"
    return kind or "other"


class _Drawing:
    """Walk a drawing; count what is dropped."""

    def __init__(self, source: SourceFolder, root: ElementTree.Element, budget: list[int]) -> None:
        self.source, self.root = source, root
        self.models = DrawnModels(source, budget)
        self.dropped: collections.Counter[str] = collections.Counter()
        self.named: collections.Counter[str] = collections.Counter()
        self.lamps: list[Lamp] = []
        levels = root.findall("level")
        self.hidden = {e.get("id") for e in levels if "false" in (e.get("visible"), e.get("viewable"))}
        self.base_m: dict[str | None, float] = {e.get("id"): number(e, "elevation") / 100 for e in levels}
        self.high_m = {e.get("id"): number(e, "height", 100 * sh3d_walls.HEIGHT_M) / 100 for e in levels}
        self.base_m.setdefault(None, min(self.base_m.values(), default=0.0))
        self.high_m.setdefault(None, number(root, "wallHeight", 100 * sh3d_walls.HEIGHT_M) / 100)
        for tag, what in DROPPED.items():
            self.dropped[what] += len(root.findall(tag))
        unread: collections.Counter[str] = collections.Counter()
        count_unread(root, _TABLES["read"], unread)
        report_unread(source, "the drawing", unread)

    def scene(self) -> RawScene:
        """Return the whole home."""
        walls = sh3d_walls.read_walls(list(self._visible("wall")), self.base_m, self.source.note)
        pieces = list(self._pieces())
        check_count(self.source.root, len(walls) + len(pieces), DRAWN, "walls and pieces of furniture")
        cutting = [e for e in pieces if e.tag == "doorOrWindow"]
        openings = [sh3d_walls.opening_of(e, self._base(e)) for e in cutting]
        high = [number(e, "elevation", 0.0) / 100 > DOOR_M[0] for e in cutting]
        cuts = [any(opening.within(wall) is not None for wall in walls) for opening in openings]
        windows = tuple(o.window() for o, *of in zip(openings, high, cuts, strict=True) if all(of))
        parts = [part for e in pieces for part in self._piece(e)]
        for wall in walls:
            e = wall.element
            looks = {side: self.models.look(e, f"{side}SideColor", f"{side}SideTexture") for side in ("left", "right")}
            looks["top"] = self.models.look(e, "topColor", "", mean_colour(looks["right"][0]))
            part = sh3d_walls.wall_part(wall, openings, looks)
            low = wall.height_m.max() < sh3d_walls.LOW_M
            parts += [] if part is None else [dataclasses.replace(part, low=low)]
        rooms, floors_m, bases = [], set(), sorted(set(self.base_m.values()))
        for e in self._visible("room"):
            room = sh3d_walls.read_room(e, self.models.look)
            if room is None:
                self.source.note(f"{called(e)}: its outline encloses nothing; it is left out")
            else:
                rooms.append(room)
        shafts = []  # footprint, foot and top
        for e in (e for e in pieces if e.get("staircaseCutOutShape")):
            foot = self._base(e) + number(e, "elevation", 0.0) / 100
            shafts.append((_footprint(e), foot, foot + number(e, "height") / 100))
        ground = min((self.base_m.get(r.level, 0.0) for r in rooms), default=bases[0])
        for base, above in zip(bases, [*bases[1:], math.inf], strict=True):
            mine = [w for w in walls if w.base_m == base]
            here = [r for r in rooms if self.base_m.get(r.level, 0.0) == base]
            high = max([self.high_m[r.level] for r in here], default=sh3d_walls.HEIGHT_M)
            if (here and base == ground) or (not here and above - base > STOREY_M):  # else open to below, or too low
                bare = sh3d_walls.enclosed(mine, here)
                if here and bare:
                    area = sum(shapely.area(room.plan) for room in bare)
                    self.source.note(f"{area:.1f} m2 within walls are in no room: taken for floor")
                here = bare + here
            span = base, base + high
            cut = [[p for p, foot, top in shafts if foot < z - 0.1 and top > z - 0.5] for z in span]
            through = [shapely.union_all(plans) for plans in cut]
            level = sh3d_walls.level_parts(here, mine, openings, span, through)
            parts += level
            if level and any(r.floor is not None for r in here):
                floors_m.add(base)
        for what, count in sorted((+self.dropped).items()):
            self.source.note(f"{count} {what}: dropped")
        if not floors_m:
            raise SceneRejected("has no room and no closed walls, expected a floor; draw a room")
        storeys: tuple[float, ...] = ()
        for z in sorted(floors_m):
            storeys += (z,) if not storeys or z - storeys[-1] > STOREY_M else ()
        places = [transformed(p.surface.vertices, p.pose) for p in parts]
        check_extent(str(self.source.root), np.vstack(places))
        lamps = tuple(lamp for lamp in self.lamps if lamp.colour.any())
        return dataclasses.replace(home(self.source, "sh3d", parts, storeys), lamps=lamps, windows=windows)

    def _visible(self, tag: str) -> Iterator[ElementTree.Element]:
        for e in self.root.findall(tag):
            if e.get("level") in self.hidden:
                self.dropped[f"{tag}s on levels that are hidden"] += 1
            elif e.get("level") not in self.base_m:
                raise SceneRejected(f"{called(e)}: names a level that is not there; save the home again")
            else:
                yield e

    def _pieces(self) -> Iterator[ElementTree.Element]:
        """Yield the visible furniture, groups taken apart."""
        for tag in (*PIECES, "furnitureGroup"):
            for top in self._visible(tag):
                stack = [top]
                while stack:
                    e = stack.pop()
                    if e.get("visible") == "false":
                        self.dropped["pieces that are hidden"] += 1
                    elif e.tag == "furnitureGroup":
                        inner = [c for c in e if c.tag in (*PIECES, "furnitureGroup")]
                        for child in inner:
                            child.attrib.setdefault("level", e.get("level", ""))
                            if not child.get("level"):
                                del child.attrib["level"]
                        stack += inner[::-1]
                    else:
                        yield e

    def _base(self, e: ElementTree.Element) -> float:
        return self.base_m.get(e.get("level"), self.base_m[None])

    def _piece(self, e: ElementTree.Element) -> list[HomePart]:
        """Return the parts of one piece: furniture, or a door or window with its leaves apart."""
        surface, group = self.models.surface(e)
        if not len(surface.faces):
            return []
        at = np.array([*point(e), self._base(e) + number(e, "elevation", 0.0) / 100])
        pose = transform(yaw_matrix(-number(e, "angle", 0.0)), at)
        height = float(np.ptp(surface.vertices[:, 2]))
        name = " ".join((e.get("name") or e.get("catalogId") or "piece").split())[:60]
        self.named[name] += 1
        name = f"{name} {self.named[name]}"
        kind = kind_of(e.get("catalogId") or "", e.get("name") or "", height)
        held = e.get("movable") == "false" or kind == "structure"
        stays = kind != "structure" and (held or not CATEGORIES[kind].is_object)
        fronts = [*self.models.fronts(e, surface, group)] if stays and e.tag not in ("doorOrWindow", "light") else []
        if SLIDES.search(" ".join([e.get("catalogId") or "", name, *np.unique(group)])) and not fronts:
            self.source.note(f"{name}: its sliding or folding parts stay as drawn")
        solid = self.models.solid(e, surface) if (e.get("catalogId") or "").startswith(OURS) else None
        if e.tag == "doorOrWindow":
            return self._door(e, HomePart(name, pose, surface, solid, False), group)
        if e.tag == "light":
            kind = kind if kind == "floor_lamp" else "other"
            self.lamps += [_lamp(e, source, pose) for source in e.findall("lightSource")]
        if fronts:
            rest = np.setdiff1d(np.arange(len(surface.faces)), np.concatenate([faces for faces, _ in fronts]))
            held, solid, surface = True, None, part_of(surface, rest)
        whole = HomePart(name, pose, surface, solid, False, held=held, category_name=kind)
        return [whole, *(dataclasses.replace(f, name=f"{f.name} of {name}", pose=pose) for _, f in fronts)]

    def _door(self, e: ElementTree.Element, door: HomePart, group: np.ndarray) -> list[HomePart]:
        """Return the frame and leaves of a door, whose faces are in a `group` each; a window in one piece."""
        sashes = e.findall("sash")
        foot, height = number(e, "elevation", 0.0) / 100, number(e, "height") / 100
        fixed = dataclasses.replace(door, collision=None, static=True, held=True, category_name="structure")
        if not sashes or foot > DOOR_M[0] or height < DOOR_M[1]:
            return [fixed]
        leaf = np.array([int(m[1]) if (m := LEAF.match(str(g))) else 0 for g in group])
        leaf[leaf > len(sashes)] = 0
        leaves = []
        for k, sash in enumerate(sashes, 1):
            faces = np.flatnonzero(leaf == k)
            flat = part_of(door.surface, faces) if len(faces) else _plain_leaf(e, sash, door.surface)
            flat = _beside(flat, _axis(e, sash)[0], [_axis(e, s)[0] for s in sashes if s is not sash])
            pin, hulls = _hinge(e, sash, flat.vertices), door.collision if len(sashes) == 1 else None
            about = flat, hulls, False, None, None, False, "door", pin
            leaves.append(HomePart(f"{door.name} leaf {k}", door.pose, *about))
        if not leaf.any():
            self.source.note(f"{called(e)}: its model has no leaf of its own; flat leaves take its place")
            return leaves
        frame = np.flatnonzero(leaf == 0)
        rest = dataclasses.replace(fixed, surface=part_of(door.surface, frame)) if len(frame) else None
        return leaves if rest is None else [rest, *leaves]


def _lamp(e: ElementTree.Element, source: ElementTree.Element, pose: np.ndarray) -> Lamp:
    """Return one source of light of a piece whose local frame (z up, front along -y) has a pose (4, 4)."""
    x, y, z = (number(source, key) - shift for key, shift in (("x", 0.5), ("y", 0.5), ("z", 0.0)))
    side = -1.0 if e.get("modelMirrored") == "true" else 1.0
    local = metres(e, "width", "depth", "height") * [side * x, y, z]
    shade = colour(source.get("color"), WHITE).ravel() / 255
    return Lamp(pose[:3, :3] @ local + pose[:3, 3], shade * float(np.clip(number(e, "power", 0.5), 0.0, 1.0)))


def _footprint(e: ElementTree.Element) -> Any:
    corners = np.array([(-1, -1), (1, -1), (1, 1), (-1, 1)]) * metres(e, "width", "depth") / 2
    return shapely.Polygon(point(e) + corners @ yaw_matrix(-number(e, "angle", 0.0))[:2, :2].T)


def _axis(e: ElementTree.Element, sash: ElementTree.Element) -> tuple[np.ndarray, np.ndarray, float]:
    """Return a leaf's (2,) hinge in the door's frame, its start and end angles (-90 degrees: front), its width (m)."""
    width, depth = metres(e, "width", "depth")
    side = -1.0 if e.get("modelMirrored") == "true" else 1.0
    at = np.array([side * (number(sash, "xAxis") - 0.5) * width, (0.5 - number(sash, "yAxis")) * depth])
    angles = np.array([number(sash, key, 0.0) for key in ("startAngle", "endAngle")])
    return at, angles if side > 0 else math.pi - angles, number(sash, "width") * float(width)


def _beside(leaf: TexturedMesh, hinge: np.ndarray, others: list[np.ndarray]) -> TexturedMesh:
    """Return a leaf that ends short of the middle between two hinges: the rebates of double doors overlap."""
    gaps = [other - hinge for other in others]
    gap = min(gaps, key=lambda g: float(g @ g), default=np.zeros(2))
    length = float(np.linalg.norm(gap))
    if length < 2 * REBATE_M:
        return leaf
    along = np.array([*gap / length, 0.0])
    beyond = np.maximum((leaf.vertices - [*hinge, 0.0]) @ along - (length / 2 - REBATE_M), 0.0)
    return dataclasses.replace(leaf, vertices=leaf.vertices - np.outer(beyond, along))


def _hinge(e: ElementTree.Element, sash: ElementTree.Element, leaf: np.ndarray) -> ScannedHinge:
    """Return the hinge of a leaf; 0 is where it is drawn."""
    at, angles, _ = _axis(e, sash)
    middle = (leaf.min(axis=0) + leaf.max(axis=0))[:2] / 2 - at
    drawn = math.atan2(middle[1], middle[0])
    gaps = [abs(math.remainder(a - drawn, math.tau)) for a in angles]
    at_rest = drawn if min(gaps) > AJAR_RAD else angles[int(np.argmin(gaps))]
    turns = np.clip([math.remainder(a - at_rest, math.tau) for a in angles], -TURN_MOST_RAD, TURN_MOST_RAD)
    return ScannedHinge(np.array([*at, leaf[:, 2].min()]), UP, (float(turns.min()), float(turns.max())))


def _plain_leaf(e: ElementTree.Element, sash: ElementTree.Element, like: TexturedMesh) -> TexturedMesh:
    """Return a flat leaf as wide as the sash, shut, in the model's mean colour."""
    at, angles, width = _axis(e, sash)
    along = np.array([math.cos(angles[0]), math.sin(angles[0])])
    across = along[::-1] * [-LEAF_M / 2, LEAF_M / 2]
    foot = np.array([at + across, at - across, at + along * width - across, at + along * width + across])
    high = float(like.vertices[:, 2].max())
    vertices = np.vstack([np.column_stack([foot, np.full(4, z)]) for z in (0.0, high)])
    box = convex_hull(vertices)
    colour = colours_of_faces(like).mean(axis=0).astype(np.uint8).reshape(1, 1, 3)
    return TexturedMesh(box.vertices, box.faces, np.full((len(box.faces), 3, 2), 0.5), np.tile(colour, (4, 4, 1)))
