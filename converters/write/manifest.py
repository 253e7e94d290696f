"""Build the `SceneManifest` (scene.json) from the results of the stages."""

import dataclasses
from importlib.metadata import version
from typing import Any

from converters.bodies.decompose import DOOR_OVERRIDES, DecomposeConfig
from converters.records.gate import Gate
from converters.records.raw import RawScene
from converters.write.emit import SceneParts
from converters.write.measures import measure_scene
from scenes_mjcf.schema import SceneManifest, SceneMaps, SceneObject

PACKAGES = ("mujoco", "coacd", "trimesh", "fast-simplification", "xatlas", "numpy", "scipy", "pillow", "shapely")


def scene_objects(parts: SceneParts) -> tuple[SceneObject, ...]:
    """Return the scene's movable objects, in its order."""
    return tuple(
        SceneObject(
            name=placed.name,
            category=placed.category,
            mass_kg=round(physical.mass_kg, 4),
            friction=physical.friction,
            n_hulls=len(placed.hulls_b),
            cad_id=placed.cad_id,
        )
        for placed, physical in zip(parts.objects, parts.physical, strict=True)
    )


def make_manifest(
    raw: RawScene,
    split: str,
    parts: SceneParts,
    floor_area_m2: float,
    alignment: list[dict[str, Any]],
    gates: tuple[Gate, ...],
    decompose: DecomposeConfig,
    fallbacks: dict[str, str] | None = None,
    maps: SceneMaps | None = None,
) -> SceneManifest:
    """Collect what a scene is, where it came from and which gates it passed; all paths are relative.

    `fallbacks` names the models whose one convex hull stands for them, and why; with `maps`, it is measured too.
    """
    fell = fallbacks or {}
    parameters = {k: v for k, v in dataclasses.asdict(decompose).items() if k != "timeout_s"}
    return SceneManifest(
        name=parts.name,
        split=split,  # pyright: ignore[reportArgumentType]: load_manifest checks it
        source={"format": raw.source_format, "sha256": raw.sources},
        licence=raw.licence,
        floor_area_m2=round(floor_area_m2, 3),
        objects=scene_objects(parts),
        collision={"method": "coacd", "boxes": "oriented box of each hull", "doors": DOOR_OVERRIDES}
        | parameters
        | {"convex_hull_only": sorted(fell), "from_source": sorted(k for k, c in raw.cads.items() if c.pieces)},
        gates={g.name: g.as_dict() for g in gates},
        versions={name: version(name) for name in PACKAGES},
        alignment=tuple(alignment),
        measures=measure_scene(parts, maps) if maps is not None else {},
        warnings=(
            *raw.warnings,
            *(f"{why}; its convex hull stands for it" for _, why in sorted(fell.items())),
            *(warning for gate in gates for warning in gate.warnings),
        ),
    )
