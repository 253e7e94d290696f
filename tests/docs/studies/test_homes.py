"""Counts of homes: 0 in two homes and twenty plans, and not in what is put wrong by hand."""

import dataclasses
import math

import numpy as np

from converters.generate.homes.building import Doorway
from converters.generate.homes.config import home_config
from converters.generate.homes.plans import home_plan
from converters.generate.models.cad import Instance, cad_model, place
from docs.studies.homes import WRONG, home_counts, plan_counts, seats_at
from tests.converters.generate.test_homes import several


def at(name: str, xy, facing_rad: float = 0.0) -> Instance:
    model = cad_model(name)
    return place(model, model.unit_m * np.ones(3), np.asarray(xy, float), facing_rad)


def test_nothing_is_wrong_in_two_homes_and_twenty_plans():
    for home in several()[:2]:
        counts = home_counts(home.plan, home.uses, [s.item for s in home.floor.standing])
        assert {name: counts[name] for name in WRONG if counts[name]} == {}
        assert counts["homes"] == 1 and counts["cartons"] <= 4
    shell = home_config("furnished", {})
    for seed in range(720_200, 720_220):
        counts = plan_counts(*home_plan(shell, np.random.default_rng(seed)))
        assert {name: counts[name] for name in WRONG if counts[name]} == {} and counts["plans"] == 1


def test_what_is_put_wrong_in_a_home_is_counted():
    plan, uses = several()[0].plan, several()[0].uses
    living, bath = (np.array(plan.rooms[uses.index(use)].centre) for use in ("living", "bathroom"))
    table, aside = at("Scopia/table4", living), at("BlendSwap-CC-0/oakTable", living + [0, 30])
    chairs = [at("Scopia/chair4", living + [0, way * 0.7], -way * math.pi / 2) for way in (1, -1)]
    right = home_counts(plan, uses, [table, *chairs, at("Scopia/corner_bathtub", bath)])
    assert right["dining tables of 2 chairs"] == 1 and not any(right[name] for name in WRONG)
    bedroom = np.array(plan.rooms[uses.index("bedroom")].centre)
    for away, over in ((living, 0), (bedroom, 1)):  # pulled away from the table, or spread over the home
        more = [at("Scopia/chair4", away + [k / 10, 1.4]) for k in range(-1, 3)]
        assert home_counts(plan, uses, [table, *chairs, *more])["models over 3 times"] == over
    wrong = [
        *(
            at("Scopia/office_chair", living + [2, 0]),
            at("Scopia/bar_chair", bath),
            at("Scopia/changing-table", living),
        ),
        *(at("BlendSwap-CC-0/radiator", bath), at("BlendSwap-CC-0/radiator", bath + [0.3, 0])),
        *(at("Scopia/cardboard-box", living + [k, 5]) for k in range(2)),
        *(at("Scopia/maceta", living + [k, 6]) for k in range(4)),
    ]
    got = home_counts(plan, uses, [table, aside, chairs[0], *wrong])
    assert got["dining tables of 1 chairs"] == got["dining tables of 0 chairs"] == 1
    assert got["dining tables under 2 chairs"] == 2 and got["no bath or shower"] == 1
    assert got["roles misplaced"] == 5  # the radiators of a bathroom are not for towels
    assert got["radiator pairs"] == 1 and got["models over 3 times"] == got["plants or bags over twice"] == 1
    assert got["cartons"] == 2 and seats_at([table, aside], chairs) == [chairs, []]


def test_what_is_put_wrong_in_a_plan_is_counted():
    plan, uses = several()[0].plan, several()[0].uses
    blind = plan_counts(dataclasses.replace(plan, windows=(), entrance=None), uses)
    wanted = sum(use in ("living", "bedroom", "kitchen") for use in uses)
    assert blind["windowless"] == wanted and blind["no front door"] == 1
    bath, other = uses.index("bathroom"), next(k for k, use in enumerate(uses) if use == "bedroom")
    doorway = dataclasses.replace(plan.doorways[0], rooms=(bath, other))
    kept: list[Doorway] = [d for d in plan.doorways if other not in d.rooms]
    counts = plan_counts(dataclasses.replace(plan, doorways=(*kept, doorway)), uses)
    assert counts["only through bathroom or bedroom"] == 1
