"""A Gazebo world (SDF 1.4 to 1.12) with its models in, `RawScene` out.

Layout: `worlds/<name>.world` (or `.sdf`, there or in the folder itself) and `models/<name>/` with `model.config` and
the SDF that it names. Links of a model are one rigid part, but for level planes, which have no end. `sdf.yaml` lists
the elements that are read.
"""

import collections
import dataclasses
import re
import xml.etree.ElementTree as ElementTree
from collections.abc import Iterator
from pathlib import Path
from urllib.parse import unquote

import numpy as np
import shapely
import trimesh

from converters.read.files import SourceFolder, read_image
from converters.read.homes.parts import Part, home
from converters.read.homes.sdf_frames import Frames
from converters.read.homes.solids import extruded, height_field
from converters.read.meshes import read_surface, textured_by_face
from converters.read.obj import GREY, TexturedMesh, find_file
from converters.read.urdf import count_unread, joined, numbers, parse_xml, placed, primitive, report_unread
from converters.records.errors import SceneRejected
from converters.records.limits import PARTS, check_count
from converters.records.raw import RawScene
from interactive_nav_common.records import read_packaged

DEEPEST = 8
"""Models within models."""
LEVEL = 0.9999
"""Least cosine between the normal of a level plane and the upright."""
HEIGHTS = 256
"""Most columns and rows of a height field that are read."""
TABLES = read_packaged(Path(__file__).with_suffix(".yaml"), dict[str, dict[str, str]])
FUEL = re.compile(r"https?://.*/models/([^/]+)(?:/(?:\d+|tip))?(?:/files)?(/.*)?")
"""The address of a model, or of a file of one, on Gazebo's server."""
GAZEBOS_OWN = {
    "sun": "<light/>",
    "groundplane": "<model name='ground_plane'><static>1</static><link><collision><geometry><plane/></geometry>"
    "</collision></link></model>",
}
"""Models that Gazebo brings."""


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
    world = parse_xml(source.use(source.inside(worlds[0]), "expected SDF"), "SDF").find("world")
    if world is None:
        raise SceneRejected(f"{worlds[0]}: has no <world>; give a world, not a model")
    count_unread(world, TABLES["read"], reader.unread)
    parts = list(reader.parts(reader.tree(world, worlds[0], False, 0, "world"), np.eye(4), world.find("state")))
    report_unread(source, worlds[0].name, reader.unread)
    return home(source, "sdf", parts)


@dataclasses.dataclass
class _Model:
    """A model, or the world, with the models within it."""

    name: str
    element: ElementTree.Element
    path: Path
    static: bool
    frames: Frames
    models: list["_Model"]
    pose: np.ndarray = dataclasses.field(default_factory=lambda: np.eye(4))
    """(4, 4) in the frame of what it is in."""


@dataclasses.dataclass
class _Reader:
    """Walks a world; counts what it does not read."""

    source: SourceFolder
    root: Path
    """Of the world."""
    unread: collections.Counter[str] = dataclasses.field(default_factory=collections.Counter)
    read: int = 0

    def tree(self, element: ElementTree.Element, path: Path, static: bool, depth: int, name: str) -> _Model:
        """Return a model, or the world, with all models within it, each placed in the one that holds it."""
        if depth > DEEPEST:
            raise SceneRejected(f"{path}: models lie {DEEPEST} deep in models; does one include itself?")
        self.read += 1
        check_count(path, self.read, PARTS, "models")
        where = f"{path}: '{name}'"
        frames = Frames(where, "world") if element.tag == "world" else Frames(where)
        model = _Model(name, element, path, static, frames, [])
        for child in element:
            if child.tag in ("link", "frame", "joint"):
                default = {"frame": child.get("attached_to"), "joint": child.findtext("child")}.get(child.tag)
                frames.add(child.get("name"), child.find("pose"), (default or "").strip())
        given = []
        for child in [*element, *element.findall("state/insertions/*")]:
            found = (child, path) if child.tag == "model" else None
            found = self._included(child, path) if child.tag == "include" else found
            if found is not None:
                inner, file = found
                called = (child.findtext("name") or inner.get("name") or file.parent.name).strip()
                fixed = static or _static(child, _static(inner, False))
                within = self.tree(inner, file, fixed, depth + 1, called)
                own = child if child.find("pose") is not None else inner
                placement = child.findtext("placement_frame") or child.get("placement_frame")
                placement = placement or (inner.get("placement_frame") if own is inner or own is child else None)
                given.append(frames.add_model(called, own.find("pose"), within.frames, placement))
                model.models.append(within)
        for within, (frame, matrix) in zip(model.models, given, strict=True):
            within.pose = frames.pose(frame) @ matrix
        for frame in element.findall("frame"):
            frames.pose(frame.get("name") or "")
        return model

    def parts(self, model: _Model, pose: np.ndarray, state: ElementTree.Element | None) -> Iterator[Part]:
        """Return the parts of a model at a pose, and of all within it, where a saved state has moved them."""
        moved = [] if state is None else state.findall("model")
        states = {element.get("name"): element for element in moved}
        deleted = [] if state is None else [e.text for e in state.findall("deletions/name")]
        grow = np.ones(3)
        if state is not None and state.tag == "model":
            grow = self._numbers(state, "scale", (1.0, 1.0, 1.0), model.path)
            if not (grow > 1e-6).all():
                raise SceneRejected(f"{model.path}: <state> scales '{model.name}' by {grow.tolist()}, expected above 0")
        yield from self._own(model, pose, state, grow)
        for within in model.models:
            if within.name not in deleted:
                moves = states.pop(within.name, None)
                at = pose @ within.pose
                if moves is not None and (place := moves.find("pose")) is not None:
                    at = within.frames.matrix(place)  # Gazebo saves poses in the world
                yield from self.parts(within, at, moves)
        if states:
            self.unread["<state> of a model that is not there"] += len(states)

    def _included(self, element: ElementTree.Element, path: Path) -> tuple[ElementTree.Element, Path] | None:
        """Return an included model and its file; None for a light."""
        uri = (element.findtext("uri") or "").strip()
        own = GAZEBOS_OWN.get(_key((fuel := FUEL.fullmatch(uri)) and fuel[1] or uri.removeprefix("model://")))
        folder = self._find(uri, path, own is None)
        if folder is None:
            root, file = ElementTree.fromstring(f"<sdf>{own}</sdf>"), path
        else:
            file = self._model_file(folder)
            root = parse_xml(self.source.use(self.source.inside(file), "expected SDF"), "SDF")
        model = root.find("model")
        if model is None and root.find("light") is None:
            raise SceneRejected(f"{file}: has no <model>")
        if model is None:
            self.unread["<light> in <include>"] += 1
            return None
        count_unread(model, TABLES["read"], self.unread)
        return model, file

    def _model_file(self, folder: Path) -> Path:
        """Return the SDF of a model's folder, or of its newest version where Fuel's layout has several."""
        versions = [p for p in folder.iterdir() if p.name.isdigit()] if folder.is_dir() else []
        if versions and not (folder / "model.sdf").is_file():
            folder = max(versions, key=lambda p: int(p.name))
        names = []
        if self.source.has(self.source.inside(folder / "model.config")):
            config = parse_xml(self.source.use(self.source.inside(folder / "model.config"), ""), "SDF")
            names = [e.text for e in config.findall("sdf") if e.text]
        return folder if folder.is_file() else folder / (names[-1].strip() if names else "model.sdf")

    def _own(
        self, model: _Model, pose: np.ndarray, state: ElementTree.Element | None, grow: np.ndarray
    ) -> Iterator[Part]:
        """Return the part that a model's links make, and its level planes, which have no end."""
        path, frames = model.path, model.frames
        for joint in model.element.findall("joint"):
            if joint.get("type") != "fixed":
                self.unread[f"{joint.get('type')} joint (its links are one part)"] += 1
        links = model.element.findall("link")
        states = {} if state is None else {e.get("name"): e.find("pose") for e in state.findall("link")}
        shapes: dict[str, list[tuple[TexturedMesh, np.ndarray | None]]] = {"visual": [], "collision": []}
        for link in links:
            at = frames.place(link.find("pose"), np.eye(4))
            if (place := states.get(link.get("name"))) is not None:
                at = np.linalg.inv(pose) @ frames.matrix(place)
                at[:3, 3] /= grow
            for kind, found in shapes.items():
                found += self._shapes(model, link, kind, np.diag([*grow, 1.0]), at)
        ends = {kind: [m for m, plane in found if not _level(pose, plane)] for kind, found in shapes.items()}
        planes = {
            kind: [(m, pose @ p) for m, p in found if p is not None and _level(pose, p)]
            for kind, found in shapes.items()
        }
        looks = [m for m, _ in planes["visual"] + planes["collision"]]
        for _, at in planes["collision"]:
            level = np.eye(4)
            level[:3, 3] = at[:3, 3]
            yield Part(model.name, level, looks[0], None, True, held=True, endless=True)
        seen = joined(ends["visual"] + ([] if planes["collision"] else [m for m, _ in planes["visual"]]))
        solid = joined(ends["collision"])
        masses = [m for link in links if (m := self._number(link, "inertial/mass", path)) is not None]
        friction = [
            f for link in links for c in link.findall("collision")
            if (f := self._number(c, "surface/friction/ode/mu", path)) is not None and 0 < f <= 2
        ]  # fmt: skip
        surface = seen or solid
        if surface is not None:
            yield Part(
                model.name,
                pose,
                surface,
                solid,
                model.static,
                sum(masses) if masses else None,
                max(friction, default=None),
            )

    def _shapes(
        self, model: _Model, link: ElementTree.Element, kind: str, grow: np.ndarray, at: np.ndarray
    ) -> Iterator[tuple[TexturedMesh, np.ndarray | None]]:
        """Yield each shape of a link in the model's frame, and, of a plane, its pose there."""
        path = model.path
        for element in link.findall(kind):
            shape = next((s for g in element.findall("geometry") for s in g), None)
            if shape is None:
                self.unread[f"<{kind}> without a shape"] += 1
            if shape is None or shape.tag == "empty" or (self._number(element, "transparency", path) or 0.0) >= 1.0:
                continue
            try:
                mesh = self._shape(shape, path)
            except ValueError as error:
                raise SceneRejected(f"{path}: <{shape.tag}>: {error}") from error
            if not np.isfinite(mesh.vertices).all() or not len(mesh.faces):
                raise SceneRejected(f"{path}: a <{shape.tag}> of link '{link.get('name')}' has no usable size")
            matrix = grow @ model.frames.place(element.find("pose"), at)
            yield placed(self._coloured(mesh, element, path), matrix), matrix if shape.tag == "plane" else None

    def _shape(self, shape: ElementTree.Element, path: Path) -> TexturedMesh:
        if shape.tag == "mesh":
            if shape.findtext("submesh/name"):
                raise SceneRejected(
                    f"{path}: shows a <submesh>, which is not read; export it to a mesh file of its own"
                )
            target = self._find((shape.findtext("uri") or "").strip(), path)
            assert target is not None
            mesh = read_surface(self.source, self.source.inside(target), "")
            return placed(mesh, np.diag([*numbers(shape.findtext("scale"), (1.0, 1.0, 1.0)), 1.0]))
        if shape.tag == "heightmap":
            return self._heightmap(shape, path)
        if shape.tag == "polyline":
            rings = [[numbers(e.text, (0.0, 0.0)) for e in shape.findall("point")]]
            height = float(numbers(shape.findtext("height"), (1.0,))[0])
            outline = shapely.make_valid(shapely.Polygon(rings[0]))
            return TexturedMesh(*extruded(outline, height), None, None)
        if shape.tag == "plane":
            mesh = _plane(numbers(shape.findtext("size"), (1.0, 1.0)))
            normal = numbers(shape.findtext("normal"), (0.0, 0.0, 1.0))
            return placed(mesh, np.asarray(trimesh.geometry.align_vectors((0.0, 0.0, 1.0), normal)))
        return primitive(path, shape.tag, shape.findtext)

    def _heightmap(self, shape: ElementTree.Element, path: Path) -> TexturedMesh:
        """Return the surface of a grey image, whose brightest pixel lies as high as its <size>."""
        target = self._find((shape.findtext("uri") or "").strip(), path)
        assert target is not None
        grey = read_image(self.source.use(self.source.inside(target), ""), "L")[::-1].astype(float)
        step = max(1, max(grey.shape) // HEIGHTS)
        size = numbers(shape.findtext("size"), (1.0, 1.0, 1.0))
        height = grey[::step, ::step] / max(float(grey.max()), 1.0) * size[2]
        vertices, faces = height_field(height, (size[0] / 2, size[1] / 2))
        return TexturedMesh(vertices + numbers(shape.findtext("pos"), (0.0, 0.0, 0.0)), faces, None, None)

    def _coloured(self, mesh: TexturedMesh, element: ElementTree.Element, path: Path) -> TexturedMesh:
        """Return the mesh with its own colours, or else those that its material says."""
        diffuse = element.findtext("material/diffuse")
        script = (element.findtext("material/script/name") or "").strip().removeprefix("Gazebo/")
        self.unread["<emissive> in <material>"] += bool(
            set(element.findtext("material/emissive", "")) & set("123456789")
        )
        if mesh.texture is not None:
            self.unread["<material> of a mesh with colours of its own"] += diffuse is not None
            return mesh
        if script and diffuse is None and script not in TABLES["colours"]:
            self.unread["<script> in <material>, but for Gazebo's plain ones"] += 1
        text = diffuse or TABLES["colours"].get(script) or element.findtext("material/ambient") or ""
        try:
            rgb = numbers(" ".join(text.split()[:3]), tuple(c / 255 for c in GREY))
        except ValueError as error:
            raise SceneRejected(f"{path}: colour {error}") from error
        colour = np.clip(np.round(255 * rgb), 0, 255).astype(np.uint8)
        return textured_by_face(mesh.vertices, mesh.faces, np.tile(colour, (len(mesh.faces), 1)))

    def _find(self, uri: str, path: Path, needed: bool = True) -> Path | None:
        """Return the file or folder within the source that a URI names; None if there is none and none is needed."""
        fuel = FUEL.fullmatch(uri)
        words = fuel[1] + (fuel[2] or "") if fuel else re.sub(r"^\w+://", "", uri).lstrip("/")
        words = unquote(words).rstrip("/")
        roots = [root / models for root in (self.root, self.source.root) for models in ("models", "")]
        head, _, rest = words.partition("/")
        alike = [
            folder / rest for root in roots if self.source.relative(root) is not None and root.is_dir()
            for folder in sorted(root.iterdir()) if head and _key(folder.name) == _key(head)
        ]  # fmt: skip
        inner = words.rpartition("models/")[2]
        for candidate in (
            *(
                folder / name
                for name in dict.fromkeys((words, inner))
                if name
                for folder in (path.parent, *roots, path.parent.parent / "models")
            ),
            *alike,
        ):
            if self.source.relative(candidate) is not None and candidate.exists():
                return candidate
        bare = find_file(self.source, path.parent, words) if words and path.parent.is_dir() else None
        if bare is None and needed:
            remedy = "put it into its models/, or give --root DIR, a folder that holds both"
            if fuel:
                remedy = f"download the model and unpack it as {self.root / 'models' / head}"
            raise SceneRejected(f"{path}: names '{uri}', which is not in {self.source.root}; {remedy}")
        return bare

    def _numbers(self, parent: ElementTree.Element, tag: str, default: tuple[float, ...], path: Path) -> np.ndarray:
        try:
            return numbers(parent.findtext(tag), default)
        except ValueError as error:
            raise SceneRejected(f"{path}: <{tag}>: {error}") from error

    def _number(self, parent: ElementTree.Element, tag: str, path: Path) -> float | None:
        return None if parent.find(tag) is None else float(self._numbers(parent, tag, (0.0,), path)[0])


def _static(element: ElementTree.Element, default: bool) -> bool:
    text = element.findtext("static")
    return default if text is None else text.strip() in ("true", "1")


def _key(name: str) -> str:
    """Return a name as it is compared: Fuel writes `Ground Plane` where a folder is called `ground_plane`."""
    return re.sub(r"[\W_]", "", unquote(name)).lower()


def _level(pose: np.ndarray, plane: np.ndarray | None) -> bool:
    return plane is not None and (pose @ plane)[2, 2] > LEVEL


def _plane(size: np.ndarray) -> TexturedMesh:
    x, y = np.maximum(size, 0.0) / 2
    corners = np.array([(-x, -y, 0), (x, -y, 0), (x, y, 0), (-x, y, 0)], float)
    return TexturedMesh(corners, np.array([(0, 1, 2), (0, 2, 3)]), None, None)
