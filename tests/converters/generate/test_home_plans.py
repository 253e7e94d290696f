"""Plans of homes: routes, windows, front doors and outlines of 150 seeds, against graphs and polygons by hand."""

from __future__ import annotations

import functools

import networkx as nx
import numpy as np
import pytest
import shapely
from hypothesis import given
from hypothesis import strategies as st

from converters.generate import GenerationError
from converters.generate.homes.arrange import TABLES
from converters.generate.homes.building import Plan, Rect
from converters.generate.homes.config import home_config
from converters.generate.homes.plans import FORBIDDEN, LARGE_M2, USES, Relations, assign_uses, home_plan, programme
from tests.converters.generate.test_generate_plan import polygon

PRIVATE = {"bathroom", "bedroom"}


@functools.cache
def plans() -> tuple[tuple[Plan, list[str]], ...]:
    shell = home_config("furnished", {})
    return tuple(home_plan(shell, np.random.default_rng(650_000 + seed)) for seed in range(150))


@given(st.integers(1, 12), st.integers(0, 1000))
def test_a_programme_has_a_living_room_and_no_more_of_a_use_than_homes_have(n, seed):
    uses = programme(n, np.random.default_rng(seed))
    assert len(uses) == n and uses.count("living") == 1 and set(uses) <= set(TABLES.rooms)
    assert all(uses.count(u) <= USES[u].most for u in uses if u != "bedroom")
    assert n < 4 or {"bedroom", "bathroom", "kitchen"} <= set(uses)


def test_large_homes_have_two_bedrooms_and_two_bathrooms():
    large = [uses for plan, uses in plans() if sum(r.area_m2 for r in plan.rooms) > LARGE_M2]
    assert len(large) > 30
    assert all(uses.count("bedroom") >= 2 and uses.count("bathroom") >= 2 for uses in large)


def test_rooms_have_the_use_that_their_size_suits():
    largest = 0
    for plan, uses in plans():
        area = {use: [r.area_m2 for r, u in zip(plan.rooms, uses, strict=True) if u == use] for use in set(uses)}
        assert len(uses) == len(plan.rooms) and (plan.corridor is None or uses[plan.corridor] == "hall")
        largest += area["living"] == [max(r.area_m2 for r in plan.rooms)]
        for room, use in zip(plan.rooms, uses, strict=True):
            assert min(room.size) >= USES[use].least_side_m - 0.6
    assert largest >= 0.9 * len(plans())


def test_the_kitchen_is_exchanged_to_lie_beside_the_living_room():
    rooms = [Rect(0, 0, 3, 3), Rect(3.1, 0, 6.1, 3), Rect(6.2, 0, 12, 3), Rect(12.1, 0, 15.1, 3)]
    joined = np.eye(4, k=1) + np.eye(4, k=-1) > 0
    uses, misfit = assign_uses(Relations(rooms, joined, np.full(4, 3.0)), 3, ["living", "kitchen", "bedroom"])
    assert uses == ["bedroom", "kitchen", "living", "hall"] and misfit < FORBIDDEN


def test_no_room_is_reached_only_through_a_bathroom_or_a_bedroom():
    for plan, uses in plans():
        assert plan.entrance is not None
        graph = nx.Graph(d.rooms for d in plan.doorways)
        assert set(graph) == set(range(len(uses)))
        for room in graph:
            others = [k for k in graph if uses[k] not in PRIVATE or k == room]
            assert nx.has_path(graph.subgraph(others), plan.entrance.rooms[0], room), (uses, room)


def _windows_of(plan: Plan, room: Rect) -> int:
    grown = room.polygon.buffer(0.02)
    return sum(grown.intersection(polygon(w.rect)).area > 0.001 for w in plan.windows)


def test_living_rooms_bedrooms_and_kitchens_have_windows_in_outer_walls():
    for plan, uses in plans():
        inside = shapely.union_all([polygon(r) for r in (*plan.rooms, *(d.rect for d in plan.doorways))])
        for room, use in zip(plan.rooms, uses, strict=True):
            assert use not in {"living", "bedroom", "kitchen"} or _windows_of(plan, room) >= 1, use
        boxes = [polygon(w.rect) for w in plan.windows]
        assert plan.entrance is not None
        boxes.append(polygon(plan.entrance.rect))
        for k, box in enumerate(boxes):
            assert not inside.buffer(-0.001).intersects(box)
            assert not any(box.intersects(other) for other in boxes[:k])
            # One side looks into a room, the other out.
            assert shapely.union_all([polygon(w.rect) for w in plan.walls if w.low[2] == 0]).contains(
                box.buffer(-0.001)
            )


def test_the_front_door_leads_into_a_hall_or_living_room_with_a_metre_of_floor():
    for plan, uses in plans():
        zone, door = plan.entrance_zone, plan.entrance
        assert zone is not None and door is not None and uses[door.rooms[0]] in ("hall", "living")
        assert zone.area_m2 == pytest.approx(1.0) and door.rect.polygon.distance(zone.polygon) < 0.001
        assert plan.rooms[door.rooms[0]].polygon.buffer(0.001).contains(zone.polygon)
        assert plan.rooms[door.rooms[0]].polygon.intersection(door.rect.polygon).area == 0


def test_outlines_and_corridors_have_several_forms():
    corners = [len(plan.facades()) for plan, _ in plans()]
    assert set(corners) >= {4, 6, 8} and 0.25 < np.mean(np.array(corners) > 4) < 0.75
    halls = [plan.rooms[plan.corridor] for plan, _ in plans() if plan.corridor is not None]
    across = [
        max(hall.size) / (max(plan.outer.size) if hall.size[0] > hall.size[1] else max(plan.outer.size))
        for hall, plan in zip(halls, [p for p, _ in plans() if p.corridor is not None], strict=True)
    ]
    wide = [min(hall.size) for hall in halls]
    assert np.mean(np.array(wide) > 1.7) > 0.1 and np.mean(np.array(across) < 0.75) > 0.2


def test_facades_enclose_the_walls():
    for plan, _ in plans():
        walls = shapely.union_all([polygon(r) for r in (*plan.rooms, *(w.rect for w in plan.walls))], grid_size=0.001)
        faces = plan.facades()
        # Area by the divergence theorem: each face's coordinate times its length, positive where it looks to +x.
        area = sum(way * face * (end - start) for axis, way, face, start, end in faces if axis == 0)
        assert area == pytest.approx(walls.area, abs=0.02) and walls.geom_type == "Polygon"
        assert len(walls.interiors) == 0 and walls.bounds == pytest.approx(
            (plan.outer.x0, plan.outer.y0, plan.outer.x1, plan.outer.y1)
        )


def test_what_no_plan_can_satisfy_is_one_line():
    shell = home_config("furnished", {"floor_area_m2": (20.0, 20.0), "n_rooms": (9, 9)})
    with pytest.raises(GenerationError, match="no plan in .* tries for .9, 9. rooms on .20.0, 20.0. m2: fewer rooms"):
        home_plan(shell, np.random.default_rng(0))
