"""A Gazebo world (SDF 1.4 to 1.11) with its models in, `RawScene` out.

Layout: `worlds/<name>.world` (or `.sdf`, there or in the folder itself) and `models/<name>/` with `model.config` and
the SDF that it names. Read are models, includes, links, poses, meshes, boxes, cylinders, spheres, planes, masses and
friction. Links of a model are one rigid part.
"""

import collections
import dataclasses
import xml.etree.ElementTree as ElementTree
from collections.abc import Iterator
from pathlib import Path

import numpy as np
import trimesh

from converters.read.files import SourceFolder
from converters.read.homes.parts import Part, home
from converters.read.meshes import read_surface, textured_by_face
from converters.read.obj import GREY, TexturedMesh, find_file
from converters.read.urdf import joined, numbers, placed, primitive
from converters.records.errors import SceneRejected
from converters.records.limits import PARTS, check_count
from converters.records.raw import RawScene

DEEPEST = 8
"""Models within models."""
DROPPED = ("actor", "light", "plugin", "population", "road", "sensor", "heightmap", "polyline", "frame")
"""Elements that have no counterpart here; they are counted."""
GAZEBOS_OWN = ("model://sun", "model://ground_plane")
"""A light, and a plane of 100 m that homes stand on; Gazebo brings both."""
ZEROS = (0.0,) * 6


def worlds_of(root: Path) -> list[Path]:
    """World files of a folder."""
    found = [p for folder in (root, root / "worlds") for p in folder.glob("*.world")]
    return sorted(found or [p for folder in (root, root / "worlds") for p in folder.glob("*.sdf")])


def root_of(world: Path) -> Path:
    """The folder whose world a file is."""
    return world.resolve().parents[1 if world.resolve().parent.name == "worlds" else 0]


def read_sdf(root: Path, strict: bool = False, chosen: Path | None = None, within: Path | None = None) -> RawScene:
    """Reads the only world of a folder, or the chosen one.

    Args:
        root: folder.
        strict: refuse what would be repaired with a warning.
        chosen: file.
        within: folder that may be read; default `root`.
    """
    source = SourceFolder(within or root, strict)
    worlds = [chosen] if chosen else worlds_of(root)
    if len(worlds) != 1:
        names = ", ".join(p.name for p in worlds) or "none"
        raise SceneRejected(f"{root}: worlds are {names}, expected one; give the file of one")
    reader = _Reader(source, root)
    world = _root(source, source.inside(worlds[0])).find("world")
    if world is None:
        raise SceneRejected(f"{worlds[0]}: has no <world>; give a world, not a model")
    parts = list(reader.parts(world, np.eye(4), worlds[0], False, 0))
    for kind, count in sorted(reader.dropped.items()):
        source.note(f"{worlds[0].name}: {count} x {kind}: dropped")
    return home(source, "sdf", parts)


def _root(source: SourceFolder, relative: str) -> ElementTree.Element:
    path = source.use(relative, "expected SDF")
    try:
        return ElementTree.parse(path).getroot()
    except ElementTree.ParseError as error:
        raise SceneRejected(f"{path}: not readable as SDF ({error}); fetch the file again") from error


@dataclasses.dataclass
class _Reader:
    """Walks a world; counts what it drops."""

    source: SourceFolder
    root: Path
    """Of the world."""
    dropped: collections.Counter[str] = dataclasses.field(default_factory=collections.Counter)
    read: int = 0

    def parts(
        self, parent: ElementTree.Element, pose: np.ndarray, path: Path, static: bool, depth: int
    ) -> Iterator[Part]:
        """Parts of the models and includes within a world or model."""
        if depth > DEEPEST:
            raise SceneRejected(f"{path}: models lie {DEEPEST} deep in models; does one include itself?")
        for element in parent:
            if element.tag in DROPPED:
                self.dropped[element.tag] += 1
            elif element.tag == "include" and (uri := (element.findtext("uri") or "").strip()) in GAZEBOS_OWN:
                self.dropped[uri] += 1
            elif element.tag == "include":
                model, where = self._included(element, path)
                own = element.find("pose") if element.find("pose") is not None else model.find("pose")
                yield from self._model(
                    model, pose @ self._pose(own, path), where, static or _yes(element), depth, element
                )
            elif element.tag == "model":
                yield from self._model(element, pose @ self._pose(element.find("pose"), path), path, static, depth)

    def _included(self, element: ElementTree.Element, path: Path) -> tuple[ElementTree.Element, Path]:
        uri = (element.findtext("uri") or "").strip()
        folder = self._find(uri, path)
        config = folder / "model.config"
        name = "model.sdf"
        if self.source.has(self.source.inside(config)):
            names = [e.text for e in _root(self.source, self.source.inside(config)).findall("sdf") if e.text]
            name = names[-1].strip() if names else name
        model = _root(self.source, self.source.inside(folder / name)).find("model")
        if model is None:
            raise SceneRejected(f"{folder / name}: has no <model>")
        return model, folder / name

    def _model(
        self,
        model: ElementTree.Element,
        pose: np.ndarray,
        path: Path,
        static: bool,
        depth: int,
        by: ElementTree.Element | None = None,
    ) -> Iterator[Part]:
        static = static or _yes(model)
        self.read += 1
        check_count(path, self.read, PARTS, "models")
        for joint in model.findall("joint"):
            if joint.get("type") != "fixed":
                self.dropped[f"{joint.get('type')} joint (its links are one part)"] += 1
        links = [(link, self._pose(link.find("pose"), path)) for link in model.findall("link")]
        seen = joined([placed(m, at) for link, at in links for m in self._geometries(link, "visual", path)])
        solid = joined([placed(m, at) for link, at in links for m in self._geometries(link, "collision", path)])
        masses = [self._number(link, "inertial/mass", path) for link, _ in links]
        friction = [
            f for link, _ in links for c in link.findall("collision")
            if (f := self._number(c, "surface/friction/ode/mu", path)) is not None and 0 < f <= 2
        ]  # fmt: skip
        name = str((by.findtext("name") if by is not None else None) or model.get("name") or path.parent.name)
        surface = seen or solid
        if surface is not None:
            known = [m for m in masses if m is not None]
            yield Part(
                name, pose, surface, solid, static, sum(known) if known else None, max(friction) if friction else None
            )
        yield from self.parts(model, pose, path, static, depth + 1)

    def _geometries(self, link: ElementTree.Element, kind: str, path: Path) -> Iterator[TexturedMesh]:
        for element in link.findall(kind):
            geometry = element.find("geometry")
            shape = None if geometry is None else next(iter(geometry), None)
            if shape is None or shape.tag in (*DROPPED, "empty"):
                self.dropped["no shape" if shape is None else shape.tag] += 1
                continue
            if shape.tag == "mesh":
                target = self._find((shape.findtext("uri") or "").strip(), path)
                mesh = read_surface(self.source, self.source.inside(target), "")
                mesh = placed(mesh, np.diag([*self._numbers(shape, "scale", (1.0, 1.0, 1.0), path), 1.0]))
            elif shape.tag == "plane":
                mesh = _plane(self._numbers(shape, "size", (1.0, 1.0), path))
            else:
                try:
                    mesh = primitive(path, shape.tag, shape.findtext)
                except ValueError as error:
                    raise SceneRejected(f"{path}: <{shape.tag}>: {error}") from error
            if not np.isfinite(mesh.vertices).all() or not len(mesh.faces):
                raise SceneRejected(f"{path}: a <{shape.tag}> of link '{link.get('name')}' has no usable size")
            if mesh.texture is None:
                rgb = self._numbers(element, "material/diffuse", (*(c / 255 for c in GREY), 1.0), path)[:3]
                colour = np.clip(np.round(255 * rgb), 0, 255).astype(np.uint8)
                mesh = textured_by_face(mesh.vertices, mesh.faces, np.tile(colour, (len(mesh.faces), 1)))
            yield placed(mesh, self._pose(element.find("pose"), path))

    def _find(self, uri: str, path: Path) -> Path:
        """The file or folder that a URI names, within the source."""
        words = uri.removeprefix("model://").removeprefix("file://").lstrip("/")
        roots = [root / models for root in (self.root, self.source.root) for models in ("models", "")]
        for folder in (path.parent, *roots, path.parent.parent / "models"):
            candidate = folder / words
            if words and self.source.relative(candidate) is not None and candidate.exists():
                return candidate
        bare = find_file(self.source, path.parent, words) if words and path.parent.is_dir() else None
        if bare is None:
            raise SceneRejected(
                f"{path}: names '{uri}', which is not in {self.source.root}; put it into its models/, or "
                "give --root DIR, a folder that holds both"
            )
        return bare

    def _pose(self, element: ElementTree.Element | None, path: Path) -> np.ndarray:
        """(4, 4) of x y z roll pitch yaw; frames that are named are taken for the parent's."""
        if element is None:
            return np.eye(4)
        if element.get("relative_to") or element.get("frame"):
            self.dropped["pose relative to a named frame (taken for the parent's)"] += 1
        values = self._words(element.text, ZEROS, path)
        if element.get("degrees") in ("true", "1"):
            values[3:] = np.radians(values[3:])
        matrix = trimesh.transformations.euler_matrix(*values[3:], axes="sxyz")
        matrix[:3, 3] = values[:3]
        return matrix

    def _numbers(self, parent: ElementTree.Element, tag: str, default: tuple[float, ...], path: Path) -> np.ndarray:
        return self._words(parent.findtext(tag), default, path)

    def _number(self, parent: ElementTree.Element, tag: str, path: Path) -> float | None:
        text = parent.findtext(tag)
        return None if text is None else float(self._words(text, (0.0,), path)[0])

    def _words(self, text: str | None, default: tuple[float, ...], path: Path) -> np.ndarray:
        try:
            return numbers(text, default)
        except ValueError as error:
            raise SceneRejected(f"{path}: {error}") from error


def _yes(element: ElementTree.Element) -> bool:
    return (element.findtext("static") or "").strip() in ("true", "1")


def _plane(size: np.ndarray) -> TexturedMesh:
    x, y = np.maximum(size, 0.0) / 2
    corners = np.array([(-x, -y, 0), (x, -y, 0), (x, y, 0), (-x, y, 0)], float)
    return TexturedMesh(corners, np.array([(0, 1, 2), (0, 2, 3)]), None, None)
