"""Read a textured OBJ and its MTL as a `TexturedMesh` with one image, vertices in the file's order.

File names are matched leniently; a missing texture file is only a warning.
"""

import collections
import dataclasses
import math
import os
import unicodedata
from collections.abc import Callable
from pathlib import Path
from urllib.parse import unquote

import numpy as np
from PIL import Image

from converters.geometry.faces import stacked
from converters.read.files import ObjMesh, SourceFolder, as_number, read_image, read_obj, read_text
from converters.records.errors import PIXELS, SceneRejected
from converters.records.raw import ScanMesh, TexturedMesh

GREY = (170, 170, 170)
"""Colour of what has none."""
GREYS = np.array(GREY, np.uint8).reshape(1, 1, 3)
MAX_TEXTURE_PX = 8192
"""Textures of several materials are joined in an image of at most this width; wider ones are shrunk."""
UNUSED = ("ke", "map_ke", "map_ka", "map_d", "map_tr", "d", "tr")
"""Statements of an MTL that change what viewers show, unless their numbers are 0 (of `d`: 1)."""
UNUSED_OPTIONS = ("-cc", "-clamp", "-imfchan", "-mm", "-o", "-s", "-t")
"""Options of a texture that change what viewers show."""
NUMBERED = {"-mm": (2, None), "-o": (3, 0.0), "-s": (3, 1.0), "-t": (3, 0.0)}
"""Options that take so many numbers or fewer, and the number that changes nothing; others take a word."""
BORDER = 2
"""Texels around each joined image that repeat its edge: smoothed and smaller versions show no neighbour."""
SMALL_IMAGE = 10_000
"""Numbers in an image that is compared with others to be kept once."""


def find_file(source: SourceFolder, folder: Path, name: str) -> Path | None:
    """Return the file that a model names, sought also by its bare name (paths of another machine, letter case)."""
    words = name.strip().strip('"').removeprefix("file://")
    bare = words.replace("\\", "/")
    names = dict.fromkeys(n for n in (bare, unquote(bare)) if n)
    for candidate in names:
        path = folder / candidate
        if _is_there(path) and Path(os.path.abspath(path)).is_relative_to(os.path.abspath(source.root)):
            source.inside(path)
            return path
    wanted = {_folded(n.rsplit("/", 1)[-1]) for n in names}
    for path in sorted(folder.iterdir()):
        if _folded(path.name) in wanted and _is_there(path):
            source.inside(path)
            return path
    return None


def _folded(name: str) -> str:
    """Return a file's name without regard to case and to how accents are composed."""
    return unicodedata.normalize("NFC", name).lower()


def _is_there(path: Path) -> bool:
    """Return True for a file or a link, a broken one too."""
    return os.path.isfile(path) or os.path.islink(path)


def use_named(source: SourceFolder, folder: Path, name: str, by: str) -> Path | None:
    """Return the named file with its hash recorded; a warning where it stands under another name than the given one."""
    path = find_file(source, folder, name)
    if path is None:
        return None
    relative = source.inside(path)
    if source.relative(folder / unquote(name.strip())) != relative:
        source.repaired(f"{by}: names '{name.strip()}', which is not there; {relative} is taken")
    return source.use(relative, "")


def read_materials(source: SourceFolder, obj: Path, libraries: tuple[str, ...]) -> dict[str, np.ndarray]:
    """Return the image (h, w, 3) uint8 of every material of an OBJ's MTL files.

    A material without a usable texture has one pixel of its colour (Kd).
    """
    where = source.relative(obj) or obj.name
    each = [[n] if find_file(source, obj.parent, n) else n.split() for n in libraries]  # a line may name several
    named = [use_named(source, obj.parent, name, where) for names in each for name in names]
    paths = [p for p in named if p is not None]
    if not paths and obj.with_suffix(".mtl").is_file():
        paths = [source.use(source.relative(obj.with_suffix(".mtl")) or "", "")]
    if not paths:
        source.repaired(
            f"{where}: its material file {', '.join(libraries) or '(none named)'} is missing; it stays grey"
        )
    result: dict[str, np.ndarray] = {}
    for path in paths:
        text = read_text(path)
        unused: collections.Counter[str] = collections.Counter()
        for key, *words in (line.split() for line in text.split("\n") if line.lower().lstrip().startswith(UNUSED)):
            unused[key] += key.lower() in UNUSED and any(as_number(word) != (key == "d") for word in words)
        for name, (colour, named) in parse_mtl(text).items():
            result[name] = np.array(colour, np.uint8).reshape(1, 1, 3)
            if named:
                image = read_texture(source, path, texture_name(named, unused))
                result[name] = result[name] if image is None else image
        source.note_counts(f"{source.relative(path)}: not used:", +unused, " ")
    return result


def read_texture(source: SourceFolder, by: Path, name: str) -> np.ndarray | None:
    """Return the image (h, w, 3) uint8 that a material file or model names; None and a warning where there is none."""
    where = source.relative(by) or by.name
    path = use_named(source, by.parent, name, where)
    if path is None:
        lack = "lies outside of the source folder" if os.path.isfile(by.parent / name) else "is missing"
        source.repaired(f"{where}: names the texture '{name}', which {lack}; the material's plain colour is taken")
        return None
    try:
        return read_image(path, "RGB")
    except SceneRejected as error:
        reason = str(error).removeprefix(f"{path}: ")
        source.repaired(f"{source.relative(path)}: {reason}; the material's plain colour is taken")
        return None


def parse_mtl(text: str) -> dict[str, tuple[tuple[int, int, int], str]]:
    """Return material -> its diffuse colour (0 to 255) and the name of its texture ('' without one)."""
    result: dict[str, tuple[tuple[int, int, int], str]] = {}
    name = None
    for line in text.splitlines():
        word, rest = [*line.split(None, 1), "", ""][:2]
        if word.lower() == "newmtl":
            name = rest.strip()
            result[name] = (GREY, "")
        elif name is not None and word.lower() == "kd":
            try:
                values = np.clip(np.nan_to_num(np.array(rest.split()[:3], float)), 0, 1)
            except ValueError:
                continue
            if len(values) == 3:
                r, g, b = (round(255 * float(v)) for v in values)
                result[name] = ((r, g, b), result[name][1])
        elif name is not None and word.lower() == "map_kd" and rest.strip():
            result[name] = (result[name][0], rest.strip())
    return result


def texture_name(text: str, unused: collections.Counter[str]) -> str:
    """Return the file name in a `map_Kd` without the options before it; count those that viewers would show."""
    while text.startswith("-") and len(words := text.split()) > 1:
        option = words[0].lower()
        most, plain = NUMBERED.get(option, (1, None))
        values = [as_number(word) for word in words[1 : 1 + most]]
        taken = next((k for k, v in enumerate(values) if math.isnan(v)), most) if option in NUMBERED else 1
        unused[option] += option in UNUSED_OPTIONS and any(value != plain for value in values[:taken])
        text = "".join(text.split(None, 1 + taken)[1 + taken :])
    return text


def read_painted_obj(
    source: SourceFolder, relative: str, remedy: str, builtin: Callable[[str], np.ndarray] | None = None
) -> tuple[ObjMesh, np.ndarray, list[np.ndarray]]:
    """Read an OBJ with all its materials; `builtin` returns the image of a material that no file defines.

    Return the mesh, (m,) image of each face, and the images (h, w, 3) uint8, none if the file has no colour at all.
    """
    path = source.use(relative, remedy)
    mesh = read_obj(path)
    source.note_counts(f"{relative}: not used:", mesh.unused, " ")
    if builtin is None and mesh.corner_uv is None and not mesh.libraries and mesh.colours is None:
        source.note(f"{relative}: has no texture; it stays grey")
        return mesh, np.zeros(len(mesh.faces), np.int64), []
    no_file = not mesh.libraries and (builtin is not None or mesh.colours is not None)
    images = {} if no_file else read_materials(source, path, mesh.libraries)
    default = builtin or (lambda _: GREYS)
    chosen = [images[name] if name in images else default(name) for name in mesh.materials]
    absent = sorted({n for n in mesh.materials if n not in images})
    if images and absent and builtin is None:
        source.repaired(f"{relative}: material '{absent[0]}' is in no material file; it stays grey")
    number = mesh.material.copy()
    if (number < 0).any():
        # Faces before any `usemtl`: with one material in the file they mean that one.
        number[number < 0] = len(chosen)
        chosen.append(next(iter(images.values())) if len(images) == 1 else default(""))
    uv = np.zeros((len(mesh.faces), 3, 2)) if mesh.corner_uv is None else mesh.corner_uv.copy()
    plain = np.array([image.shape[:2] == (1, 1) for image in chosen])[number]
    if mesh.colours is not None and plain.any():
        # Viewers differ in what colours of vertices do to a texture: there they are left out.
        faces = mesh.faces[plain]
        tinted = textured_by_face(mesh.vertices, faces, np.round(mesh.colours[faces].mean(axis=1)))
        assert tinted.corner_uv is not None and tinted.texture is not None
        uv[plain], number[plain] = tinted.corner_uv, len(chosen)
        chosen.append(tinted.texture)
    return dataclasses.replace(mesh, corner_uv=uv), number, chosen


def read_scan_obj(source: SourceFolder, relative: str, remedy: str) -> TexturedMesh:
    """Read an OBJ with all its materials, their textures joined in one image; arguments as `read_painted_obj`."""
    mesh, number, images = read_painted_obj(source, relative, remedy)
    if not images:
        return TexturedMesh(mesh.vertices, mesh.faces, None, None)
    uv = mesh.corner_uv if mesh.corner_uv is not None else np.zeros((len(mesh.faces), 3, 2))
    return TexturedMesh(mesh.vertices, mesh.faces, *join_textures(uv, number, images))


def scan_of(mesh: TexturedMesh, labels: np.ndarray) -> ScanMesh:
    """Return a mesh with labels (n,) of its vertices; grey where it has no image."""
    grey = np.full((len(mesh.vertices), 3), GREY, np.uint8) if mesh.texture is None else None
    return ScanMesh(mesh.vertices, mesh.faces, mesh.corner_uv, mesh.texture, labels=labels, vertex_colours=grey)


def texels(image: np.ndarray, uv: np.ndarray) -> np.ndarray:
    """Return (n, 3) uint8 of an image (h, w, 3) at texture coordinates (n, 2); it repeats outside [0, 1]."""
    height, width = image.shape[:2]
    u, v = (uv % 1.0).T
    row, column = ((1.0 - v) * height).astype(int), (u * width).astype(int)
    return image[np.clip(row, 0, height - 1), np.clip(column, 0, width - 1)]


def join_textures(corner_uv: np.ndarray, number: np.ndarray, images: list[np.ndarray]) -> tuple[np.ndarray, np.ndarray]:
    """Stack images vertically and map texture coordinates to the joint image; return both.

    `corner_uv` (m, 3, 2), origin at the lower left of the image `number` (m,) of each face, may leave [0, 1] (repeats).
    """
    if len(images) == 1 and images[0].size > 3:
        return corner_uv, images[0]
    # A plain colour needs a few pixels, so that rounding does not reach a neighbour.
    tiles = [np.tile(i, (4, 4, 1)) if i.shape[:2] == (1, 1) else i for i in images]
    side = 2 * MAX_TEXTURE_PX
    width = height = PIXELS
    while width * height > PIXELS:
        side //= 2
        tiles = [at_most(t, side) for t in tiles]
        width = max(t.shape[1] for t in tiles) + 2 * BORDER
        height = sum(t.shape[0] + 2 * BORDER for t in tiles)
    order = np.argsort(number, kind="stable")
    ends = np.searchsorted(number[order], np.arange(len(tiles) + 1))
    joint = np.zeros((height, width, 3), np.uint8)
    result = np.empty_like(corner_uv)
    top = 0
    for k, tile in enumerate(tiles):
        h, w = tile.shape[:2]
        joint[top : top + h + 2 * BORDER, : w + 2 * BORDER] = np.pad(tile, (*[(BORDER, BORDER)] * 2, (0, 0)), "edge")
        of = order[ends[k] : ends[k + 1]]
        uv = corner_uv[of]
        # Repeats end at a face: it is moved to the first copy as a whole and cut off at the image's edge.
        uv = np.clip(uv - np.floor(uv.min(axis=1, keepdims=True) + 1e-9), 0.0, 1.0)
        if images[k].shape[:2] == (1, 1):
            uv = np.full_like(uv, 0.5)
        result[of, :, 0] = (BORDER + uv[..., 0] * w) / width
        result[of, :, 1] = (height - top - BORDER - h + uv[..., 1] * h) / height
        top += h + 2 * BORDER
    return result, joint


def in_colour(mesh: TexturedMesh, rgb: np.ndarray) -> TexturedMesh:
    """Return a mesh in one colour (3 or more,), 0 to 1."""
    colour = np.clip(np.round(255 * rgb[:3]), 0, 255).astype(np.uint8)
    return textured_by_face(mesh.vertices, mesh.faces, np.tile(colour, (len(mesh.faces), 1)))


def textured_by_face(vertices: np.ndarray, faces: np.ndarray, colours: np.ndarray) -> TexturedMesh:
    """Return a mesh with one colour a face, as an image with one 4 x 4 tile a colour."""
    palette, index = np.unique(np.asarray(colours, np.uint8), axis=0, return_inverse=True)
    side = math.ceil(math.sqrt(len(palette)))
    image = np.zeros((side * side, 3), np.uint8)
    image[: len(palette)] = palette
    image = np.repeat(np.repeat(image.reshape(side, side, 3), 4, axis=0), 4, axis=1)
    row, column = np.divmod(index.reshape(-1), side)
    uv = np.stack([(column + 0.5) / side, 1.0 - (row + 0.5) / side], axis=1)
    return TexturedMesh(vertices, faces, np.repeat(uv[:, None], 3, axis=1), image)


def at_most(image: np.ndarray, side: int) -> np.ndarray:
    """Return the image shrunk until no side is longer."""
    small = Image.fromarray(image)
    small.thumbnail((side, side), Image.Resampling.BOX, reducing_gap=None)
    return np.asarray(small)


def join_meshes(*meshes: TexturedMesh) -> TexturedMesh:
    """Return all meshes as one, in their order; images that are alike are kept once."""
    if len(meshes) == 1:
        return meshes[0]
    vertices, faces = stacked((m.vertices, m.faces) for m in meshes)
    if all(m.texture is None for m in meshes):
        return TexturedMesh(vertices, faces, None, None)
    uv = np.vstack([m.corner_uv if m.corner_uv is not None else np.zeros((len(m.faces), 3, 2)) for m in meshes])
    of, images = distinct([m.texture if m.texture is not None else GREYS for m in meshes])
    return TexturedMesh(vertices, faces, *join_textures(uv, np.repeat(of, [len(m.faces) for m in meshes]), images))


def distinct(images: list[np.ndarray]) -> tuple[np.ndarray, list[np.ndarray]]:
    """Return the number of each image (n,) among those that differ, and these."""
    names = [(i.shape, i.tobytes()) if i.size < SMALL_IMAGE else id(i) for i in images]
    different: dict[object, np.ndarray] = dict(zip(names, images, strict=True))
    place = {name: k for k, name in enumerate(different)}
    return np.array([place[name] for name in names]), list(different.values())
