"""Convert a raw folder to a scene folder: read it, run stages that are functions of arrays, write, rename."""

import concurrent.futures
import contextlib
import dataclasses
import functools
import multiprocessing
from collections.abc import Callable
from pathlib import Path
from typing import Any

import mujoco
import numpy as np

from converters.annotate.session import with_annotations
from converters.bodies.decompose import DOOR_OVERRIDES, DecomposeConfig, Decomposition, cache_folder, decompose_all
from converters.bodies.objects import PlacedObject, align_objects, name_objects, physical_properties, place_object
from converters.check.gates import drawn_shares, evaluate, kept_share
from converters.check.settle import Settled, settle
from converters.clock import Clock, Report
from converters.geometry.boxes import Hull
from converters.geometry.faces import face_labels, sample_faces, simplify_open, simplify_parts
from converters.propose.proposals import floor_of, with_retrieved
from converters.read.homes.parts import built_in
from converters.read.source import read_source
from converters.read.surfaces import split_storeys
from converters.records.errors import Gate, SceneRejected
from converters.records.raw import (
    ATTRIBUTION,
    CATEGORY_LABELS,
    OTHER_PROP,
    ColourCloud,
    RawScene,
    TexturedMesh,
    VisualMesh,
    at_origin,
)
from converters.structure.clean import LIFT_M, CutResult, cut_furniture, level_floor
from converters.structure.fill import fill_holes, wall_planes
from converters.structure.maps import FloorPlan, make_floor_plan, resample
from converters.structure.walls import main_direction, wall_boxes
from converters.write.emit import SceneParts, write_scene
from converters.write.light import VOXEL_M, Daylight, daylight
from converters.write.manifest import make_manifest, scene_objects
from converters.write.texture import Drawn, as_it_is, bake_structure, colour_cloud, draw_objects
from interactive_nav_common.files import check_name, part_folder, publish, write_text
from interactive_nav_common.jobs.cache import NOT_HASHED, StageCache
from interactive_nav_common.rotations import matrix_from_quat
from scenes_mjcf.schema import SceneManifest, SceneMaps, save_manifest, save_maps

MODELLED = 10**6, 4096
"""Faces, and pixels a side, up to which a structure without furniture is drawn as it is: somebody modelled it."""
TURNED_M = 0.1
"""`bake_structure`'s word for homes that consist of parts."""
PARALLEL_OBJECTS = 8
"""From so many objects on, starting processes for their textures pays."""


@dataclasses.dataclass(frozen=True)
class ConvertConfig:
    """Choices of one conversion."""

    format: str = "auto"
    up: str = dataclasses.field(default="auto", metadata=NOT_HASHED)
    """Of a mesh file: its axis that points up."""
    unit: str = dataclasses.field(default="auto", metadata=NOT_HASHED)
    mirror: bool = dataclasses.field(default=False, metadata=NOT_HASHED)
    root: Path | None = dataclasses.field(default=None, metadata=NOT_HASHED)
    """Of an MJCF or Gazebo home: the folder that may be read; None: the home's."""
    split: str = dataclasses.field(default="train", metadata=NOT_HASHED)
    jobs: int = dataclasses.field(default=2, metadata=NOT_HASHED)
    seed: int = 0
    """Seed of coacd's search."""
    overwrite: bool = dataclasses.field(default=False, metadata=NOT_HASHED)
    strict: bool = dataclasses.field(default=False, metadata=NOT_HASHED)
    """Refuse what would be repaired with a warning."""
    timeout_s: float = dataclasses.field(default=240.0, metadata=NOT_HASHED)
    """Of the decomposition of one model."""
    structure_faces: int = 16000
    object_faces: int = 3000
    """Most, where a simplification within 1 cm leaves more."""
    structure_texture: int = 1024
    object_texture: int = 256
    keep: bool = dataclasses.field(default=True, metadata=NOT_HASHED)
    """Keep the results of stages for the next conversion of the same source."""
    auto_align: bool = dataclasses.field(default=False, metadata=NOT_HASHED)
    """Fits library models to labelled furniture that has no annotation."""
    library: Path | None = dataclasses.field(default=None, metadata=NOT_HASHED)
    """Folder with `cad/` for that; None: the source folder, or the packaged furniture where it has none."""

    @property
    def search(self) -> DecomposeConfig:
        """Return the parameters of the decomposition."""
        return DecomposeConfig(seed=self.seed, timeout_s=self.timeout_s)


@dataclasses.dataclass(frozen=True)
class Converted:
    """The result of `convert`."""

    folder: Path
    manifest: SceneManifest
    gates: tuple[Gate, ...]
    settled: Settled
    n_walls: int
    stage_s: dict[str, float]
    """Stage -> seconds."""
    worker_mib: float = 0.0
    """Most memory that one of the decomposition's processes held."""


def _structure_visual(
    raw: RawScene,
    vertices_w: np.ndarray,
    keep: np.ndarray,
    plan: FloorPlan,
    annotated: tuple[PlacedObject, ...],
    config: ConvertConfig,
) -> VisualMesh:
    """Return the scan as it is where it is small and whole; else levelled, filled, simplified and textured."""
    # As the levelled floor of a scan: above the plane that collides. A generated structure brings that with it.
    lift = np.array([0.0, 0.0, LIFT_M if raw.scan.furnished else 0.0])
    scanned = TexturedMesh(vertices_w + lift, raw.scan.faces, raw.scan.corner_uv, raw.scan.texture)
    most = (config.structure_faces, config.structure_texture) if raw.scan.furnished else MODELLED
    small = as_it_is(scanned, *most)
    if small is not None and keep.all() and not raw.picture:
        return small
    kept = np.flatnonzero(keep)
    level = level_floor(vertices_w, raw.scan.faces, raw.scan.labels)
    cloud = colour_cloud(raw.scan, level, kept)
    if raw.picture:
        drawn, faces = simplify_parts(raw.picture, config.structure_faces)
        drawn = drawn + (vertices_w[0] - raw.scan.vertices[0]) + lift
        # A home's parts touch, back to back and on top of one another: each face takes colours that look as it does.
        turned_m, light = TURNED_M if raw.scan.furnished else 0.0, None
        if raw.lamps or raw.windows:
            light = _light(raw, cloud.points, annotated, vertices_w[0] - raw.scan.vertices[0])
        return bake_structure(drawn, faces, cloud, config.structure_texture, turned_m, light)
    scan = simplify_open(level, raw.scan.faces[kept], config.structure_faces)
    planes = wall_planes(level, raw.scan.faces[kept], raw.scan.labels)
    (points, faces), clouds = fill_holes(planes, plan, annotated, cloud, scan)
    whole = np.vstack([scan[0], points]), np.vstack([scan[1], faces + len(scan[0])])
    joined = ColourCloud(*map(np.vstack, zip(cloud, *clouds, strict=True)))
    return bake_structure(*whole, joined, config.structure_texture)


def _light(raw: RawScene, points: np.ndarray, annotated: tuple[PlacedObject, ...], to_world_m: np.ndarray) -> Daylight:
    """Return the light in a home among points (n, 3) of its structure and its furniture, world frame."""
    solid = [o.vertices_b[o.faces] @ matrix_from_quat(o.quaternion_w).T + o.position_w for o in annotated]
    corners = np.vstack(solid).reshape(-1, 3) if solid else np.zeros((0, 3))
    furniture, _ = sample_faces(corners, np.arange(len(corners)).reshape(-1, 3), VOXEL_M / 2)
    lamps = [dataclasses.replace(lamp, at=lamp.at + to_world_m) for lamp in raw.lamps]
    windows = [dataclasses.replace(window, middle=window.middle + to_world_m) for window in raw.windows]
    return daylight(np.vstack([points, furniture]), lamps, windows)


def _object_visuals(
    raw: RawScene, vertices_w: np.ndarray, owner: np.ndarray, annotated: tuple[PlacedObject, ...], config: ConvertConfig
) -> list[Drawn]:
    """Draw every object, model by model, side by side in processes."""
    models: dict[tuple[str, bytes], list[int]] = {}
    for k, placed in enumerate(annotated):
        models.setdefault((placed.cad_id, placed.vertices_b.tobytes()), []).append(k)
    # A modelled structure shows nothing of what stands in it.
    shown = np.full_like(owner, -1) if raw.picture else owner
    clouds = [colour_cloud(raw.scan, vertices_w, np.flatnonzero(shown == k)) for k in range(len(annotated))]
    groups = [([annotated[k] for k in of], [clouds[k] for k in of]) for of in models.values()]
    draw = functools.partial(draw_objects, most_faces=config.object_faces, size=config.object_texture)
    if config.jobs < 2 or len(groups) < PARALLEL_OBJECTS:
        drawn = [draw(*group) for group in groups]
    else:
        # Not forked: the caller may hold threads.
        context = multiprocessing.get_context("spawn")
        with concurrent.futures.ProcessPoolExecutor(min(config.jobs, len(groups)), mp_context=context) as pool:
            drawn = list(pool.map(draw, *zip(*groups, strict=True)))
    places = [k for of in models.values() for k in of]
    by_place = dict(zip(places, [one for some in drawn for one in some], strict=True))
    return [by_place[k] for k in range(len(annotated))]


@dataclasses.dataclass(frozen=True)
class Placed:
    """One floor with its furniture at rest: the results of the stages from `align` to `settle`."""

    raw: RawScene
    """With the models that were retrieved for it."""
    floor_m: float
    vertices_w: np.ndarray
    """(n, 3) of the scan, m."""
    rows: list[dict[str, Any]]
    """How each annotation compares with its pose re-solved from keypoints."""
    decomposed: Decomposition
    annotated: tuple[PlacedObject, ...]
    """At the annotated poses."""
    cut: CutResult
    plan: FloorPlan
    maps: SceneMaps
    settled: Settled


def _place(raw: RawScene, config: ConvertConfig, clock: Clock, stages: StageCache, cache: Path) -> Placed:
    """Run the stages from `align` to `settle`."""
    with clock.stage("align") as progress:
        raw = with_retrieved(raw, config.library, progress) if config.auto_align else raw
        poses, rows = align_objects(raw)
        floor_m = floor_of(raw)
        vertices_w = raw.scan.vertices - [0.0, 0.0, floor_m]
        yaw = main_direction(vertices_w, raw.scan.faces, raw.scan.labels)
    with clock.stage("decompose") as progress:
        # The hulls of every model: the convex pieces that it came with, else coacd's.
        bare = {k: c for k, c in sorted(raw.cads.items()) if c.pieces is None}
        doors = {k: DOOR_OVERRIDES for k, c in bare.items() if c.category == "door"}
        meshes = {k: (c.vertices, c.faces) for k, c in bare.items()}
        decomposed = decompose_all(meshes, config.search, config.jobs, cache, progress, doors, config.strict)
        given = {k: tuple(Hull(*p) for p in c.pieces) for k, c in raw.cads.items() if c.pieces is not None}
        decomposed = dataclasses.replace(decomposed, hulls=decomposed.hulls | given)
        annotated = tuple(
            place_object(name, a, raw.cads[a.cad_id], decomposed.hulls[a.cad_id], pose, floor_m, yaw)
            for name, a, pose in zip(name_objects(raw.annotations), raw.annotations, poses, strict=True)
        )
        cads = [raw.cads[o.cad_id] for o in annotated]
        physical = tuple(
            physical_properties(o.category, o.hulls_b, cad.mass_kg, cad.friction)
            for o, cad in zip(annotated, cads, strict=True)
        )
    with clock.stage("cut"):
        cut = stages.call(cut_furniture, vertices_w, raw.scan.faces, raw.scan.labels, annotated, raw.scan.furnished)
    with clock.stage("map"):
        small = (not raw.scan.furnished) & (face_labels(raw.scan.labels, raw.scan.faces) == OTHER_PROP)
        kept = vertices_w, raw.scan.faces[cut.keep & ~small], raw.scan.labels
        plan = stages.call(make_floor_plan, *kept, annotated, raw.given_map, yaw, bool(raw.picture))
        walls = stages.call(wall_boxes, plan)
        traversable, origin = resample(plan.grid, plan.traversable, plan.grid.resolution_m)
        if not traversable.any():
            raise SceneRejected("scan: the traversable map is empty; the scan needs visible floor")
        maps = SceneMaps(traversable, plan.grid.resolution_m, origin, floor_m)
    with clock.stage("settle"):
        unsettled = SceneParts(raw.name, annotated, physical, walls)
        fitted = [k for k, a in enumerate(raw.annotations) if a.confidence is not None]
        settled = settle(unsettled, bool(raw.picture), fitted) if annotated else Settled(unsettled, (), ())
    return Placed(raw, floor_m, vertices_w, rows, decomposed, annotated, cut, plan, maps, settled)


def _judge(
    placed: Placed, parts: SceneParts, drawn: list[Drawn], config: ConvertConfig, folder: Path
) -> tuple[SceneManifest, tuple[Gate, ...]]:
    """Run the gates on a floor that is written; write and return its manifest."""
    structure, plan, faces = parts.structure_visual, placed.plan, placed.raw.scan.faces[placed.cut.owner < 0]
    assert structure is not None
    shares = {
        "scan_kept": kept_share(placed.vertices_w, faces, (structure.vertices, structure.faces)),
        "floor_open": plan.open_share,
    }
    # Of each object: how it settled, how much of it the scan showed and what is drawn of its surface.
    moves = zip(placed.settled.displacement_m, placed.settled.drop_m, strict=True)
    rows = []
    for row, (shift_m, drop_m), one, placed_object in zip(placed.rows, moves, drawn, placed.annotated, strict=True):
        settled = {"settle_shift_m": shift_m, "settle_drop_m": drop_m, "texture_seen_share": round(one.shown_share, 3)}
        shown = {"drawn_area_share": round(one.kept_share, 3), "drawn_off_m": round(one.off_m, 4)}
        hinge = placed_object.hinge
        rows.append(row | settled | shown | ({} if hinge is None else {"hinge_assumed": hinge.assumed}))
    spec = mujoco.MjSpec.from_file(str(folder / "scene.xml"))
    gates = evaluate(spec, placed.maps, scene_objects(parts), drawn_shares(rows), shares)
    area_m2, single = float(plan.traversable.sum()) * plan.grid.resolution_m**2, placed.decomposed.fallbacks
    manifest = make_manifest(placed.raw, config.split, parts, area_m2, rows, gates, config.search, single, placed.maps)
    rounded = {name: round(share, 4) for name, share in shares.items()}
    manifest = dataclasses.replace(manifest, floor_unseen_m2=round(plan.unseen_m2, 3), **rounded)
    save_manifest(manifest, folder)
    return manifest, gates


def convert_raw(raw: RawScene, folder: Path, config: ConvertConfig, clock: Clock, cache: Path) -> Converted:
    """Run every stage after reading on one floor; write into `folder`, which exists and is empty."""
    stages = StageCache(cache, keep=config.keep)
    placed = _place(raw, config, clock, stages, cache)
    limits: list[str] = []
    while held := placed.settled.held:
        # Structure that is new changes the map and the walls, and with them where everything else comes to rest.
        config, names = dataclasses.replace(config, auto_align=False), {o.name: o.cad_id for o in placed.annotated}
        beside = {k: names.get(name, "a wall, or what is built in") for k, name in held.items()}
        limits += [words for k, words in placed.settled.limits.items() if k in held]
        placed = _place(built_in(placed.raw, beside, placed.settled.limits), config, clock, stages, cache)
    if limits := [*limits, *placed.settled.limits.values()]:
        line = f"fronts that open less far than their joints, for what they would hit: {', '.join(limits)}"
        placed = dataclasses.replace(placed, raw=dataclasses.replace(placed.raw, warnings=(*placed.raw.warnings, line)))
    raw, vertices_w, cut = placed.raw, placed.vertices_w, placed.cut
    with clock.stage("texture") as progress:
        structure = stages.call(_structure_visual, raw, vertices_w, cut.keep, placed.plan, placed.annotated, config)
        progress(0.5)
        drawn = stages.call(_object_visuals, raw, vertices_w, cut.owner, placed.annotated, config)
    with clock.stage("write"):
        down = np.array([0.0, 0.0, placed.floor_m])
        parts = dataclasses.replace(
            placed.settled.parts,
            structure_visual=structure,
            object_visuals=tuple(one.mesh for one in drawn),
            windows=tuple(dataclasses.replace(w, middle=w.middle - down) for w in placed.raw.windows),
        )
        write_scene(parts, folder)
        save_maps(placed.maps, folder)
    with clock.stage("gates"):
        manifest, gates = _judge(placed, parts, drawn, config, folder)
    memory_mib = placed.decomposed.worker_mib
    return Converted(folder, manifest, gates, placed.settled, len(parts.walls), clock.seconds, memory_mib)


def convert_building(
    source: Path,
    target: Path,
    config: ConvertConfig,
    report: Report | None = None,
    cache: Path | None = None,
    warn: Callable[[str], None] = lambda warning: None,
    floors: int | None = None,
    annotations: Path | None = None,
) -> tuple[Converted, ...]:
    """Convert one raw folder, floor by floor; either all scene folders appear, or none.

    A building of several floors gives `<target>_0`, `<target>_1` and so on, from the lowest up; `floors` is their
    required number. `cache` keeps hulls and stage results by content (default: `cache_folder()`). `warn` receives
    defects of the source. `annotations`, Scan2CAD's file, replaces the source's, with models of `config.library`. Raise
    `SceneRejected`, `FileError` (of the target) or `StageFailed`.
    """
    clock = Clock(report or (lambda stage, share: None))
    if config.library is None and (source / "cad").is_dir():
        config = dataclasses.replace(config, library=source)
    check_name(target.name, f"{target}: the scene's name")
    with contextlib.ExitStack() as stack:
        # Before reading, which may take a while: an OUT that cannot be written is reported at once.
        first = stack.enter_context(part_folder(target, config.overwrite))
        with clock.stage("read"):
            about = config.up, config.unit, config.root, config.mirror
            raw = read_source(source, config.format, config.strict, *about)
            if annotations is not None:
                raw = with_annotations(raw, annotations, config.library)
            raw, furniture = at_origin(raw), [label for labels in CATEGORY_LABELS.values() for label in labels]
            unfit = config.auto_align and not np.isin(raw.scan.labels, furniture).any()
            warning = ("--auto-align: no label of furniture in the scan, so no model is fitted",) * unfit
            raw = dataclasses.replace(raw, name=target.name, warnings=raw.warnings + warning)
            scenes = split_storeys(raw)
        for warning in raw.warnings:
            warn(warning)
        if floors is not None and len(scenes) != floors:
            raise SceneRejected(f"{source}: has {len(scenes)} floors, expected {floors}; use convert_building")
        clock.floors = len(scenes)
        if len(scenes) == 1:
            folders = {first: target}
        else:
            targets = [target.parent / scene.name for scene in scenes]
            folders = {stack.enter_context(part_folder(t, config.overwrite)): t for t in targets}
        done = []
        for scene, (folder, final) in zip(scenes, folders.items(), strict=True):
            result = convert_raw(scene, folder, config, clock, cache or cache_folder())
            if scene.attribution:
                write_text(folder / ATTRIBUTION, scene.attribution)
            done.append(dataclasses.replace(result, folder=final, stage_s=clock.seconds))
        publish(folders, config.overwrite)
    return tuple(done)


def convert(
    source: Path, target: Path, config: ConvertConfig, report: Report | None = None, cache: Path | None = None
) -> Converted:
    """Convert a raw folder of one floor; arguments and errors of `convert_building`."""
    return convert_building(source, target, config, report, cache, floors=1)[0]
