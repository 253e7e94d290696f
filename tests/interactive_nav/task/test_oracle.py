"""Every score and reward of an episode again, in plain Python, from recorded `qpos` and contact forces alone."""

from __future__ import annotations

import itertools
import math

import jax
import jax.numpy as jnp
import mujoco
import numpy as np
import pytest
import shapely

import interactive_nav
from interactive_nav.physics import native
from interactive_nav.task.terms import EPISODE_METRICS
from interactive_nav.types import EpisodeStart
from tests.toys import write_room

STEPS, RADIUS_M = 50, 0.18
STARTS = ((-1.0, 0.3, 0.0), (0.6, 0.9, 0.0), (-0.35, -0.2, -math.pi / 2), (-1.0, 1.0, 0.0))
GOALS = ((0.8, 0.3), (-1.0, 1.0), (1.5, -1.0), (1.2, 1.0))
# Wheels at 10 to 14 rad/s: through the block to the goal, into the wall, at the door and into the wall, freely.
ACTIONS = ((0.3, 0.3), (0.4, 0.4), (0.2, 0.2), (0.3, 0.3))


@pytest.fixture(scope="module")
def played(tmp_path_factory):
    """Environment, [T + 1][N, nq] qpos, [T][N, substeps, bodies, 3] forces, states."""
    scene = write_room(
        tmp_path_factory.mktemp("oracle") / "room", (4.0, 3.0), (("basket", 0.0, 0.3, 1.0, 0.4),), door=True
    )
    env = interactive_nav.make("turtlebot", [scene], backend="native", num_objects=1, episode_steps=STEPS)
    n, forces, real = len(STARTS), [], native.summarise_forces

    def watched(force_w, *rest):
        forces.append(np.array(force_w))
        return real(force_w, *rest)

    poses = jnp.asarray(STARTS)
    start = EpisodeStart(
        scene_index=jnp.zeros(n, jnp.int32),
        start_xy_w=poses[:, :2],
        start_yaw_rad=poses[:, 2],
        goal_xy_w=jnp.asarray(GOALS),
        small_xy_w=jnp.broadcast_to(jnp.array([0.7, -1.2]), (n, 1, 2)),
        small_yaw_rad=jnp.ones((n, 1)),
        small_placed=jnp.ones((n, 1), bool),
    )
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(native, "summarise_forces", watched)
        state = jax.jit(jax.vmap(env.reset_to))(start, jax.random.split(jax.random.PRNGKey(0), n))
        step = jax.jit(jax.vmap(env.advance))
        states = [jax.tree.map(np.asarray, state)]
        for _ in range(STEPS):
            state = step(state, jnp.asarray(ACTIONS))
            states.append(jax.tree.map(np.asarray, state))
    assert len(forces) == STEPS
    return env, [s.pipeline_state.qpos for s in states], forces, states


def norm(vector) -> float:
    return math.sqrt(sum(float(v) ** 2 for v in vector))


def centres(model: mujoco.MjModel, bodies, qpos: np.ndarray) -> list[list[float]]:
    data = mujoco.MjData(model)
    data.qpos[:] = qpos
    mujoco.mj_kinematics(model, data)
    return [data.xipos[b].tolist() for b in bodies]


def clearance(model: mujoco.MjModel, robot_bodies, qpos: np.ndarray, radius_m: float) -> float:
    """The gap in plan between the robot's disc and the nearest of the boxes, seen from above as polygons."""
    data = mujoco.MjData(model)
    data.qpos[:] = qpos
    mujoco.mj_kinematics(model, data)
    gaps, corners = [], np.array(list(itertools.product((-1, 1), repeat=3)))
    for g in range(model.ngeom):
        if model.geom_type[g] == mujoco.mjtGeom.mjGEOM_BOX and model.geom_bodyid[g] not in robot_bodies:
            outline = data.geom_xpos[g] + (corners * model.geom_size[g]) @ data.geom_xmat[g].reshape(3, 3).T
            at = shapely.Point(data.xpos[robot_bodies[0]][:2])
            gaps.append(shapely.MultiPoint(outline[:, :2]).convex_hull.distance(at) - radius_m)
    return max(0.0, min(gaps))


def oracle(model, layout, qpos, forces, i: int) -> tuple[dict[str, float], list[dict[str, float]], dict[str, list]]:
    """Scores, rewards and what is told of objects of episode i; in a convex room the goal is straight ahead."""
    bodies = [int(b) for b in layout.slot_body]
    masses = [float(model.body_mass[b]) for b in bodies]
    robot_kg = sum(float(model.body_mass[b]) for b in layout.robot_bodies)
    goal, at = GOALS[i], layout.robot_qpos
    robot = [[float(v) for v in q[i][at : at + 3]] for q in qpos]
    objects = [centres(model, bodies, q[i]) for q in qpos]
    gaps = [math.hypot(p[0] - goal[0], p[1] - goal[1]) for p in robot]
    robot_path, force_sum, paths = 0.0, 0.0, [0.0] * len(bodies)
    touched, rewards, interactions, structure, lifted = [False] * len(bodies), [], 0, 0, False
    clear_m, turns = [], 0.0
    yaws = [math.atan2(2 * (q[3] * q[6] + q[4] * q[5]), 1 - 2 * (q[5] ** 2 + q[6] ** 2))
            for q in (q[i][at : at + 7] for q in qpos)]  # fmt: skip
    contact_steps, on_objects = [0] * len(bodies), [0.0] * len(bodies)
    success, steps = False, 0
    for t in range(STEPS):
        substeps = forces[t][i]
        step_touch = [any(norm(s[k]) > 1e-4 for s in substeps) for k in range(len(bodies))]
        touched = [a or b for a, b in zip(touched, step_touch, strict=True)]
        lengths = [norm(np.subtract(robot[t + 1], robot[t]))]
        lengths += [norm(np.subtract(b, a)) for a, b in zip(objects[t], objects[t + 1], strict=True)]
        lengths = [0.0 if length < 1e-4 else length for length in lengths]
        robot_path += lengths[0]
        for k in range(len(bodies)):
            if t >= 5 or touched[k]:  # what settles untouched in the first half second was not moved
                paths[k] += lengths[k + 1]
        contact_steps = [n + a for n, a in zip(contact_steps, step_touch, strict=True)]
        on_objects = [f + max(norm(s[k]) for s in substeps) for k, f in enumerate(on_objects)]
        force_sum += sum(norm(sum(s)) for s in substeps) / len(substeps)
        interactions += any(step_touch)
        structure += any(norm(s[-1]) > 1e-4 for s in substeps)
        lifted |= robot[t + 1][2] > 0.2
        clear_m.append(clearance(model, layout.robot_bodies, qpos[t + 1][i], RADIUS_M))
        turns += abs(math.remainder(yaws[t + 1] - yaws[t], math.tau))
        success = gaps[t + 1] < 0.333
        steps = t + 1
        rewards.append(
            {"success": 10.0 * success, "potential": gaps[t] - gaps[t + 1], "interaction": -0.1 * any(step_touch)}
        )
        if success:
            break
    work = sum(m * length for m, length in zip(masses, paths, strict=True))
    kinematic = robot_kg * robot_path / (robot_kg * robot_path + work)
    dynamic = steps * robot_kg * 9.81 / (steps * robot_kg * 9.81 + force_sum)
    p_eff = min(1.0, gaps[0] / robot_path) if success else 0.0
    e_eff = (kinematic + dynamic) / 2
    scores = {
        "success": success,
        "path_efficiency": p_eff,
        "effort_efficiency": e_eff,
        "kinematic_effort": kinematic,
        "dynamic_effort": dynamic,
        "ins_0.5": (p_eff + e_eff) / 2,
        "robot_path_m": robot_path,
        "shortest_path_m": gaps[0],
        "object_displacement_kg_m": work,
        "force_sum_n": force_sum,
        "episode_steps": steps,
        "interaction_steps": interactions,
        "structure_steps": structure,
        "lifted": lifted,
        "clearance_m": sum(clear_m) / steps,
        "least_clearance_m": min(clear_m),
        "turning_rad_per_m": turns / max(robot_path, 1.0),
    }
    scores |= dict.fromkeys(
        ("nonfinite", "overflow_steps", "left_out_steps", "crowded_steps", "objects_dropped", "off_distance"), 0.0
    )
    of_objects = {"object_path_m": paths, "object_contact_steps": contact_steps, "object_force_sum_n": on_objects}
    return {name: float(value) for name, value in scores.items()}, rewards, of_objects


@pytest.fixture(scope="module")
def scored(played):
    env, qpos, forces, _ = played
    assert env.robot.footprint_radius_m == RADIUS_M
    return [oracle(env.world.models[0], env.world.layout, qpos, forces, i) for i in range(len(STARTS))]


@pytest.mark.parametrize("i", range(len(STARTS)))
def test_every_score_and_reward(played, scored, i):
    _, _, _, states = played
    want, rewards, of_objects = scored[i]
    assert {*want, "unconverged_steps"} == set(EPISODE_METRICS)
    steps = int(want["episode_steps"])
    last = states[steps]
    assert last.done[i] == 1 and all(s.done[i] == 0 for s in states[:steps])
    for name, value in want.items():
        assert float(last.metrics[name][i]) == pytest.approx(value, rel=1e-3, abs=2e-4), name
    for name, values in of_objects.items():
        got = np.asarray(last.info["nav"].memory[name][i])
        np.testing.assert_allclose(got, values, rtol=1e-3, atol=2e-4, err_msg=name)
    for t, terms in enumerate(rewards, 1):
        for name, value in terms.items():
            got = float(states[t].metrics[f"reward/{name}"][i])
            assert got == pytest.approx(value, abs=2e-3), (t, name)
        assert float(states[t].reward[i]) == pytest.approx(sum(terms.values()), abs=3e-3)


def test_the_episodes_say_something(scored):
    scores = [each[0] for each in scored]
    assert [s["success"] for s in scores] == [1, 0, 0, 1]
    assert scores[0]["interaction_steps"] > 5 and scores[0]["object_displacement_kg_m"] > 0.3
    assert scores[1]["structure_steps"] > 5 and scores[1]["interaction_steps"] == 0
    assert scores[2]["object_displacement_kg_m"] > 0.1  # the door
    assert scores[3]["force_sum_n"] == 0 and scores[3]["effort_efficiency"] == pytest.approx(1.0, abs=2e-3)
