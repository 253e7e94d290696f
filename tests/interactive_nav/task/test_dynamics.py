"""Random dynamics by hand arithmetic: what is executed, observed, pushed and drawn, and what is refused."""

import functools
import importlib.util
from types import SimpleNamespace
from typing import Any

import jax
import jax.numpy as jnp
import mujoco
import numpy as np
import pytest

import interactive_nav
from interactive_nav.config import NavConfig
from interactive_nav.physics import PhysicsState, make_physics
from interactive_nav.physics.base import ModelChange
from interactive_nav.physics.native import NativePhysics
from interactive_nav.physics.window import PhysicsWindow
from interactive_nav.robots import get_robot
from interactive_nav.scenes.scene import load_scene
from interactive_nav.scenes.world import FLOOR_FRICTION, build_world
from interactive_nav.task.dynamics import Dynamics
from interactive_nav.task.terms import masses_kg
from interactive_nav.task.wrappers import AutoResetEnv, reset_where, wrap_for_brax_training
from interactive_nav.types import EpisodeDynamics, SceneTables
from interactive_nav_common.errors import ConfigError
from tests.toys import write_room

N, KG, FRICTION, G, SPEED_M_S = 3, 1.0, 0.2, 9.81, 2.0
NEUTRAL = {
    "random_mass": 1.0,
    "random_friction": 1.0,
    "random_motor_gain": 1.0,
    "random_wheel_slip": 0.0,
    "random_motor_delay_steps": 0,
    "random_sensor_delay_steps": 0,
}
AHEAD = jnp.tile(jnp.asarray([0.9, 0.7]), (N, 1))


def keys(n=N, seed=0):
    return jax.random.split(jax.random.PRNGKey(seed), n)


@pytest.fixture(scope="module")
def make(tmp_path_factory):
    """Settings -> an environment without objects to meet."""
    room = write_room(tmp_path_factory.mktemp("dynamics") / "room", (6.0, 6.0), ())
    settings: dict[str, Any] = {"backend": "native", "num_objects": 0, "symmetric_actions": True}
    return functools.cache(lambda **more: interactive_nav.make("turtlebot", [room], **(settings | more)))


def played(env, steps, action=AHEAD):
    """Return the states of some control steps, the first that of the reset."""
    step, states = jax.jit(jax.vmap(env.step)), [jax.jit(jax.vmap(env.reset))(keys())]
    for _ in range(steps):
        states.append(step(states[-1], action))
    return states


@pytest.fixture(scope="module")
def plain(make):
    return played(make(), 8)


def way_m(states):
    return [np.asarray(jnp.linalg.norm((s.info["nav"].robot_pos_w - states[0].info["nav"].robot_pos_w)[:, :2], axis=-1))
            for s in states]  # fmt: skip


def test_off_adds_nothing_to_the_state(make, plain):
    env = make()
    assert plain[-1].info["nav"].dynamics is None and set(plain[-1].info) == {"nav", "rng", "truncation", "time_out"}
    assert plain[-1].pipeline_state.change is None and env.dynamics._ranges == {}
    assert make(**{name: (value, value) for name, value in NEUTRAL.items()}).dynamics._ranges == {}


def test_half_the_gain_is_half_the_way(make, plain):
    half = played(make(random_motor_gain=(0.5, 0.5)), 8)
    steady = [way_m(states)[8] - way_m(states)[4] for states in (half, plain)]
    np.testing.assert_allclose(steady[0], 0.5 * steady[1], rtol=0.05)
    assert steady[1].min() > 0.2


def test_a_delay_shifts_the_actions(make, plain):
    late = played(make(random_motor_delay_steps=(3, 3)), 8)
    np.testing.assert_allclose(way_m(late)[3], 0.0, atol=1e-3)
    np.testing.assert_allclose(way_m(late)[4:], way_m(plain)[1:6], atol=8e-3)  # of 0.07 m in a step
    np.testing.assert_array_equal(late[0].info["nav"].dynamics.drawn["random_motor_delay_steps"], [3] * N)


def test_latency_shows_the_observation_of_some_steps_ago(make, plain):
    late = played(make(random_sensor_delay_steps=(2, 2)), 8)
    shown = [np.asarray(s.obs) for s in late]
    expected = [np.asarray(plain[max(0, t - 2)].obs) for t in range(9)]
    np.testing.assert_array_equal(shown, expected)
    assert not np.array_equal(expected[3], expected[4])


@pytest.mark.heavy
def test_latency_starts_again_with_each_episode(make):
    """An episode of 4 steps in batches that reset themselves, in `AutoResetEnv` and with Gymnasium's masks."""
    settings = {"episode_steps": 4, "random_sensor_delay_steps": (1, 2), "random_motor_delay_steps": (0, 2)}
    env = make(**settings)
    for wrapped in (AutoResetEnv(env), AutoResetEnv(env, final_obs=True)):
        step, state = jax.jit(wrapped.step), jax.jit(wrapped.reset)(keys())
        firsts, first = [], state
        for _ in range(5):
            state = step(state, AHEAD)
            firsts.append(state)
        new = jax.vmap(env._observation)(firsts[3])
        np.testing.assert_array_equal(firsts[3].info["nav"].step_count, [0] * N)
        np.testing.assert_array_equal(firsts[3].obs, new)
        np.testing.assert_array_equal(firsts[4].obs, new)  # the latency is 1 or 2
        assert not np.array_equal(first.obs, firsts[3].obs)
    states = played(env, 3)
    mask = jnp.asarray([True, False, True])
    new = jax.jit(functools.partial(reset_where, env))(states[3], keys(seed=1), mask)
    after = jax.jit(jax.vmap(env.step))(new, AHEAD)
    np.testing.assert_array_equal(after.obs[::2], new.obs[::2])
    np.testing.assert_array_equal(new.obs[1], states[3].obs[1])


@pytest.mark.heavy
def test_latency_sees_the_steps_within_a_held_action(make):
    env = make(random_sensor_delay_steps=(1, 1))
    once, twice = played(env, 4), AutoResetEnv(env, action_repeat=2)
    state = jax.jit(twice.reset)(keys())
    for k in (2, 4):
        state = jax.jit(twice.step)(state, AHEAD)
        np.testing.assert_allclose(state.obs, once[k].obs, atol=1e-5)


@pytest.mark.heavy
def test_an_episode_draws_the_same_whatever_else_is_drawn(make):
    ranges = {name: (low, low + 2 if name.endswith("steps") else low + 0.5) for name, low in NEUTRAL.items()}
    draw = {
        n: make(**r).reset(keys(1)[0]).info["nav"].dynamics
        for n, r in (("all", ranges), ("one", {"random_mass": (1.0, 1.5)}))
    }
    assert draw["one"].drawn.keys() == {"random_mass"} and draw["all"].drawn.keys() == NEUTRAL.keys()
    assert float(draw["one"].drawn["random_mass"]) == float(draw["all"].drawn["random_mass"])
    many = jax.jit(jax.vmap(make(**ranges).draw))(keys(200))
    for name, value in many.info["nav"].dynamics.drawn.items():
        low, high = ranges[name]
        assert low <= value.min() < value.max() <= high
        if name.endswith("_steps"):
            assert set(np.asarray(value).tolist()) == {0, 1, 2}
    left, right = many.info["nav"].dynamics.drawn["random_wheel_slip"].T
    assert not np.array_equal(left, right)


def executed(robot, command, **ranges):
    dynamics = Dynamics(NavConfig.of(**{name: (value, value) for name, value in ranges.items()}), robot)
    drawn = {name: jnp.asarray([value] * 2 if name == "random_wheel_slip" else value) for name, value in ranges.items()}
    nav: Any = SimpleNamespace(dynamics=EpisodeDynamics(drawn, None, None), step_count=0)
    return dynamics, nav, functools.partial(dynamics.execute, nav, jnp.asarray(command), None)


@pytest.mark.parametrize(
    ("robot", "mode", "command", "expected"),
    [
        ("turtlebot", "native", [10.0, 10.0], [5.0, 7.5]),  # wheels: left 50 %, right 75 %
        ("turtlebot", "twist", [1.0, 0.0], None),
        ("fetch", "whole_body", None, None),
    ],
)
def test_slip_takes_from_each_side(robot, mode, command, expected):
    robot = get_robot(robot, mode)
    command = command or [4.0, 8.0, *[0.3] * (robot.action_size - 2)]
    dynamics, nav, _ = executed(robot, command, random_wheel_slip=0.5)
    nav.dynamics.drawn["random_wheel_slip"] = jnp.asarray([0.5, 0.25])
    _, got, _ = dynamics.execute(nav, jnp.asarray(command), None)
    if expected is None and mode == "twist":  # sides at 0.5 and 0.75 m/s, half a body's width from the middle
        expected = [0.625, 0.25 / robot.body_width_m]
    np.testing.assert_allclose(got, expected or [2.0, 6.0, *command[2:]], rtol=1e-5)


def test_gain_and_slip_multiply():
    robot = get_robot("turtlebot")
    got = executed(robot, [4.0, 8.0], random_wheel_slip=0.5, random_motor_gain=0.8)[2]()[1]
    np.testing.assert_allclose(got, [1.6, 3.2], rtol=1e-5)


def test_what_cannot_be_drawn_is_refused_in_one_line(make):
    for name, value, message in (
        (
            "random_mass",
            (2.0, 1.0),
            r"random_mass is \(2.0, 1.0\), expected the smaller .* first; write \(1.0, 2.0\)",
        ),
        ("random_friction", (-1.0, 1.0), r"random_friction\[0\] is -1.0, expected"),
        ("random_wheel_slip", (0.0, 1.5), r"random_wheel_slip\[1\] is 1.5, expected"),
        ("random_motor_delay_steps", (0, 101), r"random_motor_delay_steps\[1\] is 101, expected .*100"),
        ("random_sensor_delay_steps", (0, 1, 2), "random_sensor_delay_steps is .*, expected a list of 2"),
        ("random_sensor_delay_steps", (0.5, 1), r"random_sensor_delay_steps\[0\] is 0.5, expected a whole number"),
    ):
        with pytest.raises(ConfigError, match=message) as error:
            NavConfig.of(**{name: value})
        assert "\n" not in str(error.value)
    with pytest.raises(ConfigError, match="random_wheel_slip is .*'husky' in mode 'native' .*choose one of .*twist"):
        Dynamics(NavConfig.of(random_wheel_slip=(0.0, 0.1)), get_robot("husky"))
    with pytest.raises(ConfigError, match="randomization_fn is given with backend='native', expected backend='jax'"):
        wrap_for_brax_training(make(), randomization_fn=lambda model: (model, model))


def test_scores_weigh_objects_by_their_drawn_masses():
    drawn = EpisodeDynamics({"random_mass": jnp.asarray(2.0)}, None, None)
    tables = SimpleNamespace(mass_kg=jnp.asarray([[7.0, 1.0, 3.0]]))
    step = SimpleNamespace(tables=tables, score_mass_kg=5.0, nav=SimpleNamespace(scene_index=0, dynamics=drawn))
    np.testing.assert_allclose(masses_kg(step), [5.0, 2.0, 6.0])  # type: ignore[arg-type]
    assert "mass_kg" in SceneTables.__dataclass_fields__


@pytest.fixture(scope="module")
def world(tmp_path_factory):
    """A block that slides easily, 0.55 m ahead."""
    room = write_room(tmp_path_factory.mktemp("push") / "c", (4.0, 3.0), (("basket", 0.55, 0.0, KG, FRICTION),))
    return build_world(get_robot("turtlebot"), (load_scene(room),), NavConfig.of(num_objects=0))


def pushed(world, backend):
    """Return [steps, 3] N on a block that the robot pushes, and [3] m/s2 by which a sliding block slows down.

    The three have their own mass and friction, twice the mass, and twice the friction.
    """
    physics = make_physics(world, NavConfig.of(backend=backend, num_objects=0, sleep=False))
    block, n = world.layout.slot_qvel[0], 2 * N
    change = ModelChange(jnp.asarray([1.0, 2.0, 1.0] * 2), jnp.asarray([1.0, 1.0, 2.0] * 2))
    qpos, qvel = np.tile(world.rest_qpos[0], (n, 1)), np.zeros((n, world.models[0].nv))
    qpos[:, :7] = [0.17, 0, 0, 1, 0, 0, 0]
    qpos[N:, 0] = -1.0
    qvel[N:, block] = SPEED_M_S
    still = jnp.zeros(qvel.shape, jnp.float32)
    state = PhysicsState(jnp.asarray(qpos, jnp.float32), jnp.asarray(qvel, jnp.float32), still)
    step = jax.jit(jax.vmap(physics.step))
    forces, speeds = [], [qvel[N:, block]]
    command = jnp.where(jnp.arange(n)[:, None] < N, jnp.full((n, 2), 8.0), 0.0)
    for _ in range(25):
        state, signals = step(jnp.zeros(n, jnp.int32), state.replace(change=change), command)
        assert state.change is None
        forces.append(signals.force_n[:N])
        speeds.append(state.qvel[N:, block])
    return np.asarray(forces), (speeds[0] - speeds[4]) / 0.4


@pytest.mark.parametrize(
    "backend",
    [
        "native",
        pytest.param("jax", marks=pytest.mark.heavy),
        pytest.param("warp", marks=[
            pytest.mark.gpu, pytest.mark.skipif(importlib.util.find_spec("warp") is None, reason="no warp-lang")]),
    ],
)  # fmt: skip
def test_a_block_of_twice_the_mass_or_friction_takes_twice_the_force(world, backend):
    """Force of a push at a steady speed: mu m g, and a little more where the pusher's face presses it down."""
    forces, slows = pushed(world, backend)
    steady = forces[15:].mean(0)
    assert FRICTION * KG * G < steady[0] < 1.5 * FRICTION * KG * G
    assert steady[1] / steady[0] == pytest.approx(2.0, rel=0.1)
    assert 1.8 < steady[2] / steady[0] < 2.8
    np.testing.assert_allclose(slows, FRICTION * G * np.array([1.0, 1.0, 2.0]), rtol=0.12)


def test_the_model_of_a_native_environment_is_a_scaled_copy(world):
    physics = make_physics(world, NavConfig.of(backend="native", num_objects=0))
    assert isinstance(physics, NativePhysics)
    pool = physics._take_pool(np.zeros((2, physics.nq), np.float32))
    physics._set_models(pool, np.zeros(2, int), np.array([[1.0, 1.0], [2.0, 0.5]]))
    plain, changed = pool.models
    body, dof = int(world.layout.slot_body[0]), int(world.layout.slot_qvel[0])
    assert plain is physics._models[0] and changed is not plain
    names = "body_mass", "body_inertia", "body_subtreemass", "body_invweight0"
    for name, factor in zip(names, (2.0, 2.0, 2.0, 0.5), strict=True):
        ratio = np.ones(plain.nbody)
        ratio[body] = factor
        was, now = (np.asarray(getattr(m, name)).reshape(m.nbody, -1)[:, 0] for m in (plain, changed))
        feet = plain.body_parentid == body
        np.testing.assert_allclose(now[~feet], (was * ratio)[~feet], rtol=1e-6, err_msg=name)
    floor = plain.pair_friction[:, 0] != changed.pair_friction[:, 0]
    np.testing.assert_allclose(changed.pair_friction[floor, :2], 0.5 * FRICTION, rtol=1e-6)
    assert floor.any()
    robot = np.isin(plain.geom_bodyid, world.layout.robot_bodies)
    np.testing.assert_array_equal(plain.geom_friction[robot], changed.geom_friction[robot])
    physics._set_models(pool, np.zeros(2, int), np.array([[1.0, 1.0], [1.0, 1e-3]]))
    assert pool.models[1].pair_friction[floor, 0] == pytest.approx(FLOOR_FRICTION)

    def acceleration(model):  # of 20 N on a block in free space: no floor, no gravity
        data = mujoco.MjData(model)
        data.qpos[:] = world.rest_qpos[0]
        data.qpos[world.layout.slot_qpos[0] + 2] = 3.0
        data.xfrc_applied[body, 0] = 20.0
        mujoco.mj_forward(model, data)
        return data.qacc[dof]

    assert acceleration(plain) == pytest.approx(20.0 / KG, rel=1e-3)
    assert acceleration(changed) == pytest.approx(10.0 / KG, rel=1e-3)


def test_all_objects_of_a_native_environment_are_scaled_and_the_robot_is_not(tmp_path):
    """In the stepped model, the bodies of feet stand between those of the objects."""
    blocks = tuple(("basket", x_m, 1.0, KG, FRICTION) for x_m in (-1.0, 0.0, 1.0))
    scene = load_scene(write_room(tmp_path / "three", (4.0, 4.0), blocks, door=True))
    config = NavConfig.of(backend="native", num_objects=1)
    world = build_world(get_robot("turtlebot"), (scene,), config)
    physics = make_physics(world, config)
    assert isinstance(physics, NativePhysics)
    pool = physics._take_pool(np.zeros((1, physics.nq), np.float32))
    physics._set_models(pool, np.zeros(1, int), np.array([[2.0, 1.0]]))
    plain, changed = physics._models[0], pool.models[0]
    assert len(world.layout.slot_body) == 5
    for slot_body in world.layout.slot_body:
        name = world.models[0].body(slot_body).name
        assert changed.body(name).mass[0] == pytest.approx(2 * world.models[0].body(name).mass[0]), name
    for body in world.layout.robot_bodies:
        assert changed.body(body).mass == plain.body(body).mass == world.models[0].body(body).mass


def test_given_fields_hold_where_scenes_fill_nothing(world):
    window = PhysicsWindow(world, NavConfig.of(num_objects=0))
    state = PhysicsState(
        jnp.asarray(world.rest_qpos[0], jnp.float32), jnp.zeros(world.models[0].nv), jnp.zeros(world.models[0].nv)
    )
    chosen, walls, _ = window.select(window.measure(jnp.asarray(0), state))
    fields = window.fields(jnp.asarray(0), chosen, walls)
    given = {name: jnp.full_like(fields[name], 7.0) for name in ("body_mass", "geom_friction", "qpos0")}
    new = window.with_given(fields, given | {"dof_armature": jnp.zeros(3)})
    robot, block = window.layout.robot_bodies, window.layout.slot_body
    np.testing.assert_array_equal(new["body_mass"][robot], 7.0)
    np.testing.assert_array_equal(new["body_mass"][block], fields["body_mass"][block])
    floor = window.model.geom("floor").id
    np.testing.assert_array_equal(new["geom_friction"][floor], [7.0] * 3)
    np.testing.assert_array_equal(new["geom_friction"][-1], fields["geom_friction"][-1])
    assert set(new) == set(fields)


def playground(model, rng):
    """Randomise as MuJoCo Playground's functions do: the motors of environment i have i times their strength."""

    @jax.vmap
    def rand(rng, strength):
        _, key = jax.random.split(rng)
        mass = model.body_mass * jax.random.uniform(key, (model.nbody,), minval=0.9, maxval=1.1)
        return model.actuator_gainprm * strength, mass

    gains, mass = rand(rng, jnp.arange(len(rng)))
    axes = jax.tree.map(lambda x: None, model).tree_replace({"actuator_gainprm": 0, "body_mass": 0})
    return model.tree_replace({"actuator_gainprm": gains, "body_mass": mass}), axes


@pytest.mark.heavy
def test_a_playground_randomization_fn_gives_each_environment_its_model(make):
    env = make(backend="jax", episode_steps=4)
    wrapped = wrap_for_brax_training(env, randomization_fn=functools.partial(playground, rng=keys()))
    step, state = jax.jit(wrapped.step), jax.jit(wrapped.reset)(keys())
    first, masses = state, state.info["model"]["body_mass"]
    assert masses.shape == (N, env.physics.mj_model.nbody)
    for _ in range(3):
        state = step(state, AHEAD)
    ways = way_m([first, state])[1]
    assert ways[0] == pytest.approx(0.0, abs=1e-3) and ways[2] > ways[1] > 0.05
    after = step(step(state, AHEAD), AHEAD)  # a new episode keeps its environment's model
    assert after.info["nav"].step_count.tolist() == [1] * N
    np.testing.assert_array_equal(after.info["model"]["body_mass"], masses)
    with pytest.raises(ConfigError, match="varies 3 models, expected one per environment: 5"):
        wrapped.reset(keys(5))
    with pytest.raises(ConfigError, match=r"randomization_fn varies axes \{\}, expected axis 0"):
        wrap_for_brax_training(env, randomization_fn=lambda model: (model, jax.tree.map(lambda x: None, model)))
