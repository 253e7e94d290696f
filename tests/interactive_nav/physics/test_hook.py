"""The hook: its force by hand, its kinematics against C MuJoCo, and robots that pull boxes and a door."""

import dataclasses
import importlib.util

import jax
import jax.numpy as jnp
import mujoco
import numpy as np
import pytest

import interactive_nav
from interactive_nav.config import NavConfig
from interactive_nav.physics.hook import NONE, TORN, TORN_M, Hook, _point, spring_force
from interactive_nav.robots import get_robot
from interactive_nav.scenes.scene import load_scene
from interactive_nav.scenes.world import build_world
from interactive_nav.types import EpisodeStart
from interactive_nav_common.errors import ConfigError
from tests.toys import write_room

HAS_WARP = importlib.util.find_spec("warp") is not None
FRICTION, MOST_N = 0.5, 100.0
SETTINGS = {"num_objects": 0, "control_mode": "twist", "hook_force_n": MOST_N}
FRONT_M, GAP_M, LEAF_M = 0.2865, 0.05, 0.7
"""From the Freight's axle to its hook; from there to what it couples to; from the door's hinge to where it is held."""


@pytest.fixture(scope="module")
def make_env(tmp_path_factory):
    def make(mass_kg=10.0, door=False, others=(), **settings):
        blocks = others if door else (*others, ("chair", 0.0, 0.0, mass_kg, FRICTION))
        folder = write_room(tmp_path_factory.mktemp("hook") / "room", (6.0, 4.0), blocks, door=door)
        return interactive_nav.make("freight", [folder], **{"backend": "native", **SETTINGS, **settings})

    return make


@pytest.fixture(scope="module")
def pulling(make_env):
    env = make_env()
    return env, jax.jit(env.step)


def _start(env, x_m, y_m, yaw_rad):
    f32 = [jnp.asarray(value, jnp.float32) for value in ([x_m, y_m], yaw_rad, [2.6, 1.6])]
    none = jnp.zeros((0, 2)), jnp.zeros(0), jnp.zeros(0, bool)
    return jax.jit(env.reset_to)(EpisodeStart(jnp.int32(0), f32[0], f32[1], f32[2], *none), jax.random.PRNGKey(0))


def _before_the_box(env):
    """Return a start with the hook `GAP_M` before the side of the box at the origin, which is 0.4 m wide."""
    return _start(env, -0.2 - FRONT_M - GAP_M, 0.0, 0.0)


def _action(env, linear_m_s, turn_rad_s, hook):
    return jnp.asarray(env.robot.drive(np.float64(linear_m_s), np.float64(turn_rad_s)), jnp.float32).at[-1].set(hook)


def _run(env, step, state, *legs):
    """Step through legs (control steps, m/s, rad/s, hook)."""
    for steps, *values in legs:
        for _ in range(steps):
            state = step(state, _action(env, *values))
    return state


@pytest.mark.parametrize("xp", (np, jnp))
def test_the_force_by_hand(xp):
    """0.25 x / (0.02 s)^2 + v / 0.02 s, over 0.5 / kg: 12.5 N for 1 cm, 10 N for 0.1 m/s."""
    stretch = xp.asarray([[0.01, 0, 0], [0.01, 0, 0], [0.06, 0.08, 0], [0, 0, TORN_M + 0.001], [0, 0, 0]])
    speed = xp.asarray([[0, 0, 0], [0.1, 0, 0], [0, 0, 0], [0, 0, 0], [0, -0.1, 0]])
    force = spring_force(stretch, speed, xp.full(5, 0.5), 0.02, MOST_N)
    # 0.1 m would be 125 N: the cap keeps its direction.
    want = [[12.5, 0, 0], [22.5, 0, 0], [60, 80, 0], [0, 0, 0], [0, -10, 0]]
    np.testing.assert_allclose(force, want, atol=1e-4)
    borne = spring_force(stretch, speed, xp.full(5, 0.5), 0.02, MOST_N, xp.asarray([[0, 0, 30.0]]))
    # Of the third, 75, 100 and 30 N, the cap leaves 100 in 128.55.
    want = [[12.5, 0, 30], [22.5, 0, 30], [58.34, 77.79, 23.34], [0, 0, 0], [0, -10, 30]]
    np.testing.assert_allclose(borne, want, atol=0.01)


@pytest.mark.parametrize(("name", "mode"), [("freight", "twist"), ("fetch", "hand"), ("jackrabbot2", "whole_body")])
def test_places_velocities_and_torques_are_those_of_c_mujoco(tmp_path, name, mode):
    """For a free body, a door, a drawer and a flap: the power of the forces is that of MuJoCo's generalised force."""
    folder = write_room(tmp_path / "room", (5.0, 4.0), (("chair", 0.7, 0.0, 5.0, 0.5),), door=True, kitchen=True)
    config = NavConfig.of(num_objects=0, hook_force_n=MOST_N, control_mode=mode)
    world = build_world(get_robot(name, mode).hooked(), (load_scene(folder),), config)
    hook, model, layout, rng = Hook(world, config), world.models[0], world.layout, np.random.default_rng(0)
    assert len(layout.slot_body) == 4
    for slot, body in enumerate(layout.slot_body):
        data, point_b = mujoco.MjData(model), rng.normal(size=3) * 0.3
        data.qvel[:] = rng.normal(size=model.nv)
        mujoco.mj_integratePos(model, data.qpos, rng.normal(size=model.nv), 0.3)
        mujoco.mj_forward(model, data)
        moves, base = hook._motions(np.int32(0), np.int32(slot), layout, np.int32(slot), data.qpos, data.qvel)
        base_body = model.body(world.robot.hand).id if mode != "twist" else layout.robot_bodies[0]
        for motion, at, point in ((moves, body, point_b), (base, base_body, hook.point_b)):
            place, velocity = _point(motion, point)
            jacobian = np.zeros((3, model.nv))
            mujoco.mj_jac(model, data, jacobian, None, place, int(at))
            np.testing.assert_allclose(place, data.xpos[at] + data.xmat[at].reshape(3, 3) @ point, atol=1e-5)
            np.testing.assert_allclose(velocity, jacobian @ data.qvel, atol=1e-4)
        # Where the hook is, with a stretch of 3 cm.
        here_w = _point(base, hook.point_b)[0]
        held_b = data.xmat[body].reshape(3, 3).T @ (here_w + [0.03, 0, 0] - data.xpos[body])
        row = np.array([slot, *held_b, 50.0, 0, 0, 0])
        states = data.qpos, data.qvel, data.xfrc_applied
        data.xfrc_applied[:] = hook.applied(np.int32(0), row, layout, np.int32(slot), *states)
        pulls = data.xfrc_applied[:, :3]
        assert 0.1 < np.linalg.norm(pulls[body]) <= MOST_N + 1e-3 and np.flatnonzero(pulls.any(1)).size == 2
        np.testing.assert_allclose(pulls[body], -pulls[base_body], atol=1e-4)
        want, got = np.zeros((2, model.nv))  # generalised forces: at the points, and at the centres of mass
        for at, place in ((body, here_w + [0.03, 0, 0]), (base_body, here_w)):
            mujoco.mj_applyFT(model, data, pulls[at], np.zeros(3), place, int(at), want)
            mujoco.mj_applyFT(model, data, pulls[at], data.xfrc_applied[at, 3:], data.xipos[at], int(at), got)
        np.testing.assert_allclose(got, want, atol=1e-3)
        nothing = hook.applied(np.int32(0), row, layout, np.int32(-1), *states)
        assert not nothing.any()


def test_a_robot_pulls_a_box_that_had_gone_to_sleep(pulling):
    env, step = pulling
    state = _run(env, step, _before_the_box(env), (20, 0.0, 0.0, 0.0))
    assert state.obs[-4:].tolist() == [0, 0, 0, 0] and int(state.pipeline_state.hook[0]) == -1
    state = _run(env, step, state, (1, 0.0, 0.0, 1.0), (40, -0.3, 0.0, 0.0))  # 0 keeps the coupling
    box_m, robot_m = state.info["nav"].object_pos_w[0], state.info["nav"].robot_pos_w
    assert -1.3 < float(box_m[0]) < -0.8 and abs(float(box_m[1])) < 0.05
    # It is dragged at the stretch of its friction, mu m g = 49 N, which counts in each control step.
    dragged = _run(env, step, state, (5, -0.3, 0.0, 1.0))
    mean_n = float(dragged.info["nav"].memory["force_sum_n"] - state.info["nav"].memory["force_sum_n"]) / 5
    assert mean_n == pytest.approx(FRICTION * 10.0 * 9.81, rel=0.15)
    assert int(dragged.info["nav"].memory["object_contact_steps"][0]) >= 40
    seen = np.asarray(state.obs[-4:])
    assert seen[0] == 1 and FRONT_M <= seen[1] < FRONT_M + TORN_M and abs(seen[2]) < 0.05
    assert float(box_m[0] - robot_m[0]) == pytest.approx(seen[1] + GAP_M + 0.2, abs=0.03)
    # Let go, it stays.
    free = _run(env, step, state, (10, -0.3, 0.0, -1.0))
    assert abs(float(free.info["nav"].object_pos_w[0, 0] - box_m[0])) < 0.1 and int(free.pipeline_state.hook[0]) == -1
    assert float(free.info["nav"].robot_pos_w[0]) < float(robot_m[0]) - 0.2
    memory = free.info["nav"].memory
    assert int(memory["hook_torn"]) == 0 and int(memory["hook_steps"]) == 41
    again = _run(env, step, free, (5, 0.0, 0.0, 1.0))
    assert int(again.pipeline_state.hook[0]) == -1  # too far


def test_what_the_cap_cannot_move_stays_and_is_torn_away(make_env):
    """mu m g = 294 N against 100 N."""
    env = make_env(60.0)
    step = jax.jit(env.step)
    state = _run(env, step, _before_the_box(env), (2, 0.0, 0.0, 1.0))
    state = step(state, jnp.full(env.action_size, jnp.nan))  # as zeros: it keeps the coupling
    assert int(state.pipeline_state.hook[0]) == 0
    seen = []
    for _ in range(15):
        state = step(state, _action(env, -0.3, 0.0, 0.0))
        seen.append(int(state.pipeline_state.hook[0]))
    torn = seen.index(TORN)
    assert seen == [0] * torn + [TORN] + [-1] * (14 - torn)
    memory = state.info["nav"].memory
    assert int(memory["hook_torn"]) == 1 and int(memory["hook_steps"]) == 3 + torn
    assert float(jnp.linalg.norm(state.info["nav"].object_pos_w[0, :2])) < 0.01
    assert float(memory["object_force_sum_n"][0]) <= MOST_N * (4 + torn)
    assert float(memory["force_sum_n"]) > 2 * MOST_N


def test_a_door_that_opens_towards_the_robot_is_pulled_open(make_env):
    """The robot drives backwards on a circle about the hinge, at (-1, -1.9) m."""
    env = make_env(door=True)
    yaw = np.radians(-70.0)
    x_m, y_m = np.array([-1 + LEAF_M, -1.88]) - (FRONT_M + GAP_M) * np.array([np.cos(yaw), np.sin(yaw)])
    state, step = _start(env, x_m, y_m, yaw), jax.jit(env.step)
    state = _run(env, step, state, (2, 0.0, 0.0, 1.0), (45, -0.2, 0.26, 1.0))
    at = int(env.world.layout.slot_qpos[0])
    assert float(state.pipeline_state.qpos[at]) > np.radians(60) and int(state.pipeline_state.hook[0]) == 0
    assert float(state.info["nav"].memory["object_path_m"][0]) > 0.3  # the kinematic effort has it


def test_it_pulls_what_it_holds_among_others(make_env):
    """The last of three boxes: each body but the first has another number in the stepped model."""
    env = make_env(others=(("chair", 2.0, 1.2, 10.0, FRICTION), ("chair", 2.0, -1.2, 10.0, FRICTION)))
    state = _before_the_box(env)
    before_m = np.asarray(state.info["nav"].object_pos_w)
    state = _run(env, jax.jit(env.step), state, (1, 0.0, 0.0, 1.0), (20, -0.3, 0.0, 0.0))
    assert int(state.pipeline_state.hook[0]) == 2
    moved_m = np.asarray(state.info["nav"].object_pos_w) - before_m
    assert moved_m[2, 0] < -0.3
    np.testing.assert_allclose(moved_m[:2], 0.0, atol=1e-3)


@pytest.mark.parametrize(
    "backend",
    [
        pytest.param("jax", marks=pytest.mark.heavy),
        pytest.param("warp", marks=pytest.mark.skipif(not HAS_WARP, reason="no warp-lang")),
    ],
)
def test_mjx_pulls_as_c_mujoco_does(make_env, backend):
    envs = [make_env(backend=name, solver_iterations=100) for name in ("native", backend)]
    steps = [jax.jit(env.step) for env in envs]
    # In a turn the box rocks from edge to edge, where small differences grow.
    for turn_rad_s, atol in ((0.0, 1e-4), (0.1, 5e-3)):
        legs = (1, 0.0, 0.0, 1.0), (8, -0.3, turn_rad_s, 1.0)
        states = [_run(env, step, _before_the_box(env), *legs) for env, step in zip(envs, steps, strict=True)]
        assert float(states[0].info["nav"].object_pos_w[0, 0]) < -0.05
        for of in ((lambda s: s.pipeline_state.hook), (lambda s: s.info["nav"].object_pos_w), (lambda s: s.obs[-4:])):
            np.testing.assert_allclose(of(states[1]), of(states[0]), atol=atol)
        forces_n = [float(state.info["nav"].memory["force_sum_n"]) for state in states]
        assert forces_n[1] == pytest.approx(forces_n[0], rel=2e-2)


def test_a_hook_that_holds_nothing_and_none_at_all_are_the_same_to_the_bit(pulling, make_env):
    env, step = pulling
    plain = make_env(hook_force_n=0.0)
    assert (env.action_size, plain.action_size) == (3, 2) and env.robot.action_names[-1] == "hook"
    assert env.observation_size == plain.observation_size + 4
    states, plain_step = [_before_the_box(e) for e in (env, plain)], jax.jit(plain.step)
    assert states[1].pipeline_state.hook is None and not {"hook_steps", "hook_torn"} & set(plain.metric_names)
    for k in range(12):  # it bumps into the box
        action = _action(env, 0.4, 0.3 * (-1) ** k, -1.0)
        states = [step(states[0], action), plain_step(states[1], action[:2])]
    for name in ("qpos", "qvel"):
        a, b = (np.asarray(getattr(state.pipeline_state, name)) for state in states)
        assert a.tobytes() == b.tobytes()
    assert float(states[1].info["nav"].memory["object_path_m"][0]) > 0
    assert np.asarray(states[0].obs[:-4]).tobytes() == np.asarray(states[1].obs).tobytes()
    assert float(states[0].reward) == float(states[1].reward)


def test_a_new_episode_holds_nothing(pulling):
    env, step = pulling
    held = _run(env, step, _before_the_box(env), (2, 0.0, 0.0, 1.0))
    assert int(held.pipeline_state.hook[0]) == 0
    first = _before_the_box(env)
    np.testing.assert_array_equal(first.pipeline_state.hook, NONE)
    # Brax's automatic reset puts the first physics back, and leaves the rest.
    again = step(held.replace(pipeline_state=first.pipeline_state), _action(env, 0.0, 0.0, 0.0))
    assert int(again.pipeline_state.hook[0]) == -1 and int(again.info["nav"].memory["hook_steps"]) == 0


@pytest.mark.parametrize("mass_kg", (0.05, 300.0))
def test_random_driving_with_any_mass_stays_finite(make_env, mass_kg):
    env = make_env(mass_kg, random_mass=(0.5, 0.5))
    step, state, rng = jax.jit(env.step), _before_the_box(env), np.random.default_rng(0)
    fastest = 0.0
    for _ in range(60):
        state = step(state, jnp.asarray(rng.uniform(-1, 1, 3), jnp.float32).at[2].set(1.0))
        fastest = max(fastest, float(jnp.abs(state.pipeline_state.qvel).max()))
    assert bool(jnp.isfinite(state.pipeline_state.qpos).all()) and fastest < 60.0
    assert int(state.info["nav"].memory["hook_steps"]) > 0


def test_what_cannot_hook_is_refused(make_env, tmp_path):
    with pytest.raises(ConfigError, match="legged"):
        get_robot("ant").hooked()
    with pytest.raises(ConfigError, match="look at single contacts"):
        make_env(interaction_with="anything")
    empty = write_room(tmp_path / "empty", blocks=())
    with pytest.raises(ConfigError, match="nothing moves"):
        interactive_nav.make("freight", [empty], **SETTINGS)
    robot = get_robot("freight", "twist")
    assert dataclasses.replace(robot.hooked(), control=None).action_low == (*robot.action_low, -1.0)
