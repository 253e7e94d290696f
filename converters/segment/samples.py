"""Generate labelled crops of furnished buildings, scanned as by a hand-held sensor (scan x, y, height; metres)."""

import dataclasses
from pathlib import Path

import numpy as np

from converters.generate import GenerationError, design_building, render_building
from converters.generate.homes.config import home_config
from converters.generate.models.cad import MODELS, Instance
from converters.generate.models.parts import MATERIALS
from converters.generate.surface.scan import NYU40 as LABELS
from converters.generate.surface.scan import Volume, smooth_noise, visible_from
from converters.records.raw import TexturedMesh
from converters.segment.voxels import LAYERS, NAMES, VOXEL_M, Surface, classes_of, joined, sample_surface, voxelise
from interactive_nav_common.files import write_arrays

TIERS = ("furnished", "cluttered", "sparse")
OTHER = (39,)
"""Id of generated appliances as of waste baskets: here they are `other`, unless their category is one of these."""
BASKETS = ("basket", "bin", "laundry_basket")


@dataclasses.dataclass(frozen=True)
class Crop:
    """Hold the occupied voxels of a square column."""

    index: np.ndarray
    """(k, 3) uint8."""
    features: np.ndarray
    """(k, `FEATURES`) int8."""
    classes: np.ndarray
    """(k,) uint8."""


def _of_item(item: Instance) -> list[Surface]:
    visual = item.model.surface
    if visual is not None:
        v, uv = item.to_floor(np.asarray(visual.vertices, float)), np.asarray(visual.uv, float)[visual.uv_faces]
        return [sample_surface(TexturedMesh(v, visual.faces, uv, np.asarray(visual.image)[..., :3]))]
    surfaces = []
    for part in item.model.parts:
        bare = sample_surface(TexturedMesh(item.to_floor(part.vertices), part.faces))
        colour = 255 * np.array(MATERIALS[part.material])
        surfaces.append(dataclasses.replace(bare, colours=np.tile(colour, (len(bare.points), 1))))
    return surfaces


def building_surface(seed: int, tier: str, split: str) -> tuple[Surface, np.ndarray]:
    """Return the surface of a generated building's structure and furniture, with the class of each point."""
    # Not `recipes.building_of`, whose imports a machine for training alone lacks.
    config = home_config(tier, {}, MODELS[split])
    building = design_building(seed, config)
    scan, atlas = render_building(building, seed, config, lambda stage, share: None)
    labels = scan.labels.astype(int)
    labels[np.isin(labels, OTHER)] = 40
    surfaces = [sample_surface(TexturedMesh(scan.vertices, scan.faces, atlas.uv[atlas.uv_faces], atlas.image))]
    classes = [classes_of(labels)[scan.faces[surfaces[0].face, 0]]]
    for item in building.items if config.artefacts == "none" else ():
        category = item.model.category
        label = 39 if category in BASKETS else 40 if LABELS[category] in OTHER else LABELS[category]
        surfaces += (new := _of_item(item))
        classes += [np.full(len(s.points), classes_of(np.array([label]))[0]) for s in new]
    return joined(surfaces), np.concatenate(classes)


def _visible(surface: Surface, rng: np.random.Generator, side_m: float) -> np.ndarray:
    """Return (n,) bool: points that a sensor carried around the middle sees."""
    occupied, count = voxelise(surface, 0.0), int(rng.integers(3, 9))
    free = np.ones((*(occupied.index[:, :2].max(axis=0, initial=0) + 3), LAYERS + 2), np.float32)
    free[tuple(occupied.index.T)] = -1.0
    volume = Volume(free, occupied.origin + VOXEL_M / 2, VOXEL_M)
    cameras = np.column_stack([rng.normal(0, side_m / 7, (count, 2)), rng.uniform(0.8, 1.8, count)])
    places, normals = volume.origin + VOXEL_M * occupied.index, occupied.features[:, :3] / 127
    return visible_from(places, normals, cameras, volume)[occupied.of_point] & (occupied.of_point >= 0)


def _recoloured(colours: np.ndarray | None, rng: np.random.Generator) -> np.ndarray | None:
    """Return colours of another exposure, white balance and camera; None for a quarter of all."""
    if colours is None or rng.random() < 0.25:
        return None
    c = np.clip(colours / 255, 0.0, 1.0)[:, rng.permutation(3) if rng.random() < 0.15 else [0, 1, 2]]
    grey = c.mean(axis=1, keepdims=True)
    c = grey + (c - grey) * rng.uniform(0.2, 1.4)
    c = np.clip(c, 0, 1) ** rng.uniform(0.6, 1.9) * rng.uniform(0.5, 1.15) * rng.uniform(0.85, 1.15, 3)
    return 255 * np.clip(c + rng.normal(0, rng.uniform(0, 0.06), c.shape) + rng.normal(0, 0.04), 0, 1)


def worn(surface: Surface, classes: np.ndarray, rng: np.random.Generator, side_m: float) -> tuple[Surface, np.ndarray]:
    """Turn, mirror and badly scan a square column of a building around its middle, which is at x = y = 0."""
    floor = np.flatnonzero((classes == NAMES.index("floor")) & (surface.normals[:, 2] > 0.9))
    middle = surface.points[rng.choice(floor)] if len(floor) else surface.points.mean(axis=0)
    angle, mirror = rng.uniform(0, 2 * np.pi), rng.choice([-1.0, 1.0])
    c, s = np.cos(angle), np.sin(angle)
    turn = np.array([[mirror * c, -s, 0], [mirror * s, c, 0], [0, 0, 1]])
    points = (surface.points - [*middle[:2], 0]) @ turn.T * rng.uniform(0.9, 1.1)
    keep = (np.abs(points[:, :2]) < side_m / 2).all(axis=1) & (rng.random(len(points)) < rng.uniform(0.4, 1.0))
    if rng.random() < 0.5:
        keep &= classes != NAMES.index("ceiling")
    if rng.random() < 0.5:
        keep &= points[:, 2] < rng.uniform(1.1, 2.6)
    out = dataclasses.replace(surface, points=points, normals=surface.normals @ turn.T).rows(keep)
    points, normals, classes = out.points, out.normals, classes[keep]
    if not len(points):
        return out, classes
    left = np.ones(len(points), bool)
    for spot in points[rng.integers(len(points), size=rng.integers(0, 12))]:
        left &= ((points - spot) ** 2).sum(axis=1) >= rng.uniform(0.05, 0.4) ** 2
    if rng.random() < 0.5:
        left &= smooth_noise(points, rng.uniform(0.15, 0.5), rng) <= rng.uniform(1.2, 2.5)
    wave = smooth_noise(points, rng.uniform(0.08, 0.3), rng) * rng.uniform(0, 0.015)
    moved = points + normals * (wave + rng.normal(0, rng.uniform(0, 0.008), len(points)))[:, None]
    normals = normals + rng.normal(0, rng.uniform(0, 0.3), normals.shape)
    normals /= np.maximum(np.linalg.norm(normals, axis=1, keepdims=True), 1e-9)
    points = moved + [0, 0, rng.normal(0, 0.02)]
    out = Surface(points, normals, _recoloured(out.colours, rng), out.face)
    if rng.random() < 0.7:
        left &= _visible(out, rng, side_m)
    return out.rows(left), classes[left]


def make_crop(surface: Surface, classes: np.ndarray, rng: np.random.Generator, side: int) -> Crop:
    """Return the voxels of `worn`, each of the class that most of its points have."""
    column, of = worn(surface, classes, rng, side * VOXEL_M)
    voxels = voxelise(column, 0.0)
    votes, has_class = np.zeros((len(voxels.index), len(NAMES)), np.int32), (voxels.of_point >= 0) & (of < len(NAMES))
    np.add.at(votes, (voxels.of_point[has_class], of[has_class]), 1)
    inside = (voxels.index < side).all(axis=1)
    index, classes = voxels.index.astype(np.uint8), votes.argmax(axis=1).astype(np.uint8)
    return Crop(index[inside], voxels.features[inside], classes[inside])


def generate_crops(task: tuple[Path, int, str, int, int]) -> Path:
    """Write missing crops of one building (path, seed, split, count, side); on failure, try the seed plus 1,000,000."""
    path, seed, split, count, side = task
    if path.exists():
        return path
    rng = np.random.default_rng((seed, 7))
    tier = str(rng.choice(TIERS, p=(0.5, 0.25, 0.25)))
    try:
        surface, classes = building_surface(seed, tier, split)
    except GenerationError:
        return generate_crops((path, seed + 1_000_000, split, count, side))
    crops = [make_crop(surface, classes, rng, side) for _ in range(count)]
    crops = [c for c in crops if len(c.index) > 500] or crops
    columns = {f.name: np.concatenate([getattr(c, f.name) for c in crops]) for f in dataclasses.fields(Crop)}
    write_arrays(path, lengths=np.array([len(c.index) for c in crops]), **columns)
    return path


def read_crops(path: Path) -> list[Crop]:
    """Read what `generate_crops` wrote."""
    with np.load(path) as file:
        ends = np.cumsum(file["lengths"])[:-1]
        columns = (np.split(file[f.name], ends) for f in dataclasses.fields(Crop))
        return [Crop(*row) for row in zip(*columns, strict=True)]
