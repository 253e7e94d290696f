"""A home's plan in, its exact structure out: a finely painted mesh of rooms and what is built in, nothing that moves.

Frame: scan x, y, height above the floor; metres.
"""

import math
from collections.abc import Sequence

import numpy as np
import shapely

from converters.generate.design.instance import Instance
from converters.generate.design.plan import Plan, Rect
from converters.generate.models.parts import MATERIALS
from converters.generate.surface import sides as at_walls
from converters.generate.surface.charts import Chart, assemble, piece_charts, plain, polygon
from converters.generate.surface.finishes import FRAMES, Colouring, Finish, finishes, framed
from converters.generate.surface.light import Daylight, space_of
from converters.generate.surface.scan import NYU40, Scan
from converters.generate.surface.sides import CLOTHS, ENTRANCES, FLOOR_M, PICTURE, Side
from converters.generate.surface.texture import Atlas
from converters.records.raw import CEILING, FLOOR, WALL

CEILING_WHITE, LAMP_LABEL = np.array([0.95, 0.95, 0.93]), 35
DRAPED = {"living": 0.9, "bedroom": 0.9, "dining": 0.6, "office": 0.4}
"""Use of a room -> share of its windows that have curtains."""
PICTURES = {"living": 4, "bedroom": 2, "dining": 3, "office": 2, "hall": 2, "kitchen": 1}
"""Use of a room -> pictures on its walls, at most."""


def _flat(rect: Rect, z: float, up: int, label: int, paint: Colouring, texels_per_m: float = 80.0,
          glows: bool = False) -> Chart:  # fmt: skip
    corners = [(rect.x0, rect.y0, z), (rect.x1, rect.y0, z), (rect.x1, rect.y1, z), (rect.x0, rect.y1, z)]
    return polygon(corners, (0, 0, up), label, paint, texels_per_m, glows)


def _shell(plan: Plan, sides: list[list[Side]], finish: list[Finish]) -> list[Chart]:
    """Floors, ceilings, walls with their boards, doorways; tops and outsides of the walls."""
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
    o = plan.outer
    for axis, way, face, low, high in (
        (0, -1, o.x0, o.y0, o.y1), (0, 1, o.x1, o.y0, o.y1), (1, -1, o.y0, o.x0, o.x1), (1, 1, o.y1, o.x0, o.x1)
    ):  # fmt: skip
        near = [w for w in plan.windows if abs((w.low if way < 0 else w.high)[axis] - face) < 0.005]
        outside = Side(axis, way, face, low, high, (), tuple(near))
        charts += at_walls.wall_face(outside, height, plain([0.80, 0.78, 0.73]), 8.0)
    return charts


def _lamp(at: np.ndarray, radius: float) -> list[Chart]:
    """A round shade under the ceiling; `at` is the middle of its top."""
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
    """Footprints of what is higher than that."""
    return shapely.union_all([
        i.footprint for i in items if i.position[2] + i.scale[1] * i.model.bounds[1, 1] > above_m
    ])  # fmt: skip


def _windows(plan: Plan, uses: Sequence[str], sides: list[list[Side]], items: Sequence[Instance],
             rng: np.random.Generator) -> list[Chart]:  # fmt: skip
    """Windows, and curtains where nothing is in their way."""
    charts, sky = [], np.array([0.52, 0.70, 0.92]) + rng.uniform(-0.06, 0.06, 3)
    low, tall = _standing(items, 0.1), _standing(items, 0.84)
    for walls, use in zip(sides, uses, strict=True):
        cloth, draped = CLOTHS[rng.integers(len(CLOTHS))], rng.random() < DRAPED.get(use, 0.0)
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
    """Framed pictures on one wall, clear of its openings and of what stands high before it."""
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


def _fittings(plan: Plan, uses: Sequence[str], sides: list[list[Side]], items: Sequence[Instance],
              rng: np.random.Generator) -> list[Chart]:  # fmt: skip
    """Front door, pictures, switches and sockets."""
    charts, o = [], plan.outer
    standing, tall = _standing(items, 0.05), _standing(items, 1.1)
    order = sorted(range(len(uses)), key=lambda k: ({"hall": 0, "living": 1}.get(uses[k], 2), k))
    walls = [s for k in order if k == plan.corridor or uses[k] in ("hall", "living", "dining") for s in sides[k]]
    reach = {(0, 1): o.x0, (0, -1): o.x1, (1, 1): o.y0, (1, -1): o.y1}
    found = at_walls.entrance_place(walls, [abs(reach[s.axis, s.way] - s.face) < 0.5 for s in walls], standing)
    colour = ENTRANCES[rng.integers(len(ENTRANCES))]
    if found is not None:
        charts += at_walls.entrance(*found, colour)
        middle = found[1]
        tall = shapely.union(tall, found[0].strip(middle - 0.6, middle + 0.6, 0.2))
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
    """Built-in furniture: drawn parts in the colour of their material, a library's model with its image."""
    charts = []
    images: dict[str, np.ndarray] = {}
    for item in items:
        label, visual = NYU40[item.model.category], item.model.surface
        if visual is None:
            for part in item.model.parts:
                paint = plain(MATERIALS[part.material])
                charts += piece_charts(item.to_floor(part.vertices), part.faces, label, paint)
            continue
        if item.model.name not in images:
            picture = np.asarray(visual.image, float)[..., :3] / 255
            h, w = (n // 2 * 2 for n in picture.shape[:2])
            images[item.model.name] = picture[:h, :w].reshape(h // 2, 2, w // 2, 2, 3).mean(axis=(1, 3))
        placed, image = item.to_floor(np.asarray(visual.vertices, float)), images[item.model.name]
        uv, uv_faces = np.asarray(visual.uv, float), visual.uv_faces
        charts.append(Chart(placed, visual.faces, label, image, uv=uv, uv_faces=uv_faces))
    return charts


def model_building(plan: Plan, items: Sequence[Instance], uses: Sequence[str],
                   rng: np.random.Generator) -> tuple[Scan, Atlas]:  # fmt: skip
    """Models and paints the structure.

    Returns:
        The mesh, no vertex in faces of two labels, and its atlas.
    """
    rooms = [(r.x0, r.y0, r.x1, r.y1) for r in plan.rooms]
    finish = finishes(rooms, uses, rng, pictures=False)
    sides = [at_walls.sides_of(room, plan.doorways, plan.windows) for room in plan.rooms]
    everything = [*plan.built_in, *items]
    lamps = np.array([[*np.round(r.centre, 3), plan.wall_height_m] for r in plan.rooms])
    charts = _shell(plan, sides, finish)
    charts += _windows(plan, uses, sides, everything, rng)
    charts += _fittings(plan, uses, sides, everything, rng)
    for room, lamp in zip(plan.rooms, lamps, strict=True):
        charts += _lamp(lamp, min(0.22, 0.11 * min(room.size)))
    cabinet = np.array(MATERIALS["white"] if rng.random() < 0.6 else MATERIALS["oak"])
    charts += [c for box in plan.fixtures for c in at_walls.cupboard(box, cabinet)]
    charts += _built_in(plan.built_in)
    panes = [
        (side.at(low + (high - low) * share, 0.0, 1.5), side.inward)
        for walls in sides for side in walls for low, high in map(side.along, (w.rect for w in side.windows))
        for share in (0.25, 0.75)
    ]  # fmt: skip
    places, inwards = (np.array([p[k] for p in panes]).reshape(-1, 3) for k in range(2))
    light = Daylight(space_of(plan), lamps - [0, 0, 0.3], places, inwards)
    return assemble(charts, light)
