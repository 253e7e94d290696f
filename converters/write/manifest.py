"""Measure a finished scene, and build its `SceneManifest` (scene.json) from the results of the stages."""

import dataclasses
import math
from collections.abc import Sequence
from importlib.metadata import version
from typing import Any

import numpy as np
from scipy.sparse import csgraph
from scipy.spatial import ConvexHull, KDTree

from converters.bodies.decompose import DOOR_OVERRIDES, DecomposeConfig
from converters.bodies.objects import PlacedObject, to_world
from converters.geometry.density import ROBOTS, must_push_shares
from converters.geometry.faces import face_areas
from converters.records.errors import Gate
from converters.records.raw import RawScene
from converters.structure.maps import Grid
from converters.write.emit import SceneParts
from interactive_nav_common.grids import clearance, largest_component
from scenes_mjcf.schema import SceneManifest, SceneMaps, SceneObject

NAVIGATION_CELL_M = 0.1
STARTS = 32
"""Places from which paths to all others are measured."""
LEAST_APART_M = 1.0
"""Two places closer than this are no pair: a thin wall between them makes the ratio as large as one likes."""


def shadow(objects: Sequence[PlacedObject], maps: SceneMaps, height_m: float = math.inf) -> np.ndarray:
    """Return [rows, columns] bool: cells with their middle below a movable's hull that reaches below a height."""
    out = np.zeros_like(maps.traversable)
    grid = Grid(0.0, maps.origin_w, out.shape, maps.resolution_m)
    for placed in objects:
        for hull in placed.hulls_b:
            points_w = to_world(placed, hull.vertices)
            if points_w[:, 2].min() <= height_m:
                grid.add_below(out, points_w, 0.0)
    return out


def specific_surface_1_m(surfaces: Sequence[tuple[np.ndarray, np.ndarray]]) -> float:
    """Return the area of meshes over the volume of the convex hull of all of them, 1/m."""
    area_m2 = sum(float(face_areas(vertices, faces).sum()) for vertices, faces in surfaces)
    return area_m2 / float(ConvexHull(np.vstack([vertices for vertices, _ in surfaces])).volume)


def navigation_complexity(free: np.ndarray, cell_m: float, radius_m: float) -> float:
    """Return the largest ratio of shortest path to straight line of two places a metre or more apart.

    Paths are 8-connected over cells of `NAVIGATION_CELL_M` in the largest region for a disc's middle; the result is 1
    without such a pair. Diagonals may cut corners, unlike those of `grids.grid_graph`, which would give larger values.
    """
    step = max(round(NAVIGATION_CELL_M / cell_m), 1)
    mask = largest_component((clearance(free, cell_m) >= radius_m)[step // 2 :: step, step // 2 :: step])
    if not mask.any():
        return 1.0
    places = np.argwhere(mask)
    tree, side_m = KDTree(places), step * cell_m
    graph = tree.sparse_distance_matrix(tree, 1.5, output_type="coo_matrix").tocsr() * side_m
    starts = np.random.default_rng(0).permutation(len(places))[:STARTS]
    way_m = np.asarray(csgraph.dijkstra(graph, directed=False, indices=starts))
    places = places * side_m
    line_m = np.linalg.norm(places[starts][:, None] - places[None], axis=2)
    far = line_m >= LEAST_APART_M
    return float((way_m[far] / line_m[far]).max()) if far.any() else 1.0


def measure_scene(parts: SceneParts, maps: SceneMaps) -> dict[str, Any]:
    """Measure a scene with its visuals.

    Return `movable_share`: share of the traversable floor below movables; `must_push_share`: robot -> share (see
    `converters.geometry.density`); `specific_surface_1_m`; and `navigation_complexity` for the smallest robot.
    """
    structure, objects = parts.structure_visual, parts.objects
    assert structure is not None
    visuals = zip(objects, parts.object_visuals, strict=True)
    surfaces = [(structure.vertices, structure.faces), *((to_world(o, v.vertices), v.faces) for o, v in visuals)]
    below = shadow(objects, maps)
    free = {robot: maps.traversable & ~shadow(objects, maps, facts.height_m) for robot, facts in ROBOTS.items()}
    must_push = must_push_shares(maps.traversable, free, maps.resolution_m)
    smallest = min(ROBOTS, key=lambda robot: ROBOTS[robot].radius_m)
    complexity = navigation_complexity(free[smallest], maps.resolution_m, ROBOTS[smallest].radius_m)
    return {
        "movable_share": round(float(below[maps.traversable].mean()), 4),
        "must_push_share": {robot: round(share, 4) for robot, share in must_push.items()},
        "specific_surface_1_m": round(specific_surface_1_m(surfaces), 4),
        "navigation_complexity": round(complexity, 3),
    }


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
    fallbacks: dict[str, str],
    maps: SceneMaps,
) -> SceneManifest:
    """Return a scene's manifest: measurements, sources and gates, with relative paths.

    `fallbacks` names the models that one convex hull replaces, and why.
    """
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
        | {"convex_hull_only": sorted(fallbacks), "from_source": sorted(k for k, c in raw.cads.items() if c.pieces)},
        gates={g.name: g.as_dict() for g in gates},
        versions={name: version(name) for name in PACKAGES},
        alignment=tuple(alignment),
        measures=measure_scene(parts, maps),
        warnings=(
            *raw.warnings,
            *(f"{why}; its convex hull stands for it" for _, why in sorted(fallbacks.items())),
            *(warning for gate in gates for warning in gate.warnings),
        ),
    )
