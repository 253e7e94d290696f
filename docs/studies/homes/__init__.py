"""Count what gives generated homes away: routes, windows, front doors, chairs, roles, radiators, cartons, models."""

import math
from collections import Counter
from collections.abc import Iterable, Sequence

import networkx as nx
import shapely

from converters.generate.homes.building import Plan
from converters.generate.homes.furnish import IN_ROWS
from converters.generate.homes.plans import LARGE_M2, USES
from converters.generate.models.cad import LIBRARY, Instance

PRIVATE = ("bathroom", "bedroom")
NEAR_M = 0.35
"""From edge to edge: seats no farther from a table stand at it."""
BESIDE_M = 0.5
"""Radiators of one wall that are nearer than that stand side by side."""
CARTONS = ("storage", "hall", "office", "bedroom")
"""Uses of rooms where people keep cartons."""
AT = {"office": ("desk", ""), "child": ("desk", "child"), "bar": ("table", "bar")}
"""Role of a seat -> category and role of what it stands at; bar stools stand at counters too."""
WRONG = (
    *("only through bathroom or bedroom", "windowless", "no front door", "door not into hall or living room"),
    *("no bath or shower", "dining tables under 2 chairs", "roles misplaced", "radiator pairs", "cartons misplaced"),
    *("models over 3 times", "plants or bags over twice"),
)
"""Counts that are 0 in every plan and home."""


def plan_counts(plan: Plan, uses: Sequence[str]) -> Counter[str]:
    """Count what is wrong with a plan, and which form it has."""
    out = Counter({"plans": 1, f"outline of {len(plan.facades())} sides": 1})
    doors, entrance = nx.Graph(d.rooms for d in plan.doorways), plan.entrance
    doors.add_nodes_from(range(len(uses)))
    if entrance is None:
        out["no front door"] += 1
    else:
        out["door not into hall or living room"] += uses[entrance.rooms[0]] not in ("hall", "living")
    start = entrance.rooms[0] if entrance else uses.index("living")
    for room, use in enumerate(uses):
        others = doors.subgraph(k for k in doors if uses[k] not in PRIVATE or k in (room, start))
        out["only through bathroom or bedroom"] += not nx.has_path(others, start, room)
        near = plan.rooms[room].polygon.buffer(0.02)
        seen = any(near.intersection(w.rect.polygon).area > 0.001 for w in plan.windows)
        out["windowless"] += USES[use].window and not seen
    if sum(r.area_m2 for r in plan.rooms) > LARGE_M2:
        out["plans above 90 m2"] += 1
        out["of these with 2 bedrooms and bathrooms"] += min(uses.count(use) for use in PRIVATE) >= 2
    return out


def role(item: Instance) -> str:
    """Return the role of a piece's model, empty where it has none."""
    plain = item.model.name.partition("#")[0].partition("~")[0]  # of a front that opens, and of a tint
    return LIBRARY[plain].role


def seats_at(tables: Sequence[Instance], seats: Iterable[Instance]) -> list[list[Instance]]:
    """Return the seats that stand at each table, each at the nearest one."""
    out: list[list[Instance]] = [[] for _ in tables]
    for seat in seats if tables else ():
        away = [seat.footprint.distance(table.footprint) for table in tables]
        if min(away) < NEAR_M:
            out[away.index(min(away))].append(seat)
    return out


def home_counts(plan: Plan, uses: Sequence[str], items: Sequence[Instance]) -> Counter[str]:
    """Count what is wrong with a home's furniture, built-in pieces among the items, and what there is of it."""
    of = {c: [i for i in items if i.model.category == c] for c in {i.model.category for i in items}}
    out = Counter({"homes": 1, "no bath or shower": not ({"tub", "shower"} & set(of))})

    def room(item: Instance) -> int:
        at = shapely.Point(item.footprint.centroid)
        return min(range(len(uses)), key=lambda k: plan.rooms[k].polygon.distance(at))

    def use(item: Instance) -> str:
        return uses[room(item)]

    tables = [t for t in of.get("table", []) if role(t) != "bar"]
    chairs = seats_at(tables, (c for c in of.get("chair", []) if not role(c)))
    out.update(f"dining tables of {len(at)} chairs" for at in chairs)
    out["dining tables under 2 chairs"] = sum(len(at) < 2 for at in chairs)
    for item in items:
        kind, where = role(item), use(item)
        wrong = (kind == "bath") != (where == "bathroom") if item.model.category == "radiator" else False
        wrong |= kind in ("child", "baby") and where != "bedroom"
        if item.model.category in ("chair", "stool") and kind:
            category, wanted = AT[kind]
            hosts = [h for h in of.get(category, []) if role(h) == wanted]
            hosts += of.get("counter", []) if kind == "bar" else []
            wrong |= not any(item.footprint.distance(h.footprint) < NEAR_M for h in hosts)
        out["roles misplaced"] += wrong
    heaters = of.get("radiator", [])
    out["radiator pairs"] = sum(
        room(a) == room(b)
        and abs(math.sin(a.yaw_rad - b.yaw_rad)) < 0.5
        and a.footprint.distance(b.footprint) < BESIDE_M
        for k, a in enumerate(heaters)
        for b in heaters[:k]
    )
    out["cartons"] = len(of.get("box", []))
    out["cartons misplaced"] = sum(use(box) not in CARTONS for box in of.get("box", []))
    # Chairs of one model in the room of their table belong to it, even where they were pulled away from it.
    sets = [(at[0], c) for at in chairs if at for c in of["chair"] if c.model.name == at[0].model.name]
    at_tables = {id(c) for first, c in sets if c is not first and room(c) == room(first)}
    alike = Counter(i.model.name for i in items if i.model.category not in IN_ROWS and id(i) not in at_tables)
    out["models over 3 times"] = sum(count > 3 for count in alike.values())
    kept = Counter(i.model.name for i in items if i.model.category in ("plant", "bag"))
    out["plants or bags over twice"] = sum(count > 2 for count in kept.values())
    return out
