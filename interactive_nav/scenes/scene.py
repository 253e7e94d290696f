"""Read scene folders into a `Scene` of plain arrays: the one reader of `scene.xml`."""

import dataclasses
import functools
import hashlib
import warnings
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import mujoco
import numpy as np

from interactive_nav.scenes.many import for_each_home
from interactive_nav_common.errors import readable
from interactive_nav_common.rotations import rotate
from scenes_mjcf.agreement import differences
from scenes_mjcf.categories import MaskClasses, class_id
from scenes_mjcf.look import geom_mesh
from scenes_mjcf.schema import SceneError, SceneManifest, SceneMaps, load_manifest, load_maps
from scenes_mjcf.sets import existing, installed

MASS_KG = (1e-3, 1e4)
FRICTION = (1e-3, 10.0)
"""Least and greatest sliding coefficient."""
BASE_M = (-0.5, 3.0)
"""Least and greatest height of an object's lowest point above the floor."""
BESIDE_M = 1.0
"""Objects may stand, and free floor may reach, so far beyond the map and the walls."""
TASK_DIGEST = "task-1:"
"""Begins a digest of what decides a task, and names the method."""
# MuJoCo would keep 500 MB of textures and meshes that it has read, 50 MB of each cluttered home.
mujoco.mj_setCacheCapacity(mujoco.mj_getCache(), 100 * 2**20)
_DECIMALS = 9
"""Numbers are rounded before they are hashed: what MuJoCo computes differs between machines in its last bits."""


@dataclasses.dataclass(frozen=True)
class Joint:
    """What ties a body to the structure, a hinge or a slide, in the body's frame."""

    axis: np.ndarray
    """(3,)"""
    anchor_m: np.ndarray
    """(3,) a point of a hinge's axis."""
    range: tuple[float, float] | None
    """rad, or m of a slide."""
    damping: float
    """N m s/rad, or N s/m of a slide."""
    frictionloss: float
    """N m, or N of a slide."""
    slides: bool = False
    balanced: bool = False
    """Springs carry the body's weight, as a flap's."""


@dataclasses.dataclass(frozen=True)
class Movable:
    """A movable body of a scene; geometry in the body's frame."""

    name: str
    category: str
    mass_kg: float
    inertia: np.ndarray
    """(3,) principal moments, kg m^2."""
    com_m: np.ndarray
    """(3,)"""
    inertia_quat: np.ndarray
    """(4,) w x y z."""
    pos_w: np.ndarray
    """(3,) rest position, m."""
    quat_w: np.ndarray
    """(4,) rest orientation."""
    friction: float
    boxes: np.ndarray
    """[n, 10]: centre (3), quaternion (4), half sizes (3)."""
    hulls: tuple[np.ndarray, ...]
    """Vertices [v, 3] of each convex hull."""
    joint: Joint | None
    """None: a free body."""

    @property
    def kind(self) -> str:
        """Return `free`, `hinge` or `slide`."""
        return "free" if self.joint is None else "slide" if self.joint.slides else "hinge"

    @property
    def rows(self) -> np.ndarray:
        """Return `boxes`, under the name that `SmallObject` has for the same."""
        return self.boxes

    def mask_id(self, classes: MaskClasses) -> int:
        """Return its class where the setting `segmentation_classes` is this."""
        return class_id(self.category, classes)


@dataclasses.dataclass(frozen=True)
class Scene:
    """A scene: its manifest, maps, walls and movable bodies."""

    path: Path
    name: str
    split: str
    digest: str
    """SHA-256 of the files scene.xml and maps.npz."""
    manifest: SceneManifest
    maps: SceneMaps
    walls: np.ndarray
    """[n, 10]: world centre, quaternion, half sizes."""
    movables: tuple[Movable, ...]

    @functools.cached_property
    def task_digest(self) -> str:
        """Return `TASK_DIGEST` and SHA-256 of what decides the task: map, walls, and the movables' places, shapes,
        masses, friction and categories. Names, textures, colours and other looks are not in it."""
        maps = self.maps
        parts = [maps.traversable.shape, np.packbits(maps.traversable).tobytes().hex()]
        parts += [_rounded([maps.resolution_m, *maps.origin_w]), _rounded(_six_digits(self.walls))]
        hulls = hull_sources(self.path / "scene.xml") if any(m.hulls for m in self.movables) else {}
        for movable in self.movables:
            parts += body_task_parts(movable, hulls.get(movable.name, []))
        return TASK_DIGEST + hashlib.sha256(repr(parts).encode()).hexdigest()


def _rounded(value: object) -> list:
    # Adding 0 turns -0 into 0.
    return (np.round(np.asarray(value, float), _DECIMALS) + 0.0).tolist()


def _six_digits(rows: np.ndarray) -> np.ndarray:
    """Return rows of centre, quaternion and half sizes, the lengths with six digits: older scenes have no more."""
    rows = np.array(rows)
    lengths = np.r_[0:3, 7:10] if rows.ndim == 2 else slice(None)
    rows[..., lengths] = np.vectorize(lambda value: float(f"{value:.6g}"), otypes=[float])(rows[..., lengths])
    return rows


def body_task_parts(movable: Movable, hulls: list) -> list:
    """Return what of a body decides a task, to be hashed: all but its name; its hulls as `hull_sources` has them."""
    numbers = {f.name: getattr(movable, f.name) for f in dataclasses.fields(Movable)}
    for name in ("name", "hulls", "joint", "category"):
        del numbers[name]
    numbers |= {"pos_w": _six_digits(movable.pos_w), "boxes": _six_digits(movable.boxes)}
    # A hinge's list is as it was before there were slides.
    joint = movable.joint and [_rounded(v) for v in vars(movable.joint).values() if v is not None and v is not False]
    return [movable.category, {name: _rounded(value) for name, value in numbers.items()}, joint, hulls]


def hull_sources(xml: Path) -> dict[str, list]:
    """Return body name -> what its colliding meshes come from: MuJoCo turns and centres the vertices themselves."""
    spec = mujoco.MjSpec.from_file(str(xml))
    sources: dict[str, list] = {}
    for geom in spec.geoms:
        if geom.type == mujoco.mjtGeom.mjGEOM_MESH and (geom.contype or geom.conaffinity):
            mesh = spec.mesh(geom.meshname)
            path = xml.parent / spec.meshdir / mesh.file
            content = path.read_bytes() if mesh.file else np.asarray(mesh.uservert).tobytes()
            numbers = [_rounded(v) for v in (geom.pos, geom.quat, mesh.scale, mesh.refpos, mesh.refquat)]
            sources.setdefault(geom.parent.name, []).append([hashlib.sha256(content).hexdigest(), numbers])
    return sources


def check_scene(scene: Scene, model: mujoco.MjModel) -> None:
    """Raise `SceneError` for absurd poses, masses, walls or maps."""
    path, maps, movables = scene.path, scene.maps, scene.movables
    faults = [*_wall_faults(maps, scene.walls), *_object_faults(maps, movables, model)]
    faults += differences(model, scene.manifest.objects)
    if faults:
        more = f" (and {len(faults) - 1} more faults)" if len(faults) > 1 else ""
        raise SceneError(f"{path}: {faults[0]}{more}; convert the scene again")


def warn_of_reach(scene: Scene) -> None:
    """Warn where most furniture is out of reach, by the gate that the converter wrote."""
    gate = scene.manifest.gates.get("furniture_apart")
    if isinstance(gate, dict) and gate.get("passed") is False:
        warnings.warn(
            f"{scene.path}: more than half of the movable objects stand on floor that no robot can reach from the "
            "largest piece; look at the map with 'python -m converters preview'",
            stacklevel=3,
        )


def _wall_faults(maps: SceneMaps, walls: np.ndarray) -> list[str]:
    if not len(walls):
        return ["scene.xml has no wall: 'structure' has no geom that collides"]
    if not np.isfinite(walls).all():
        return ["a wall of scene.xml has a position or size that is not finite"]
    reach = np.linalg.norm(walls[:, 7:], axis=1, keepdims=True)
    low, high = (walls[:, :3] - reach).min(axis=0), (walls[:, :3] + reach).max(axis=0)
    x0, x1, y0, y1 = _free_extent(maps)
    if min(x0 - low[0], y0 - low[1], high[0] - x1, high[1] - y1) > -BESIDE_M:
        return []
    return [
        f"the free floor of maps.npz reaches from ({x0:.4g}, {y0:.4g}) to ({x1:.4g}, {y1:.4g}) m, expected it within "
        f"the walls of scene.xml, ({low[0]:.4g}, {low[1]:.4g}) to ({high[0]:.4g}, {high[1]:.4g}) m"
    ]


def _object_faults(maps: SceneMaps, movables: Sequence[Movable], model: mujoco.MjModel) -> list[str]:
    data, faults, (x0, x1, y0, y1) = mujoco.MjData(model), [], _free_extent(maps)
    mujoco.mj_kinematics(model, data)
    for movable in movables:
        name = f"object {movable.name}"
        body = model.body(movable.name).id
        if not all(np.isfinite(n).all() for n in (data.xpos[body], data.xquat[body], movable.inertia, movable.boxes)):
            faults.append(f"{name} of scene.xml has numbers that are not finite")
            continue
        boxes, _ = _geoms(model, body)
        down_m = np.einsum("nk,nk->n", np.abs(data.geom_xmat[boxes, 6:]), model.geom_size[boxes])
        base_m, (x, y) = float((data.geom_xpos[boxes, 2] - down_m).min()), movable.pos_w[:2]
        if not (x0 - BESIDE_M < x < x1 + BESIDE_M and y0 - BESIDE_M < y < y1 + BESIDE_M):
            faults.append(f"{name} stands at ({x:.4g}, {y:.4g}) m, expected it on the map's floor")
        if not BASE_M[0] <= base_m <= BASE_M[1]:
            faults.append(f"the base of {name} is at a height of {base_m:.4g} m, expected it on the floor")
        for key, (least, most) in (("mass_kg", MASS_KG), ("friction", FRICTION)):
            if not least <= getattr(movable, key) <= most:
                faults.append(f"{name}: {key} is {getattr(movable, key):g}, expected {least:g} to {most:g}")
    return faults


def _free_extent(maps: SceneMaps) -> tuple[float, float, float, float]:
    """Return the least and largest x, then y, of the free cells, m."""
    rows, columns = np.nonzero(maps.traversable)
    (x, y), side = maps.origin_w, maps.resolution_m
    return x + columns.min() * side, x + (columns.max() + 1) * side, y + rows.min() * side, y + (rows.max() + 1) * side


def _boxes(model: mujoco.MjModel, geoms: np.ndarray) -> np.ndarray:
    return np.concatenate([model.geom_pos[geoms], model.geom_quat[geoms], model.geom_size[geoms]], 1)


def _geoms(model: mujoco.MjModel, body: int) -> tuple[np.ndarray, np.ndarray]:
    """Return a body's boxes and what of it collides."""
    mine = model.body_geomadr[body] + np.arange(model.body_geomnum[body])
    solid = (model.geom_contype[mine] != 0) | (model.geom_conaffinity[mine] != 0)
    return mine[model.geom_type[mine] == mujoco.mjtGeom.mjGEOM_BOX], mine[solid]


def read_movable(model: mujoco.MjModel, xml: Path, name: str, category: str, friction: float) -> Movable:
    """Return a movable body of a compiled scene or single object; `xml` is named in errors, `friction` is sliding."""
    body = mujoco.mj_name2id(model, mujoco.mjtObj.mjOBJ_BODY, name)
    if body < 0:
        raise SceneError(f"{xml}: no body named '{name}', which its JSON file lists; convert it again")
    if model.body_jntnum[body] != 1:
        raise SceneError(f"{xml}: body '{name}' has {model.body_jntnum[body]} joints, expected 1")
    joint = model.body_jntadr[body]
    box, solid = _geoms(model, body)
    if not len(box):
        raise SceneError(f"{xml}: body '{name}' has no box geom to collide with; convert it again")
    tie, slides = None, bool(model.jnt_type[joint] == mujoco.mjtJoint.mjJNT_SLIDE)
    if slides or model.jnt_type[joint] == mujoco.mjtJoint.mjJNT_HINGE:
        dof = model.jnt_dofadr[joint]
        limits = tuple(float(v) for v in model.jnt_range[joint]) if model.jnt_limited[joint] else None
        tie = Joint(
            axis=model.jnt_axis[joint].copy(),
            anchor_m=model.jnt_pos[joint].copy(),
            range=limits,  # type: ignore[arg-type]
            damping=float(np.ravel(model.dof_damping[dof])[0]),
            frictionloss=float(model.dof_frictionloss[dof]),
            slides=slides,
            balanced=bool(model.body_gravcomp[body] == 1.0),
        )
    elif model.jnt_type[joint] != mujoco.mjtJoint.mjJNT_FREE:
        raise SceneError(f"{xml}: joint of '{name}' is neither free nor a hinge or slide")
    return Movable(
        name=name,
        category=category,
        mass_kg=float(model.body_mass[body]),
        inertia=model.body_inertia[body].copy(),
        com_m=model.body_ipos[body].copy(),
        inertia_quat=model.body_iquat[body].copy(),
        pos_w=model.body_pos[body].copy(),
        quat_w=model.body_quat[body].copy(),
        friction=friction,
        boxes=_boxes(model, box),
        hulls=tuple(geom_mesh(model, g)[0] for g in solid if model.geom_type[g] == mujoco.mjtGeom.mjGEOM_MESH),
        joint=tie,
    )


def load_scene(folder: str | Path) -> Scene:
    """Load and check scene.xml, scene.json and maps.npz of a scene folder, or of an `installed` scene.

    Raise `SceneError` if the folder or a file is missing or damaged, or if files disagree.
    """
    return load_scenes([folder])[0]


def load_scenes(folders: Sequence[str | Path]) -> tuple[Scene, ...]:
    """Do `load_scene` for each folder, see `for_each_home`."""
    calls = [(folder, _files(installed(folder))) for folder in folders]
    scenes = tuple(for_each_home(_read_scene, calls, "loading homes"))
    for scene in scenes:
        warn_of_reach(scene)
    return scenes


def _files(folder: Path) -> list[Any]:
    """Return what tells apart the states of a scene's folder: the content of its data, sizes and times of all files."""
    data = [path.read_bytes() for name in ("scene.xml", "scene.json", "maps.npz") if (path := folder / name).is_file()]
    states = [(str(path), path.stat()) for path in sorted(folder.rglob("*")) if path.exists()]
    return [hashlib.sha256(b"".join(data)).hexdigest(), *((path, s.st_size, s.st_mtime_ns) for path, s in states)]


def _read_scene(folder: str | Path, _files: object = None) -> Scene:
    """Do `load_scene` without its warning; `_files` only tells states of the folder apart in a cache."""
    folder = existing(folder, or_set=True)
    manifest, maps = load_manifest(folder), load_maps(folder)
    xml = folder / "scene.xml"
    if not xml.is_file():
        raise SceneError(f"{xml}: no such file; convert the scene again")
    with readable(xml, SceneError, "convert it again", " as MJCF"):
        model = mujoco.MjModel.from_xml_path(str(xml))
    digest = hashlib.sha256(xml.read_bytes() + (folder / "maps.npz").read_bytes()).hexdigest()

    structure = mujoco.mj_name2id(model, mujoco.mjtObj.mjOBJ_BODY, "structure")
    if structure < 0:
        raise SceneError(f"{xml}: no body named 'structure'; convert the scene again")
    box, solid = _geoms(model, structure)
    if len(wrong := np.setdiff1d(solid, box)):
        raise SceneError(f"{xml}: geom '{model.geom(int(wrong[0])).name}' of 'structure' collides but is not a box")

    movables = [read_movable(model, xml, obj.name, obj.category, obj.friction) for obj in manifest.objects]
    walls = _boxes(model, solid)
    for row in walls:
        row[:3] = model.body_pos[structure] + rotate(model.body_quat[structure], row[:3])
    if not np.allclose(model.body_quat[structure], [1, 0, 0, 0]):
        raise SceneError(f"{xml}: body 'structure' is rotated, expected the identity")
    scene = Scene(folder, manifest.name, manifest.split, digest, manifest, maps, walls, tuple(movables))
    check_scene(scene, model)
    return scene
