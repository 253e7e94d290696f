"""Convert one mesh or URDF to a folder with an MJCF body (`object.xml`), `object.json` and assets.

Body frame: origin at the middle of the base, z up. The body has a free joint and rests on a level floor.
"""

import dataclasses
import json
import math
import re
from collections.abc import Callable
from importlib.metadata import version
from pathlib import Path
from typing import Any

import mujoco
import numpy as np

from converters.bodies.decompose import DecomposeConfig, cache_folder, decompose_all
from converters.bodies.objects import PlacedObject, physical_properties
from converters.check.gates import collide_with, physical_values
from converters.check.settle import settle
from converters.generating import ObjectConfig
from converters.geometry.boxes import Hull, convex_hull, fit_box
from converters.geometry.faces import merge_vertices
from converters.read.files import SourceFolder
from converters.read.meshes import clean_surface, read_surface
from converters.read.urdf import RigidObject, read_urdf
from converters.records.errors import SceneRejected
from converters.write.emit import SceneParts, build_spec, write_scene
from converters.write.manifest import PACKAGES
from converters.write.texture import NO_CLOUD, draw_objects
from interactive_nav_common.files import whole_folder
from interactive_nav_common.rotations import Y_UP_TO_Z_UP, matrix_from_quat
from scenes_mjcf.categories import TABLE
from scenes_mjcf.schema import CATEGORIES

FOOT_SHARE = 0.03
"""Of the height: what ends within this above the base is brought down to it. Collision meshes come from voxels, and
a pot on unequal hulls rests tilted."""
TEXELS = 256
FACES = 3000


def guess_category(*names: str) -> str | None:
    """Return the category whose word stands in a name, the longest word first; None where there is none."""
    text = re.sub(r"[^a-z]", "", " ".join(names).lower())
    return max(((len(w), c.name) for c in TABLE for w in c.words if w in text), default=(0, None))[1]


def read_object(path: Path, config: ObjectConfig) -> tuple[RigidObject, SourceFolder]:
    """Read a URDF or a mesh, in metres and z up."""
    source = SourceFolder(config.within or path.parent, config.strict)
    relative = source.inside(path)
    if path.suffix.lower() == ".urdf":
        item = read_urdf(source, relative, "give a mesh or a URDF")
    else:
        surface = read_surface(source, relative, "give a mesh or a URDF")
        item = RigidObject(path.stem, surface, None, (surface.vertices, surface.faces), None, None)
    turn = config.scale * (Y_UP_TO_Z_UP if config.up == "y" else np.eye(3))
    pieces = None if item.pieces is None else tuple((v @ turn.T, f) for v, f in item.pieces)
    solid = (item.collision[0] @ turn.T, item.collision[1])
    surface = dataclasses.replace(item.surface, vertices=item.surface.vertices @ turn.T)
    return dataclasses.replace(item, surface=surface, pieces=pieces, collision=solid), source


def _level_feet(points: np.ndarray, foot_m: float) -> Hull:
    """Return the hull of (n, 3) points, body frame, with its lowest points at the base z = 0, also after thickening."""
    level = points.copy()
    level[level[:, 2] < foot_m, 2] = 0.0
    hull = convex_hull(np.vstack([points, level]))
    return dataclasses.replace(hull, vertices=hull.vertices - [0.0, 0.0, min(float(hull.vertices[:, 2].min()), 0.0)])


def convert_object(
    path: Path,
    target: Path,
    config: ObjectConfig,
    cache: Path | None = None,
    warn: Callable[[str], None] = lambda warning: None,
) -> dict[str, Any]:
    """Convert one mesh or URDF atomically to the folder `target`; return the content of `object.json`.

    The URDF gives mass, friction and collision mesh unless `config` sets them. Inertia follows from hulls and mass.
    """
    if not path.is_file():
        raise SceneRejected(f"{path}: no such file; give a mesh (OBJ, PLY, STL, GLB, ...) or a URDF")
    with whole_folder(target, config.overwrite) as folder:
        item, source = read_object(path, config)
        category = config.category or guess_category(item.name, path.stem)
        if category is None:
            source.note(f"the name {item.name} tells no category: it is 'other', unless --category says so")
        elif category not in CATEGORIES:
            raise SceneRejected(f"category is '{category}', expected one of {', '.join(CATEGORIES)}")
        category = category or "other"
        for warning in source.warnings:
            warn(warning)
        low, high = item.surface.vertices.min(axis=0), item.surface.vertices.max(axis=0)
        if not 0.005 < (high - low).max() < 10.0:
            raise SceneRejected(
                f"{path}: is {(high - low).max():g} m long, expected 0.5 cm to 10 m; give --scale for another unit"
            )
        hulls, hull_source = _hulls(item, path, config, source, cache)
        base = np.array([*(low + high)[:2] / 2, min(float(h.vertices[:, 2].min()) for h in hulls)])
        hulls = tuple(_level_feet(h.vertices - base, FOOT_SHARE * float(high[2] - low[2])) for h in hulls)
        surface = dataclasses.replace(item.surface, vertices=item.surface.vertices - base)
        mass_kg, mass_source = _given(config.mass_kg, item.mass_kg, "density")
        friction, friction_source = _given(config.friction, item.friction, "category")
        physical = physical_properties(category, hulls, mass_kg, friction)
        mesh = clean_surface(source, path.name, surface)
        boxes = tuple(fit_box(h, 0.0) for h in hulls)
        placed = PlacedObject(target.name, category, item.name, *mesh, hulls, boxes, surface_b=surface)
        # Points twice as dense as the texels of the picture.
        (drawn,) = draw_objects([placed], [NO_CLOUD], FACES, TEXELS, least_m=1e-4)
        parts = settle(SceneParts(placed.name, (placed,), (physical,), ())).parts
        about = {
            "source_name": item.name,
            "source": {"sha256": dict(sorted(source.sha256.items()))},
            "warnings": source.warnings,
            "versions": {name: version(name) for name in PACKAGES},
            "name": target.name,
            "category": category,
            "mass_kg": round(physical.mass_kg, 5),
            "mass_source": mass_source,
            "friction": physical.friction,
            "friction_source": friction_source,
            "n_hulls": len(hulls),
            "hull_source": hull_source,
            "hull_volume_m3": round(physical.volume_m3, 8),
            "size_m": [round(float(v), 4) for v in high - low],
            "rest": _rest(parts),
        }
        _write(dataclasses.replace(parts, object_visuals=(drawn.mesh,)), about, folder)
    return about


def _hulls(
    item: RigidObject, path: Path, config: ObjectConfig, source: SourceFolder, cache: Path | None
) -> tuple[tuple[Hull, ...], str]:
    if item.pieces is not None:
        return tuple(Hull(*p) for p in item.pieces), "collision mesh"
    vertices, faces, _ = merge_vertices(*item.collision)
    search = DecomposeConfig(seed=config.seed, timeout_s=config.timeout_s)
    meshes = {path.name: (vertices, faces)}
    result = decompose_all(meshes, search, 1, cache or cache_folder(), strict=config.strict)
    for why in result.fallbacks.values():
        source.note(f"{why}; its convex hull stands for it")
    return result.hulls[path.name], "convex hull" if result.fallbacks else "coacd"


def _given(option: float | None, urdf: float | None, default: str) -> tuple[float | None, str]:
    """Return the value that a source gives, an option before the URDF, and where it came from."""
    return (option, "given") if option is not None else (urdf, default if urdf is None else "urdf")


def _rest(parts: SceneParts) -> dict[str, Any]:
    """Return the pose at rest on a level floor, and how far hulls and boxes drift from it in the gates' time."""
    (placed,) = parts.objects
    up = matrix_from_quat(placed.quaternion_w)[:, 2]
    result: dict[str, Any] = {
        "position_m": [round(float(v), 6) + 0.0 for v in placed.position_w],
        "quaternion_wxyz": [round(float(v), 9) + 0.0 for v in placed.quaternion_w],
        "tilt_deg": round(math.degrees(math.acos(float(np.clip(up[2], -1, 1)))), 3),
    }
    for shape, name in (("hull", "hulls"), ("box", "boxes")):
        values = physical_values(collide_with(build_spec(parts), shape))
        if not values["finite"]:
            raise SceneRejected(f"{placed.name}: its simulation is not finite with {name}; give another collision mesh")
        result |= {
            f"drift_{name}_m": round(values["drift"], 6),
            f"turn_{name}_deg": round(values["turn"], 4),
            f"penetration_{name}_m": round(values["penetration"], 6),
        }
    return result


def _write(parts: SceneParts, about: dict[str, Any], folder: Path) -> None:
    """Write `object.json`, `assets/` and `object.xml`: the scene's file without floor, light and structure."""
    (placed,) = parts.objects
    centred = dataclasses.replace(placed, position_w=placed.position_w * [0.0, 0.0, 1.0])
    write_scene(dataclasses.replace(parts, objects=(centred,)), folder)
    path = folder / "scene.xml"
    spec = mujoco.MjSpec.from_file(str(path))
    floor = [g for g in spec.worldbody.geoms if g.name == "floor"]
    for part in (*floor, *spec.lights, spec.body("structure")):
        spec.delete(part)
    spec.compile()
    path.unlink()
    (folder / "object.xml").write_text(spec.to_xml(), encoding="utf-8")
    text = json.dumps(about, indent=1, sort_keys=True, allow_nan=False)
    (folder / "object.json").write_text(text + "\n", encoding="utf-8")
