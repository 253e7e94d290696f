"""Read a scene of a Habitat dataset (ReplicaCAD, HSSD), whose world is y up.

`*.scene_instance.json` may lie anywhere; stages, objects and articulated objects have the names of their configuration
files and URDFs, or are mesh files. A `*semantic_lexicon.json` gives objects the names of their classes.
"""

import collections
import dataclasses
from collections.abc import Iterator
from pathlib import Path
from typing import Annotated, Any

import numpy as np

from converters.read.files import SourceFolder, only_file, read_json
from converters.read.homes.parts import HomePart, home
from converters.read.meshes import SUFFIXES, read_surface
from converters.read.obj import TexturedMesh
from converters.read.urdf import placed, read_urdf, urdf_fronts
from converters.records.errors import PARTS, SceneRejected, check_count
from converters.records.raw import RawScene
from interactive_nav_common.config import Bounds
from interactive_nav_common.records import Reader
from interactive_nav_common.rotations import Y_UP_TO_Z_UP, matrix_from_quat, transform

SCENE, STAGE, OBJECT, ARTICULATED = (
    f".{kind}.json" for kind in ("scene_instance", "stage_config", "object_config", "ao_config")
)
LEXICON = "semantic_lexicon.json"
KEYS = {
    "scene": "stage_instance object_instances articulated_object_instances translation_origin user_defined",
    "instance": "template_name translation rotation translation_origin motion_type uniform_scale non_uniform_scale "
    "fixed_base shader_type user_defined",
    "config": "render_asset collision_asset is_collidable up front scale units_to_meters COM mass friction_coefficient "
    "semantic_id urdf_filepath shader_type requires_lighting force_flat_shading margin inertia restitution_coefficient "
    "join_collision_meshes semantic_asset has_semantic_textures semantic_descriptor_filename nav_asset gravity "
    "user_defined",
}
"""The keys that are read, or that change neither place, size nor colour."""
DEFAULT_MASS_KG = 1.0
"""Habitat's default."""
Number = Annotated[float, Bounds(-1e6, 1e6)]
_DATASET = Reader(SceneRejected, "mend the dataset")


def scenes_of(root: Path) -> list[Path]:
    """Return the scene files of a folder."""
    return sorted(root.rglob(f"*{SCENE}"))


def root_of(scene: Path) -> Path:
    """Return the folder of a scene file's dataset: the nearest one with a dataset's config, if any."""
    near = scene.resolve().parents[:4]
    default = near[1] if near[0].name == "scenes" else near[0]
    return next((folder for folder in near if any(folder.glob("*.scene_dataset_config.json"))), default)


def read_habitat(root: Path, strict: bool = False, chosen: Path | None = None) -> RawScene:
    """Read the only scene of a folder, or the chosen one."""
    source = SourceFolder(root, strict)
    scene = chosen or only_file(root, scenes_of(root), "scenes", ending=SCENE)
    reader = _Reader(source)
    parts = list(reader.parts(scene))
    source.note_counts(f"{scene.name}:", reader.dropped)
    return home(source, "habitat", parts)


class _Reader:
    """Find and read the files that a scene names; count what is dropped."""

    def __init__(self, source: SourceFolder) -> None:
        self.source = source
        self.dropped: collections.Counter[str] = collections.Counter()
        self._files: dict[str, list[Path]] = collections.defaultdict(list)
        for path in sorted(source.root.rglob("*")):
            if path.suffix.lower() in (*SUFFIXES, ".json", ".urdf"):
                self._files[path.name].append(path)
        self._classes = self._lexicon()
        self._assets: dict[tuple[str, str, bool], list[HomePart]] = {}

    def parts(self, path: Path) -> Iterator[HomePart]:
        """Yield the stage, rigid and articulated objects of a scene."""
        scene = self._table(path)
        local = _value(scene, "translation_origin", "", path).lower() == "asset_local"
        if "stage_instance" not in scene:
            raise SceneRejected(f"{path}: has no stage_instance; expected a Habitat scene")
        instances = []
        kinds = {"stage_instance": STAGE, "object_instances": OBJECT, "articulated_object_instances": ARTICULATED}
        for key, kind in kinds.items():
            value = [scene[key]] if kind == STAGE else scene.get(key, [])
            listed = _DATASET.typed(value, list[dict[str, Any]], f"{path}: {key}")
            instances += [(instance, kind) for instance in listed]
        check_count(path, len(instances), PARTS, "instances")
        self._count(scene, "scene")
        for instance, kind in instances:
            yield from self._parts(instance, kind, local, path)

    def _count(self, about: dict[str, Any], kind: str) -> None:
        """Count the keys that are not read."""
        self.dropped.update(f"{key:.60} (not read)" for key in about if key not in KEYS[kind].split())

    def _parts(self, instance: dict[str, Any], kind: str, local: bool, path: Path) -> Iterator[HomePart]:
        self._count(instance, "instance")
        name = _value(instance, "template_name", "", path)
        if not name:
            raise SceneRejected(f"{path}: an instance has no template_name, expected the name of a stage or an object")
        key = name, kind, instance.get("fixed_base") is True
        if key not in self._assets:
            self._assets[key] = (self._articulated if kind == ARTICULATED else self._rigid)(path, *key)
        asset, *_ = assets = self._assets[key]  # with y up, at its centre of mass: the file's, or the middle of its box
        scale = _value(instance, "non_uniform_scale", (1.0, 1.0, 1.0), path)
        scale = scale * _value(instance, "uniform_scale", 1.0, path)
        quat = _value(instance, "rotation", (1.0, 0.0, 0.0, 0.0), path)
        length = float(np.linalg.norm(quat))
        if length < 1e-6 or not (np.abs(scale) > 1e-6).all():
            raise SceneRejected(f"{path}: '{name}' has no usable rotation or scale ({quat.tolist()}, {scale.tolist()})")
        pose = transform(matrix_from_quat(quat / length), _value(instance, "translation", (0.0, 0.0, 0.0), path))
        origin = _value(instance, "translation_origin", "", path).lower()
        if kind == OBJECT and not (origin == "asset_local" or (local and origin != "com")):
            pose[:3, 3] -= pose[:3, :3] @ (asset.pose[:3, 3] * scale)
        turn = transform(Y_UP_TO_Z_UP)
        upright = turn @ np.diag([*scale, 1.0])  # The part's frame has z up as well.
        motion = _value(instance, "motion_type", "", path).lower() or ("static" if kind != OBJECT else "dynamic")
        about = {"pose": turn @ pose @ turn.T, "static": kind == STAGE or motion == "static" or key[2]}
        for asset in assets:
            solid = None if asset.collision is None else placed(asset.collision, upright)
            hinge = None if asset.hinge is None else asset.hinge.moved(upright)
            surface = placed(asset.surface, upright)
            yield dataclasses.replace(asset, surface=surface, collision=solid, hinge=hinge, **about)

    def _rigid(self, path: Path, name: str, kind: str, fixed: bool) -> list[HomePart]:
        config = self._find(name, (kind,))
        if config is None:
            model = self._find(name, SUFFIXES)
            if model is None:
                raise SceneRejected(f"{path}: names '{name}', which is not in {self.source.root}; copy it there")
            config, about = model, {"render_asset": model.name}
        else:
            about = self._table(config)
            self._count(about, "config")
        render = self._mesh(about, "render_asset", config)
        if render is None:
            raise SceneRejected(f"{config}: names no render_asset, expected a mesh file")
        collision = self._mesh(about, "collision_asset", config) if about.get("is_collidable", True) is True else None
        corners = [render.vertices.min(axis=0), render.vertices.max(axis=0)]
        origin = np.mean(corners, axis=0)
        if "COM" in about:
            origin = _value(about, "COM", (0.0, 0.0, 0.0), config)
        mass = _value(about, "mass", DEFAULT_MASS_KG, config) if kind == OBJECT else None
        friction = _value(about, "friction_coefficient", 0.0, config)
        number = about.get("semantic_id") if kind == OBJECT else None
        label = self._classes.get(_DATASET.typed(number, int | None, f"{config}: semantic_id"), "")
        title = Path(name).name + (f"_{label}" if label else "")
        friction = friction if 0 < friction <= 2 else None
        return [HomePart(title, transform(np.eye(3), origin), render, collision, False, mass, friction)]

    def _articulated(self, path: Path, name: str, kind: str, fixed: bool) -> list[HomePart]:
        """Read a URDF, joints at 0; if its base is `fixed`, each front is a part."""
        urdf = self._find(name, (".urdf",))
        config = self._find(name, (kind,))
        if urdf is None and config is not None:
            urdf = config.parent / _value(self._table(config), "urdf_filepath", "", config)
        if urdf is None or not urdf.is_file():
            raise SceneRejected(f"{path}: names '{name}', whose URDF is not in {self.source.root}; copy it there")
        self.dropped["articulated object (its joints are held at 0)"] += not fixed
        file, piece, parts = self.source.inside(urdf), Path(name).name, []
        fronts = urdf_fronts(self.source, file, self.dropped) if fixed else []
        for front, hinge, links in fronts or [("", None, None)]:
            body = read_urdf(self.source, file, "", hold=True, only=links)
            solid = TexturedMesh(*body.collision, None, None)
            # read_urdf keeps the file's frame, and Habitat's URDFs have y up as its other assets have.
            about = body.surface, solid, False, body.mass_kg, body.friction, len(fronts) > 1, "", hinge
            parts.append(HomePart(f"{front}_of_" * bool(front) + piece, np.eye(4), *about))
        return parts

    def _mesh(self, about: dict[str, Any], key: str, config: Path) -> TexturedMesh | None:
        name = _value(about, key, "", config)
        if not name:
            return None
        target = config.parent / name
        if self.source.relative(target) is None or not target.is_file():
            elsewhere = self._files.get(Path(name).name, [])
            if key == "collision_asset" and not elsewhere:
                self.source.note(f"{config.name}: its {key} '{name}' is not there; the visual mesh is decomposed")
                return None
            if not elsewhere:
                raise SceneRejected(f"{config}: names '{name}', which is not in {self.source.root}; copy it there")
            target = elsewhere[0]
        mesh = read_surface(self.source, self.source.inside(target), "")
        up = _value(about, "up", (0.0, 1.0, 0.0), config)
        front = _value(about, "front", (0.0, 0.0, -1.0), config)
        lengths = np.linalg.norm(up), np.linalg.norm(front)
        if min(lengths) < 1e-6 or abs(up @ front) > 1e-3 * lengths[0] * lengths[1]:
            raise SceneRejected(f"{config}: up {up.tolist()} and front {front.tolist()} are not at right angles")
        up, front = up / lengths[0], front / lengths[1]
        frame = np.stack([np.cross(front, up), up, -front])  # to y up, looking along -z
        size = _value(about, "scale", (1.0, 1.0, 1.0), config) * _value(about, "units_to_meters", 1.0, config)
        matrix = transform(frame @ np.diag(size))
        if abs(np.linalg.det(matrix)) < 1e-12:
            raise SceneRejected(f"{config}: scale {size.tolist()} leaves nothing; expected positive numbers")
        return placed(mesh, matrix)

    def _find(self, name: str, endings: tuple[str, ...]) -> Path | None:
        """Return the file that a template name ends in, with or without its ending; the longest common path wins."""
        base = Path(name).name
        paths = [p for end in ("", *endings) for p in self._files.get(base + end, []) if p.name.endswith(endings)]
        folders = Path(name).parent.parts
        return max(paths, key=lambda p: sum(part in p.parts for part in folders), default=None)

    def _table(self, path: Path) -> dict[str, Any]:
        return _DATASET.typed(read_json(self.source.use(self.source.inside(path), "")), dict[str, Any], str(path))

    def _lexicon(self) -> dict[Any, str]:
        """Return class number -> name."""
        names: dict[Any, str] = {}
        for path in (p for same in self._files.values() for p in same if p.name.endswith(LEXICON)):
            for entry in _DATASET.typed(self._table(path).get("classes", []), list[Any], f"{path}: classes"):
                if isinstance(entry, dict) and isinstance(entry.get("id"), int) and isinstance(entry.get("name"), str):
                    names[entry["id"]] = entry["name"]
        return names


def _value(parent: dict[str, Any], key: str, default: Any, path: Path) -> Any:
    """Return a text, a number, or as many numbers as the default has."""
    hint = {str: str, float: Number}.get(type(default)) or tuple[(Number,) * len(default)]
    value = _DATASET.typed(parent.get(key, default), hint, f"{path}: {key}")
    return np.array(value) if isinstance(default, tuple) else value
