"""Settle objects at their annotated poses among wall boxes until they rest."""

import dataclasses
import re
from collections.abc import Collection, Mapping

import mujoco
import numpy as np

from converters.check.gates import collide_with, started_over
from converters.check.opening import STEPS, blocked_fronts
from converters.records.errors import StageFailed
from converters.write.emit import SceneParts, build_spec

SNAP_M = 0.25
"""An object annotated to stand within this of the floor is set on it; others are dropped."""
CLEARANCE_M = 0.001
DOOR_CLEARANCE_M = 0.015
"""Gap under a door's leaf."""
PUSH_STEPS = 400
MAX_PUSH_M = 0.5
DRAWN_PUSH_M = 0.1
"""The same of a piece that somebody drew where it is to stand."""
OVERLAP_M = 0.002
DAMP_PER_S = 8.0
SETTLE_S = 1.5


@dataclasses.dataclass(frozen=True)
class Settled:
    """Outcome of the settling."""

    parts: SceneParts
    """With the objects' poses replaced."""
    displacement_m: tuple[float, ...]
    """Per object, horizontal, from the annotated pose."""
    drop_m: tuple[float, ...]
    """Per object, change of height (positive: up)."""
    held: Mapping[int, str] = dataclasses.field(default_factory=dict)
    """Objects that could not be parted from what is named, by number."""
    limits: Mapping[int, str] = dataclasses.field(default_factory=dict)
    """How far fronts open that hit something, by number; those that are `held` hardly do."""


def _on_floor(parts: SceneParts) -> SceneParts:
    objects = []
    for placed in parts.objects:
        bottom = placed.position_w[2] + min(h.vertices[:, 2].min() for h in placed.hulls_b)
        position = placed.position_w.copy()
        if placed.hinge is not None:
            position[2] += max(DOOR_CLEARANCE_M - bottom, 0.0)
        elif bottom < SNAP_M:
            position[2] += CLEARANCE_M - bottom
        objects.append(dataclasses.replace(placed, position_w=position))
    return dataclasses.replace(parts, objects=tuple(objects))


def _overlaps(
    model: mujoco.MjModel, data: mujoco.MjData, among: Collection[int]
) -> dict[tuple[int, int], tuple[float, np.ndarray]]:
    """Return pairs of bodies, one `among` them: their deepest overlap, m, and the (2,) way out for the second."""
    mujoco.mj_kinematics(model, data)
    mujoco.mj_comPos(model, data)
    mujoco.mj_collision(model, data)
    deepest: dict[tuple[int, int], tuple[float, np.ndarray]] = {}
    for contact in data.contact[: data.ncon]:
        a, b = (int(model.geom_bodyid[g]) for g in contact.geom)
        if contact.dist > -0.0005 or 0 in (a, b) or not {a, b} & set(among):
            continue
        depth, normal = -float(contact.dist), np.array(contact.frame[:2])
        if np.linalg.norm(normal) < 0.5:  # one above the other: apart along the line between their middles
            normal = data.xipos[b, :2] - data.xipos[a, :2]
        normal = normal / max(np.linalg.norm(normal), 1e-9)
        if depth > deepest.get((a, b), (0.0, normal))[0]:
            deepest[a, b] = (depth, normal)
    return deepest


def _push(model: mujoco.MjModel, data: mujoco.MjData, free: dict[int, int], most_m: float) -> None:
    """Slide the free bodies (id -> address in qpos) by up to `most_m`."""
    mujoco.mj_resetData(model, data)
    start = {body: data.qpos[at : at + 2].copy() for body, at in free.items()}
    for _ in range(PUSH_STEPS):
        deepest = _overlaps(model, data, free)
        if not deepest:
            break
        shift = {body: np.zeros(2) for body in free}
        for (a, b), (depth, normal) in deepest.items():
            both = a in free and b in free
            step = (0.5 if both else 1.0) * min(0.5 * depth + 0.0005, 0.02)
            if a in free:
                shift[a] -= step * normal
            if b in free:
                shift[b] += step * normal
        for body, by in shift.items():
            way = data.qpos[free[body] : free[body] + 2] + by - start[body]
            data.qpos[free[body] : free[body] + 2] = start[body] + way * min(1.0, most_m / max(np.hypot(*way), 1e-9))


def push_apart(
    parts: SceneParts, most_m: float = MAX_PUSH_M, hold: Collection[int] = ()
) -> tuple[SceneParts, dict[int, str]]:
    """Slide free objects by up to `most_m`, without dynamics, so that hulls and boxes overlap neither walls nor others.

    Return also the objects among `hold` that still overlap, which are no longer pushed: number -> what it overlaps.
    """
    model = collide_with(build_spec(parts), "both")
    data = mujoco.MjData(model)
    number = {int(model.body(o.name).id): k for k, o in enumerate(parts.objects)}
    free = {
        body: int(model.joint(f"{parts.objects[k].name}_free").qposadr[0])
        for body, k in number.items()
        if parts.objects[k].hinge is None
    }
    held: dict[int, str] = {}
    among = {body for body, k in number.items() if k in hold}
    _push(model, data, free, most_m)
    while among:
        left = {pair: depth for pair, (depth, _) in _overlaps(model, data, among).items() if depth > OVERLAP_M}
        if not left:
            break
        a, b = max(left, key=lambda pair: left[pair])
        # A leaf that stands in a piece cannot turn; of two pieces the lighter one can be missed.
        worst = min({a, b} & among, key=lambda body: (body in free, model.body_mass[body]))
        held[number[worst]] = model.body(a + b - worst).name
        among -= {worst, *({a, b} - free.keys())}  # of two that cannot be pushed one is enough
        free.pop(worst, None)
        _push(model, data, free, most_m)
    return _with_poses(parts, model, data), held


def _with_poses(parts: SceneParts, model: mujoco.MjModel, data: mujoco.MjData) -> SceneParts:
    objects = []
    for placed in parts.objects:
        if placed.hinge is not None:
            objects.append(placed)
            continue
        at = int(model.joint(f"{placed.name}_free").qposadr[0])
        pose = np.array(data.qpos[at : at + 7])
        objects.append(dataclasses.replace(placed, position_w=pose[:3], quaternion_w=pose[3:]))
    return dataclasses.replace(parts, objects=tuple(objects))


def _simulate(parts: SceneParts, shape: str, seconds: float) -> SceneParts:
    """Simulate with damping; doors are held."""
    model = collide_with(build_spec(parts), shape)
    model.opt.timestep = 0.002
    for placed in parts.objects:
        body = int(model.body(placed.name).id)
        dof = int(model.body_dofadr[body])
        if placed.hinge is not None:
            model.dof_damping[dof] = 1e4
            continue
        model.dof_damping[dof : dof + 3] = DAMP_PER_S * model.body_mass[body]
        model.dof_damping[dof + 3 : dof + 6] = DAMP_PER_S * model.body_inertia[body].mean()
    data = mujoco.MjData(model)
    for _ in range(round(seconds / model.opt.timestep)):
        mujoco.mj_step(model, data)
    if started_over(data) or not np.isfinite(data.qpos).all():
        raise StageFailed(
            f"settle: MuJoCo started the simulation over (its numbers became too large with {shape} geoms); "
            "two objects overlap too deeply to part, move one of them"
        )
    return _with_poses(parts, model, data)


def _within_reach(parts: SceneParts) -> tuple[SceneParts, dict[int, str], dict[int, str]]:
    """Cut ranges of fronts to what is free; return what those hit that open by less than a third, and words on all."""
    whole, names = parts.objects, [o.name for o in parts.objects]
    held, words = dict[int, str](), dict[int, str]()
    while True:
        spec = build_spec(parts)
        for exclude in spec.excludes:
            spec.delete(exclude)
        lines = [re.split(" hits | at | ", line) for line in blocked_fronts(collide_with(spec, "box"))]
        hits = [(k, *hit) for name, *hit in lines if (k := names.index(name)) not in held]
        if not hits:
            return parts, held, words
        objects = list(parts.objects)
        for k, other, at, unit in hits:
            hinge, drawn, cad_id = objects[k].hinge, whole[k].hinge, whole[k].cad_id
            assert hinge is not None and drawn is not None
            (low, high), most = hinge.range_rad, drawn.range_rad[1]
            free = low + (high - low) * (min(round((float(at) - low) / (high - low) * STEPS), STEPS) - 1) / STEPS
            other = whole[names.index(other)].cad_id if other in names else other
            words[k] = f"{cad_id} to {free:.2f} of {most:.2f} {unit} ({other})"
            if free < max(low + (most - low) / 3, 0.0):
                held[k], words[k] = other, f"{cad_id} not at all ({other})"
            else:
                objects[k] = dataclasses.replace(objects[k], hinge=dataclasses.replace(hinge, range_rad=(low, free)))
        parts = dataclasses.replace(parts, objects=tuple(objects))


def settle(parts: SceneParts, drawn: bool = False, fitted: Collection[int] = ()) -> Settled:
    """Set objects on the floor, push them apart, then let boxes and after them hulls come to rest."""
    hold = range(len(parts.objects)) if drawn else fitted
    result, held = push_apart(_on_floor(parts), DRAWN_PUSH_M if drawn else MAX_PUSH_M, hold)
    if not held:
        result = _simulate(result, "box", SETTLE_S)
        result = _simulate(result, "hull", SETTLE_S)
    result, held, limits = _within_reach(result) if drawn and not held else (result, held, {})
    off = np.array([o.position_w for o in result.objects]) - np.array([o.position_w for o in parts.objects])
    shift, drop = (tuple(round(float(v), 4) for v in by) for by in (np.linalg.norm(off[:, :2], axis=1), off[:, 2]))
    return Settled(result, shift, drop, held, limits)
