"""Models of a Sweet Home 3D drawing in; a piece of furniture's surface out: turned, sized, mirrored, coloured as drawn.

Models are y up, front along +z. A piece's own frame is z up, front along -y, the middle of its base at the origin.
"""

from __future__ import annotations

import dataclasses
import math
import re
import xml.etree.ElementTree as ElementTree
from pathlib import Path

import numpy as np
import trimesh

from converters.geometry.rotations import Y_UP_TO_Z_UP
from converters.read.files import SourceFolder, read_image, read_obj
from converters.read.homes.sh3d_archive import called, colour, metres, model_path, number
from converters.read.homes.sh3d_sheet import WHITE, Look
from converters.read.meshes import read_surface
from converters.read.obj import GREY, TexturedMesh, join_textures, read_materials
from converters.read.urdf import placed
from converters.records.errors import SceneRejected
from converters.records.limits import EXTENT_M, GEOMS, check_count

_NAMED = """
amber:934400 amber_trans:934400 charcoal:010101 lavendar:381758 navy_blue:00000e pale_green:12610c
pale_pink:a7346a pale_yellow:b09e33 peach:a22f04 periwinkle:000ad3 redwood:420800 smoked_glass:010101
aqua_filter:5fab94 yellow_green:306800 bluetint:0cb5f4 plasma:ff1472 emerald:0cff00 ruby:ff0000 sapphire:0600ff
white:ffffff red:c50000 blue_pure:0000ff lime:00ff00 green:004000 yellow:ffaa00 purple:8000ff orange:ff2b00
grey:2f2f2f rubber:030303 flaqua:008080 flblack:010101 flblue_pure:0000b5 flgrey:808080 fllime:00ff00
florange:ff2b00 flpurple:6000c0 flred:ff0000 flyellow:ffaa00 pink:fc2bab flbrown:1c0300 brown:160400
glass:7c7d87 flesh:866956 aqua:008080 black:010101 silver:9d9d9d dkblue_pure:000022 fldkblue_pure:000022
dkgreen:010600 dkgrey:0c0c0c ltbrown:471d0e fldkgreen:010600 flltbrown:471d0e tan:a98538 fltan:a97421
brzskin:614a36 lips:ec434a redorange:c10500 blutan:144234 bluteal:144234 pinktan:af4237 brnhair:170803
blondhair:92540b flblonde:92540b yelloworng:e23f00 bone:e6c26d teeth:fbcb78 brass:7a3200 dkred:3a0000
taupe:341f1b dkteal:00110b dkdkgrey:030303 dkblue:00010f gold:ff7d00 redbrick:540a02 flmustard:e35a02
flpinegreen:1b3716 fldkred:3a0202 fldkgreen2:061201 flmintgreen:214a2b olivegreen:060900 skin:1c0804
redbrown:480200 deepgreen:000501 flltolivegreen:0a0e03 jetflame:f37e19 brownskn:050200 greenskn:001300
ltgrey:626262 bronze:110903 bone1:fbcb78 flwhite1:ffffff flwhite:fbedd6 shadow:090605 fldkolivegreen:040501
fldkdkgrey:030303 lcdgreen:96ff81 brownlips:24110a muscle:6b1216 flltgrey:d2d2d2 offwhite.warm:d5b072
offwhite.cool:d5ae91 yellowbrt:ffc800 chappie:952e09 archwhite:fefefe archwhite2:d6d6d6 lighttan:b36b38
lighttan2:503019 lighttan3:2e1504 lightyellow:fff356 lighttannew:c99b52 default:b5b3a7 ship2:ffffff
dkpurple:06000c dkorange:b60900 mintgrn:067a15 fgreen:000b00 glassblutint:8eccc5 bflesh:060201 meh:8eccc5
violet:070722 iris:000f51 blugrn:15a347 glasstransparent:787878 fleshtransparent:b04b21 fldkgrey:181818
sky_blue:2097cc fldkpurple:290055 dkbrown:020100 bone2:fbdca6 bluegrey:30474a metal:e6c26d sand_stone:201d19
hair:000000
"""
BUILT_IN = {name: code for name, _, code in (word.partition(":") for word in _NAMED.split())}
"""Colours of the materials that models name without a file: those of the first OBJ viewers, diffuse."""
PANE = "sweethome3d_window_pane"
"""Groups that begin so are glass: a piece's one colour leaves them."""
GLASS = np.array([176, 200, 214], np.uint8).reshape(1, 1, 3)
LEAF = re.compile(r"sweethome3d_(?:opening|window_pane)_on_hinge_(\d{1,2})")
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
        file = self.source.use(path, "")
        mesh = read_obj(file)
        check_count(path, len(mesh.faces), GEOMS, "faces", "simplify the model")
        own = read_materials(self.source, file, mesh.libraries) if mesh.libraries else {}
        names = (*mesh.materials, "")
        built = {n: colour(f"ff{BUILT_IN.get(re.sub(r'[.][0-9]+$', '', n), '')}", GREYS) for n in names}
        images = [own.get(n, built[n]) for n in names]
        number = np.where(mesh.material < 0, len(mesh.materials), mesh.material)
        uv = np.zeros((len(mesh.faces), 3, 2)) if mesh.corner_uv is None else mesh.corner_uv
        return Model(mesh.vertices, mesh.faces, uv, number, images, names, np.array((*mesh.groups, ""))[mesh.group])

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
        """A piece's surface in its own frame, and the (m,) group of each face.

        Raises:
            SceneRejected: no usable size or turn.
        """
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
            used, faces = np.unique(faces, return_inverse=True)
            faces, group = faces.reshape(-1, 3), model.group
            vertices = vertices[used] @ _rotation(element).T
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
                mesh,
                faces=np.vstack([mesh.faces, mesh.faces[:, ::-1]]),
                corner_uv=np.vstack([twice, twice[:, ::-1]]),
            )
            group = np.tile(group, 2)
        pitch, roll = number(element, "pitch", 0.0), number(element, "roll", 0.0)
        tilt = trimesh.transformations.rotation_matrix(-pitch if pitch else -roll, [1, 0, 0] if pitch else [0, 0, 1])
        tilt[:3, :3] = Y_UP_TO_Z_UP @ tilt[:3, :3]
        mesh = placed(mesh, tilt)
        return dataclasses.replace(mesh, vertices=mesh.vertices - [0, 0, mesh.vertices[:, 2].min()]), group

    def _deformed(self, element: ElementTree.Element, model: Model) -> tuple[np.ndarray, np.ndarray]:
        """Vertices and faces of a model whose parts are opened, turned or slid as drawn.

        Raises:
            SceneRejected: a matrix that is none.
        """
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
    """(3, 3) that turns the model's own axes upright; the identity where it is not given.

    Raises:
        SceneRejected: no rotation.
    """
    turn = _numbers(element, "modelRotation", element.get("modelRotation") or "1 0 0 0 1 0 0 0 1")
    turn = turn.reshape(3, 3) if len(turn) == 9 else np.zeros((3, 3))
    if not np.allclose(turn @ turn.T, np.eye(3), atol=1e-2):
        raise SceneRejected(f"{called(element)}: modelRotation is no rotation; mend the drawing")
    return turn


def _numbers(element: ElementTree.Element, what: str, text: str) -> np.ndarray:
    """(n,) numbers of a list.

    Raises:
        SceneRejected: one that is none.
    """
    name = element.get("name") or element.get("id") or "?"
    return np.array(
        [number(ElementTree.Element(element.tag, {"name": name, what: word}), what) for word in text.split()]
    )


def yaw_pose(at: np.ndarray, yaw: float) -> np.ndarray:
    """(4, 4) of an upright piece at (3,) m, turned by `yaw` rad."""
    pose = np.eye(4)
    pose[:2, :2] = [[math.cos(yaw), -math.sin(yaw)], [math.sin(yaw), math.cos(yaw)]]
    pose[:3, 3] = at
    return pose
