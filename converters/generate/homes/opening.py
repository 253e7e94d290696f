"""Cut the fronts out of built-in furniture that open where it stands: those that would hit something stay shut."""

import dataclasses
from collections.abc import Sequence

import shapely

from converters.generate.design.plan import Plan
from converters.generate.homes.arrange import TABLES
from converters.generate.models.cad import Instance, LeafHinge
from converters.generate.models.fronts import Front, carcass, opened, openings

KITCHEN = ("counter", "sink", "fridge", "stove")
"""Categories whose fronts open where the setting `opening` is `kitchen`."""
STEPS, LEAST = 12, 0.6
"""A front opens as far as it hits nothing, in so many steps; one that gets less far than this share stays shut."""
TOUCH_M = 0.005
"""Fronts that overlap others' outlines by less hit nothing: neighbours stand side by side."""
Slab = tuple[shapely.Geometry, float, float]
"""An outline from above, its lowest and its highest point."""


def _reach(item: Instance, front: Front, around: Sequence[Slab]) -> float:
    """Return the share of its range by which a front opens without hitting what stands around."""
    for step in range(1, STEPS + 1):
        for points in opened(item, front, step / STEPS):
            outline = shapely.MultiPoint(points[:, :2]).convex_hull.buffer(-TOUCH_M)
            low, high = points[:, 2].min() + TOUCH_M, points[:, 2].max() - TOUCH_M
            if any(base < high and top > low and outline.intersects(shape) for shape, base, top in around):
                return (step - 1) / STEPS
    return 1.0


def open_fronts(
    plan: Plan, built_in: Sequence[Instance], others: Sequence[Instance], opening: str
) -> tuple[tuple[Instance, ...], tuple[Instance, ...]]:
    """Return the built-in furniture without the fronts that open, and these; `others` is what stands around.

    Light pieces are in no front's way: they are pushed.
    """
    walls = [(shapely.box(w.rect.x0, w.rect.y0, w.rect.x1, w.rect.y1), w.low[2], w.high[2]) for w in plan.walls]
    heavy = [item for item in (*built_in, *others) if item.model.category not in TABLES.light]
    bodies, fronts = [], []
    for item in built_in:
        cut = []
        far = item.footprint.buffer(1.2)
        opens = opening == "all" or (opening == "kitchen" and item.model.category in KITCHEN)
        around = [*walls, *(slab for other in heavy if other is not item for slab in other.slabs)] if opens else []
        around = [slab for slab in around if far.intersects(slab[0])]
        for part in openings(item.model.name) if opens else ():
            share = _reach(item, part.front, around)
            if share >= LEAST:
                cut.append(part)
                hinge: LeafHinge = part.front.hinge
                hinge = dataclasses.replace(hinge, range_rad=(0.0, round(share * hinge.range_rad[1], 4)))
                fronts.append(dataclasses.replace(item, model=part.front.model, hinge=hinge))
        bodies.append(dataclasses.replace(item, model=carcass(item.model, tuple(cut))) if cut else item)
    return tuple(bodies), tuple(fronts)
