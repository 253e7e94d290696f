"""Every front of a kitchen opens: C MuJoCo pulls each to its limit, among walls and heavy furniture at rest."""

from __future__ import annotations

import dataclasses
import functools
import math
from collections import Counter
from pathlib import Path

import mujoco
import numpy as np
import pytest

from converters.check.gates import collide_with
from converters.check.opening import blocked_fronts, held_bodies
from converters.generate import Building, design_building
from converters.generate.homes.arrange import TABLES
from converters.generate.homes.building import Plan, PlanBox, Rect
from converters.generate.homes.config import home_config
from converters.generate.homes.opening import KITCHEN, OPENS, TOUCH_M, open_fronts
from converters.generate.models.cad import LIBRARY, Instance, cad_model, place
from converters.generate.models.fronts import openings
from scenes_mjcf.schema import SceneError
from scenes_mjcf.sets import scene_folders

MOST_N = 100.0
"""Contacts may push a front by so much: a chair of 8 kg is pushed at 40 N."""
PULL = {mujoco.mjtJoint.mjJNT_SLIDE: (2000.0, 60.0), mujoco.mjtJoint.mjJNT_HINGE: (800.0, 40.0)}
"""Stiffness, N/m or N m/rad, and greatest pull, N or N m, of the hand that opens a front within two seconds."""
LEAST = {mujoco.mjtJoint.mjJNT_SLIDE: 0.2, mujoco.mjtJoint.mjJNT_HINGE: math.radians(60)}


def pulled(model: mujoco.MjModel, body: int, most: float = np.inf) -> tuple[float, float, float]:
    """Pull a front to its limit, or to `most`; return where it gets and should get, m or rad, and the largest contact
    force on it, mean of a tenth second, N."""
    data, joint = mujoco.MjData(model), model.body_jntadr[body]
    at, dof, limit = model.jnt_qposadr[joint], model.jnt_dofadr[joint], min(most, model.jnt_range[joint, 1])
    stiff, hand = PULL[mujoco.mjtJoint(model.jnt_type[joint])]
    model.opt.timestep, force, pushes_n = 0.004, np.zeros(6), []
    for k in range(700):
        want = limit * min(1.0, k / 500) - data.qpos[at]
        data.qfrc_applied[dof] = np.clip(stiff * want - 0.05 * stiff * data.qvel[dof], -hand, hand)
        mujoco.mj_step(model, data)
        push_n = 0.0
        for c in np.flatnonzero((model.geom_bodyid[data.contact.geom] == body).any(axis=1)):
            mujoco.mj_contactForce(model, data, c, force)
            push_n += force[0]
        pushes_n.append(push_n)
    return float(data.qpos[at]), float(limit), float(np.convolve(pushes_n, np.full(25, 0.04), "valid").max())


def stuck(model: mujoco.MjModel, share: float = 1.0, wide: bool = True) -> list[str]:
    """The fronts that do not get within 2 cm or 2 degrees of a limit that lets one reach in, or are pushed hard.

    Without `wide` they are pulled only as far as one needs to reach in.
    """
    lines = []
    for body in held_bodies(model):
        least = LEAST[mujoco.mjtJoint(model.jnt_type[model.body_jntadr[body]])]
        reached, limit, most_n = pulled(model, body, np.inf if wide else least)
        if reached < limit - 0.02 - 0.015 * (least > 1) or limit < share * least - 1e-3 or most_n > MOST_N:
            lines.append(f"{model.body(body).name}: {reached:.2f} of {limit:.2f}, {most_n:.0f} N")
    return lines


@functools.cache
def kitchen(seed: int, tier: str) -> Building:
    return design_building(seed, home_config(tier, {"opening": "all"}))


def smaller(corners: np.ndarray) -> np.ndarray:
    """A convex part (n, 3) with its sides `TOUCH_M` farther in."""
    low, high = corners.min(axis=0), corners.max(axis=0)
    return (low + high) / 2 + (corners - (low + high) / 2) * np.maximum(1 - 2 * TOUCH_M / (high - low), 0.1)


def room(b: Building, item: Instance, more: tuple[PlanBox, ...] = ()) -> mujoco.MjModel:
    """The fronts of one piece on their joints, and as solids the walls and what stands near that no front pushes away.

    Neighbours are a little smaller than they are, as they touch. World: scan x, y, height; no gravity.
    """
    spec = mujoco.MjSpec()
    spec.option.gravity = [0, 0, 0]
    spec.compiler.degree = False
    for wall in (*b.plan.walls, *more):
        ends = np.array([wall.low, wall.high])
        spec.worldbody.add_geom(type=mujoco.mjtGeom.mjGEOM_BOX, pos=ends.mean(0), size=np.ptp(ends, axis=0) / 2)
    kinds = ("cabinet_door", "drawer")
    others = [i for i in (*b.plan.built_in, *b.items) if i.model.category not in (*TABLES.light, *kinds)]
    for k, other in enumerate(others):
        if other.model.name != item.model.name and other.footprint.distance(item.footprint) < 1.2:
            for j, part in enumerate(other.model.parts):
                spec.add_mesh(name=f"{k} {j}", uservert=smaller(other.to_floor(part.vertices)).ravel())
                spec.worldbody.add_geom(type=mujoco.mjtGeom.mjGEOM_MESH, meshname=f"{k} {j}")
    mine = [i for i in b.items if i.model.category in kinds and np.array_equal(i.matrix, item.matrix)]
    for front in mine:
        assert front.hinge is not None
        kind = "slide" if front.hinge.slides else "hinge"
        base, tip = front.to_floor(np.array([front.hinge.origin, np.add(front.hinge.origin, front.hinge.axis)]))
        body = spec.worldbody.add_body(name=front.model.name)
        body.add_joint(type=getattr(mujoco.mjtJoint, f"mjJNT_{kind.upper()}"), pos=base, axis=tip - base,
            range=front.hinge.range_rad, limited=True, damping=[1.0, 0, 0])  # fmt: skip
        for j, part in enumerate(front.model.solids):
            spec.add_mesh(name=f"{front.model.name} {j}", uservert=front.to_floor(part.vertices).ravel())
            body.add_geom(type=mujoco.mjtGeom.mjGEOM_MESH, meshname=f"{front.model.name} {j}", mass=2.0)
    return spec.compile()


@pytest.mark.parametrize(
    ("seed", "tier", "wardrobes"),
    [
        pytest.param(720_003, "furnished", 4, marks=pytest.mark.heavy),
        (720_007, "furnished", 3),
        pytest.param(720_007, "cluttered", 5, marks=pytest.mark.slow),
    ],
)
def test_every_front_of_a_kitchen_opens(seed: int, tier: str, wardrobes: int) -> None:
    """With `opening=all`: so do those of wardrobes, washbasins and showers. A vanity's drawers are 0.18 m deep."""
    b, count = kitchen(seed, tier), Counter[str]()
    for item in (i for i in b.plan.built_in if i.model.category in OPENS and openings(i.model.name)):
        model = room(b, item)
        assert stuck(model, 0.9) == []
        assert model.njnt == len(openings(item.model.name)) or item.model.category not in KITCHEN
        count[item.model.category] += model.njnt
    assert sum(count.values()) == sum(i.model.category in ("cabinet_door", "drawer") for i in b.items)
    assert min(count[c] for c in KITCHEN) > 0 and count["wardrobe"] == wardrobes


def test_fronts_of_one_model_do_not_jam() -> None:
    """Doors side by side, whose inner edges come out farther than their outer ones, in every model by itself."""
    count = 0
    for name in (n for n, drawing in LIBRARY.items() if drawing.category in OPENS and openings(n)):
        model = cad_model(name)
        item = place(model, np.full(3, model.unit_m), np.zeros(2), 0.0)
        plan = Plan((Rect(-3, -3, 3, 3),), Rect(-3.1, -3.1, 3.1, 3.1), (), (), (), None, 2.5)
        bodies, fronts = open_fronts(plan, (item,), (), "all")
        alone = room(Building(dataclasses.replace(plan, built_in=bodies), fronts, 0.0), item)
        assert (stuck(alone, 0.9), alone.njnt) == ([], len(openings(name))), name
        count += alone.njnt
    assert count == 61


def test_a_wall_before_a_kitchen_is_noticed() -> None:
    """It stands 0.2 m before each piece, as wide as that."""
    b = kitchen(720_003, "furnished")
    for item in (i for i in b.plan.built_in if i.model.category in KITCHEN):
        ahead = item.matrix[:2, 2] / item.scale[2]
        x0, y0, x1, y1 = item.footprint.bounds
        away = ahead * (np.array([x1 - x0, y1 - y0]) + 0.2)
        moved = Rect(x0 + away[0], y0 + away[1], x1 + away[0], y1 + away[1])
        assert len(stuck(room(b, item, (PlanBox.over(moved, 0.0, 2.5),)))) > 0


@pytest.mark.heavy
@pytest.mark.parametrize("tier", ["furnished", "cluttered"])
def test_every_front_of_the_packaged_homes_opens(tier: str) -> None:
    """As written: among all that moves, as far as one needs to reach in; the walls of scene.xml, which fronts do not
    meet in it, by the gate."""
    try:
        folders = scene_folders([tier])
    except SceneError:
        pytest.skip(f"the homes of {tier} are not made here")
    for folder in folders:
        spec = mujoco.MjSpec.from_file(str(Path(folder) / "scene.xml"))
        # Stools and chairs are pushed along and may stop a door behind the angle that a plan must allow.
        assert stuck(spec.compile(), wide=False) == [], folder
        for exclude in spec.excludes:
            spec.delete(exclude)
        assert blocked_fronts(collide_with(spec, "box")) == (), folder
