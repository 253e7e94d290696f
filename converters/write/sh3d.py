"""Export a scene folder as an editable Sweet Home 3D drawing (`.sh3d`, a ZIP with `Home.xml` and models).

Frames: a scene is metres, z up, y to the back of the plan; a drawing is cm, its y points down and its angles turn
clockwise; models are y up, front along +z. A door's frame is z up, x along its wall.
"""

import io
import math
import xml.etree.ElementTree as ElementTree
import zipfile
from collections.abc import Callable
from pathlib import Path
from typing import Any, NamedTuple

import mujoco
import numpy as np
import shapely
from PIL import Image

from converters.geometry.boxes import convex_hull
from converters.read.files import read_image, read_obj
from converters.read.homes.sh3d import OURS
from converters.read.homes.sh3d_models import HULLS, PANE, PANES
from converters.records.errors import SceneRejected
from converters.records.raw import ATTRIBUTION, ColourCloud, TexturedMesh
from converters.write.sh3d_rooms import SIDE_M, Wall, gap_around, half_wall, merged_walls, rooms_of, wall_between
from converters.write.texture import NO_CLOUD, textured_cloud
from interactive_nav_common.errors import FileError
from interactive_nav_common.files import whole_file
from interactive_nav_common.rotations import Y_UP_TO_Z_UP, matrix_from_quat, yaw_from_quat, yaw_matrix
from scenes_mjcf.schema import SceneMaps, load_manifest, load_maps

WALL_M = 1.8
"""What is built in and lower is furniture or a parapet: it bounds no room."""
FRAME_M = 0.008
"""Of a door's frame, within the wall beside the leaf and above it."""
ROOM_M2, SLACK_RAD, TILT_RAD, FACING = 0.5, 0.15, 0.01, 0.9
IN_M = 0.002
"""Free faces are drawn so far back: those on the border of two cells of a map would fill both."""
APART_M = 0.04
"""Between the points at which the structure's colours are looked at."""
WALL, FLOOR = "FFEDEAE4", "FFC8B9A0"
LEAF = "sweethome3d_opening_on_hinge_1"
BAR_M = 0.05
"""Of a window's frame, within its opening."""


Place = Callable[[np.ndarray], np.ndarray]
"""(n, 3) points in one frame -> in another."""


class Mesh(NamedTuple):
    """What shows a body: (n, 3) vertices (body frame, m), the OBJ's other lines, its texture, the names of both."""

    vertices: np.ndarray
    rest: str
    image: bytes
    key: tuple[str, str]
    hulls: list[np.ndarray]
    """(n, 3) vertices of each, as the mesh's."""


def export_sh3d(folder: Path, target: Path) -> list[str]:
    """Write a scene's walls, rooms, doors and furniture as a drawing; return a line for each part, also if left out."""
    manifest = load_manifest(folder)
    if target.suffix != ".sh3d" or target.exists():
        state = "exists" if target.exists() else "has another ending"
        raise FileError(f"{target}: {state}, expected a new file that ends in .sh3d; choose another name")
    drawing = _Export(folder, manifest.name, manifest.licence)
    lines = drawing.fill({o.name: o.category for o in manifest.objects}, load_maps(folder))
    with whole_file(target) as partial, zipfile.ZipFile(partial, "w", zipfile.ZIP_DEFLATED) as archive:
        for name, data in drawing.files.items():
            archive.writestr(zipfile.ZipInfo(name, (1980, 1, 1, 0, 0, 0)), data, zipfile.ZIP_DEFLATED)
    return lines


class _Export:
    """A drawing in the making."""

    def __init__(self, folder: Path, name: str, licence: str) -> None:
        self.folder, self.files = folder, {"LICENCE": licence.encode()} if licence else {}
        if (folder / ATTRIBUTION).is_file():
            self.files[ATTRIBUTION] = (folder / ATTRIBUTION).read_bytes()
        try:
            self.spec = mujoco.MjSpec.from_file(str(folder / "scene.xml"))
        except (ValueError, RuntimeError, OSError) as error:
            why = f"MuJoCo refuses it ({' '.join(str(error).split())})"
            raise SceneRejected(f"{folder / 'scene.xml'}: {why}; convert the scene again") from None
        self.root = ElementTree.Element("home", version="6500", name=f"{name}.sh3d", wallHeight="250")
        self._add("property", name="licence", value=licence)
        self.models: dict[Any, str] = {}

    def _add(self, tag: str, parent: ElementTree.Element | None = None, /, **words: Any) -> ElementTree.Element:
        text = {k: f"{v:.5f}" if isinstance(v, float) else str(v) for k, v in words.items()}
        return ElementTree.SubElement(self.root if parent is None else parent, tag, text)

    def fill(self, category: dict[str, str], maps: SceneMaps) -> list[str]:
        """Fill the drawing; return what there is and what is left out, a line each."""
        geoms = [g for g in self.spec.geoms if g.name.startswith("wall_")]
        self.walls = merged_walls([(np.array(g.pos), np.array(g.size), float(yaw_from_quat(g.quat))) for g in geoms])
        self.low_m = min(WALL_M, 0.8 * max((w.height for w in self.walls), default=0.0))
        self.high = [w for w in self.walls if w.height > self.low_m]
        self.stands = shapely.union_all([w.polygon() for w in self.high])
        self.cloud = self._cloud()
        places: Any = shapely.points(self.cloud.points[:, :2])
        self.plan = shapely.STRtree(places)
        lines, doors, pieces = ["left out: textures of walls and floors, lamps' light, and masses"], 0, 0
        if len(self.high) < len(self.walls):
            lines.append("built-in furniture is drawn as low walls")
        bodies = [b for b in self.spec.bodies if b.name in category]
        for body in bodies:
            mesh = self._mesh(body)
            hinge = mesh is not None and any(j.type == mujoco.mjtJoint.mjJNT_HINGE for j in body.joints)
            if mesh is None:
                lines.append(f"left out: {body.name}, which has no mesh to look at")
            elif hinge and self._door(body, mesh):
                doors += 1
            else:
                pieces += 1
                self._piece(body, mesh, category[body.name])
                lines += [f"{body.name}: stands in no gap of a wall; drawn as a piece that does not turn"] * hinge
        sites = [site for site in self.spec.sites if site.name.startswith("window_")]
        for site in sites:
            self._window(site)
        every = shapely.union_all([w.polygon() for w in self.walls])
        for k, wall in enumerate(self.walls):
            run = np.diff(wall.ends, axis=0)[0] / np.linalg.norm(wall.ends[1] - wall.ends[0])
            beyond = [wall.ends[0] - 1e-3 * run, wall.ends[1] + 1e-3 * run]
            out = np.where(shapely.contains(every, shapely.points(beyond)), IN_M, -IN_M)
            (x0, y0), (x1, y1) = 100 * (wall.ends + np.outer(out * [-1, 1], run)) * [1.0, -1.0] + 0.0
            top = wall.height - (IN_M / 2 if wall.height <= self.low_m else 0.0)  # heights on the grid are rounded up
            words = {"height": 100 * top, "thickness": 100 * (wall.thickness - 2 * IN_M), "pattern": "hatchUp"}
            left = run[::-1] * [-1.0, 1.0]
            for side, out in (("left", left), ("right", -left)):
                words[f"{side}SideColor"] = self._colour(WALL, wall.side(out), out, 0.1, wall.height)
            self._add("wall", id=f"wall{k}", xStart=x0, yStart=y0, xEnd=x1, yEnd=y1, **words)
        low, high = (
            shapely.union_all([w.polygon() for w in self.walls if (w.height > self.low_m) == tall])
            for tall in (False, True)
        )
        across = any(abs(math.remainder(float(yaw_from_quat(g.quat)), math.pi / 2)) > 1e-3 for g in geoms)
        stands = high.buffer(1e-4, join_style="mitre")
        rooms = rooms_of(maps, low, stands, ROOM_M2, maps.resolution_m if across else 0.0)
        for k, plan in enumerate(rooms):
            colour = self._colour(FLOOR, plan, np.zeros(2), -SIDE_M, SIDE_M)
            words = {"areaVisible": "true", "floorColor": colour, "ceilingVisible": "false"}
            room = self._add("room", id=f"room{k}", name=f"Room {k + 1}", **words)
            for x, y in 100 * shapely.get_coordinates(plan.exterior)[:-1] * [1.0, -1.0] + 0.0:
                self._add("point", room, x=x, y=y)
        ElementTree.indent(self.root)
        self.files["Home.xml"] = ElementTree.tostring(self.root, "utf-8", xml_declaration=True)
        count = f"{len(self.walls)} walls, {len(rooms)} rooms, {doors} doors, {len(sites)} windows"
        return [f"{count}, {pieces} other objects", *lines]

    def _cloud(self) -> ColourCloud:
        """Return points of what shows the structure."""
        for geom in (g for g in self.spec.geoms if g.name == "structure_visual"):
            mesh = read_obj(self.folder / self.spec.meshdir / self.spec.mesh(geom.meshname).file)
            surface = TexturedMesh(mesh.vertices, mesh.faces, mesh.corner_uv, read_image(self._image(geom), "RGB"))
            return textured_cloud(surface, APART_M)
        return NO_CLOUD

    def _image(self, geom: Any) -> Path:
        look = self.spec.material(geom.material).textures[mujoco.mjtTextureRole.mjTEXROLE_RGB]
        return self.folder / self.spec.texturedir / self.spec.texture(look).file

    def _colour(self, default: str, plan: Any, out: np.ndarray, low_m: float, high_m: float) -> str:
        """Return the structure's median colour over a plan, between two heights, facing (2,) `out` or, if 0, up."""
        near, towards = self.plan.query(plan), np.array([*out, 0.0 if out.any() else 1.0])
        points, normals = self.cloud.points[near], self.cloud.normals[near]
        here = (normals @ towards > FACING) & (np.abs(points[:, 2] - (low_m + high_m) / 2) < (high_m - low_m) / 2)
        near = near[here & shapely.contains_xy(plan, *points[:, :2].T)]
        colour = np.median(self.cloud.colours[near], axis=0) if len(near) else None
        return default if colour is None else f"FF{bytes(colour.astype(np.uint8)).hex().upper()}"

    def _mesh(self, body: Any) -> Mesh | None:
        """Return what shows a body; None where nothing does."""
        geom = next((g for g in body.geoms if g.name == f"{body.name}_visual"), None)
        if geom is None:
            return None
        path = self.folder
        try:
            solid = [self.spec.mesh(g.meshname) for g in body.geoms if g.name.startswith(f"{body.name}_hull_")]
            clouds, rows = [], []
            for mesh in (*solid, self.spec.mesh(geom.meshname)):
                path = self.folder / self.spec.meshdir / mesh.file
                rows = path.read_text(encoding="ascii").splitlines()
                clouds.append(np.array([row.split()[1:4] for row in rows if row[:2] == "v "], float) * mesh.scale)
                if clouds[-1].ndim != 2 or not np.isfinite(clouds[-1]).all():
                    raise ValueError("has no vertices")
            path = self._image(geom)
            data = path.read_bytes()
            Image.open(io.BytesIO(data)).verify()
        except (OSError, ValueError, AttributeError, SyntaxError) as error:
            reason = getattr(error, "strerror", None) or " ".join(str(error).split())
            why = f"not readable ({reason}), {body.name} needs it"
            raise SceneRejected(f"{path}: {why}; convert the scene again") from None
        rest = "\n".join(row for row in rows if row[:2] in ("vt", "f "))
        return Mesh(clouds.pop(), rest, data, (f"{mesh.file} {mesh.scale}", path.name), clouds)

    def _model(self, key: Any, place: Place, mesh: Mesh, group: str = "piece", frame: np.ndarray | None = None) -> str:
        """Return the entry of a model, written once, of a mesh in a frame that is z up and of a door frame's bars."""
        if key in self.models:
            return self.models[key]
        number, vertices = len(self.models) + 1, place(mesh.vertices)
        bars = [] if frame is None else [convex_hull(bar) for bar in frame]
        text = "mtllib model.mtl\n" + _lines(np.vstack([vertices, *(bar.vertices for bar in bars)]))
        text += f"g {group}\nusemtl look\n{mesh.rest}\n" + ("g frame\nusemtl frame\n" if bars else "")
        first = len(vertices) + 1
        for bar in bars:
            text += "".join(f"f {a} {b} {c}\n" for a, b, c in bar.faces + first)
            first += len(bar.vertices)
        solid, first = "", 1
        for k, hull in enumerate(convex_hull(place(points)) for points in mesh.hulls):
            solid += f"g hull_{k}\n" + _lines(hull.vertices)
            solid += "".join(f"f {a} {b} {c}\n" for a, b, c in hull.faces + first)
            first += len(hull.vertices)
        if solid:
            self.files[f"{number}/{HULLS}"] = solid.encode()
        materials = "newmtl look\nKd 1 1 1\nillum 1\nmap_Kd model.png\nnewmtl frame\nKd 0.85 0.83 0.8\nillum 1\n"
        for name, data in (("obj", text.encode()), ("mtl", materials.encode()), ("png", mesh.image)):
            self.files[f"{number}/model.{name}"] = data
        self.models[key] = f"{number}/model.obj"
        return self.models[key]

    def _words(self, kind: str, model: str, box: np.ndarray, yaw: float, at: np.ndarray) -> dict[str, Any]:
        """Return the attributes of a piece whose model fills a (2, 3) box in a frame at (3,) `at`."""
        middle = at[:2] + yaw_matrix(yaw)[:2, :2] @ box.mean(axis=0)[:2]
        width, depth, height = 100 * (box[1] - box[0])
        place = {"x": 100 * middle[0], "y": -100 * middle[1], "elevation": max(100 * (at[2] + box[0, 2]), 0.0)}
        place |= {"angle": -yaw % math.tau, "width": width, "depth": depth, "height": height}
        name = "thing" if kind == "other" else kind.replace("_", " ").capitalize()
        return {"catalogId": OURS + kind, "name": name, "model": model, **place}

    def _piece(self, body: Any, mesh: Mesh, kind: str) -> None:
        yaw = float(yaw_from_quat(body.quat))
        rest = yaw_matrix(yaw).T @ matrix_from_quat(np.array(body.quat))
        rest = rest if math.acos(np.clip(rest[2, 2], -1, 1)) > TILT_RAD else np.eye(3)
        vertices = mesh.vertices @ rest.T
        model = self._model((mesh.key, rest.round(6).tobytes()), lambda points: points @ rest.T, mesh)
        box = np.array([vertices.min(axis=0), vertices.max(axis=0)])
        self._add("pieceOfFurniture", movable="true", **self._words(kind, model, box, yaw, np.array(body.pos)))

    def _door(self, body: Any, mesh: Mesh) -> bool:
        """Add a door as it stands, with its frame and the wall that it stands in; False where it stands in no gap."""
        joint, at, rotation = body.joints[0], np.array(body.pos), matrix_from_quat(np.array(body.quat))
        leaf, hinge = mesh.vertices @ rotation.T + at, (rotation @ joint.pos + at)[:2]
        middle = (mesh.vertices.min(axis=0) + mesh.vertices.max(axis=0)) / 2 - joint.pos
        axis = int(np.argmax(np.ptp(mesh.vertices, axis=0)[:2]))
        along = rotation[:2, axis] * math.copysign(1.0, middle[axis])
        rest, length = math.atan2(along[1], along[0]), float(((leaf[:, :2] - hinge) @ along).max())
        lines = {round(math.atan2(*(w.ends[1] - w.ends[0])[::-1]) % (math.pi / 2), 3) for w in self.high}
        gaps = []
        for yaw in (line + k * math.pi / 2 for line in lines for k in range(4)):
            turn = math.remainder(yaw - rest, math.tau)
            if joint.range[0] - SLACK_RAD <= turn <= joint.range[1] + SLACK_RAD:
                shut = hinge + yaw_matrix(turn)[:2, :2] @ (rotation @ middle)[:2]
                gap = gap_around(self.stands, shut, yaw_matrix(yaw)[:2, 0], length)
                gaps += [] if gap is None else [(float(np.linalg.norm(gap[1] - gap[0])), yaw, gap)]
        if not gaps:
            return False
        wide, yaw, gap = min(gaps, key=lambda g: g[:2])
        wall = wall_between(self.stands, gap, max(w.height for w in self.high))
        self.walls.append(wall)
        back, centre = yaw_matrix(yaw), np.array([*wall.ends.mean(axis=0), 0.0])

        def place(points: np.ndarray) -> np.ndarray:
            return (points @ rotation.T + at - centre) @ back

        vertices, pin = place(mesh.vertices), ((hinge - centre[:2]) @ back[:2, :2])
        x, y, top = wide / 2, wall.thickness / 2, vertices[:, 2].max() + 0.01
        out, up = x + FRAME_M, top + FRAME_M
        bars = np.array([_bar(-out, -x, 0.0, top, y), _bar(x, out, 0.0, top, y), _bar(-out, out, top, up, y)])
        model = self._model((mesh.key, body.name), place, mesh, LEAF, bars)
        every = np.vstack([vertices, bars.reshape(-1, 3)])
        box = np.array([every.min(axis=0), every.max(axis=0)])
        width, depth = (box[1] - box[0])[:2]
        words = self._words("door", model, box, yaw, centre)
        shape = f"M{(-out - box[0, 0]) / width:.5f},0 v1 h{2 * out / width:.5f} v-1 z"  # the leaf may reach farther
        words |= {"wallThickness": wall.thickness / depth, "wallDistance": (box[1, 1] - y) / depth}
        door = self._add("doorOrWindow", movable="false", cutOutShape=shape, wallCutOutOnBothSides="true", **words)
        start, end = sorted((math.remainder(rest - yaw, math.tau) + float(q) for q in joint.range), key=abs)
        sash = {"xAxis": (pin[0] - box[0, 0]) / width, "yAxis": (box[1, 1] - pin[1]) / depth}
        self._add("sash", door, **sash, width=length / width, startAngle=start, endAngle=end)
        return True

    def _window(self, site: Any) -> None:
        """Add a pane in a frame as deep as the wall around it, and the wall if a scene has none behind furniture."""
        at, (x, deep, up), yaw = np.array(site.pos), np.array(site.size), float(yaw_from_quat(site.quat))
        y, high = half_wall(self.stands, at[:2], yaw_matrix(yaw)[:2, 1], deep), 2 * up
        if y is None:
            ends = at[:2] + np.outer([-x - BAR_M, x + BAR_M], yaw_matrix(yaw)[:2, 0])
            y, tall = deep, max((w.height for w in self.high), default=at[2] + up)
            self.walls.append(Wall(ends, 2 * deep, max(tall, at[2] + up)))
        sides = (-x, BAR_M - x, 0.0, high), (x - BAR_M, x, 0.0, high), (-x, x, 0.0, BAR_M), (-x, x, high - BAR_M, high)
        pane, glass = convex_hull(_bar(-x, x, 0.0, high, IN_M)), io.BytesIO()
        Image.fromarray(PANES).save(glass, "PNG")
        rest = "vt 0.5 0.5\n" + "\n".join(f"f {a}/1 {b}/1 {c}/1" for a, b, c in pane.faces + 1)
        mesh = Mesh(pane.vertices, rest, glass.getvalue(), (site.name, ""), [])
        model = self._model(site.name, lambda points: points, mesh, PANE, np.array([_bar(*s, y) for s in sides]))
        box = np.array([[-x, -y, 0.0], [x, y, high]])
        words = self._words("window", model, box, yaw, at - [0.0, 0.0, up])
        cut = {"movable": "false", "cutOutShape": "M0,0 v1 h1 v-1 z", "wallCutOutOnBothSides": "true"}
        self._add("doorOrWindow", **cut, **words)


def _lines(vertices: np.ndarray) -> str:
    """Return an OBJ's lines, in cm and y up, of (n, 3) vertices in m and z up."""
    return "".join(f"v {x:.3f} {y:.3f} {z:.3f}\n" for x, y, z in 100 * vertices @ Y_UP_TO_Z_UP + 0.0)


def _bar(x0: float, x1: float, z0: float, z1: float, half: float) -> np.ndarray:
    """Return (8, 3) corners of an upright bar across a wall: four below, four above."""
    return np.array([(x, y, z) for z in (z0, z1) for x, y in ((x0, -half), (x1, -half), (x1, half), (x0, half))])
