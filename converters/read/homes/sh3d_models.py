"""Read the models of a Sweet Home 3D drawing: turned, sized, mirrored and coloured as drawn.

Models are y up, front along +z. A piece's local frame is z up, front along -y, the middle of its base at the origin.
"""

import dataclasses
import math
import re
import xml.etree.ElementTree as ElementTree
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import numpy as np
import shapely
import trimesh
from trimesh.registration import procrustes

from converters.geometry.boxes import convex_hull
from converters.geometry.faces import compacted, triangulated
from converters.read.files import SourceFolder, read_image, read_obj
from converters.read.homes.parts import HomePart
from converters.read.homes.sh3d_archive import called, colour, metres, model_path, number, parsed
from converters.read.meshes import read_surface
from converters.read.obj import GREYS, TexturedMesh, join_textures, read_painted_obj
from converters.read.urdf import joined, placed, solid
from converters.records.errors import EXTENT_M, GEOMS, SceneRejected, check_count
from converters.records.raw import ScannedHinge
from interactive_nav_common.records import read_packaged
from interactive_nav_common.rotations import Y_UP_TO_Z_UP, transform, transformed
from scenes_mjcf.look import GLASS

WHITE = np.array([235, 235, 230], np.uint8).reshape(1, 1, 3)
"""Of sides and rooms that have no colour."""
MOST_TILES = 400
"""Copies of a texture on one side or room; more become its mean colour."""

Look = tuple[np.ndarray, np.ndarray | None]
"""Image (h, w, 3), and size (2,) of one copy of it, m; None: a plain colour."""
BUILT_IN = read_packaged(Path(__file__).with_suffix(".yaml"), dict[str, str])
"""Colours of the materials that models name without a file: those of the first OBJ viewers, diffuse."""
PANE = "sweethome3d_window_pane"
"""Groups that begin so are glass: a piece's one colour leaves them."""
PANES = np.array(GLASS, np.uint8).reshape(1, 1, 3)
LEAF = re.compile(r"sweethome3d_(?:opening|window_pane)_on_hinge_(\d{1,2})")
OPENS = re.compile(r"sweethome3d_[a-z_]+_on_((?:hinge|rail)_\d{1,2})(?!\d)")
"""Groups that open on the one that is called so, or on `sweethome3d_unique_rail`."""
HULLS = "hulls.obj"
"""Beside a model in its folder: convex pieces to collide with, each a group that shares no vertex."""
APART = 1e-4
MOST_FACES = 2_000_000
"""Of all pieces together."""


@dataclasses.dataclass(frozen=True)
class DrawnModel:
    """Hold a model as its file has it, y up."""

    vertices: np.ndarray
    faces: np.ndarray
    corner_uv: np.ndarray
    number: np.ndarray
    """(m,) image of each face."""
    images: list[np.ndarray]
    materials: tuple[str, ...]
    """Of each image."""
    group: np.ndarray
    """(m,) name of each face's group."""


class DrawnModels:
    """Read models and images, each once."""

    def __init__(self, source: SourceFolder, budget: list[int]) -> None:
        """Read from the unpacked drawing `source`; `budget` bounds what archives within it may take."""
        self.source, self.budget = source, budget
        self.models: dict[str, DrawnModel | None] = {}
        self.images: dict[str, np.ndarray | None] = {}
        self.faces = 0

    def model(self, element: ElementTree.Element) -> DrawnModel | None:
        """Return the model of a piece; None and a report where it cannot be read."""
        name = element.get("model") or ""
        if name not in self.models:
            self.models[name] = self._attempt(element, "model", name, self._read, "a box stands for it")
        model = self.models[name]
        self.faces += 12 if model is None else len(model.faces)
        check_count(self.source.root, self.faces, MOST_FACES, "faces in its furniture", "leave the finest models out")
        return model

    def _attempt(
        self, element: ElementTree.Element, kind: str, name: str, read: Callable[[str], Any], instead: str
    ) -> Any:
        """Read a file that an element names; return None and report it where that fails."""
        try:
            path = model_path(self.source.root, name, self.budget)
            if path is None:
                raise SceneRejected("is not in the file")
            return read(path)
        except SceneRejected as error:
            reason = str(error).replace(f"{self.source.root}/", "")
            self.source.repaired(f"{called(element)}: its {kind} {name[:60]!r} {reason}; {instead}")

    def _read(self, path: str) -> DrawnModel:
        ending = Path(path).suffix.lower()
        if ending in (".3ds", ".kmz", ".lwo", ".lws"):
            raise SceneRejected(f"is in the format {ending}, expected OBJ or COLLADA")
        if ending == ".dae":
            mesh = read_surface(self.source, path, "")
            uv = np.zeros((len(mesh.faces), 3, 2)) if mesh.corner_uv is None else mesh.corner_uv
            image = WHITE if mesh.texture is None else mesh.texture
            none = np.zeros(len(mesh.faces), np.int64)
            back = mesh.vertices @ Y_UP_TO_Z_UP
            return DrawnModel(back, mesh.faces, uv, none, [image], ("",), np.full(len(none), ""))
        mesh, number, images = read_painted_obj(
            self.source, path, "", lambda n: colour(f"ff{BUILT_IN.get(re.sub(r'[.][0-9]+$', '', n), '')}", GREYS)
        )
        check_count(path, len(mesh.faces), GEOMS, "faces", "simplify the model")
        assert mesh.corner_uv is not None
        names, groups = (*mesh.materials, "", "")[: len(images)], np.array((*mesh.groups, ""))
        return DrawnModel(mesh.vertices, mesh.faces, mesh.corner_uv, number, images, names, groups[mesh.group])

    def _image(self, path: str) -> np.ndarray:
        return read_image(self.source.use(path, ""), "RGB")

    def look(self, element: ElementTree.Element, colour_key: str, texture: str, default: np.ndarray = WHITE) -> Look:
        """Return the colour of an element, or its texture: the child `<texture attribute=...>`."""
        plain = colour(element.get(colour_key), default)
        for child in element.findall("texture"):
            name = child.get("image") or ""
            if child.get("attribute", "texture") != texture:
                continue
            if name not in self.images:
                self.images[name] = self._attempt(element, "texture", name, self._image, "a plain colour is taken")
            size = metres(child, "width", "height") * number(child, "scale", 1.0)
            if (image := self.images[name]) is not None and (size > 1e-3).all():
                return image, size
        return plain, None

    def surface(self, element: ElementTree.Element) -> tuple[TexturedMesh, np.ndarray]:
        """Return a piece's surface in its local frame, and the (m,) group of each face."""
        size = metres(element, "width", "height", "depth")
        if not (size >= 0).all() or not 0 < size.max() < EXTENT_M:
            raise SceneRejected(f"{called(element)}: is {100 * size} cm large; mend the drawing")
        size = np.maximum(size, 1e-3)
        model = self.model(element)
        if model is None:
            box = solid("box", size)
            vertices, faces, group = box.vertices, box.faces, np.full(len(box.faces), "")
            uv, numbers = np.zeros((len(faces), 3, 2)), np.zeros(len(faces), np.int64)
            images = [colour(element.get("color"), GREYS)]
        else:
            vertices, faces = self._deformed(element, model)
            (vertices, faces), group = compacted(vertices, faces), model.group
            words = (element.get("modelRotation") or "1 0 0 0 1 0 0 0 1").split()
            turn = np.array([parsed(element, "modelRotation", word) for word in words])
            turn = turn.reshape(3, 3) if len(turn) == 9 else np.zeros((3, 3))
            if not np.allclose(turn @ turn.T, np.eye(3), atol=1e-2):
                raise SceneRejected(f"{called(element)}: modelRotation is no rotation; mend the drawing")
            vertices = vertices @ turn.T
            uv, numbers, images = self._painted(element, model)
        low, span = vertices.min(axis=0), np.ptp(vertices, axis=0)
        scale = np.where(span > 1e-9, size / np.maximum(span, 1e-12), 1.0)
        vertices = (vertices - low - span / 2) * scale
        mesh = TexturedMesh(vertices, faces, *join_textures(uv, numbers, images))
        if element.get("modelMirrored") == "true":
            mesh = placed(mesh, np.diag([-1.0, 1.0, 1.0, 1.0]))
        if element.get("backFaceShown") == "true":
            twice = mesh.corner_uv
            assert twice is not None
            mesh = dataclasses.replace(
                mesh, faces=np.vstack([mesh.faces, mesh.faces[:, ::-1]]), corner_uv=np.vstack([twice, twice[:, ::-1]])
            )
            group = np.tile(group, 2)
        pitch, roll = number(element, "pitch", 0.0), number(element, "roll", 0.0)
        axis = [1, 0, 0] if pitch else [0, 0, 1]
        tilt = np.asarray(trimesh.transformations.rotation_matrix(-pitch if pitch else -roll, axis))
        tilt[:3, :3] = Y_UP_TO_Z_UP @ tilt[:3, :3]
        mesh = placed(mesh, tilt)
        return dataclasses.replace(mesh, vertices=mesh.vertices - [0, 0, mesh.vertices[:, 2].min()]), group

    def solid(self, element: ElementTree.Element, surface: TexturedMesh) -> TexturedMesh | None:
        """Return the hulls beside a piece's model in a drawing of ours, in the piece's frame; None without any."""
        model, folder = self.model(element), (element.get("model") or "").rpartition("/")[0]
        path = model_path(self.source.root, f"{folder}/{HULLS}", self.budget) if folder else None
        if model is None or path is None or element.find("transformation") is not None:
            return None
        mesh = read_obj(self.source.use(path, ""))
        check_count(path, len(mesh.faces), GEOMS, "faces", "simplify the hulls")
        # Sizes, turns and mirrors of the model are the hulls' as well.
        points = np.column_stack([model.vertices[np.unique(model.faces)], np.ones(len(surface.vertices))])
        placing = np.linalg.lstsq(points, surface.vertices, rcond=None)[0]
        # Hulls that touch stay apart: each is drawn in by as little as that.
        vertices = np.column_stack([mesh.vertices, np.ones(len(mesh.vertices))]) @ placing
        for k in np.unique(mesh.group):
            of = np.unique(mesh.faces[mesh.group == k])
            vertices[of] += APART * (vertices[of].mean(axis=0) - vertices[of])
        return TexturedMesh(vertices, mesh.faces, None, None)

    def fronts(
        self, e: ElementTree.Element, mesh: TexturedMesh, group: np.ndarray
    ) -> Iterator[tuple[np.ndarray, HomePart]]:
        """Yield what opens of a piece: its faces, and the part in the piece's frame, its joint 0 as drawn."""
        words = np.array([m[1] if (m := OPENS.match(str(g))) else "" for g in group])
        model = self.models.get(e.get("model") or "")
        if model is None or not words.any():
            return
        body = np.flatnonzero(~np.char.startswith(model.group.astype(str), "sweethome3d_"))
        flat = np.column_stack([model.vertices[model.faces[body]].mean(axis=1), np.ones(len(body))])
        there = mesh.vertices[mesh.faces[body]].mean(axis=1)
        placing, _, rank, _ = np.linalg.lstsq(flat, there, rcond=None)
        place = transform(placing[:3].T, placing[3])
        for word in sorted({*words.tolist()} - {""}) if rank == 4 else ():
            pin = re.compile(rf"sweethome3d_(?:{word}(?!\d)|unique_{word.partition('_')[0]})")
            pins, faces = [pin.match(str(g)) is not None for g in model.group], np.flatnonzero(words == word)
            if not any(pins):
                continue
            on, once = model.vertices[model.faces[pins]].reshape(-1, 3), faces[faces < len(model.faces)]
            part = model.vertices[model.faces[once]].reshape(-1, 3)
            low, high, first, last = (side(of, axis=0) for of in (on, part) for side in (np.min, np.max))
            k, slides, most = int(np.argmax(high - low)), word.startswith("rail"), math.pi / 2
            joint = ScannedHinge((low + high) / 2, np.eye(3)[k], (0.0, most), slides=slides)
            # It opens away from the body's middle, a drawer to the front, what is shorter than its rail along it.
            shut, at = joint.moved(place), transformed((first + last)[None] / 2, place)[0]
            out = at - (there.min(axis=0) + there.max(axis=0)) / 2
            way = float(np.cross(shut.axis, at - shut.origin) @ out)
            if slides:
                ahead, behind, most = (high - last)[k], (first - low)[k], (high - low)[k]
                along = (last - first)[k] < 0.9 * most
                way, most = (ahead - behind, max(ahead, behind)) if along else (shut.axis @ (out - [0, 10, 0]), most)
            # How somebody has opened it, by its corners in the model's frame.
            corners = mesh.vertices[mesh.faces[once]][:, :: int(np.sign(np.linalg.det(place)))].reshape(-1, 3)
            corners = transformed(corners, np.linalg.inv(place))
            drawn = np.asarray(procrustes(part, corners, reflection=False, scale=False, return_cost=False))
            value = joint.value(drawn)
            if (value if abs(value) > 1e-3 else way) < 0:
                joint, value = dataclasses.replace(joint, axis=-joint.axis), -value
            hinge = dataclasses.replace(joint, range_rad=(0.0 - value, float(max(value, most) - value))).moved(place)
            # What is stretched along one axis shears as it turns in the drawing: it turns as a rigid body instead.
            rigid = joint.moved(place).motion(-hinge.range_rad[0]) @ place @ np.linalg.inv(place @ drawn)
            groups = [mesh.vertices[mesh.faces[faces[group[faces] == g]]] for g in np.unique(group[faces])]
            hulls = [convex_hull(transformed(points.reshape(-1, 3), rigid)) for points in groups]  # exact: doors touch
            collision = joined([TexturedMesh(hull.vertices, hull.faces, None, None) for hull in hulls])
            shown = placed(part_of(mesh, faces), rigid)
            yield faces, HomePart(word, np.eye(4), shown, collision, True, hinge=hinge)

    def _deformed(self, element: ElementTree.Element, model: DrawnModel) -> tuple[np.ndarray, np.ndarray]:
        """Return the vertices and faces of a model whose parts are opened, turned or slid as drawn."""
        vertices, faces = model.vertices, model.faces
        for child in element.findall("transformation"):
            name = (child.get("name") or "?")[:60]
            words = (child.get("matrix") or "").split()
            matrix = np.array([parsed(element, "transformation", word) for word in words])
            if len(matrix) != 12 or not np.linalg.det(matrix.reshape(3, 4)[:, :3]) > 0:
                raise SceneRejected(f"{called(element)}: transformation is no matrix; mend the drawing")
            word = re.compile(rf"({re.escape(name)}|.*_on_{re.escape(name.removeprefix('sweethome3d_'))})(?!\d)")
            chosen = np.flatnonzero([word.match(str(g)) is not None for g in model.group])
            if not len(chosen):
                self.source.note(f"{called(element)}: its model has no part {name!r}; it stays as modelled")
            moved = vertices[faces[chosen]].reshape(-1, 3) @ matrix.reshape(3, 4)[:, :3].T + matrix.reshape(3, 4)[:, 3]
            faces = faces.copy()
            faces[chosen] = len(vertices) + np.arange(len(moved)).reshape(-1, 3)
            vertices = np.vstack([vertices, moved])
        return vertices, faces

    def _painted(
        self, element: ElementTree.Element, model: DrawnModel
    ) -> tuple[np.ndarray, np.ndarray, list[np.ndarray]]:
        """Return the texture coordinates, image numbers and images of a model in the piece's colours."""
        images, numbers, uv = list(model.images), model.number.copy(), model.corner_uv
        pane = np.char.startswith(model.group.astype(str), PANE)
        whole, size = self.look(element, "color", "texture", GREYS)
        changed: dict[str, Look] = {}
        for child in element.findall("material"):
            if child.get("color") or child.find("texture") is not None:
                changed[child.get("name") or ""] = self.look(child, "color", "texture", GREYS)
        if element.get("color") or size is not None:
            changed = dict.fromkeys(model.materials, (whole, size))
        for k, name in enumerate(model.materials):
            if name in changed:
                images[k], size = changed[name]
                chosen = np.flatnonzero(numbers == k)
                if size is not None and len(chosen) and not np.ptp(uv[chosen], axis=(0, 1)).any():
                    uv = uv.copy()
                    uv[chosen] = _by_place(model, element, chosen, size)
        numbers[pane] = len(images)
        return uv, numbers, [*images, PANES]


def part_of(mesh: TexturedMesh, faces: np.ndarray) -> TexturedMesh:
    """Return some faces of a mesh."""
    uv = None if mesh.corner_uv is None else mesh.corner_uv[faces]
    return TexturedMesh(*compacted(mesh.vertices, mesh.faces[faces]), uv, mesh.texture)


def _by_place(model: DrawnModel, element: ElementTree.Element, faces: np.ndarray, size: np.ndarray) -> np.ndarray:
    """Return (k, 3, 2) of faces without texture coordinates: by place across the face's main axis."""
    span = np.maximum(np.ptp(model.vertices, axis=0), 1e-9)
    corners = model.vertices[model.faces[faces]] / span * metres(element, "width", "height", "depth")
    normal = np.abs(np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])).argmax(axis=1)
    pair = np.array([(2, 1), (0, 2), (0, 1)])[normal]
    return np.take_along_axis(corners, pair[:, None, :].repeat(3, axis=1), axis=2) / size


class Sheet(list[TexturedMesh]):
    """Collect flat patches with their images."""

    def add(self, region: Any, place: Callable[[np.ndarray], np.ndarray], look: Look, turned: bool = False) -> None:
        """Add a flat region with holes; `place` turns its points (n, 2) into (n, 3)."""
        image, size = look
        for tile, low in _tiles(region, size):
            flat = triangulated(tile)[:, :: -1 if turned else 1].reshape(-1, 2)
            uv = 0 * flat if size is None else np.clip((flat - low) / size, 0, 1)
            faces = np.arange(len(flat)).reshape(-1, 3)
            self.append(TexturedMesh(place(flat), faces, uv.reshape(-1, 3, 2), image))

    def quad(self, corners: np.ndarray, look: Look) -> None:
        """Add a plain patch, (4, 3) corners counter-clockwise."""
        faces = np.array([(0, 1, 2), (0, 2, 3)])
        self.append(TexturedMesh(corners, faces, np.zeros((2, 3, 2)), mean_colour(look[0])))

    def part(self, name: str) -> HomePart | None:
        """Return all of it as a built-in part; None of nothing."""
        mesh = joined(self)
        return None if mesh is None else HomePart(name, np.eye(4), mesh, None, True, held=True)


def _tiles(region: Any, size: np.ndarray | None) -> Iterator[tuple[Any, np.ndarray]]:
    """Yield the polygons of a region, cut along the copies of a texture, with the corner of each copy."""
    whole = shapely.get_parts(region)
    boxes = [np.zeros(2)]
    if size is not None and not shapely.is_empty(region):
        x0, y0, x1, y1 = shapely.bounds(region)
        steps = [np.arange(math.floor(a / s), math.ceil(b / s)) for a, b, s in ((x0, x1, size[0]), (y0, y1, size[1]))]
        boxes = [size * [i, j] for i in steps[0] for j in steps[1]]
    for low in boxes:
        box = None if size is None else shapely.box(low[0], low[1], low[0] + size[0], low[1] + size[1])
        for piece in shapely.get_parts(whole if box is None else shapely.intersection(whole, box)):
            if shapely.get_type_id(piece) == 3 and shapely.area(piece) > 1e-8:
                yield piece, low


def fitted(look: Look, area_m2: float) -> Look:
    """Return the look, or its mean colour where it would repeat too often."""
    image, size = look
    return (mean_colour(image), None) if size is None or area_m2 / float(np.prod(size)) > MOST_TILES else look


def mean_colour(image: np.ndarray) -> np.ndarray:
    """Return an image of one pixel."""
    return image.mean(axis=(0, 1)).astype(np.uint8).reshape(1, 1, 3)
