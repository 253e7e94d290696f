"""Draw the floor plan of a sparse building: rooms without uses, doorways, windows, cupboards."""

import dataclasses
import itertools

import networkx as nx
import numpy as np

from converters.generate.design.config import BuildingConfig, GenerationError
from converters.generate.design.plan import (
    CM,
    DOORWAY_MARGIN_M,
    Doorway,
    Plan,
    PlanBox,
    Rect,
    Wall,
    cut,
    doorway_zone,
    draw_outline,
    place_doorway,
    shared_wall,
    snap,
    split,
    wall_boxes,
)


def _layout(cfg: BuildingConfig, rng: np.random.Generator) -> tuple[Rect, list[Rect], list[Wall], int | None]:
    """Draw rooms and inner walls once; the caller checks the rooms."""
    n, spread = int(rng.integers(cfg.n_rooms[0], cfg.n_rooms[1] + 1)), 0.1
    weights = (1.0,) * n
    inside = draw_outline(rng.uniform(*cfg.floor_area_m2), rng)
    if n < cfg.corridor_from_rooms:
        rooms, walls = split(inside, weights, spread, cfg, rng)
        return inside, rooms, walls, None
    across = int(inside.size[0] >= inside.size[1])
    thick = snap(rng.uniform(*cfg.wall_thickness_m))
    clear = snap(cfg.corridor_width_m)
    n_low = (n - 1) // 2
    span = inside.size[across] - clear - 2 * thick
    few, many = weights[1 : 1 + n_low], weights[1 + n_low :]
    share = sum(few) / sum(weights[1:]) + rng.uniform(-spread / 2, spread / 2)
    at = snap(inside.span(across)[0] + span * share)
    low, wall_low, rest = cut(inside, across, at, thick)
    corridor, wall_high, high = cut(rest, across, snap(at + thick + clear), thick)
    rooms_low, walls_low = split(low, few, spread, cfg, rng)
    rooms_high, walls_high = split(high, many, spread, cfg, rng)
    return inside, [corridor, *rooms_low, *rooms_high], [wall_low, wall_high, *walls_low, *walls_high], 0


def _doorways(
    rooms: list[Rect],
    walls: list[Wall],
    corridor: int | None,
    cfg: BuildingConfig,
    rng: np.random.Generator,
    door_height: float,
) -> list[Doorway] | None:
    """Draw doorways that join all rooms, and some more; return None where the plan does not allow that."""
    graph = nx.Graph()
    shared_walls: dict[tuple[int, int], Wall] = {}
    graph.add_nodes_from(range(len(rooms)))
    need = cfg.doorway_width_m[1] + 2 * DOORWAY_MARGIN_M
    for i, j in itertools.permutations(range(len(rooms)), 2):
        shared = shared_wall(rooms[i], rooms[j], walls)
        if shared is None:
            continue
        axis, rect = shared
        if rect.size[1 - axis] >= need:
            weight = rng.random() + (0.0 if corridor in (i, j) else 1.0)
            graph.add_edge(i, j, weight=weight)
            shared_walls[i, j] = axis, rect
    if not nx.is_connected(graph):
        return None
    tree = set(nx.minimum_spanning_edges(graph, data=False))
    chosen = []
    for (i, j), (axis, rect) in sorted(shared_walls.items()):
        if (i, j) not in tree and (j, i) not in tree and rng.random() >= cfg.loop_probability:
            continue
        start, end = rect.span(1 - axis)
        width = rng.uniform(*cfg.doorway_width_m)
        if rng.random() < 0.4:
            width += rng.uniform(0, cfg.archway_extra_m)
        at, width = place_doorway((start, end), width, cfg, rng)
        chosen.append(Doorway((i, j), axis, Rect.across(axis, *rect.span(axis), at, at + width), door_height))
    return chosen


def _fixtures(
    rooms: list[Rect], doorways: list[Doorway], cfg: BuildingConfig, rng: np.random.Generator
) -> list[PlanBox]:
    """Draw cupboards and counters in corners of rooms, away from doorways."""
    wanted = int(rng.integers(cfg.n_static[0], cfg.n_static[1] + 1))
    boxes: list[PlanBox] = []
    zones = [doorway_zone(d, 1.05, 0.15) for d in doorways]
    order = rng.permutation(len(rooms))
    for room in [rooms[i] for i in order] * 3:
        if len(boxes) == wanted:
            break
        if min(room.size) < 1.8:
            continue
        axis, way, face, start, end = room.sides()[rng.integers(4)]
        counter = rng.random() < 0.5
        length = snap(min(rng.uniform(1.2, 2.0) if counter else rng.uniform(0.8, 1.3), end - start))
        depth, height = (0.60, 0.90) if counter else (0.45, snap(rng.uniform(1.6, 2.1)))
        at = start if rng.random() < 0.5 else end - length
        lo, hi = sorted((face, face + way * depth))
        rect = Rect.across(axis, lo, hi, at, at + length)
        if not any(rect.overlaps(other) for other in (*zones, *(b.rect for b in boxes))):
            boxes.append(PlanBox.over(rect, 0.0, height))
    return boxes


def _windows(
    inside: Rect,
    rooms: list[Rect],
    fixtures: list[PlanBox],
    thick: float,
    cfg: BuildingConfig,
    rng: np.random.Generator,
) -> list[PlanBox]:
    """Draw windows in outer walls, each before one room, none behind a cupboard."""
    wanted = int(rng.integers(cfg.n_windows[0], cfg.n_windows[1] + 1))
    outer_faces = {(axis, way): face for axis, way, face, *_ in inside.sides()}
    sides = [side for room in rooms for side in room.sides() if side[4] - side[3] > 1.6]
    sides = [side for side in sides if abs(side[2] - outer_faces[side[0], side[1]]) < CM / 2]
    boxes: list[PlanBox] = []
    for k in rng.permutation(len(sides)):
        if len(boxes) == wanted:
            break
        axis, way, face, start, end = sides[k]
        width = snap(rng.uniform(0.8, min(1.5, end - start - 0.6)))
        at = snap(rng.uniform(start + 0.3, max(start + 0.3, end - 0.3 - width)))
        lo, hi = sorted((face, face - way * thick))
        rect = Rect.across(axis, lo, hi, at, at + width)
        if not any(rect.grown(0.3, 0.3).overlaps(f.rect) for f in fixtures):
            boxes.append(PlanBox.over(rect, 0.9, 2.05))
    return boxes


def make_plan(cfg: BuildingConfig, rng: np.random.Generator, max_tries: int = 2000) -> Plan:
    """Draw a plan whose rooms are all joined by doorways."""
    for _ in range(max_tries):
        inside, rooms, walls, corridor = _layout(cfg, rng)
        plain = [r for i, r in enumerate(rooms) if i != corridor]
        if min(min(r.size) for r in plain) < cfg.min_room_side_m or max(max(r.size) / min(r.size) for r in plain) > 2.3:
            continue
        door_height = snap(rng.uniform(2.06, 2.12))
        doorways = _doorways(rooms, walls, corridor, cfg, rng, door_height)
        if doorways is None:
            continue
        height = snap(rng.uniform(*cfg.wall_height_m))
        thick = snap(cfg.wall_thickness_m[1])
        outer = Rect(*map(snap, dataclasses.astuple(inside.grown(thick, thick))))
        boxes = [b for w in walls for b in wall_boxes(w, doorways, height)]
        around = [Rect(x0, outer.y0, x1, outer.y1) for x0, x1 in ((outer.x0, inside.x0), (inside.x1, outer.x1))]
        around += [Rect(inside.x0, y0, inside.x1, y1) for y0, y1 in ((outer.y0, inside.y0), (inside.y1, outer.y1))]
        boxes += [PlanBox.over(rect, 0.0, height) for rect in around]
        fixtures = _fixtures(rooms, doorways, cfg, rng)
        panes, cut = tuple(_windows(inside, plain, fixtures, thick, cfg, rng)), tuple(doorways)
        return Plan(tuple(rooms), outer, tuple(boxes), cut, panes, tuple(fixtures), corridor, height)
    raise GenerationError(
        f"no plan in {max_tries} tries for {cfg.n_rooms} rooms on {cfg.floor_area_m2} m2: "
        "fewer rooms, more area or a smaller min_room_side_m would make it possible"
    )
