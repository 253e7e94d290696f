"""Models of a Sweet Home 3D drawing in; a piece of furniture's surface out: turned, sized, mirrored, coloured as drawn.

Models are y up, front along +z. A piece's own frame is z up, front along -y, the middle of its base at the origin.
"""

import dataclasses
import re
import xml.etree.ElementTree as ElementTree
from pathlib import Path

import numpy as np
import trimesh

from converters.geometry.faces import compacted
from converters.read.files import SourceFolder, read_image, read_obj
from converters.read.homes.sh3d_archive import called, colour, metres, model_path, number
from converters.read.homes.sh3d_sheet import WHITE, Look
from converters.read.meshes import read_surface
from converters.read.obj import GREY, TexturedMesh, join_textures, read_painted_obj
from converters.read.urdf import placed
from converters.records.errors import SceneRejected
from converters.records.limits import EXTENT_M, GEOMS, check_count
from interactive_nav_common.records import read_packaged
from interactive_nav_common.rotations import Y_UP_TO_Z_UP, transform, yaw_matrix

BUILT_IN = read_packaged(Path(__file__).with_suffix(".yaml"), dict[str, str])
"""Colours of the materials that models name without a file: those of the first OBJ viewers, diffuse."""
PANE = "sweethome3d_window_pane"
"""Groups that begin so are glass: a piece's one colour leaves them."""
GLASS = np.array([176, 200, 214], np.uint8).reshape(1, 1, 3)
LEAF = re.compile(r"sweethome3d_(?:opening|window_pane)_on_hinge_(\d{1,2})")
HULLS = "hulls.obj"
"""Beside a model in its folder: convex pieces to collide with, each a group with vertices of its own."""
APART = 1e-4
MOST_FACES = 2_000_000
"""Of all pieces together."""


@dataclasses.dataclass(frozen=True)
class Model:
    """A model as its file has it, y up."""

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


class Models:
    """Reads models and images, each once."""

    def __init__(self, source: SourceFolder, budget: list[int]) -> None:
        """Of the unpacked drawing `source`; `budget` bounds what archives within it may take."""
        self.source, self.budget = source, budget
        self.known: dict[str, Model | None] = {}
        self.images: dict[str, np.ndarray | None] = {}
        self.faces = 0

    def model(self, element: ElementTree.Element) -> Model | None:
        """The model of a piece; None and a word where it cannot be read."""
        name = element.get("model") or ""
        if name not in self.known:
            self.known[name] = None
            try:
                path = model_path(self.source.root, name, self.budget)
                if path is None:
                    raise SceneRejected("is not in the file")
                self.known[name] = self._read(path)
            except SceneRejected as error:
                reason = str(error).replace(f"{self.source.root}/", "")
                self.source.repaired(f"{called(element)}: its model {name[:60]!r} {reason}; a box stands for it")
        found = self.known[name]
        self.faces += 12 if found is None else len(found.faces)
        check_count(self.source.root, self.faces, MOST_FACES, "faces in its furniture", "leave the finest models out")
        return found

    def _read(self, path: str) -> Model:
        ending = Path(path).suffix.lower()
        if ending in (".3ds", ".kmz", ".lwo", ".lws"):
            raise SceneRejected(f"is in the format {ending}, expected OBJ or COLLADA")
        if ending == ".dae":
            mesh = read_surface(self.source, path, "")
            uv = np.zeros((len(mesh.faces), 3, 2)) if mesh.corner_uv is None else mesh.corner_uv
            image = WHITE if mesh.texture is None else mesh.texture
            none = np.zeros(len(mesh.faces), np.int64)
            back = mesh.vertices @ Y_UP_TO_Z_UP
            return Model(back, mesh.faces, uv, none, [image], ("",), np.full(len(none), ""))
        mesh, number, images = read_painted_obj(
            self.source, path, "", lambda n: colour(f"ff{BUILT_IN.get(re.sub(r'[.][0-9]+$', '', n), '')}", GREYS)
        )
        check_count(path, len(mesh.faces), GEOMS, "faces", "simplify the model")
        assert mesh.corner_uv is not None
        names, groups = (*mesh.materials, "", "")[: len(images)], np.array((*mesh.groups, ""))
        return Model(mesh.vertices, mesh.faces, mesh.corner_uv, number, images, names, groups[mesh.group])

    def look(self, element: ElementTree.Element, colour_key: str, texture: str, default: np.ndarray = WHITE) -> Look:
        """Colour of an element, or its texture: the child `<texture attribute=...>`."""
        plain = colour(element.get(colour_key), default)
        for child in element.findall("texture"):
            name = child.get("image") or ""
            if child.get("attribute", "texture") != texture:
                continue
            if name not in self.images:
                path, self.images[name] = model_path(self.source.root, name, self.budget), None
                try:
                    if path is None:
                        raise SceneRejected("is not in the file")
                    self.images[name] = read_image(self.source.use(path, ""), "RGB")
                except SceneRejected as error:
                    reason = str(error).replace(f"{self.source.root}/", "")
                    self.source.repaired(
                        f"{called(element)}: its texture {name[:60]!r} {reason}; a plain colour is taken"
                    )
            size = metres(child, "width", "height") * number(child, "scale", 1.0)
            if (image := self.images[name]) is not None and (size > 1e-3).all():
                return image, size
        return plain, None

    def surface(self, element: ElementTree.Element) -> tuple[TexturedMesh, np.ndarray]:
        """A piece's surface in its own frame, and the (m,) group of each face."""
        size = metres(element, "width", "height", "depth")
        if not (size >= 0).all() or not 0 < size.max() < EXTENT_M:
            raise SceneRejected(f"{called(element)}: is {100 * size} cm large; mend the drawing")
        size = np.maximum(size, 1e-3)
        model = self.model(element)
        if model is None:
            box = trimesh.creation.box(size)
            none = np.zeros(len(box.faces), np.int64)
            vertices, faces, group = np.asarray(box.vertices), np.asarray(box.faces, np.int64), np.full(len(none), "")
            uv, numbers, images = np.zeros((len(faces), 3, 2)), none, [colour(element.get("color"), GREYS)]
        else:
            vertices, faces = self._deformed(element, model)
            (vertices, faces), group = compacted(vertices, faces), model.group
            vertices = vertices @ _rotation(element).T
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
        tilt = trimesh.transformations.rotation_matrix(-pitch if pitch else -roll, [1, 0, 0] if pitch else [0, 0, 1])
        tilt[:3, :3] = Y_UP_TO_Z_UP @ tilt[:3, :3]
        mesh = placed(mesh, tilt)
        return dataclasses.replace(mesh, vertices=mesh.vertices - [0, 0, mesh.vertices[:, 2].min()]), group

    def solid(self, element: ElementTree.Element, surface: TexturedMesh) -> TexturedMesh | None:
        """The hulls that a drawing of ours brings beside a piece's model, in the piece's frame; None without them."""
        model, folder = self.model(element), (element.get("model") or "").rpartition("/")[0]
        path = model_path(self.source.root, f"{folder}/{HULLS}", self.budget) if folder else None
        if model is None or path is None or element.find("transformation") is not None:
            return None
        mesh = read_obj(self.source.use(path, ""))
        check_count(path, len(mesh.faces), GEOMS, "faces", "simplify the hulls")
        # Sizes, turns and mirrors of the model are the hulls' as well.
        own = np.column_stack([model.vertices[np.unique(model.faces)], np.ones(len(surface.vertices))])
        placing = np.linalg.lstsq(own, surface.vertices, rcond=None)[0]
        # Hulls that touch stay apart: each is drawn in by as little as that.
        vertices = np.column_stack([mesh.vertices, np.ones(len(mesh.vertices))]) @ placing
        for k in np.unique(mesh.group):
            of = np.unique(mesh.faces[mesh.group == k])
            vertices[of] += APART * (vertices[of].mean(axis=0) - vertices[of])
        return TexturedMesh(vertices, mesh.faces, None, None)

    def _deformed(self, element: ElementTree.Element, model: Model) -> tuple[np.ndarray, np.ndarray]:
        """Vertices and faces of a model whose parts are opened, turned or slid as drawn."""
        vertices, faces = model.vertices, model.faces
        for child in element.findall("transformation"):
            name = (child.get("name") or "?")[:60]
            matrix = _numbers(element, "transformation", child.get("matrix") or "")
            if len(matrix) != 12 or not np.linalg.det(matrix.reshape(3, 4)[:, :3]) > 0:
                raise SceneRejected(f"{called(element)}: transformation is no matrix; mend the drawing")
            word = re.compile(rf"({re.escape(name)}|.*_on_{re.escape(name.removeprefix('sweethome3d_'))})(?!\d)")
            own = np.flatnonzero([word.match(str(g)) is not None for g in model.group])
            if not len(own):
                self.source.note(f"{called(element)}: its model has no part {name!r}; it stays as modelled")
            moved = vertices[faces[own]].reshape(-1, 3) @ matrix.reshape(3, 4)[:, :3].T + matrix.reshape(3, 4)[:, 3]
            faces = faces.copy()
            faces[own] = len(vertices) + np.arange(len(moved)).reshape(-1, 3)
            vertices = np.vstack([vertices, moved])
        return vertices, faces

    def _painted(self, element: ElementTree.Element, model: Model) -> tuple[np.ndarray, np.ndarray, list[np.ndarray]]:
        """Texture coordinates, image numbers and images of a model, in the piece's own colours."""
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
                own = np.flatnonzero(numbers == k)
                if size is not None and len(own) and not np.ptp(uv[own], axis=(0, 1)).any():
                    uv = uv.copy()
                    uv[own] = _by_place(model, element, own, size)
        numbers[pane] = len(images)
        return uv, numbers, [*images, GLASS]


GREYS = np.array(GREY, np.uint8).reshape(1, 1, 3)


def _by_place(model: Model, element: ElementTree.Element, faces: np.ndarray, size: np.ndarray) -> np.ndarray:
    """(k, 3, 2) of faces without coordinates of their own: by place across the face's main axis."""
    span = np.maximum(np.ptp(model.vertices, axis=0), 1e-9)
    corners = model.vertices[model.faces[faces]] / span * metres(element, "width", "height", "depth")
    normal = np.abs(np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])).argmax(axis=1)
    pair = np.array([(2, 1), (0, 2), (0, 1)])[normal]
    return np.take_along_axis(corners, pair[:, None, :].repeat(3, axis=1), axis=2) / size


def _rotation(element: ElementTree.Element) -> np.ndarray:
    """(3, 3) that turns the model's own axes upright; the identity where it is not given."""
    turn = _numbers(element, "modelRotation", element.get("modelRotation") or "1 0 0 0 1 0 0 0 1")
    turn = turn.reshape(3, 3) if len(turn) == 9 else np.zeros((3, 3))
    if not np.allclose(turn @ turn.T, np.eye(3), atol=1e-2):
        raise SceneRejected(f"{called(element)}: modelRotation is no rotation; mend the drawing")
    return turn


def _numbers(element: ElementTree.Element, what: str, text: str) -> np.ndarray:
    """(n,) numbers of a list."""
    name = element.get("name") or element.get("id") or "?"
    return np.array(
        [number(ElementTree.Element(element.tag, {"name": name, what: word}), what) for word in text.split()]
    )


def yaw_pose(at: np.ndarray, yaw: float) -> np.ndarray:
    """Return the (4, 4) of an upright piece at (3,) m, turned by `yaw` rad."""
    return transform(yaw_matrix(yaw), at)
