"""Open every front of a scene over its range, and name those that hit what does not give way."""

import mujoco
import numpy as np

from scenes_mjcf.look import mesh_of

STEPS, HIT_M, CELL_M = 8, 0.03, 0.055
"""Positions in which a front is looked at, and how deep it may then overlap furniture and walls, which are in cells."""
CABINET_M = 0.06
"""Structure is a front's cabinet up to here before it: it is in columns, a worktop's edge reaches to the floor."""
WITHIN = np.array([(a, b, 8 - a - b) for a in range(9) for b in range(9 - a)]) / 8
"""Of a triangle's corners, the weights for points all over it: where it is looked whether a front is within a wall."""
PUSHED_N = 60.0
"""Dry friction of what a front pushes away: 12 kg on a floor of 0.5."""


def held_bodies(model: mujoco.MjModel) -> list[int]:
    """Return the bodies on a hinge or slide, but for doors' leaves, which walls stop as they turn."""
    bodies = model.jnt_bodyid[model.jnt_type != mujoco.mjtJoint.mjJNT_FREE].tolist()
    return [body for body in bodies if not model.body(body).name.startswith("door_")]


def _depths(model: mujoco.MjModel, data: mujoco.MjData, body: int) -> dict[int, float]:
    """Return what a front overlaps of furniture that does not give way: geom -> depth, m."""
    mujoco.mj_collision(model, data)
    depths: dict[int, float] = {}
    bodies = model.geom_bodyid[data.contact.geom]
    for k in np.flatnonzero((bodies == body).any(axis=1)):
        second = int(bodies[k, 0] == body)
        against, other = int(bodies[k, second]), int(data.contact.geom[k, second])
        if model.body(against).name.startswith(("door_", "structure")):
            continue
        free = model.body_jntnum[against] and model.jnt_type[model.body_jntadr[against]] == mujoco.mjtJoint.mjJNT_FREE
        weight_n = float(model.body_mass[against] * np.linalg.norm(model.opt.gravity))
        if not (free and weight_n * model.geom_friction[other, 0] <= PUSHED_N):
            depths[other] = max(depths.get(other, -np.inf), -float(data.contact.dist[k]))
    return depths


def _points_w(model: mujoco.MjModel, data: mujoco.MjData, body: int, value: float) -> np.ndarray:
    """Return points (n, 3) of a front's hulls with its joint at a value, the rest of the scene at rest."""
    data.qpos[model.jnt_qposadr[model.body_jntadr[body]]] = value
    mujoco.mj_kinematics(model, data)
    mujoco.mj_comPos(model, data)
    points = []
    for geom in np.flatnonzero(model.geom_bodyid == body):
        if model.geom_type[geom] == mujoco.mjtGeom.mjGEOM_MESH and "_hull_" in model.geom(geom).name:
            vertices, faces, _ = mesh_of(model, model.geom_dataid[geom])
            within = (WITHIN @ vertices[faces]).reshape(-1, 3)
            points.append(within @ data.geom_xmat[geom].reshape(3, 3).T + data.geom_xpos[geom])
    return np.concatenate(points)


def blocked_fronts(model: mujoco.MjModel) -> tuple[str, ...]:
    """Return a line for each front that hits walls, heavy furniture or other fronts before it is fully open.

    The part that leaves its cabinet must not enter the structure. `model`'s boxes collide, without exclusions.
    """
    data, lines = mujoco.MjData(model), []
    walls = np.flatnonzero(model.geom_bodyid == model.body("structure").id)
    walls = walls[model.geom_type[walls] == mujoco.mjtGeom.mjGEOM_BOX]
    for body in held_bodies(model):
        joint = model.body_jntadr[body]
        mujoco.mj_resetData(model, data)
        shut, ajar = model.jnt_range[joint].tolist()
        points = _points_w(model, data, body, shut)
        middle, axis = points.mean(axis=0), data.xaxis[joint]
        slides = model.jnt_type[joint] == mujoco.mjtJoint.mjJNT_SLIDE
        out = axis if slides else np.cross(axis, middle - data.xanchor[joint])
        out = out / np.linalg.norm(out)
        before = (points @ out).max() + CABINET_M
        eye = middle + (before - middle @ out) * out
        if slides and not model.body(body).name.startswith("drawer_"):
            before = np.inf  # a wardrobe's door slides along its front
        reach = np.linalg.norm(points - data.xanchor[joint], axis=1).max() + abs(ajar)
        away = np.linalg.norm(data.geom_xpos[walls] - data.xanchor[joint], axis=1) - model.geom_rbound[walls]
        near = walls[away < reach]
        turned, half = data.geom_xmat[near].reshape(-1, 3, 3), model.geom_size[near]
        side = ((eye - data.geom_xpos[near])[:, None] @ turned)[:, 0]
        side = np.where(np.abs(side) > half, np.sign(side), 0.0)
        # What is squarely before the cabinet, or beside it, goes on behind the cells on its border.
        side[np.count_nonzero(side, axis=1) != 1] = 0.0
        beside = {geom for geom, depth in _depths(model, data, body).items() if depth > 0}
        for value in np.linspace(shut, ajar, STEPS + 1):
            points = _points_w(model, data, body, value)
            hit = {g: d for g, d in _depths(model, data, body).items() if d > HIT_M and g not in beside}
            points = points[points @ out > before, None]
            at = ((points - data.geom_xpos[near])[..., None, :] @ turned)[..., 0, :]
            depth = (half - np.where(side, side * at, np.abs(at))).min(axis=-1).max(axis=0, initial=0.0)
            hit |= {int(g): float(d) for g, d in zip(near, depth, strict=True) if d > CELL_M}
            if hit:
                other = model.body(model.geom_bodyid[max(hit, key=lambda g: hit[g])]).name.replace("world", "floor")
                lines.append(f"{model.body(body).name} hits {other} at {value:.2f} {'m' if slides else 'rad'}")
                break
    return tuple(lines)
