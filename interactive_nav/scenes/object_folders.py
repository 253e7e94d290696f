"""Read the folders of `python -m converters object` that `NavConfig.objects` names as small objects."""

import dataclasses
import hashlib
from collections.abc import Sequence
from pathlib import Path

import mujoco
import numpy as np

from interactive_nav.scenes.objects import Box, SmallObject, pick
from interactive_nav.scenes.scene import Movable, body_task_parts, hull_sources, read_movable
from interactive_nav_common.config import Positive
from interactive_nav_common.files import check_name
from interactive_nav_common.records import Reader
from interactive_nav_common.untrusted.reading import check_named
from scenes_mjcf.schema import CATEGORIES, SceneError

RGBA = (0.6, 0.6, 0.6, 1.0)


@dataclasses.dataclass(frozen=True)
class _About:
    """What is required of object.json."""

    name: str
    category: str
    friction: Positive


_OBJECTS = Reader(SceneError, "expected a folder made by 'python -m converters object'")


@dataclasses.dataclass(frozen=True)
class ConvertedObject(SmallObject):
    """A small object from a folder; its boxes are those of `object.xml` as it stands at rest, lowest point at 0."""

    sha256: str
    """Of object.xml and the hulls."""
    movable: Movable = dataclasses.field(repr=False, compare=False)
    """Its body in the same frame: mass properties and hulls as converted."""
    hull_sources: list = dataclasses.field(repr=False, compare=False)
    """What its hulls come from."""

    @property
    def task_parts(self) -> tuple:
        return *super().task_parts, body_task_parts(self.movable, self.hull_sources)


def small_objects(num_objects: int, split: str, folders: Sequence[str]) -> tuple[SmallObject, ...]:
    """Return the small objects of an environment: the folders in turn where there are some, else the builtin ones."""
    if not folders:
        return pick(num_objects, split)
    models = [load_object(folder) for folder in folders]
    return tuple(models[i % len(models)] for i in range(num_objects))


def load_object(folder: str | Path) -> ConvertedObject:
    """Read and check a folder with `object.xml`, `object.json` and `assets/`."""
    from scenes_mjcf.categories import class_id  # which imports the world that small objects are part of

    folder = Path(folder)
    xml, described = folder / "object.xml", folder / "object.json"
    about = _OBJECTS.record(_OBJECTS.json(described), _About, str(described), others=True)
    category, friction = about.category, about.friction
    name = check_name(about.name, f"{described}: name", SceneError)
    check_named(xml, SceneError, _OBJECTS.remedy)
    try:
        hulls = sorted((folder / "assets").glob("*_hull_*.obj"))
        sha256 = hashlib.sha256(b"".join(p.read_bytes() for p in (xml, *hulls))).hexdigest()
        model = mujoco.MjModel.from_xml_path(str(xml))
    except (OSError, ValueError) as error:
        reason = str(error).splitlines()[0]
        raise SceneError(f"{folder}: is no usable object ({reason}), {_OBJECTS.remedy}") from error
    if category not in CATEGORIES:
        raise SceneError(f"{folder}: category is '{category}', expected one of {', '.join(CATEGORIES)}")
    movable = _standing(read_movable(model, xml, name, category, friction))
    rows = movable.boxes.tolist()
    boxes = tuple(Box(tuple(row[:3]), tuple(row[7:]), tuple(row[3:7])) for row in rows)  # type: ignore[arg-type]
    about_physics = movable, hull_sources(xml).get(name, [])
    return ConvertedObject(
        name, category, class_id(category), movable.mass_kg, friction, boxes, RGBA, (), sha256, *about_physics
    )


def _standing(movable: Movable) -> Movable:
    """Return the body as it stands at rest over the origin: its frame level, its boxes' lowest corner at z = 0."""
    turn = np.zeros(9)
    mujoco.mju_quat2Mat(turn, movable.quat_w)
    turn = turn.reshape(3, 3)

    def turned(quat: np.ndarray) -> np.ndarray:
        out = np.zeros(4)
        mujoco.mju_mulQuat(out, movable.quat_w, quat)
        return out

    boxes = np.asarray([[*(turn @ r[:3]), *turned(r[3:7]), *r[7:]] for r in movable.boxes])
    drop = np.array([0.0, 0.0, min(z for r in boxes for _, _, z in Box(r[:3], r[7:], r[3:7]).corners_m)])
    boxes[:, :3] -= drop
    return dataclasses.replace(
        movable,
        pos_w=np.zeros(3),
        quat_w=np.array([1.0, 0.0, 0.0, 0.0]),
        com_m=turn @ movable.com_m - drop,
        inertia_quat=turned(movable.inertia_quat),
        boxes=boxes,
        hulls=tuple(h @ turn.T - drop for h in movable.hulls),
    )
