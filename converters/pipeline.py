"""A raw folder in, a scene folder out: read, stages that are functions of arrays, write, rename."""

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
from converters.bodies.alignment import Alignment
from converters.bodies.decompose import DOOR_OVERRIDES, DecomposeConfig, Decomposition, cache_folder, decompose_all
from converters.bodies.objects import PlacedObject, name_objects, place_object
from converters.bodies.physical import Physical, physical_properties, with_source
from converters.bodies.placement import align_objects
from converters.check.gates import drawn_shares, evaluate
from converters.check.settle import Settled, settle
from converters.check.surfaces import kept_share
from converters.clock import Clock, Report
from converters.geometry.boxes import Hull
from converters.geometry.simplify import simplify_open, simplify_parts
from converters.propose.report import floor_of, with_retrieved
from converters.read.homes.parts import built_in
from converters.read.source import read_source
from converters.read.storeys import split_storeys
from converters.records.cache import NOT_HASHED, StageCache
from converters.records.errors import SceneRejected
from converters.records.gate import Gate
from converters.records.raw import ATTRIBUTION, CATEGORY_LABELS, RawScene, at_origin
from converters.records.visual import TexturedMesh, VisualMesh, joined_clouds
from converters.structure.cut import cut_furniture
from converters.structure.fill import fill_holes, wall_planes
from converters.structure.floor import LIFT_M, level_floor
from converters.structure.maps import FloorPlan, main_direction, make_floor_plan, resample
from converters.structure.walls import wall_boxes
from converters.write.drawn import Drawn, as_it_is, draw_objects
from converters.write.emit import SceneParts, write_scene
from converters.write.manifest import make_manifest, scene_objects
from converters.write.texture import bake_structure, colour_cloud
from interactive_nav_common.files import check_name, part_folder, publish, write_text
from scenes_mjcf.schema import SceneManifest, SceneMaps, save_manifest, save_maps

MODELLED = 10**6, 4096
"""Faces, and pixels a side, up to which a structure without furniture is drawn as it is: somebody modelled it."""
TURNED_M = 0.1
"""`bake_structure`'s word for homes that are made of parts."""
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
    """Of an MJCF or Gazebo home: the folder that may be read; None: its own."""
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
    auto_align: bool = dataclasses.field(default=False, metadata=NOT_HASHED)
    """Fits library models to labelled furniture that has no annotation."""
    library: Path | None = dataclasses.field(default=None, metadata=NOT_HASHED)
    """Folder with `cad/` for that; None: the source folder, or the packaged furniture where it has none."""


@dataclasses.dataclass(frozen=True)
class Converted:
    """What `convert` made."""

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
    """The scan as it is, where it is small and whole; else levelled, filled, simplified and textured."""
    # As the levelled floor of a scan: above the plane that collides. A generated structure brings that with it.
    lift = np.array([0.0, 0.0, LIFT_M if raw.scan.furnished else 0.0])
    own = TexturedMesh(vertices_w + lift, raw.scan.faces, raw.scan.corner_uv, raw.scan.texture)
    most = (config.structure_faces, config.structure_texture) if raw.scan.furnished else MODELLED
    small = as_it_is(own, *most)
    if small is not None and keep.all() and not raw.picture:
        return small
    kept = np.flatnonzero(keep)
    level = level_floor(vertices_w, raw.scan.faces, raw.scan.labels)
    cloud = colour_cloud(raw.scan, level, raw.scan.faces, kept)
    if raw.picture:
        drawn, faces = simplify_parts(raw.picture, config.structure_faces)
        drawn = drawn + (vertices_w[0] - raw.scan.vertices[0]) + lift
        # A home's parts touch, back to back and on top of one another: each face takes colours that look as it does.
        turned_m = TURNED_M if raw.scan.furnished else 0.0
        return bake_structure(drawn, faces, cloud, config.structure_texture, turned_m)
    scan = simplify_open(level, raw.scan.faces[kept], config.structure_faces)
    planes = wall_planes(level, raw.scan.faces[kept], raw.scan.labels)
    (points, faces), clouds = fill_holes(planes, plan, annotated, cloud, scan)
    whole = np.vstack([scan[0], points]), np.vstack([scan[1], faces + len(scan[0])])
    return bake_structure(*whole, joined_clouds(cloud, *clouds), config.structure_texture)


def _object_visuals(
    raw: RawScene,
    vertices_w: np.ndarray,
    owner: np.ndarray,
    annotated: tuple[PlacedObject, ...],
    config: ConvertConfig,
) -> list[Drawn]:
    """Every object's visual, model by model, side by side in processes."""
    models: dict[tuple[str, bytes], list[int]] = {}
    for k, placed in enumerate(annotated):
        models.setdefault((placed.cad_id, placed.vertices_b.tobytes()), []).append(k)
    # A modelled structure shows nothing of what stands in it.
    shown = np.full_like(owner, -1) if raw.picture else owner
    clouds = [
        colour_cloud(raw.scan, vertices_w, raw.scan.faces, np.flatnonzero(shown == k)) for k in range(len(annotated))
    ]
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
    made = dict(zip(places, [one for some in drawn for one in some], strict=True))
    return [made[k] for k in range(len(annotated))]


def _decompose_models(
    raw: RawScene, search: DecomposeConfig, config: ConvertConfig, cache: Path, progress: Callable[[float], None]
) -> Decomposition:
    """Hulls of every model: its own convex pieces where it came with them, else coacd's."""
    bare = {k: c for k, c in sorted(raw.cads.items()) if c.pieces is None}
    found = decompose_all(
        {k: (c.vertices, c.faces) for k, c in bare.items()},
        search,
        config.jobs,
        cache,
        progress,
        {k: DOOR_OVERRIDES for k, c in bare.items() if c.category == "door"},
        config.strict,
    )
    own = {k: tuple(Hull(*p) for p in c.pieces) for k, c in raw.cads.items() if c.pieces is not None}
    return dataclasses.replace(found, hulls=found.hulls | own)


def _report_objects(
    rows: list[dict[str, Any]], settled: Settled, drawn: list[Drawn], annotated: tuple[PlacedObject, ...]
) -> None:
    """Adds to each object's row how it settled, how much of it the scan showed and what is drawn of its surface."""
    for row, moved, drop, own, placed in zip(
        rows, settled.displacement_m, settled.drop_m, drawn, annotated, strict=True
    ):
        row |= {"settle_shift_m": moved, "settle_drop_m": drop, "texture_seen_share": round(own.seen_share, 3)}
        row |= {"drawn_area_share": round(own.kept_share, 3), "drawn_off_m": round(own.off_m, 4)}
        if placed.hinge is not None:
            row["hinge_assumed"] = placed.hinge.assumed


def _placed(
    raw: RawScene, placements: list[Alignment], decomposed: Decomposition, floor_m: float, walls_yaw: float
) -> tuple[tuple[PlacedObject, ...], tuple[Physical, ...]]:
    """Every object where it was annotated, and its mass and friction."""
    annotated = tuple(
        place_object(name, a, raw.cads[a.cad_id], decomposed.hulls[a.cad_id], pose, floor_m, walls_yaw)
        for name, a, pose in zip(name_objects(raw.annotations), raw.annotations, placements, strict=True)
    )
    cads = [raw.cads[o.cad_id] for o in annotated]
    return annotated, tuple(
        with_source(physical_properties(o.category, o.hulls_b), cad.mass_kg, cad.friction)
        for o, cad in zip(annotated, cads, strict=True)
    )


def _beside(settled: Settled, annotated: tuple[PlacedObject, ...]) -> dict[int, str]:
    """Number of an object that was held -> what its source calls what it overlaps."""
    called = {o.name: o.cad_id for o in annotated}
    return {k: called.get(other, "a wall, or what is built in") for k, other in settled.held.items()}


def convert_raw(raw: RawScene, folder: Path, config: ConvertConfig, clock: Clock, cache: Path) -> Converted:
    """Every stage after reading, of one floor; writes into `folder`, which exists and is empty."""
    stages = StageCache(cache)
    with clock.stage("align") as progress:
        raw = with_retrieved(raw, config.library, progress) if config.auto_align else raw
        placements, rows = align_objects(raw)
        floor_height = floor_of(raw)
        vertices_w = raw.scan.vertices - [0.0, 0.0, floor_height]
        walls_yaw = main_direction(vertices_w, raw.scan.faces, raw.scan.labels)
    decompose_config = DecomposeConfig(seed=config.seed, timeout_s=config.timeout_s)
    with clock.stage("decompose") as progress:
        decomposed = _decompose_models(raw, decompose_config, config, cache, progress)
        annotated, physical = _placed(raw, placements, decomposed, floor_height, walls_yaw)
    with clock.stage("cut"):
        cut = stages.call(cut_furniture, vertices_w, raw.scan.faces, raw.scan.labels, annotated, raw.scan.furnished)
    with clock.stage("map"):
        kept = raw.scan.faces[cut.keep]
        seen = vertices_w, kept, raw.scan.labels, annotated, raw.given_map, walls_yaw
        plan = stages.call(make_floor_plan, *seen, bool(raw.picture))
        walls = stages.call(wall_boxes, plan)
        traversable, origin = resample(plan.grid, plan.traversable, plan.grid.resolution_m)
        if not traversable.any():
            raise SceneRejected("scan: the traversable map is empty; the scan needs visible floor")
        maps = SceneMaps(traversable, plan.grid.resolution_m, origin, floor_height)
    with clock.stage("settle"):
        unsettled = SceneParts(raw.name, annotated, physical, walls)
        fitted = [k for k, a in enumerate(raw.annotations) if a.confidence is not None]
        settled = settle(unsettled, bool(raw.picture), fitted) if annotated else Settled(unsettled, (), ())
    if settled.held:
        found = dataclasses.replace(config, auto_align=False)
        return convert_raw(built_in(raw, _beside(settled, annotated)), folder, found, clock, cache)
    with clock.stage("texture") as progress:
        structure = stages.call(_structure_visual, raw, vertices_w, cut.keep, plan, annotated, config)
        progress(0.5)
        drawn = stages.call(_object_visuals, raw, vertices_w, cut.owner, annotated, config)
    _report_objects(rows, settled, drawn, annotated)
    with clock.stage("write"):
        visuals = tuple(own.mesh for own in drawn)
        lamps = tuple(dataclasses.replace(p, at=p.at - [0.0, 0.0, floor_height]) for p in raw.lamps)
        windows = tuple(dataclasses.replace(w, middle=w.middle - [0.0, 0.0, floor_height]) for w in raw.windows)
        seen = {"structure_visual": structure, "object_visuals": visuals, "lamps": lamps, "windows": windows}
        parts = dataclasses.replace(settled.parts, **seen)
        write_scene(parts, folder)
        save_maps(maps, folder)
    with clock.stage("gates"):
        spec = mujoco.MjSpec.from_file(str(folder / "scene.xml"))
        shares = {
            "scan_kept": kept_share(vertices_w, raw.scan.faces[cut.owner < 0], (structure.vertices, structure.faces)),
            "floor_open": plan.open_share,
        }
        gates = evaluate(spec, maps, scene_objects(parts), drawn_shares(rows), shares)
        area_m2, found = float(plan.traversable.sum()) * plan.grid.resolution_m**2, decomposed.fallbacks
        manifest = make_manifest(raw, config.split, parts, area_m2, rows, gates, decompose_config, found, maps)
        rounded = {name: round(share, 4) for name, share in shares.items()}
        manifest = dataclasses.replace(manifest, floor_unseen_m2=round(plan.unseen_m2, 3), **rounded)
        save_manifest(manifest, folder)
    return Converted(folder, manifest, gates, settled, len(walls), clock.seconds, decomposed.worker_mib)


def _read(source: Path, name: str, config: ConvertConfig, annotations: Path | None) -> RawScene:
    """The source under its scene's name, with a file's annotations if one is given."""
    about = config.up, config.unit, config.root, config.mirror
    raw = read_source(source, config.format, config.strict, *about)
    if annotations is not None:
        raw = with_annotations(raw, annotations, config.library)
    raw = at_origin(raw)
    labelled = np.isin(raw.scan.labels, [label for own in CATEGORY_LABELS.values() for label in own]).any()
    unfit = ("--auto-align: no label of furniture in the scan, so no model is fitted",)
    told = raw.warnings if labelled or not config.auto_align else raw.warnings + unfit
    return dataclasses.replace(raw, name=name, warnings=told)


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
    """Converts one raw folder, floor by floor; the scene folders appear whole and together, or not at all.

    Args:
        source: folder in one of the layouts of `READERS`.
        target: scene folder to make; its name becomes the scene's. A building of several floors makes `<target>_0`,
            `<target>_1` and so on instead, from the lowest floor up.
        config: choices.
        report: progress callback.
        cache: folder of hulls and stage results by content; default `cache_folder()`.
        warn: told what is wrong with the source as soon as it is read; all warnings stand in the result too.
        floors: that it must have; None: any number.
        annotations: Scan2CAD's file, in place of the source's own; its models are those of `config.library`.
    """
    clock = Clock(report or (lambda stage, share: None))
    if config.library is None and (source / "cad").is_dir():
        config = dataclasses.replace(config, library=source)
    check_name(target.name, f"{target}: the scene's name")
    with contextlib.ExitStack() as stack:
        # Before reading, which may take a while: an OUT that cannot be written is told at once.
        first = stack.enter_context(part_folder(target, config.overwrite))
        with clock.stage("read"):
            raw = _read(source, target.name, config, annotations)
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
    """Converts a raw folder of one floor; arguments and errors of `convert_building`."""
    return convert_building(source, target, config, report, cache, floors=1)[0]
