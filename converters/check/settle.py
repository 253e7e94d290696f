"""Objects at their annotated poses and wall boxes in, objects at rest out."""

from __future__ import annotations

import dataclasses

import mujoco
import numpy as np

from converters.check.gates import collide_with, run, started_over
from converters.records.errors import StageFailed
from converters.write.emit import SceneParts, build_spec

SNAP_M = 0.25
"""An object annotated to stand within this of the floor is set on it; others are dropped."""
CLEARANCE_M = 0.001
DOOR_CLEARANCE_M = 0.015
"""Gap under a door's leaf."""
PUSH_STEPS = 400
MAX_PUSH_M = 0.5
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


def push_apart(parts: SceneParts) -> SceneParts:
    """Slides free objects horizontally until neither hulls nor boxes cut walls or each other.

    Without dynamics, so that nothing flies."""
    model = collide_with(build_spec(parts), "both")
    data = mujoco.MjData(model)
    free = {
        int(model.body(o.name).id): int(model.joint(f"{o.name}_free").qposadr[0])
        for o in parts.objects
        if o.hinge is None
    }
    moved = dict.fromkeys(free, 0.0)
    for _ in range(PUSH_STEPS):
        mujoco.mj_kinematics(model, data)
        mujoco.mj_comPos(model, data)
        mujoco.mj_collision(model, data)
        deepest: dict[tuple[int, int], tuple[float, np.ndarray]] = {}
        for contact in data.contact[: data.ncon]:
            a, b = (int(model.geom_bodyid[g]) for g in contact.geom)
            if contact.dist > -0.0005 or 0 in (a, b) or (a not in free and b not in free):
                continue
            depth, normal = -float(contact.dist), np.array(contact.frame[:2])
            if np.linalg.norm(normal) < 0.5:  # one above the other: apart along the line between their middles
                normal = data.xipos[b, :2] - data.xipos[a, :2]
            normal = normal / max(np.linalg.norm(normal), 1e-9)
            if depth > deepest.get((a, b), (0.0, normal))[0]:
                deepest[a, b] = (depth, normal)
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
            length = float(np.linalg.norm(by))
            if moved[body] + length <= MAX_PUSH_M:
                data.qpos[free[body] : free[body] + 2] += by
                moved[body] += length
    return _with_poses(parts, model, data)


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
    """Damped simulation; doors are held."""
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
    run(model, data, seconds)
    if started_over(data) or not np.isfinite(data.qpos).all():
        raise StageFailed(
            f"settle: MuJoCo started the simulation over (its numbers became too large with {shape} geoms); "
            "two objects overlap too deeply to part, move one of them"
        )
    return _with_poses(parts, model, data)


def settle(parts: SceneParts) -> Settled:
    """Sets objects on the floor, pushes them apart, then lets boxes and after them hulls come to rest.

    Raises:
        StageFailed: the simulation diverged.
    """
    result = push_apart(_on_floor(parts))
    result = _simulate(result, "box", SETTLE_S)
    result = _simulate(result, "hull", SETTLE_S)
    before = np.array([o.position_w for o in parts.objects])
    after = np.array([o.position_w for o in result.objects])
    horizontal = np.linalg.norm((after - before)[:, :2], axis=1)
    return Settled(
        result,
        tuple(round(float(v), 4) for v in horizontal),
        tuple(round(float(v), 4) for v in (after - before)[:, 2]),
    )
