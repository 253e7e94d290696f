"""Read a Gazebo world (SDF 1.4 to 1.12) with its models; `sdf.yaml` lists the supported elements.

Layout: `worlds/<name>.world` (or `.sdf`, or in the folder itself) and `models/<name>/model.config`, which names the
model's SDF. A model is one rigid part, except for infinite planes and the opening links of a static one.
"""

import collections
import dataclasses
import itertools
import math
import re
import xml.etree.ElementTree as ElementTree
from collections.abc import Iterator
from pathlib import Path
from urllib.parse import unquote

import numpy as np
import trimesh

from converters.geometry.faces import unit_normals
from converters.read import urdf
from converters.read.files import SourceFolder, only_file
from converters.read.homes.parts import LEVEL, HomePart, home
from converters.read.meshes import UP_AXES, collada_frame, read_surface
from converters.read.obj import GREY, TexturedMesh, find_file, in_colour
from converters.records.errors import PARTS, SceneRejected, check_count
from converters.records.raw import RawScene
from interactive_nav_common.records import read_packaged
from interactive_nav_common.rotations import matrix_from_quat, transform, transformed


@dataclasses.dataclass
class SdfModel:
    """Hold a model, or the world, with its named frames and the models within it."""

    name: str
    element: ElementTree.Element
    path: Path
    static: bool = False
    models: list["SdfModel"] = dataclasses.field(default_factory=list)
    pose: np.ndarray = dataclasses.field(default_factory=lambda: np.eye(4))
    """(4, 4) in the frame of the model or world that it is in."""
    given: dict[str, tuple[str, np.ndarray]] = dataclasses.field(default_factory=dict)
    """Frame -> the frame that its (4, 4) pose is given in, and that pose."""
    placed: dict[str, np.ndarray] = dataclasses.field(
        default_factory=lambda: {"": np.eye(4), "world": np.eye(4), "__model__": np.eye(4)}
    )
    """Frame -> its (4, 4) pose in the frame of this one, once it is resolved."""

    def add(self, models: list[tuple["SdfModel", ElementTree.Element | None, str]]) -> None:
        """Add the frames of links, joints and `<frame>`, and models, each posed by a frame in it or by itself."""
        for child in self.element:
            if child.tag in ("link", "frame", "joint"):
                on = {"frame": child.get("attached_to"), "joint": child.findtext("child")}.get(child.tag) or ""
                pose = child.find("pose")
                self.given[child.get("name") or ""] = _frame(pose) or on.strip(), self.matrix(pose)
        for model, pose, placement in models:
            self.given[model.name] = _frame(pose), self.matrix(pose) @ np.linalg.inv(model.frame(placement))
            self.models.append(model)
        for model, pose, placement in models:
            model.pose = self.place(pose, np.eye(4)) @ np.linalg.inv(model.frame(placement))
        for element in self.element.findall("frame"):
            self.frame(element.get("name") or "")

    def frame(self, name: str) -> np.ndarray:
        """Return the (4, 4) pose of a frame; `model::frame` is one of a model within."""
        steps: dict[str, np.ndarray] = {}
        while name not in self.placed:
            head, _, rest = name.partition("::")
            within = [model for model in self.models if model.name == head]
            if name in steps:
                raise SceneRejected(f"{self.path}: frame '{name}' is given relative to itself; mend its pose")
            if name in self.given:
                following, steps[name] = self.given[name]
            elif rest and within:
                following, steps[name] = head, within[0].frame(rest)
            else:
                raise SceneRejected(
                    f"{self.path}: a pose in '{self.name}' is relative to '{name}', which is no frame there, expected "
                    f"one of {', '.join(sorted(self.given)[:8]) or 'none'}; mend the pose"
                )
            name = following
        at = self.placed[name]
        for each, matrix in reversed(steps.items()):
            at = self.placed[each] = at @ matrix
        return at

    def place(self, pose: ElementTree.Element | None, default: np.ndarray) -> np.ndarray:
        """Return the (4, 4) of a pose that is relative to the frame at `default` unless it names another."""
        name = _frame(pose)
        return (self.frame(name) if name else default) @ self.matrix(pose)

    def matrix(self, pose: ElementTree.Element | None) -> np.ndarray:
        """Return the (4, 4) of x y z and roll pitch yaw, or a quaternion, in the frame that the pose is given in."""
        if pose is None:
            return np.eye(4)
        quaternion = {"euler_rpy": False, "quat_xyzw": True}.get(pose.get("rotation_format", "euler_rpy"))
        try:
            values = urdf.numbers(pose.text, (0.0,) * 6 + (1.0,) * bool(quaternion))
        except ValueError as error:
            raise SceneRejected(f"{self.path}: '{self.name}': {error}") from error
        length = float(np.linalg.norm(values[3:]))
        if quaternion is None or (quaternion and length < 1e-6):
            form = f"{pose.get('rotation_format')} {values[3:].tolist()}"
            raise SceneRejected(f"{self.path}: '{self.name}' is turned by {form}, expected euler_rpy or quat_xyzw")
        if quaternion:
            return transform(matrix_from_quat(values[[6, 3, 4, 5]] / length), values[:3])
        rpy = np.radians(values[3:]) if pose.get("degrees") in ("true", "1") else values[3:]
        return transform(trimesh.transformations.euler_matrix(*rpy, axes="sxyz")[:3, :3], values[:3])


def _frame(pose: ElementTree.Element | None) -> str:
    """Return the name of the frame that a pose is relative to; empty for the default."""
    return "" if pose is None else (pose.get("relative_to") or pose.get("frame") or "").strip()


DEEPEST = 8
"""Models within models."""
TABLES = read_packaged(Path(__file__).with_suffix(".yaml"), dict[str, dict[str, str]])
FUEL = re.compile(r"https?://.*/models/([^/]+)(?:/(?:\d+|tip))?(?:/files)?(/.*)?")
"""The address of a model, or of a file of one, on Gazebo's server."""
BUILTIN = {
    "sun": ElementTree.fromstring("<sdf><light/></sdf>"),
    "groundplane": ElementTree.fromstring(
        "<sdf><model name='ground'><link><collision><geometry><plane/></geometry></collision></link></model></sdf>"
    ),
}
"""Models that come with Gazebo."""
UNMOVED = ElementTree.Element("model")
"""A saved state without a pose."""


def worlds_of(root: Path) -> list[Path]:
    """Return the world files of a folder."""
    worlds = [p for folder in (root, root / "worlds") for p in folder.glob("*.world")]
    return sorted(worlds or [p for folder in (root, root / "worlds") for p in folder.glob("*.sdf")])


def root_of(world: Path) -> Path:
    """Return the folder whose world a file is."""
    return world.resolve().parents[1 if world.resolve().parent.name == "worlds" else 0]


def read_sdf(root: Path, strict: bool = False, chosen: Path | None = None, within: Path | None = None) -> RawScene:
    """Read the only world of a folder, or the chosen one."""
    source = SourceFolder(within or root, strict)
    file = chosen or only_file(root, worlds_of(root), "worlds")
    reader = _Reader(source, root)
    world = reader.root_of(file).find("world")
    if world is None:
        raise SceneRejected(f"{file}: has no <world>; give a world, not a model")
    urdf.count_unread(world, TABLES["read"], reader.unread)
    saved = world.find("state")
    tree = reader.tree(SdfModel("world", world, file))
    parts = list(reader.parts(tree, np.eye(4), UNMOVED if saved is None else saved))
    urdf.report_unread(source, file.name, reader.unread)
    return home(source, "sdf", parts)


@dataclasses.dataclass
class _Reader:
    """Walk a world; count what is not read."""

    source: SourceFolder
    root: Path
    """Of the world."""
    unread: collections.Counter[str] = dataclasses.field(default_factory=collections.Counter)
    read: int = 0

    def tree(self, model: SdfModel, depth: int = 0) -> SdfModel:
        """Return a model, or the world, filled with its frames and all models within it."""
        if depth > DEEPEST:
            raise SceneRejected(f"{model.path}: models lie {DEEPEST} deep in models; does one include itself?")
        self.read += 1
        check_count(model.path, self.read, PARTS, "models")
        within = []
        for child in [*model.element, *model.element.findall("state/insertions/*")]:
            item = (child, model.path) if child.tag == "model" else None
            item = self._included(child, model.path) if child.tag == "include" else item
            if item is not None:
                inner, path = item
                name = (child.findtext("name") or inner.get("name") or path.parent.name).strip()
                static = (child.findtext("static") or inner.findtext("static") or "").strip() in ("true", "1")
                placement = child.findtext("placement_frame") or child.get("placement_frame")
                pose = inner.find("pose") if child.find("pose") is None else child.find("pose")
                filled = self.tree(SdfModel(name, inner, path, static or model.static), depth + 1)
                within.append((filled, pose, (placement or inner.get("placement_frame") or "").strip()))
        model.add(within)
        return model

    def parts(self, model: SdfModel, pose: np.ndarray, state: ElementTree.Element) -> Iterator[HomePart]:
        """Return the parts of a model at a pose, and of all within it, where a saved state has moved them."""
        try:
            yield from self._of_links(model, pose, state)
        except ValueError as error:
            raise SceneRejected(f"{model.path}: '{model.name}': {error}") from error
        states = {element.get("name"): element for element in state.findall("model")}
        self.unread["<state> of a model that is not there"] += len(states.keys() - {m.name for m in model.models})
        deleted = [element.text for element in state.findall("deletions/name")]
        for within in model.models:
            if within.name not in deleted:
                saved = states.get(within.name, UNMOVED)
                place = saved.find("pose")  # Gazebo saves poses in the world
                at = pose @ within.pose if place is None else within.matrix(place)
                yield from self.parts(within, at, saved)

    def _included(self, element: ElementTree.Element, path: Path) -> tuple[ElementTree.Element, Path] | None:
        """Return an included model and its file; None for a light."""
        uri = (element.findtext("uri") or "").strip()
        fuel = FUEL.fullmatch(uri)
        root = BUILTIN.get(_key(fuel[1] if fuel else uri.removeprefix("model://")))
        if root is None:
            path = self._model_file(self._find(uri, path))
            root = self.root_of(path)
        model = root.find("model")
        if model is None and root.find("light") is None:
            raise SceneRejected(f"{path}: has no <model>")
        if model is None:
            self.unread["<light> in <include>"] += 1
            return None
        urdf.count_unread(model, TABLES["read"], self.unread)
        return model, path

    def root_of(self, path: Path) -> ElementTree.Element:
        """Return the root of an SDF file; up to SDF 1.4 the axes of joints are the model's."""
        root = urdf.parse_xml(self.source.use(self.source.inside(path), "expected SDF"), "SDF")
        for axis in root.iter("axis") if root.get("version") in ("1.0", "1.2", "1.3", "1.4") else ():
            ElementTree.SubElement(axis, "use_parent_model_frame").text = "1"
        return root

    def _model_file(self, folder: Path) -> Path:
        """Return the SDF of a model's folder, or of its newest version where Fuel's layout has several."""
        if folder.is_file():
            return folder
        versions = [path for path in folder.iterdir() if path.name.isdigit()]
        if versions and not (folder / "model.sdf").is_file():
            folder = max(versions, key=lambda path: int(path.name))
        names = []
        if self.source.has(self.source.inside(folder / "model.config")):
            config = urdf.parse_xml(self.source.use(self.source.inside(folder / "model.config"), ""), "SDF")
            names = [e.text for e in config.findall("sdf") if e.text]
        return folder / (names[-1].strip() if names else "model.sdf")

    def _of_links(self, model: SdfModel, pose: np.ndarray, state: ElementTree.Element) -> Iterator[HomePart]:
        """Return the part that a model's links make, what opens of it, and its level planes, which have no end."""
        scale = urdf.numbers(state.findtext("scale"), (1.0, 1.0, 1.0))
        if not (scale > 1e-6).all():
            raise ValueError(f"<state> scales it by {scale.tolist()}, expected numbers above 0")
        grow, links = np.diag([*scale, 1.0]), {link.get("name") or "": link for link in model.element.findall("link")}
        moved = {e.get("name"): e.find("pose") for e in state.findall("link")}
        places = {"world": np.eye(4)}
        for name, link in links.items():
            places[name] = model.place(link.find("pose"), np.eye(4))
            if (place := moved.get(name)) is not None:
                places[name] = np.linalg.inv(pose @ grow) @ model.matrix(place) @ grow
        every = [self._joint(model, element, places) for element in model.element.findall("joint")]
        joints = dict(every)
        self.unread["joint of a link that has another (its links are one part)"] += len(every) - len(joints)
        fast = model.static or any(joint.parent == "world" for joint in joints.values())
        joints = joints if fast else {link: joint._replace(hinge=None) for link, joint in joints.items()}
        groups = urdf.by_front(self.source, model.name, links, joints, self.unread)
        for front, with_it in groups.items():
            some = [links[name] for name in with_it]
            shapes: dict[str, list[tuple[TexturedMesh, np.ndarray | None]]] = {"visual": [], "collision": []}
            for link, (kind, meshes) in itertools.product(some, shapes.items()):
                for element, mesh in self._shapes(model, link, kind):
                    matrix = grow @ model.place(element.find("pose"), places[link.get("name") or ""])
                    level = element.find("geometry/plane") is not None and (
                        unit_normals(transformed(mesh.vertices, pose @ matrix), mesh.faces)[0, 2] > LEVEL
                    )
                    meshes.append((urdf.placed(mesh, matrix), pose @ matrix if level else None))
            planes = [at for _, at in shapes["collision"] if at is not None]
            for at in planes:
                look = next(mesh for mesh, at in shapes["visual"] + shapes["collision"] if at is not None)
                at[:3, :3] = np.eye(3)
                yield HomePart(model.name, at, look, None, True, held=True, endless=True)
            visual = urdf.joined([mesh for mesh, at in shapes["visual"] if at is None or not planes])
            solid = urdf.joined([mesh for mesh, at in shapes["collision"] if at is None])
            masses = [float(urdf.numbers(text, (0.0,))[0]) for link in some if (text := link.findtext("inertial/mass"))]
            mus = [c.findtext("surface/friction/ode/mu") for link in some for c in link.findall("collision")]
            friction = [mu for text in mus if text and 0 < (mu := float(urdf.numbers(text, (0.0,))[0])) <= 2]
            surface, mass, held = visual or solid, sum(masses) if masses else None, len(groups) > 1
            if surface is not None:
                hinge = joints[front].hinge if front else None
                about = fast, mass, max(friction, default=None), held, "", hinge and hinge.moved(grow)
                yield HomePart(f"{front}_of_" * bool(front) + model.name, pose, surface, solid, *about)

    def _joint(self, model: SdfModel, e: ElementTree.Element, places: dict[str, np.ndarray]) -> tuple[str, urdf.Joint]:
        """Return the child and the joint that it hangs on, in the model's frame where the links are at `places`."""
        name, kind, axis, hinge = e.get("name") or "", e.get("type") or "", e.find("axis"), None
        parent, child = ((e.findtext(key) or "").strip() for key in ("parent", "child"))
        if axis is not None and {parent, child} <= places.keys():
            # A saved state may have opened the joint, or moved the link off it.
            by, of_parent = (places[link] @ np.linalg.inv(model.frame(link)) for link in (child, parent))
            xyz, whole = next(axis.iter("xyz"), axis), axis.findtext("use_parent_model_frame") in ("1", "true")
            frame = xyz.get("expressed_in") or ("__model__" if whole else name)
            at = of_parent @ transform(model.frame(frame)[:3, :3], model.frame(name)[:3, 3])
            limits = float(axis.findtext("limit/lower") or "-inf"), float(axis.findtext("limit/upper") or "inf")
            hinge = urdf.hinge_along(kind, at, urdf.numbers(xyz.text, (0.0, 0.0, 1.0)), limits)
            if hinge is not None:
                value = hinge.value(by @ np.linalg.inv(of_parent))
                on = np.allclose(by, hinge.motion(value) @ of_parent, atol=1e-3)
                hinge = dataclasses.replace(hinge, range_rad=(limits[0] - value, limits[1] - value)) if on else None
        return child, urdf.Joint(name, kind, parent, hinge)

    def _shapes(
        self, model: SdfModel, link: ElementTree.Element, kind: str
    ) -> Iterator[tuple[ElementTree.Element, TexturedMesh]]:
        """Yield the visuals or collisions of a link with their meshes, each in its local frame."""
        for element in link.findall(kind):
            shape = next((s for g in element.findall("geometry") for s in g), None)
            if shape is None:
                self.unread[f"<{kind}> without a shape"] += 1
                continue
            transparency = urdf.numbers(element.findtext("transparency"), (0.0,))[0]
            if shape.tag not in ("empty", "heightmap") and transparency < 1.0:
                mesh = self._shape(shape, model.path)
                if not np.isfinite(mesh.vertices).all() or not len(mesh.faces):
                    raise ValueError(f"a <{shape.tag}> of link '{link.get('name')}' has no usable size")
                yield element, self._coloured(mesh, element)

    def _shape(self, shape: ElementTree.Element, path: Path) -> TexturedMesh:
        if shape.findtext("submesh/name"):
            raise ValueError("shows a <submesh>, which is not read; export it to a mesh file of its own")
        if shape.tag == "mesh":
            file = self.source.inside(self._find((shape.findtext("uri") or "").strip(), path))
            matrix = np.diag([*urdf.numbers(shape.findtext("scale"), (1.0, 1.0, 1.0)), 1.0])
            mesh = read_surface(self.source, file, "")
            if file.lower().endswith(".dae"):  # Gazebo does not read the axis that points up
                matrix[:3, :3] @= UP_AXES[collada_frame(self.source.root / file)[0]].T
            return urdf.placed(mesh, matrix)
        if shape.tag == "plane":
            x, y = np.maximum(urdf.numbers(shape.findtext("size"), (1.0, 1.0)), 1e-3) / 2
            a, b, c = urdf.numbers(shape.findtext("normal"), (0.0, 0.0, 1.0))
            axis, angle = (-b, a, 0.0) if a or b else (1.0, 0.0, 0.0), math.atan2(math.hypot(a, b), c)
            turn = np.asarray(trimesh.transformations.rotation_matrix(angle, axis))
            return urdf.placed(urdf.rectangle(x, y), turn)
        return urdf.primitive(path, shape.tag, shape.findtext)

    def _coloured(self, mesh: TexturedMesh, element: ElementTree.Element) -> TexturedMesh:
        """Return the mesh with the colours of its file, or else of its material."""
        diffuse, emissive = element.findtext("material/diffuse"), element.findtext("material/emissive") or ""
        script = (element.findtext("material/script/name") or "").strip().removeprefix("Gazebo/")
        self.unread["<emissive> in <material>"] += any(digit in emissive for digit in "123456789")
        if mesh.texture is not None:
            self.unread["<material> of a mesh with colours of its own"] += diffuse is not None
            return mesh
        if script and diffuse is None and script not in TABLES["colours"]:
            self.unread["<script> in <material>, but for Gazebo's plain ones"] += 1
        text = diffuse or TABLES["colours"].get(script) or element.findtext("material/ambient") or ""
        rgb = urdf.numbers(" ".join(text.split()[:3]), tuple(c / 255 for c in GREY))
        return in_colour(mesh, rgb)

    def _find(self, uri: str, path: Path) -> Path:
        """Return the file or folder within the source that a URI names."""
        fuel = FUEL.fullmatch(uri)
        words = fuel[1] + (fuel[2] or "") if fuel else re.sub(r"^\w+://", "", uri).lstrip("/")
        words = unquote(words).rstrip("/")
        head, _, rest = words.partition("/")
        roots = [root / models for root in (self.root, self.source.root) for models in ("models", "")]
        roots = [root for root in roots if self.source.relative(root) is not None and root.is_dir()]
        names = [name for name in (words, words.rpartition("models/")[2]) if name]
        candidates = [at / name for name in names for at in (path.parent, *roots, path.parent.parent / "models")]
        candidates += [at / rest for root in roots for at in sorted(root.iterdir()) if _key(at.name) == _key(head)]
        for candidate in candidates if head else ():
            if self.source.relative(candidate) is not None and candidate.exists():
                return candidate
        bare = find_file(self.source, path.parent, words) if words and path.parent.is_dir() else None
        if bare is None:
            remedy = "put it into its models/, or give --root DIR, a folder that holds both"
            remedy = f"download that model and unpack it as {self.root / 'models' / head}" if fuel else remedy
            raise SceneRejected(f"{path}: names '{uri}', which is not in {self.source.root}; {remedy}")
        return bare


def _key(name: str) -> str:
    """Return a name as it is compared: Fuel writes `Ground Plane` where a folder is called `ground_plane`."""
    return re.sub(r"[\W_]", "", unquote(name)).lower()
