"""Open every front of a scene over its range, and name those that hit what does not give way."""

import mujoco
import numpy as np

STEPS, HIT_M = 8, 0.03
"""Positions in which a front is looked at, and how deep it may then overlap something: walls are in cells of 2.5 cm."""
CABINET_M = 0.06
"""Walls so near to a front that is shut are its cabinet: they are columns, a worktop's edge reaches to the floor."""
PUSHED_N = 60.0
"""Dry friction of what a front pushes away: 12 kg on a floor of 0.5."""


def held_bodies(model: mujoco.MjModel) -> list[int]:
    """Return the bodies on a hinge or slide, but for doors' leaves, which walls stop as they turn."""
    bodies = model.jnt_bodyid[model.jnt_type != mujoco.mjtJoint.mjJNT_FREE].tolist()
    return [body for body in bodies if not model.body(body).name.startswith("door_")]


def _depths(model: mujoco.MjModel, data: mujoco.MjData, body: int) -> dict[int, float]:
    """Return what a front overlaps that does not give way: geom -> depth, m."""
    mujoco.mj_kinematics(model, data)
    mujoco.mj_comPos(model, data)
    mujoco.mj_collision(model, data)
    depths: dict[int, float] = {}
    bodies = model.geom_bodyid[data.contact.geom]
    for k in np.flatnonzero((bodies == body).any(axis=1)):
        second = int(bodies[k, 0] == body)
        against, other = int(bodies[k, second]), int(data.contact.geom[k, second])
        if model.body(against).name.startswith("door_"):
            continue
        free = model.body_jntnum[against] and model.jnt_type[model.body_jntadr[against]] == mujoco.mjtJoint.mjJNT_FREE
        weight_n = float(model.body_mass[against] * np.linalg.norm(model.opt.gravity))
        if not (free and weight_n * model.geom_friction[other, 0] <= PUSHED_N):
            depths[other] = max(depths.get(other, -np.inf), -float(data.contact.dist[k]))
    return depths


def blocked_fronts(model: mujoco.MjModel) -> tuple[str, ...]:
    """Return a line for each front that hits walls, heavy furniture or other fronts before it is open.

    `model`: a scene's, its boxes colliding, without exclusions.
    """
    data, lines = mujoco.MjData(model), []
    for body in held_bodies(model):
        joint = model.body_jntadr[body]
        mujoco.mj_resetData(model, data)
        model.geom_margin[model.geom_bodyid == body] = model.body_margin[body] = CABINET_M
        near = _depths(model, data, body)
        model.geom_margin[model.geom_bodyid == body] = model.body_margin[body] = 0.0
        structure = model.body("structure").id
        cabinet = {geom for geom, depth in near.items() if depth > 0 or model.geom_bodyid[geom] == structure}
        shut, ajar = model.jnt_range[joint].tolist()
        for value in np.linspace(shut, ajar, STEPS + 1):
            data.qpos[model.jnt_qposadr[joint]] = value
            hit = {g: d for g, d in _depths(model, data, body).items() if d > HIT_M and g not in cabinet}
            if hit:
                other = model.body(model.geom_bodyid[max(hit, key=lambda g: hit[g])]).name.replace("world", "floor")
                unit = "m" if model.jnt_type[joint] == mujoco.mjtJoint.mjJNT_SLIDE else "rad"
                lines.append(f"{model.body(body).name} hits {other} at {value:.2f} {unit}")
                break
    return tuple(lines)
