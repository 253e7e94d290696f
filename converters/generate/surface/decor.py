"""Model what hangs on the walls of kitchens and bathrooms or stands on counters, too high or thin to collide."""

from collections.abc import Iterable, Iterator, Sequence

import numpy as np
import shapely

from converters.generate.homes.building import PlanBox
from converters.generate.models.cad import LOOKS, Instance, drawn_parts
from converters.generate.models.parts import MATERIALS
from converters.generate.surface.finishes import Colouring
from converters.generate.surface.sides import OTHER, Side, Span
from converters.generate.surface.texture import Chart, piece_charts, plain
from converters.geometry.faces import face_vectors
from converters.records.raw import OTHER_PROP
from interactive_nav_common.rotations import Y_UP_TO_Z_UP, yaw_matrix

CUPBOARD_M, CUPBOARD_DEEP_M, DOOR_M = (1.45, 2.1), 0.33, 0.5
HOOD_M, HOOD_DEEP_M, CHIMNEY_M = (1.6, 1.67), 0.48, 0.26
MIRROR_M, TOWEL_M, RAIL_M = (1.25, 1.95), (0.5, 0.65), 1.3
FRONTS = np.array([[0.93, 0.93, 0.91], [0.88, 0.83, 0.74], [0.72, 0.55, 0.38], [0.55, 0.62, 0.58], [0.36, 0.40, 0.45]])
TOWELS = np.array([[0.93, 0.92, 0.88], [0.55, 0.68, 0.72], [0.80, 0.62, 0.56], [0.62, 0.68, 0.52], [0.36, 0.42, 0.52]])
TRIES = 12
BARE = 0.35
"""Share of counters with nothing on them."""
Slab = tuple[Side, Span, Span, Span, Colouring]
"""Wall, along it, out of it, heights, paint."""


def _backed(side: Side, items: Iterable[Instance]) -> Iterator[tuple[Instance, Span]]:
    """Yield what stands with its back at a wall, low enough to hang something above, and where along the wall."""
    strip = side.strip(side.start, side.end, 0.12)
    for item in items:
        front = item.matrix[:3, 2] / item.scale[2]
        top_m = item.position[2] + item.scale[1] * item.model.bounds[1, 1]
        if front @ side.inward > 0.99 and top_m < MIRROR_M[0] and item.footprint.intersects(strip):
            low, high = np.reshape(item.footprint.bounds, (2, 2))[:, 1 - side.axis]
            yield item, (max(low, side.start), min(high, side.end))


def _is_bare(side: Side, run: Span, low_m: float) -> bool:
    """Return whether a stretch of a wall has no opening above a height."""
    return not any(h.start < run[1] + 0.08 and h.end > run[0] - 0.08 and h.high > low_m for h in side.holes())


def _doors(side: Side, run: Span, colour: np.ndarray) -> Colouring:
    """Paint a wall cupboard's doors with seams and handles."""
    wide = (run[1] - run[0]) / max(1, round((run[1] - run[0]) / DOOR_M))

    def paint(p: np.ndarray) -> np.ndarray:
        front = side.way * (p[:, side.axis] - side.face) > CUPBOARD_DEEP_M - 0.01
        along, up = np.mod(p[:, 1 - side.axis] - run[0], wide), p[:, 2] - CUPBOARD_M[0]
        edge = np.minimum(np.minimum(along, wide - along), np.minimum(up, CUPBOARD_M[1] - p[:, 2]))
        out = np.where((front & (edge < 0.008))[:, None], 0.62 * colour, colour)
        handle = front & (np.abs(along - wide + 0.06) < 0.009) & (np.abs(up - 0.13) < 0.08)
        return np.where(handle[:, None], MATERIALS["steel"], out)

    return paint


def _above_row(side: Side, items: Sequence[Instance], ceiling_m: float, colour: np.ndarray) -> Iterator[Slab]:
    """Yield the cupboards and hoods above a kitchen's row at one wall."""
    steel = plain(MATERIALS["steel"])
    for item, run in _backed(side, items):
        if item.model.category in ("counter", "sink") and _is_bare(side, run, CUPBOARD_M[0]):
            yield side, run, (0.0, CUPBOARD_DEEP_M), CUPBOARD_M, _doors(side, run, colour)
        if item.model.category == "stove" and _is_bare(side, run, HOOD_M[0]):
            middle = sum(run) / 2
            yield side, run, (0.0, HOOD_DEEP_M), HOOD_M, steel
            chimney = middle - CHIMNEY_M / 2, middle + CHIMNEY_M / 2
            yield side, chimney, (0.0, CHIMNEY_M), (HOOD_M[1], ceiling_m), steel


def _mirrors(side: Side, items: Sequence[Instance]) -> Iterator[Slab]:
    """Yield a framed mirror above each washbasin at one wall, in which a bright room is blurred."""
    for item, (low, high) in _backed(side, items):
        half, middle = min(0.4, 0.42 * (high - low)), (low + high) / 2
        run = (middle - half, middle + half)
        if item.model.category != "washbasin" or not _is_bare(side, run, MIRROR_M[0]):
            continue

        def paint(p: np.ndarray, run: Span = run) -> np.ndarray:
            along, z = p[:, 1 - side.axis], p[:, 2]
            rim = np.minimum(np.minimum(along - run[0], run[1] - along), np.minimum(z - MIRROR_M[0], MIRROR_M[1] - z))
            tone = 0.86 + 0.1 * np.cos(4.0 * (along - run[0] + 0.8 * z)) + 0.08 * (z - MIRROR_M[0])
            return np.where((rim < 0.02)[:, None], MATERIALS["steel"], np.array([0.80, 0.86, 0.88]) * tone[:, None])

        yield side, run, (0.0, 0.02), MIRROR_M, paint


def _towel(
    walls: Sequence[Side], items: Sequence[Instance], taken: Sequence[Slab], rng: np.random.Generator
) -> Iterator[Slab]:
    """Yield a rail with a towel at the first place of a few drawn ones where it is in nobody's way."""
    colour = TOWELS[rng.integers(len(TOWELS))]
    footprints = shapely.union_all([item.footprint for item in items])
    for _ in range(TRIES):
        side, wide = walls[int(rng.integers(len(walls)))], float(rng.uniform(*TOWEL_M))
        start = round(float(rng.uniform(side.start, max(side.start, side.end - wide))), 2)
        run, low = (start, start + wide), RAIL_M - 0.75 * wide - 0.25
        hung = any(s is side and r[0] < run[1] + 0.1 and r[1] > run[0] - 0.1 for s, r, *_ in taken)
        free = run[1] < side.end and _is_bare(side, run, 0.0) and not hung
        if free and not side.strip(*run, 0.25).intersects(footprints):

            def paint(p: np.ndarray, low: float = low) -> np.ndarray:
                band = np.abs(p[:, 2] - low - 0.11) < 0.025
                return np.where(band[:, None], 0.72, 1.0) * colour

            yield side, run, (0.045, 0.06), (RAIL_M, RAIL_M + 0.015), plain(MATERIALS["chrome"])
            yield side, (run[0] + 0.06, run[1] - 0.06), (0.03, 0.058), (low, RAIL_M + 0.01), paint
            return


def _on_worktops(items: Sequence[Instance], rng: np.random.Generator) -> Iterator[Chart]:
    """Yield what stands on most counters that do not come with anything on top."""
    for item in (i for i in items if i.model.category == "counter" and "+" not in i.model.name):
        if rng.random() < BARE:
            continue
        solid = item.model.surface or item.model.parts[-1]
        normal = face_vectors(solid.vertices, solid.faces)
        level, of = np.unique(np.round(solid.vertices[solid.faces, 1].mean(axis=1), 3), return_inverse=True)
        area = np.bincount(of, np.where(normal[:, 1] > 0.99 * np.linalg.norm(normal, axis=1), normal[:, 1], 0.0))
        foot = item.to_floor(np.array([item.model.center * [1, 0, 1] + [0, level[np.argmax(area)], 0]]))[0]
        turn = yaw_matrix(item.yaw_rad + rng.uniform(-0.3, 0.3)) @ Y_UP_TO_Z_UP
        for part in drawn_parts(LOOKS.worktops[rng.integers(len(LOOKS.worktops))]):
            yield from piece_charts(part.vertices @ turn.T + foot, part.faces, OTHER_PROP, part.material)


def decor(
    uses: Sequence[str],
    sides: Sequence[Sequence[Side]],
    items: Sequence[Instance],
    ceiling_m: float,
    rng: np.random.Generator,
) -> tuple[list[Chart], list[PlanBox]]:
    """Return what hangs on the walls of rooms of these uses, which have these walls, and the boxes that it fills."""
    slabs: list[Slab] = []
    for use, walls in zip(uses, sides, strict=True):
        if use == "kitchen":
            colour = FRONTS[rng.integers(len(FRONTS))]
            slabs += [slab for side in walls for slab in _above_row(side, items, ceiling_m, colour)]
        elif use == "bathroom":
            mirrors = [slab for side in walls for slab in _mirrors(side, items)]
            slabs += [*mirrors, *_towel(walls, items, mirrors, rng)]
    # From a stream beside it: pictures, which are drawn next, reach into the band of the map.
    charts = list(_on_worktops(items, rng.spawn(1)[0])) if "kitchen" in uses else []
    boxes = []
    for side, run, out, heights, paint in slabs:
        charts += side.slab(run, out, heights, OTHER, paint, 80.0, "b", thin=out[1] < 0.1)
        ends = [side.at(a, o, z) for a, o, z in zip(run, out, heights, strict=True)]
        low, high = np.min(ends, axis=0), np.max(ends, axis=0)
        boxes.append(PlanBox(tuple(low.tolist()), tuple(high.tolist())))
    return charts, boxes
