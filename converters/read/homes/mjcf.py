"""Read an MJCF home (RoboCasa, MolmoSpaces, a scene of this project) through MuJoCo.

All files must lie in the source's folder. Bodies on a free joint are parts; bodies without joints are structure; a
hinge or slide with limits opens if its furniture is fixed.
"""

import collections
import dataclasses
import math
import os
import re
import xml.etree.ElementTree as ElementTree
from pathlib import Path

import mujoco
import numpy as np

from converters.read.files import SourceFolder, only_file
from converters.read.homes.parts import LEVEL, HomePart, category_of, home
from converters.read.obj import TexturedMesh, in_colour
from converters.read.urdf import SHAPES, joined, parse_xml, placed, rectangle, solid, trouble
from converters.records.errors import FILES, GEOMS, PIXELS, SceneRejected, check_count, check_image
from converters.records.raw import RawScene, ScannedHinge
from interactive_nav_common.rotations import matrix_from_quat, transform
from scenes_mjcf.categories import CATEGORIES, Category
from scenes_mjcf.look import geom_image, mesh_of

NUMBER = re.compile(r"\+?\d+\.?\d*(e\+?\d+)?", re.IGNORECASE)
FARTHEST_M = 1e4
DEFAULT_RGBA = (0.5, 0.5, 0.5, 1.0)
"""MuJoCo's default for geoms: any other colour takes the place of the material's."""
REMEDY = "put a copy of the file there, or give --root DIR, a folder that holds both"
UNREAD = {
    **{"actuator": "nu", "sensor": "nsensor", "tendon": "ntendon", "equality": "neq", "flex": "nflex", "skin": "nskin"},
    **{"light": "nlight", "camera": "ncam"},
}
"""What a home may have that is not read -> MuJoCo's name of their number."""
DOOR = CATEGORIES["door"]
_GEOM, _JOINT = mujoco.mjtGeom, mujoco.mjtJoint


def mains_of(root: Path) -> list[Path]:
    """Return the MJCF files of a folder: `scene.xml` where there is one, else all."""
    files = [p for p in sorted(root.glob("*.xml")) if _tag(p) == "mujoco"]
    return [p for p in files if p.name == "scene.xml"] or files


def _tag(path: Path) -> str:
    try:
        return next(iter(ElementTree.iterparse(path, events=("start",))))[1].tag
    except (ElementTree.ParseError, OSError, StopIteration):
        return ""


def read_mjcf(root: Path, strict: bool = False, chosen: Path | None = None, within: Path | None = None) -> RawScene:
    """Read a folder's only MJCF file, its `scene.xml`, or the chosen one."""
    source = SourceFolder(within or root, strict, REMEDY)
    main = chosen or only_file(root, mains_of(root), "MJCF files", "one or scene.xml; give the file of one")
    files = _Files(source)
    try:
        model = mujoco.MjSpec.from_string(files.whole(main), include=files.models).compile()
    except (ValueError, RuntimeError) as error:  # RecursionError among them
        raise SceneRejected(f"{main}: MuJoCo refuses it ({' '.join(str(error).split())})") from error
    return home(source, "mjcf", _parts(model, source, main))


@dataclasses.dataclass
class _Files:
    """Join a home's files into one MJCF with the full path of every file: MuJoCo reads what was checked."""

    source: SourceFolder
    models: dict[str, bytes] = dataclasses.field(default_factory=dict)
    """Name that stands in the MJCF -> a model to attach, as whole as the home itself."""
    parsed: int = 0
    heaviest: float = 0.0
    """Elements of the largest model to attach."""

    def whole(self, path: Path) -> str:
        """Return the text of an MJCF with its includes; names mean what they do in MuJoCo's `xml_native_reader.cc`."""
        main = Path(os.path.abspath(path))
        root = self._parse(main)
        if root.tag != "mujoco":
            raise SceneRejected(f"{path}: starts with <{root.tag}>, expected <mujoco>")
        folder: dict[ElementTree.Element, Path] = {}
        self._include(root, main.parent, main.parent, {main}, folder)
        # While it parses, MuJoCo looks for names below the last meshdir, or else assetdir; to compile, an assetdir
        # takes the place of the meshdir before it.
        words = ("assetdir", "meshdir", "texturedir")
        looked: dict[str, str] = dict.fromkeys(words, "")
        used: dict[str, str] = {}
        strip = False
        for compiler in root.iter("compiler"):
            strip = compiler.attrib.pop("strippath", str(strip)).lower() == "true"
            stated = {word: compiler.attrib.pop(word) for word in looked if word in compiler.attrib}
            looked |= stated
            used |= (dict.fromkeys(looked, stated["assetdir"]) if "assetdir" in stated else {}) | stated
        for element, at in folder.items():
            for key, name in element.attrib.items():
                if not key.startswith("file") or not name or element.tag == "include":
                    continue
                name = name.replace("\\", "/")
                if element.tag == "model":
                    text = self.whole(_reduced(at / name)).encode()
                    place = Path(f"model_{len(self.models)}.xml")
                    self.models[str(place)] = text
                else:
                    word = {"texture": "texturedir", "mesh": "meshdir"}.get(element.tag, "assetdir")
                    sought = "" if element.tag == "flexcomp" else looked[word] or looked["assetdir"]
                    if not os.path.exists(main.parent / sought / name):
                        name = str(_reduced(at / name)) if at != main.parent else name
                    name = name.rpartition("/")[2] if strip else name
                    place = _reduced(
                        main.parent / used.get("texturedir" if element.tag == "texture" else "meshdir", "") / name
                    )
                    check_image(self.source.use(self.source.inside(place), f"{path.name} names it"))
                element.set(key, str(place))
        self._check_size(root, path)
        return ElementTree.tostring(root, encoding="unicode")

    def _check_size(self, root: ElementTree.Element, path: Path) -> None:
        """Refuse what would be too much to compile: images and height fields, and elements with their copies."""
        left, total = [(root, 1.0)], 0.0
        while left:
            element, times = left.pop()
            sizes = {key: _first(element, key) for key in ("width", "height", "nrow", "ncol")}
            cube = 6 * sizes["width"] ** 2 if element.tag == "texture" and element.get("type") != "2d" else 0.0
            pixels = max(sizes["width"] * sizes["height"], sizes["nrow"] * sizes["ncol"], cube)
            check_count(path, pixels, PIXELS, f"pixels in a <{element.tag}>", "make it smaller")
            copies = _first(element, "count", "params")
            total += times * copies + (self.heaviest if element.tag == "attach" else 0.0) * times
            left += [(child, times * copies if element.tag == "replicate" else times) for child in element]
        check_count(path, total, GEOMS, "elements with their copies")
        self.heaviest = max(self.heaviest, total)

    def _include(
        self, root: ElementTree.Element, at: Path, main: Path, done: set[Path], folder: dict[ElementTree.Element, Path]
    ) -> None:
        """Put includes in their places: files below the main file's folder, or else below the including file's."""
        for parent in list(root.iter()):
            folder[parent] = at
            for k, child in reversed(list(enumerate(parent))):
                name = child.get("file", "").replace("\\", "/")
                if child.tag.lower() != "include" or len(child) or not name:
                    continue
                path = _reduced(main / name)
                path = path if os.path.exists(path) else _reduced(at / name)
                if path in done:
                    raise SceneRejected(f"{path}: is included twice; does one include itself?")
                done.add(path)
                inner = self._parse(path)
                self._include(inner, path.parent, main, done, folder)
                parent[k : k + 1] = list(inner)

    def _parse(self, path: Path) -> ElementTree.Element:
        self.parsed += 1
        check_count(path, self.parsed, FILES, "MJCF files")
        return parse_xml(self.source.use(self.source.inside(path), "an MJCF names it"), "MJCF")


def _first(element: ElementTree.Element, *keys: str) -> float:
    """Return the product of an attribute's numbers that are larger than 1; 1 where it has none."""
    words = " ".join(element.get(key, "") for key in keys).split()
    return math.prod(float(word) for word in words if NUMBER.fullmatch(word) and float(word) > 1)


def _reduced(path: Path) -> Path:
    """Return the path without `..`, which MuJoCo takes away before it looks for links."""
    return Path(os.path.normpath(path))


def _parts(model: mujoco.MjModel, source: SourceFolder, path: Path) -> list[HomePart]:
    data = mujoco.MjData(model)
    if model.nkey:
        mujoco.mj_resetDataKeyframe(model, data, 0)
    mujoco.mj_kinematics(model, data)
    if not (np.abs(data.geom_xpos) < FARTHEST_M).all():  # NaN too
        raise SceneRejected(f"{path}: a geom stands at no usable place, expected all within {FARTHEST_M:g} m")
    categories = [category_of(model.body(body).name) for body in range(model.nbody)]
    dropped = collections.Counter({f"{word}: dropped": int(getattr(model, count)) for word, count in UNREAD.items()})
    for geom in np.flatnonzero((model.geom_matid >= 0) & (model.geom_type != int(_GEOM.mjGEOM_MESH))):
        if model.mat_texid[model.geom_matid[geom]].max() >= 0:
            dropped["texture of a geom that is no mesh: dropped"] += 1
    planes = _planes(model, data)
    opens = _openings(model, data, categories, source, dropped)
    top = _tops(model, categories, opens)
    pieces = {int(top[model.body_parentid[body]]) for body in opens}
    built_in = [category is not None and not category.is_object for category in categories]
    for body in range(model.nbody - 1, 0, -1):
        built_in[model.body_parentid[body]] |= built_in[body]
    span = float(2.0 * max(np.abs(data.geom_xpos).max(initial=0.0), 2.0))
    parts = list(planes.values())
    for body in range(model.nbody):
        if top[body] != body:
            continue
        members = np.flatnonzero(top == body)
        pose = transform(matrix_from_quat(data.xquat[body]), data.xpos[body])
        back = np.linalg.inv(pose)
        visible, solid = [], []
        for geom in np.flatnonzero(np.isin(model.geom_bodyid, members) & ~np.isin(range(model.ngeom), list(planes))):
            mesh = _mesh(model, int(geom), span)
            if mesh is None:
                dropped[f"{_GEOM(model.geom_type[geom]).name[7:].lower()}: dropped"] += 1
                continue
            at = back @ transform(data.geom_xmat[geom].reshape(3, 3), data.geom_xpos[geom])
            collides = bool(model.geom_contype[geom] or model.geom_conaffinity[geom])
            if collides:
                solid.append((placed(mesh, at), float(model.geom_friction[geom, 0])))
            if model.geom_group[geom] < 3 and _rgba(model, int(geom))[3] > 0:
                visible.append((placed(mesh, at), collides, int(model.geom_group[geom])))
        # Where a body has a group of geoms to look at, those of other groups that it collides with are not drawn; the
        # world's geoms stand each for itself.
        groups = {group for _, collides, group in visible if body == 0 or not collides}
        looks = groups or {group for *_, group in visible}
        surface = joined([m for m, _, group in visible if body == 0 or group in looks] or [m for m, _ in solid])
        if surface is None:
            continue
        free = model.body_jntnum[body] == 1 and model.jnt_type[model.body_jntadr[body]] == _JOINT.mjJNT_FREE
        # A body on a hinge or slide is held, and one that has a counter, a sink or the like within it. What MJCF calls
        # a box is more often a shape than a carton.
        jointed = model.body_jntnum[body] > 0 and categories[body] is not DOOR
        held = not free and bool(built_in[body] or jointed or categories[body] is CATEGORIES["box"] or body in pieces)
        friction = max((f for _, f in solid), default=0.0)
        name, mass = model.body(body).name or f"body_{body}", float(model.body_mass[members].sum()) or None
        friction = friction if 0 < friction <= 2 else None
        piece = model.body(top[model.body_parentid[body]]).name if body in opens else "world"
        name = name if piece == "world" else f"{name}_of_{piece}"
        about = not free, mass, friction, held, "", opens[body].moved(back) if body in opens else None
        parts.append(HomePart(name, pose, surface, joined([m for m, _ in solid]), *about))
    source.note_counts(f"{path.name}:", +dropped)
    return parts


def _planes(model: mujoco.MjModel, data: mujoco.MjData) -> dict[int, HomePart]:
    """Return the level planes, which collide without an end whatever the size that they are drawn in, by their geom."""
    planes = {}
    for geom in np.flatnonzero(model.geom_type == int(_GEOM.mjGEOM_PLANE)):
        at = transform(data.geom_xmat[geom].reshape(3, 3), data.geom_xpos[geom])
        collides = model.geom_contype[geom] or model.geom_conaffinity[geom] or not model.geom_size[geom, :2].all()
        if at[2, 2] > LEVEL and collides:
            mesh = _mesh(model, int(geom), 1.0)
            assert mesh is not None
            planes[int(geom)] = HomePart("plane", at, mesh, None, True, held=True, endless=True)
    return planes


def _openings(
    model: mujoco.MjModel, data: mujoco.MjData, categories: list, source: SourceFolder, dropped: dict[str, int]
) -> dict[int, ScannedHinge]:
    """Return the bodies that open with their joints in the home, 0 as they stand; name or count all other joints."""
    driven = model.actuator_trnid[model.actuator_trntype == int(mujoco.mjtTrn.mjTRN_JOINT), 0]
    opens: dict[int, ScannedHinge] = {}
    for joint, body in enumerate(model.jnt_bodyid.tolist()):
        kind, still = _JOINT(model.jnt_type[joint]), model.body_weldid[model.body_parentid[body]] == 0
        limits = model.jnt_range[joint] if model.jnt_limited[joint] else np.array([-np.inf, np.inf])
        low, high = (limits - data.qpos[model.jnt_qposadr[joint]]).tolist()
        at, slides = data.xanchor[joint].copy(), kind == _JOINT.mjJNT_SLIDE
        hinge = ScannedHinge(at, data.xaxis[joint].copy(), (low, high), slides=slides)
        kept = still and model.body_jntnum[body] == 1 and (slides or kind == _JOINT.mjJNT_HINGE) and joint not in driven
        if kept and not (why := trouble(hinge)):
            opens[body] = hinge
        elif kept:
            door = not slides and categories[body] is DOOR and categories[model.body_parentid[body]] is None
            end = "swings at its edge if it stands on the floor" if door else "welded shut"
            source.note(f"joint '{model.joint(joint).name}' of '{model.body(body).name}' {why}; {end}")
        elif kind != _JOINT.mjJNT_FREE:
            dropped[f"{kind.name[6:].lower()} joint (fixed, as part of its piece)"] += 1
    return opens


def _tops(model: mujoco.MjModel, categories: list[Category | None], opens: dict[int, ScannedHinge]) -> np.ndarray:
    """Return (nbody,) the body that each is a part of: the world's children, and what opens, is free or has a name."""
    top, hinged = np.arange(model.nbody), model.jnt_bodyid[model.jnt_type == int(_JOINT.mjJNT_HINGE)]
    for body in range(1, model.nbody):
        parent, category = int(model.body_parentid[body]), categories[body]
        apart = category is not None and not model.body_jntnum[body]
        if category is DOOR:
            apart = body in hinged and categories[top[parent]] is None
        still = model.body_weldid[parent] == 0
        top[body] = body if parent == 0 or body in opens or (still and apart) else top[parent]
    return top


def _mesh(model: mujoco.MjModel, geom: int, span_m: float) -> TexturedMesh | None:
    """Return a geom's surface in its frame; None for kinds without one. Planes without an end reach `span_m` far."""
    size, kind = model.geom_size[geom], _GEOM(model.geom_type[geom])  # a NumPy integer is `in` no tuple of kinds
    rgba, data = _rgba(model, geom), int(model.geom_dataid[geom])
    if kind == _GEOM.mjGEOM_MESH:
        vertices, faces, uv = mesh_of(model, data)
        vertices, faces, image = vertices.astype(float), faces.astype(np.int64), geom_image(model, geom)
        at = model.geom_matid[geom], mujoco.mjtTextureRole.mjTEXROLE_RGB
        if image is None or uv is None or model.tex_type[model.mat_texid[at]] != mujoco.mjtTexture.mjTEXTURE_2D:
            return in_colour(TexturedMesh(vertices, faces, None, None), rgba)
        # MuJoCo keeps images with their first row at the top and texture coordinates from there.
        image = np.clip(image[..., :3] * rgba[:3], 0, 255).astype(np.uint8)
        return TexturedMesh(vertices, faces, uv.astype(float) * [1.0, -1.0] + [0.0, 1.0], image)
    if kind == _GEOM.mjGEOM_PLANE:
        x, y = (v if v > 0 else span_m for v in size[:2])
        return in_colour(rectangle(x, y), rgba)
    name = kind.name[7:].lower()
    if name not in SHAPES:
        return None
    sizes = {"box": 2 * size, "sphere": size[:1], "ellipsoid": size}.get(name, size[:2] * [1.0, 2.0])
    return in_colour(solid(name, sizes), rgba)


def _rgba(model: mujoco.MjModel, geom: int) -> np.ndarray:
    """Return a geom's colour, or else its material's."""
    rgba, material = model.geom_rgba[geom], int(model.geom_matid[geom])
    return rgba if material < 0 or not np.allclose(rgba, DEFAULT_RGBA) else model.mat_rgba[material]
