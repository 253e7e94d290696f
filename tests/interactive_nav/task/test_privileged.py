"""The true state that a critic may see, against C MuJoCo's model and data, and against arithmetic by hand."""

from __future__ import annotations

import jax
import jax.numpy as jnp
import mujoco
import numpy as np
import pytest

import interactive_nav
from interactive_nav.task.privileged import MAP_SIDE, OF_OBJECT, OF_TASK, PRIVILEGED, PRIVILEGED_SIZE, PrivilegedEnv
from interactive_nav.task.wrappers import AutoResetEnv
from interactive_nav.types import EpisodeStart

START, YAW, GOAL, SMALL = (-1.2, 0.3), 0.5, (1.3, -0.6), (-0.2, -0.9)


@pytest.fixture(scope="module")
def env(room):
    return interactive_nav.make("turtlebot", [room], backend="native", num_objects=1, episode_steps=50)


@pytest.fixture(scope="module")
def state(env):
    """Of a given episode, after three steps with turning wheels."""
    f32 = lambda *x: jnp.asarray(x, jnp.float32)  # noqa: E731
    start = EpisodeStart(
        scene_index=jnp.int32(0),
        start_xy_w=f32(*START),
        start_yaw_rad=jnp.float32(YAW),
        goal_xy_w=f32(*GOAL),
        small_xy_w=f32(SMALL),
        small_yaw_rad=f32(1.0),
        small_placed=jnp.ones(1, bool),
    )
    state, step = env.reset_to(start, jax.random.PRNGKey(0)), jax.jit(env.step)
    for _ in range(3):
        state = step(state, jnp.array([0.2, 0.6]))
    return state


def test_the_vector_is_what_mujoco_and_the_map_say(env, state):
    got = np.asarray(jax.jit(env.privileged)(state))
    assert got.shape == (PRIVILEGED_SIZE,) and got.dtype == np.float32
    model, layout = env.world.models[0], env.world.layout
    data = mujoco.MjData(model)
    data.qpos[:] = np.asarray(state.pipeline_state.qpos)
    mujoco.mj_kinematics(model, data)
    mujoco.mj_comPos(model, data)
    base = layout.robot_bodies[0]
    pos, ahead = data.xpos[base], data.xmat[base].reshape(3, 3)[:2, 0]
    ahead = ahead / np.linalg.norm(ahead)
    left = np.array([-ahead[1], ahead[0]])
    away = np.array(GOAL) - pos[:2]
    # Nothing stands between robot and goal that counts for the geodesic, which is then the straight line.
    task = [away @ ahead, away @ left, *pos[:2], np.linalg.norm(away)]
    task = [*np.array(task) / 10, *ahead, 1 - 3 / 50, 0, 0]
    np.testing.assert_allclose(got[:OF_TASK], task, atol=2e-3)

    objects = []
    for body in layout.slot_body:
        offset = data.xipos[body] - pos
        heading = data.xmat[body].reshape(3, 3)[:2, 0]
        geoms = np.flatnonzero(model.geom_bodyid == body)
        geoms = geoms[(model.geom_type[geoms] == mujoco.mjtGeom.mjGEOM_BOX) & (model.geom_group[geoms] != 2)]
        reach = [np.abs(model.geom_pos[g]) + np.abs(matrix(model.geom_quat[g])) @ model.geom_size[g] for g in geoms]
        place = np.array([offset[:2] @ ahead, offset[:2] @ left, offset[2]]) / 5
        mass = np.log(1 + model.body_mass[body]) / 5
        row = [1, *place, heading @ ahead, heading @ left, *np.max(reach, 0), mass]
        objects.append((np.linalg.norm(offset[:2]), row))
    assert len(objects) == 2
    rows = got[OF_TASK : OF_TASK + 8 * OF_OBJECT].reshape(8, OF_OBJECT)
    np.testing.assert_allclose(rows[:2], [row for _, row in sorted(objects)], atol=2e-3)
    assert not rows[2:].any()
    # The chair's own numbers, by hand: 0.4 m cube of 5 kg.
    chair = rows[np.argmax(rows[:2, -1])]
    np.testing.assert_allclose(chair[6:], [0.2, 0.2, 0.2, np.log(6) / 5], atol=1e-5)

    # The map: its middle is where the robot stands; whatever lies outside the walls of 4 x 3 m is not free.
    side = (np.arange(MAP_SIDE) - 4) * 0.3
    points = pos[:2] + side[:, None, None] * ahead + side[None, :, None] * left
    free = got[OF_TASK + 8 * OF_OBJECT :].reshape(MAP_SIDE, MAP_SIDE)
    outside = (np.abs(points) > [2.0, 1.5]).any(-1)
    well_inside = (np.abs(points) < [1.5, 1.0]).all(-1)
    assert outside.any() and not free[outside].any()
    assert well_inside.sum() > 10 and free[well_inside].all()


def matrix(quat):
    out = np.zeros(9)
    mujoco.mju_quat2Mat(out, quat)
    return out.reshape(3, 3)


def test_objects_out_of_reach_and_broken_states_are_zeros(env, state):
    qpos, nav = state.pipeline_state.qpos, state.info["nav"]
    far = nav.replace(object_pos_w=nav.object_pos_w.at[:, 0].add(20.0))
    got = env.privileged(state.replace(info=state.info | {"nav": far}))
    assert not got[OF_TASK : OF_TASK + 8 * OF_OBJECT].any() and got[:OF_TASK].any()
    broken = state.replace(pipeline_state=state.pipeline_state.replace(qpos=jnp.full_like(qpos, jnp.nan)))
    assert not env.privileged(broken).any()


@pytest.mark.heavy
def test_a_batch_carries_it_beside_what_the_policy_sees(env):
    batch = AutoResetEnv(PrivilegedEnv(env))
    assert batch.observation_size == {"state": 29, PRIVILEGED: PRIVILEGED_SIZE}
    state = jax.jit(batch.reset)(jax.random.split(jax.random.PRNGKey(1), 2))
    state = jax.jit(batch.step)(state, jnp.zeros((2, 2)))
    plain = jax.vmap(env.observe)(state).obs
    np.testing.assert_allclose(state.obs["state"], plain, atol=1e-5)
    np.testing.assert_allclose(state.obs[PRIVILEGED], jax.vmap(env.privileged)(state), atol=1e-5)
