"""Read a URDF of one rigid object: its surface, convex pieces, mass and friction.

Inertia follows from mass and hulls, as released URDFs have placeholders (1 kg m2 about every axis).
"""

import dataclasses
import math
import xml.etree.ElementTree as ElementTree
from collections import Counter
from collections.abc import Callable, Collection, Iterable, Mapping
from pathlib import Path
from typing import NamedTuple

import numpy as np
import trimesh

from converters.geometry.boxes import convex_pieces
from converters.read.files import SourceFolder, read_obj
from converters.read.meshes import read_surface
from converters.read.obj import TexturedMesh, find_file, in_colour, join_meshes
from converters.records.errors import SceneRejected
from converters.records.raw import ScannedHinge
from interactive_nav_common.errors import readable
from interactive_nav_common.rotations import transform, transformed

READ = {
    "any": "| @name",
    "robot": "link joint material | @version",
    "link": "inertial visual collision contact | @type",
    "inertial": "mass | origin inertia",
    "visual": "origin geometry material",
    "collision": "origin geometry | @group verbose",
    "geometry": "mesh box sphere ellipsoid cylinder capsule cone",
    "joint": "origin parent child axis limit @type | dynamics calibration safety_controller",
    "axis": "@xyz", "limit": "@lower @upper | @effort @velocity",
    "contact": "lateral_friction | rolling_friction spinning_friction stiffness damping inertia_scaling contact_cfm "
    "contact_erp",
    "material": "color",
    "origin": "@xyz @rpy", "mass": "@value", "mesh": "@filename @scale", "box": "@size", "sphere": "@radius",
    "cylinder": "@radius @length", "capsule": "@radius @length", "cone": "@radius @length", "ellipsoid": "@radii",
    "parent": "@link", "child": "@link", "color": "@rgba", "lateral_friction": "@value",
}  # fmt: skip
"""Element -> the names within it (@ before attributes) that are read and, after `|`, that change nothing seen."""
MOST_KINDS = 30
"""Of elements that are reported as not read."""


@dataclasses.dataclass(frozen=True)
class RigidObject:
    """Hold one rigid object, z up, in its local frame."""

    name: str
    surface: TexturedMesh
    pieces: tuple[tuple[np.ndarray, np.ndarray], ...] | None
    """Convex pieces (vertices (n, 3), faces (m, 3)) of the collision mesh; None: it is not made of convex pieces."""
    collision: tuple[np.ndarray, np.ndarray]
    """The collision mesh itself, to be decomposed where there are no pieces; the surface without a collision mesh."""
    mass_kg: float | None
    friction: float | None


def read_urdf(
    source: SourceFolder, relative: str, remedy: str, hold: bool = False, only: Collection[str] | None = None
) -> RigidObject:
    """Read a URDF's links (`only` these, None: all), joined by fixed joints, or with `hold` by joints fixed at 0."""
    path = source.use(relative, remedy)
    with readable(path, SceneRejected, "fetch the file again", " as URDF"):
        root = ElementTree.parse(path).getroot()
        links = {str(e.get("name")): e for e in root.findall("link")}
        places = _link_places(path, root, links, hold)
        links = {name: link for name, link in links.items() if only is None or name in only}
        rgba = {m.get("name"): str(c.get("rgba")) for m in root.iter("material") for c in m.findall("color")}
        visual = [placed(g, places[n]) for n, e in links.items() for g in _geometries(source, path, e, "visual", rgba)]
        hard = [placed(g, places[n]) for n, e in links.items() for g in _geometries(source, path, e, "collision", {})]
        masses, frictions = (
            [float(numbers(e.get("value"), (0.0,))[0]) for link in links.values() for e in link.findall(tag)[:1]]
            for tag in ("inertial/mass", "contact/lateral_friction")
        )
    unread: Counter[str] = Counter()
    count_unread(root, READ, unread)
    report_unread(source, relative, unread)
    surface = joined(visual or hard)
    if surface is None:
        raise SceneRejected(f"{path}: names no mesh to see or to collide with; expected a <visual> with geometry")
    if not hard:
        source.note(f"{relative}: has no collision mesh; the visual one is decomposed")
    body = joined(hard) or surface
    mass = sum(masses)
    if mass <= 0:
        source.note(f"{relative}: its mass is {mass:g} kg; mass comes from density and volume")
    pieces = convex_pieces(body.vertices, body.faces) if hard else None
    mass_kg, friction = mass if mass > 0 else None, max((f for f in frictions if f > 0), default=None)
    name = str(root.get("name") or path.stem)
    return RigidObject(name, surface, pieces, (body.vertices, body.faces), mass_kg, friction)


class Joint(NamedTuple):
    """Describe the joint that a link of a piece hangs on; its hinge, in the piece's frame, is 0 as it stands."""

    name: str
    kind: str
    parent: str
    hinge: ScannedHinge | None


def hinge_along(kind: str, at: np.ndarray, axis: np.ndarray, limits: Iterable[float]) -> ScannedHinge | None:
    """Return a hinge or slide along an axis of a frame (4, 4); None of other kinds, and without an axis."""
    (low, high), length = limits, float(np.linalg.norm(axis))
    if kind not in ("revolute", "prismatic") or not length:
        return None
    return ScannedHinge(np.zeros(3), axis / length, (low, high), slides=kind == "prismatic").moved(at)


def trouble(hinge: ScannedHinge) -> str:
    """Return why a hinge or slide cannot be kept, to 1e-3 rad or m; empty if it can."""
    low, high = hinge.range_rad
    fits = 1e-3 < high - low <= math.tau and low - 1e-3 <= 0 <= high + 1e-3
    return "" if fits else f"stands outside of its limits, or has none ({low:g} to {high:g})"


def by_front(
    source: SourceFolder, where: str, links: Iterable[str], joints: Mapping[str, Joint], dropped: Counter[str]
) -> dict[str, list[str]]:
    """Return the links that move with each that opens, and under "" those that stand fast; name or count the rest."""
    groups: dict[str, list[str]] = {}
    opens = {link for link, joint in joints.items() if joint.hinge and not trouble(joint.hinge)}
    for link in links:
        path = [link]
        while path[-1] in joints and len(path) <= len(joints):
            path.append(joints[path[-1]].parent)
        groups.setdefault(next((at for at in reversed(path) if at in opens), ""), []).append(link)
    for link, joint in joints.items():
        if joint.hinge and (why := trouble(joint.hinge)):
            source.note(f"{where}: joint '{joint.name}' of '{link}' {why}; welded shut")
        elif link not in groups and joint.kind != "fixed":
            dropped[f"{joint.kind} joint (its links are one part)"] += 1
    return groups


def urdf_fronts(
    source: SourceFolder, relative: str, dropped: Counter[str]
) -> list[tuple[str, ScannedHinge | None, list[str]]]:
    """Return the links of a URDF that open, on what in the root link's frame, each with those that move with it."""
    path = source.use(relative, "")
    with readable(path, SceneRejected, "fetch the file again", " as URDF"):
        root, joints = ElementTree.parse(path).getroot(), {}
        links = {str(e.get("name")): e for e in root.findall("link")}
        places = _link_places(path, root, links, hold=True)
        for e in root.findall("joint"):
            parent, child = (str(end.get("link")) for tag in ("parent", "child") for end in e.findall(tag)[:1])
            axis, limit = (next(e.iter(tag), ElementTree.Element(tag)) for tag in ("axis", "limit"))
            limits = numbers(f"{limit.get('lower', 0)} {limit.get('upper', 0)}", (0.0, 0.0)).tolist()
            along, kind = numbers(axis.get("xyz"), (1.0, 0.0, 0.0)), str(e.get("type"))
            hinge = hinge_along(kind, places.get(child, np.eye(4)), along, limits)
            joints[child] = Joint(str(e.get("name")), kind, parent, hinge)
    shown = [name for name, link in links.items() if {"visual", "collision"} & {e.tag for e in link}]
    groups = by_front(source, relative, shown, joints, dropped)
    return [(front, joints[front].hinge if front else None, some) for front, some in groups.items()]


def numbers(text: str | None, default: tuple[float, ...]) -> np.ndarray:
    """Return as many numbers as the default has, from text."""
    values = np.array((text or "").split() or default, float)
    if values.shape != np.shape(default) or not np.isfinite(values).all() or np.abs(values).max(initial=0) > 1e8:
        raise ValueError(f"'{text}' is not {len(default)} usable numbers")
    return values


def parse_xml(path: Path, kind: str, remedy: str = "fetch the file again") -> ElementTree.Element:
    """Return the root of an XML file."""
    with readable(path, SceneRejected, remedy, f" as {kind}"):
        return ElementTree.parse(path).getroot()


def count_unread(root: ElementTree.Element, table: dict[str, str], unread: Counter[str]) -> None:
    """Count the elements and attributes that a reader does not use."""
    left = [(root, root.tag)]
    while left:
        element, row = left.pop()
        used, _, more = table.get(row, "").partition("|")
        expected = {*used.split(), *more.split(), *table["any"].split()}
        unread.update(f"{key}= of <{element.tag}>" for key in element.attrib if f"@{key}" not in expected)
        for child in element:
            inner = f"{row}/{child.tag}"
            if child.tag in used.split():
                left.append((child, inner if inner in table else child.tag))
            elif child.tag not in expected:
                unread[f"<{child.tag}> in <{element.tag}>"] += 1


def report_unread(source: SourceFolder, where: str, unread: Counter[str]) -> None:
    """Warn once of each kind that was not read, and of the number of kinds where there are many."""
    counts = sorted((+unread).items(), key=lambda item: (-item[1], item[0]))
    for kind, count in counts[:MOST_KINDS]:
        source.note(f"{where}: {count} x {kind}: not read")
    if len(counts) > MOST_KINDS:
        source.note(f"{where}: {len(counts) - MOST_KINDS} more kinds of elements: not read")


def _origin(element: ElementTree.Element) -> np.ndarray:
    """Return the (4, 4) of an element's `<origin>`; roll, pitch, yaw about fixed axes."""
    origin = element.find("origin")
    if origin is None:
        return np.eye(4)
    turn = trimesh.transformations.euler_matrix(*numbers(origin.get("rpy"), (0.0, 0.0, 0.0)), axes="sxyz")
    return transform(turn[:3, :3], numbers(origin.get("xyz"), (0.0, 0.0, 0.0)))


def _link_places(
    path: Path, root: ElementTree.Element, links: dict[str, ElementTree.Element], hold: bool
) -> dict[str, np.ndarray]:
    """Return link -> (4, 4) in the frame of the root link."""
    if not links:
        raise SceneRejected(f"{path}: has no <link>, expected a URDF of one object")
    parents = {}
    for joint in root.findall("joint"):
        kind, child, parent = joint.get("type"), joint.find("child"), joint.find("parent")
        if child is None or parent is None:
            raise SceneRejected(f"{path}: joint '{joint.get('name')}' lacks a parent or child")
        if kind != "fixed" and not hold:
            raise SceneRejected(
                f"{path}: joint '{joint.get('name')}' is {kind}, expected fixed joints only; "
                "articulated objects are not supported, give each rigid part a URDF of its own"
            )
        parents[str(child.get("link"))] = (str(parent.get("link")), _origin(joint))
    places = {}
    for name in links:
        place, at, visited = np.eye(4), name, set()
        while at in parents:
            if at in visited:
                raise SceneRejected(f"{path}: its joints form a loop at link '{at}'")
            visited.add(at)
            at, origin = parents[at]
            place = origin @ place
        places[name] = place
    return places


def _geometries(
    source: SourceFolder, path: Path, link: ElementTree.Element, kind: str, rgba: dict[str | None, str]
) -> list[TexturedMesh]:
    """Return the meshes of a link's `<visual>` or `<collision>` elements, in the link's frame, coloured by `rgba`."""
    meshes = []
    for element in link.findall(kind):
        geometry = element.find("geometry")
        shape = None if geometry is None else next(iter(geometry), None)
        if shape is None:
            continue
        if shape.tag == "mesh":
            name = str(shape.get("filename") or "").removeprefix("package://").removeprefix("file://")
            target = find_file(source, path.parent, name) if name else None
            if target is None:
                raise SceneRejected(f"{path}: names the mesh '{name}', which is not there; put it beside the URDF")
            inside = source.inside(target)
            if kind == "collision" and inside.lower().endswith(".obj"):  # no report of missing colours
                bare = read_obj(source.use(inside, ""))
                mesh = TexturedMesh(bare.vertices, bare.faces, None, None)
            else:
                mesh = read_surface(source, inside, "")
            mesh = placed(mesh, np.diag([*numbers(shape.get("scale"), (1.0, 1.0, 1.0)), 1.0]))
        else:
            mesh = primitive(path, shape.tag, shape.get)
        for material in element.findall("material"):
            colour = material.find("color")
            text = rgba.get(material.get("name"), "") if colour is None else str(colour.get("rgba"))
            if mesh.texture is None and text:
                mesh = in_colour(mesh, numbers(text, (0.0,) * 4))
        meshes.append(placed(mesh, _origin(element)))
    return meshes


SHAPES = {
    "box": (3, lambda s: trimesh.creation.box(s)),
    "sphere": (1, lambda s: trimesh.creation.icosphere(2, s[0])),
    "ellipsoid": (3, lambda s: trimesh.creation.icosphere(2).apply_scale(s)),
    "cylinder": (2, lambda s: trimesh.creation.cylinder(*s, sections=16)),
    "capsule": (2, lambda s: trimesh.creation.capsule(s[1], s[0], count=(12, 12))),
    "cone": (2, lambda s: trimesh.creation.cone(*s, sections=16).apply_translation((0.0, 0.0, -s[1] / 2))),
}
"""Shape -> how many numbers are its size, and what builds it around its origin."""


def primitive(path: Path, kind: str, text: Callable[[str], str | None]) -> TexturedMesh:
    """Build an uncoloured shape of `SHAPES`; `text` gives dimensions by name, m."""
    if kind not in SHAPES:
        raise SceneRejected(f"{path}: geometry <{kind}>, expected mesh, {', '.join(SHAPES)}")
    count = SHAPES[kind][0]
    names = {"box": ("size",), "ellipsoid": ("radii",)}.get(kind, ("radius", "length")[:count])
    words = " ".join(text(name) or "" for name in names)
    size = numbers(words, (0.0,) * count)
    if size.min() < 0 or not size.any() or (kind != "box" and size.min() == 0):
        raise SceneRejected(f"{path}: a <{kind}> of {size.tolist()} m, expected positive numbers")
    return solid(kind, size)


def solid(kind: str, size: np.ndarray) -> TexturedMesh:
    """Build an uncoloured shape of `SHAPES` from the numbers that are its size, m."""
    mesh = SHAPES[kind][1](size)
    return TexturedMesh(np.asarray(mesh.vertices, float), np.asarray(mesh.faces, np.int64), None, None)


def rectangle(x_m: float, y_m: float) -> TexturedMesh:
    """Return an uncoloured rectangle around the origin that looks up, from its half sides."""
    corners = np.array([(-x_m, -y_m, 0), (x_m, -y_m, 0), (x_m, y_m, 0), (-x_m, y_m, 0)], float)
    return TexturedMesh(corners, np.array([(0, 1, 2), (0, 2, 3)]), None, None)


def placed(mesh: TexturedMesh, matrix: np.ndarray) -> TexturedMesh:
    """Return the mesh moved by a (4, 4) matrix; one that mirrors turns the faces' order."""
    faces = mesh.faces if np.linalg.det(matrix[:3, :3]) > 0 else mesh.faces[:, ::-1]
    corner_uv = mesh.corner_uv
    if faces is not mesh.faces and corner_uv is not None:
        corner_uv = corner_uv[:, ::-1]
    return dataclasses.replace(mesh, vertices=transformed(mesh.vertices, matrix), faces=faces, corner_uv=corner_uv)


def joined(meshes: list[TexturedMesh]) -> TexturedMesh | None:
    """Return all meshes as one; None of none."""
    return join_meshes(*meshes) if meshes else None
