"""Build a home's exact structure from its plan, painted and lit (scan x, y, height above the floor; metres)."""

import dataclasses
import math
from collections.abc import Sequence
from typing import Any

import numpy as np
import shapely
from scipy import ndimage

from converters.generate.homes.building import Plan, PlanBox, Rect
from converters.generate.models.cad import Instance
from converters.generate.models.parts import MATERIALS
from converters.generate.surface import sides as at_walls
from converters.generate.surface.decor import decor
from converters.generate.surface.finishes import FRAMES, RUGS, Finish, finishes, framed
from converters.generate.surface.scan import NYU40, Scan, building_solids, fuse, solid_from_box
from converters.generate.surface.sides import CLOTHS, ENTRANCES, FLOOR_M, PICTURE, Side
from converters.generate.surface.texture import Chart, assemble, piece_charts, plain, polygon
from converters.records.raw import CEILING, FLOOR, WALL, VisualMesh
from converters.write.light import VOXEL_M, Daylight, Space
from converters.write.texture import share_plain

Sides = list[list[Side]]
"""Of each room its walls."""


def space_of(plan: Plan, items: Sequence[Instance] = (), boxes: Sequence[PlanBox] = ()) -> Space:
    """Return the distances to the structure, windows open, to furniture where it stands, and to boxes on walls."""
    o, pad = plan.outer, 4 * VOXEL_M
    low = np.array([o.x0, o.y0, 0.0]) - pad
    top = plan.wall_height_m
    lid = solid_from_box((o.x0, o.y0, top), (o.x1, o.y1, top + 0.4), 0, "paint")
    hung = [solid_from_box(box.low, box.high, 0, "paint") for box in boxes]
    near = fuse([*building_solids(plan, list(items)), *hung, lid], low, np.array([o.x1, o.y1, top]) + pad, VOXEL_M).sdf
    for w in plan.windows:
        i0 = np.maximum(np.floor((np.array(w.low) - 0.3 - low) / VOXEL_M).astype(int), 0)
        i1 = np.ceil((np.array(w.high) + 0.3 - low) / VOXEL_M).astype(int) + 1
        part = near[tuple(slice(a, b) for a, b in zip(i0, i1, strict=True))]
        points = low + VOXEL_M * (i0 + np.indices(part.shape).reshape(3, -1).T)
        hole = solid_from_box(w.low, w.high, 0, "paint").distance(points)
        np.maximum(part, -hole.reshape(part.shape), out=part)
    # Farther away: how far the nearest place beside a surface is, and what is left from there.
    steps, nearest = ndimage.distance_transform_edt(near > 1.4 * VOXEL_M, return_indices=True)  # pyright: ignore
    far = np.asarray(steps) * VOXEL_M + near[tuple(nearest)]
    return Space(np.where(near < 2.8 * VOXEL_M, near, np.maximum(far, 2.8 * VOXEL_M)).astype(np.float32), low)


CEILING_WHITE, LAMP_LABEL = np.array([0.95, 0.95, 0.93]), 35
DRAPED = {"living": 0.9, "bedroom": 0.9, "dining": 0.6, "office": 0.4}
"""Use of a room -> share of its windows that have curtains."""
PICTURES = {"living": 4, "bedroom": 2, "dining": 3, "office": 2, "hall": 2, "kitchen": 1}
"""Use of a room -> pictures on its walls, at most."""


def _flat(rect: Rect, z: float, up: int, *about: Any) -> Chart:
    corners = [(rect.x0, rect.y0, z), (rect.x1, rect.y0, z), (rect.x1, rect.y1, z), (rect.x0, rect.y1, z)]
    return polygon(corners, (0, 0, up), *about)


def _shell(plan: Plan, sides: Sides, finish: list[Finish]) -> list[Chart]:
    """Return floors, ceilings, walls with their boards, doorways; tops and outsides of the walls."""
    height, charts = plan.wall_height_m, []
    for room, walls, of in zip(plan.rooms, sides, finish, strict=True):
        charts.append(_flat(room, FLOOR_M, 1, FLOOR, of.floor_colour))
        charts.append(_flat(room, height, -1, CEILING, plain(CEILING_WHITE), 20.0))
        for side in walls:
            charts += at_walls.wall_face(side, height, of.wall_colour)
            charts += at_walls.skirting(side) if of.skirting else []
            for doorway in side.doorways:
                charts += at_walls.casing(side, at_walls.Hole(*side.along(doorway.rect), 0.0, doorway.height_m))
    for doorway in plan.doorways:
        charts += at_walls.lining(doorway, finish[doorway.rooms[0]].floor_colour)
    charts += [_flat(w.rect, w.high[2], 1, WALL, plain([0.62, 0.61, 0.59]), 2.0, True) for w in plan.walls]
    for axis, way, face, start, end in plan.facades():
        outside = at_walls.windowed(Side(axis, way, face, start, end, (), ()), plan.windows)
        charts += at_walls.wall_face(outside, height, plain([0.80, 0.78, 0.73]), 8.0)
    return charts


def _lamp(at: np.ndarray, radius: float) -> list[Chart]:
    """Return a round shade under the ceiling; `at` is the middle of its top."""
    turn = 2 * math.pi * np.arange(14) / 14
    ring = np.round(at + radius * np.column_stack([np.cos(turn), np.sin(turn), 0 * turn]), 4)
    low = ring - [0, 0, 0.11]
    glow, rim = plain([1.0, 0.97, 0.88]), plain([0.96, 0.91, 0.80])
    charts = [polygon(low, (0, 0, -1), LAMP_LABEL, glow, 10.0, glows=True)]
    for k in range(14):
        corners = [ring[k - 1], ring[k], low[k], low[k - 1]]
        charts.append(polygon(corners, ring[k] + ring[k - 1] - 2 * at, LAMP_LABEL, rim, 10.0, glows=True))
    return charts


def _standing(items: Sequence[Instance], above_m: float) -> shapely.Geometry:
    """Return the footprints of what is higher than that."""
    tops_m = ((i, i.position[2] + i.scale[1] * i.model.bounds[1, 1]) for i in items)
    return shapely.union_all([i.footprint for i, top_m in tops_m if top_m > above_m])


def _windows(
    uses: Sequence[str], sides: Sides, items: Sequence[Instance], cloths: np.ndarray, rng: np.random.Generator
) -> list[Chart]:
    """Return windows, and curtains where nothing is in their way."""
    charts, sky = [], np.array([0.52, 0.70, 0.92]) + rng.uniform(-0.06, 0.06, 3)
    low, tall = _standing(items, 0.1), _standing(items, 0.84)
    for walls, use in zip(sides, uses, strict=True):
        cloth, draped = cloths[rng.integers(len(cloths))], rng.random() < DRAPED.get(use, 0.0)
        for side in walls:
            for box in side.windows:
                charts += at_walls.window(side, box, at_walls.outlook(side, sky, float(rng.uniform(0, 9))))
                a0, a1 = side.along(box.rect)
                strip = side.strip(a0 - 0.2, a1 + 0.2, 0.07)
                in_way = any(h.start < a1 + 0.3 and h.end > a0 - 0.3 for h in side.holes() if h.low < 0.01)
                if draped and not in_way and not strip.intersects(tall):
                    foot = box.low[2] - 0.06 if strip.intersects(low) else 0.17
                    charts += at_walls.curtains(side, box, foot, cloth)
    return charts


def _pictures(side: Side, count: int, tall: shapely.Geometry, rng: np.random.Generator) -> list[Chart]:
    """Return framed pictures on one wall, clear of its openings and of what stands high before it."""
    charts, taken = [], [(h.start - 0.4, h.end + 0.4) for h in side.holes()]
    for _ in range(3 * count):
        half = rng.uniform([0.18, 0.15], [0.42, 0.32]).round(2)
        if rng.random() < 0.35:
            half = half[::-1]
        z = round(float(rng.uniform(1.5, 1.62)), 2)
        frame, seed = FRAMES[rng.integers(len(FRAMES))], int(rng.integers(2**31))
        if side.end - side.start < 2 * half[0] + 0.5:
            continue
        middle = round(float(rng.uniform(side.start + half[0] + 0.25, side.end - half[0] - 0.25)), 2)
        run = (middle - half[0], middle + half[0])
        if len(charts) // 4 >= count or any(a < run[1] + 0.1 and b > run[0] - 0.1 for a, b in taken):
            continue
        if side.strip(*run, 0.1).intersects(tall):
            continue
        taken.append(run)

        def paint(p: np.ndarray, middle=middle, z=z, half=half, frame=frame, seed=seed) -> np.ndarray:
            at = np.column_stack([p[:, 1 - side.axis] - middle, p[:, 2] - z]) / half
            return framed(at, half, frame, np.random.default_rng(seed))

        heights = (z - half[1], z + half[1])
        charts += side.slab(run, (0.0, 0.02), heights, PICTURE, plain(frame), 20.0, "bfu")
        charts += side.slab(run, (0.0, 0.02), heights, PICTURE, paint, 130.0, "blrtu")
    return charts


def _fittings(
    plan: Plan, uses: Sequence[str], sides: Sides, tall: shapely.Geometry, rng: np.random.Generator
) -> list[Chart]:
    """Return front door, pictures, which nothing `tall` hides, switches and sockets."""
    charts: list[Chart] = []
    if plan.entrance is not None:
        walls = sides[plan.entrance.rooms[0]]
        side, middle = at_walls.entrance_place(walls, plan.entrance)
        charts += at_walls.entrance(side, middle, ENTRANCES[rng.integers(len(ENTRANCES))])
        tall = shapely.union(tall, side.strip(middle - 0.6, middle + 0.6, 0.2))
    for k, use in enumerate(uses):
        left = PICTURES.get(use, 0)
        for index in rng.permutation(4):
            wanted = min(left, int(rng.integers(0, 3)))
            hung = _pictures(sides[k][index], wanted, tall, rng) if wanted else []
            charts += hung
            left -= len(hung) // 4
        for side in sides[k]:
            for d in side.doorways:
                low, high = side.along(d.rect)
                beside = high + 0.19 if high + 0.3 < side.end else low - 0.19
                if side.start + 0.05 < beside < side.end - 0.05:
                    charts += at_walls.switch(side, beside, 1.08) + at_walls.switch(side, beside, 0.3)
    return charts


def _built_in(items: Sequence[Instance]) -> list[Chart]:
    """Return built-in furniture: drawn parts in the colour of their material, a library's model with its image."""
    charts = []
    looks: dict[str, tuple[VisualMesh, np.ndarray]] = {}
    for item in items:
        label, visual = NYU40[item.model.category], item.model.surface
        if visual is None:
            for part in item.model.parts:
                charts += piece_charts(item.to_floor(part.vertices), part.faces, label, part.material)
            continue
        if item.model.name not in looks:
            h, w = (n // 2 * 2 for n in visual.image.shape[:2])
            image = visual.image[:h, :w, :3].reshape(h // 2, 2, w // 2, 2, 3).mean(axis=(1, 3))
            look = share_plain(dataclasses.replace(visual, image=np.rint(image).astype(np.uint8)))
            looks[item.model.name] = look, look.image / 255
        look, image = looks[item.model.name]
        placed = item.to_floor(visual.vertices.astype(float))
        charts.append(Chart(placed, visual.faces, label, image, uv=look.uv, uv_faces=look.uv_faces))
    return charts


def model_building(
    plan: Plan, items: Sequence[Instance], uses: Sequence[str], rng: np.random.Generator, palette: Sequence[str] = ()
) -> tuple[Scan, VisualMesh]:
    """Model and paint the structure, with textiles of a `palette`; faces of two labels share no vertex."""
    shades = np.array([MATERIALS[name] for name in palette])
    # As many as without a palette: pictures, which collide, are drawn from the same stream.
    rugs, cloths = (shades[: len(RUGS)], 0.5 + 0.5 * shades[: len(CLOTHS)]) if palette else (RUGS, CLOTHS)
    finish = finishes(plan.rooms, uses, rng, False, rugs)
    sides = [at_walls.sides_of(room, plan.doorways, plan.windows) for room in plan.rooms]
    everything = [*plan.built_in, *items]
    lamps = np.array([[*np.round(r.centre, 3), plan.wall_height_m] for r in plan.rooms])
    charts = _shell(plan, sides, finish)
    charts += _windows(uses, sides, everything, cloths, rng)
    hung, boxes = decor(uses, sides, everything, plan.wall_height_m, rng)
    charts += hung
    tall = shapely.union_all([_standing(everything, 1.1), *(box.rect.polygon for box in boxes)])
    charts += _fittings(plan, uses, sides, tall, rng)
    for room, lamp in zip(plan.rooms, lamps, strict=True):
        charts += _lamp(lamp, min(0.22, 0.11 * min(room.size)))
    charts += _built_in(plan.built_in)
    spans = [(side, *side.along(w.rect)) for walls in sides for side in walls for w in side.windows]
    places = [side.at(low + (high - low) * share, 0.0, 1.5) for side, low, high in spans for share in (0.25, 0.75)]
    inwards = np.repeat([side.inward for side, *_ in spans], 2, axis=0)
    space = space_of(plan, items, boxes)
    light = Daylight(space, lamps - [0, 0, 0.3], np.reshape(places, (-1, 3)), inwards.reshape(-1, 3))
    return assemble(charts, light)
