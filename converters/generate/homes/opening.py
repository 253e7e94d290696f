"""Cut the fronts out of built-in furniture that open where it stands; all of a kitchen do."""

import dataclasses
import math
from collections.abc import Sequence

import shapely

from converters.generate.homes.arrange import TABLES
from converters.generate.homes.building import Plan
from converters.generate.homes.config import GenerationError
from converters.generate.models.cad import Instance
from converters.generate.models.fronts import carcass, opened, openings

KITCHEN = ("counter", "sink", "fridge", "stove")
"""Categories whose fronts open where the setting `opening` is `kitchen`."""
OPENS = (*KITCHEN, "wardrobe", "washbasin", "shower")
"""The same where it is `all`."""
STEPS, LEAST_RAD, LEAST_M = 12, math.radians(60), 0.2
"""A front opens as far as it hits nothing, in so many steps. Less than this is not open."""
TOUCH_M = 0.005
"""Fronts that overlap other furniture's outlines by less hit nothing: neighbours stand side by side. Walls are hit."""
Slab = tuple[shapely.Geometry, float, float]
"""An outline from above, its lowest and its highest point."""


def _reach(front: Instance, around: Sequence[Slab]) -> float:
    """Return the share of its range by which a front opens without hitting what stands around."""
    for step in range(1, STEPS + 1):
        for points in opened(front, step / STEPS):
            outline = shapely.MultiPoint(points[:, :2]).convex_hull.buffer(-TOUCH_M)
            low, high = points[:, 2].min() + TOUCH_M, points[:, 2].max() - TOUCH_M
            if any(base < high and top > low and outline.intersects(shape) for shape, base, top in around):
                return (step - 1) / STEPS
    return 1.0


def open_fronts(
    plan: Plan, built_in: Sequence[Instance], others: Sequence[Instance], opening: str
) -> tuple[tuple[Instance, ...], tuple[Instance, ...]]:
    """Return the built-in furniture without its opening fronts, and these fronts; `others` is the furniture around it.

    Raise `GenerationError` if a kitchen's front is blocked; other blocked fronts stay part of their cabinet.
    """
    rects = [w.rect.grown(TOUCH_M, TOUCH_M) for w in plan.walls]
    walls = [(rect.polygon, w.low[2], w.high[2]) for rect, w in zip(rects, plan.walls, strict=True)]
    heavy = [item for item in (*built_in, *others) if item.model.category not in TABLES.light]
    bodies, fronts = [], []
    for item in built_in:
        cut = []
        far = item.footprint.buffer(1.2)
        opens = item.model.category in {"all": OPENS, "kitchen": KITCHEN, "none": ()}[opening]
        around = [*walls, *(slab for other in heavy if other is not item for slab in other.slabs)] if opens else []
        around = [slab for slab in around if far.intersects(slab[0])]
        for part in openings(item.model.name) if opens else ():
            hinge, front = part.hinge, dataclasses.replace(item, model=part.model, hinge=part.hinge)
            limit = round(_reach(front, around) * hinge.range_rad[1], 4)
            if limit >= min(LEAST_M if hinge.slides else LEAST_RAD, hinge.range_rad[1]) - 1e-3:
                cut.append(part)
                hinge = dataclasses.replace(hinge, range_rad=(0.0, limit))
                fronts.append(dataclasses.replace(front, hinge=hinge))
            elif item.model.category in KITCHEN:
                raise GenerationError(
                    f"a front of the {item.model.category} {item.model.name} opens by {limit:.2f} "
                    f"{'m' if hinge.slides else 'rad'} only: ask for more area or fewer rooms"
                )
        bodies.append(dataclasses.replace(item, model=carcass(item.model, tuple(cut))) if cut else item)
    return tuple(bodies), tuple(fronts)
