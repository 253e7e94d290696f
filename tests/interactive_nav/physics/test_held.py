"""Drawers and flaps: all backends step them as C MuJoCo does, resets close them, and wheels do not catch on them."""

import dataclasses
import importlib.util

import jax
import jax.numpy as jnp
import mujoco
import numpy as np
import pytest

import interactive_nav
from interactive_nav.config import NavConfig
from interactive_nav.physics import PhysicsState, make_physics
from interactive_nav.robots import get_robot
from interactive_nav.scenes.scene import load_scene
from interactive_nav.scenes.world import build_world
from interactive_nav.sensing import make_renderer
from interactive_nav.sensing.boxes import build_boxes
from scenes_mjcf.categories import class_id
from scenes_mjcf.look import Lens, look_along
from tests.toys import write_room

OPEN_M = 0.3
BACKENDS = ("native", "jax", *(("warp",) if importlib.util.find_spec("warp") else ()))


@pytest.fixture(scope="module")
def kitchen(tmp_path_factory):
    return write_room(tmp_path_factory.mktemp("held") / "kitchen", (5.0, 4.0), (), door=True, kitchen=True)


@pytest.fixture(scope="module")
def world(kitchen):
    config = NavConfig.of(num_objects=0, solver_iterations=100)
    return build_world(get_robot("turtlebot", "twist"), (load_scene(kitchen),), config)


def _start(world, drawer_m):
    qpos = world.rest_qpos[0].copy()
    slots = dict(zip(world.slots.names[0], world.layout.slot_qpos, strict=True))
    qpos[:7] = [0, 0.75, world.robot.spawn_height_m, np.sqrt(0.5), 0, 0, np.sqrt(0.5)]
    qpos[slots["drawer_0"]] = drawer_m
    still = jnp.zeros(world.models[0].nv)
    return PhysicsState(jnp.asarray(qpos, jnp.float32), still, still), slots


def test_a_drawer_and_a_flap_are_read_as_they_are_written(world):
    scene = world.scenes[0]
    assert {m.name: m.kind for m in scene.movables} == {
        "door_0": "hinge", "drawer_0": "slide", "cabinet_door_0": "hinge"
    }  # fmt: skip
    drawer = next(m for m in scene.movables if m.name == "drawer_0")
    assert (
        drawer.joint is not None
        and drawer.joint.range == (0.0, 0.35)
        and drawer.mass_kg == pytest.approx(5.0, abs=1e-3)
    )
    assert drawer.joint.axis.tolist() == [0.0, -1.0, 0.0]
    assert world.layout.slot_kind == ("hinge", "hinge", "slide")
    shut, _ = _start(world, 0.0)
    assert float(jnp.abs(shut.qpos[world.layout.slot_qpos]).max()) < 1e-3, "a flap that is shut stays so"


@pytest.mark.parametrize("backend", [pytest.param(b, marks=[pytest.mark.heavy] * (b == "jax")) for b in BACKENDS])
def test_a_robot_shuts_an_open_drawer(world, backend):
    """It drives 0.4 m/s; the drawer's front is 0.4 m before it and goes 0.3 m."""
    config = NavConfig.of(backend=backend, num_objects=0, solver_iterations=100)
    state, slots = _start(world, OPEN_M)
    step = jax.jit(jax.vmap(make_physics(world, config).step))
    robot, states = world.robot, jax.tree.map(lambda x: x[None], state)
    command = jnp.asarray(robot.command(robot.drive(np.float64(0.4), np.float64(0.0))), jnp.float32)[None]
    most_n, at = 0.0, slots["drawer_0"]
    for k in range(20):
        states, signals = step(jnp.zeros(1, int), states, command, jnp.full(1, 0.1 * k))
        most_n = max(most_n, float(signals.slot_force_n.max()))
    assert abs(float(states.qpos[0, at])) < 0.02 and most_n > 1.0
    assert int(signals.overflow[0]) == int(signals.nonfinite[0]) == 0
    others = [v for name, v in slots.items() if name != "drawer_0"]
    assert float(jnp.abs(states.qpos[0, jnp.asarray(others)]).max()) < 1e-2, "the rest stays shut"


@pytest.mark.heavy
def test_backends_agree_on_a_drawer_that_is_let_go(world):
    """Pushed at 0.5 m/s it comes to rest by its damping alone, as C MuJoCo has it."""
    state, slots = _start(world, 0.0)
    model, data, layout = world.models[0], mujoco.MjData(world.models[0]), world.layout
    speed = np.zeros(model.nv)
    speed[layout.slot_qvel[world.slots.names[0].index("drawer_0")]] = 0.5
    data.qpos[:], data.qvel[:] = np.asarray(state.qpos), speed
    for _ in range(25):
        mujoco.mj_step(model, data)
    want = float(data.qpos[slots["drawer_0"]])
    assert 0.1 < want < 0.35
    for backend in BACKENDS:
        config = NavConfig.of(backend=backend, num_objects=0, solver_iterations=100)
        step, now = (
            jax.jit(jax.vmap(make_physics(world, config).step)),
            dataclasses.replace(state, qvel=jnp.asarray(speed)),
        )
        states = jax.tree.map(lambda x: jnp.asarray(x, jnp.float32)[None], now)
        for k in range(5):
            zero = jnp.zeros((1, world.robot.action_size))
            states, _ = step(jnp.zeros(1, int), states, zero, jnp.full(1, 0.1 * k))
        assert float(states.qpos[0, slots["drawer_0"]]) == pytest.approx(want, abs=1e-3), backend


def test_a_reset_shuts_what_was_open(kitchen):
    """And pictures follow: where the flap was is the wall 0.4 m behind it while it is open, and the flap after."""
    env = interactive_nav.make("turtlebot", [kitchen], backend="native", num_objects=0)
    at = dict(zip(env.world.slots.names[0], env.world.layout.slot_qpos, strict=True))
    rest = env.world.rest_qpos[0][env.world.layout.slot_qpos]
    camera = look_along(jnp.asarray([[0.8, 0.4, 0.22]]), jnp.asarray([[0.0, 1.0, -0.02]]))
    renderer = make_renderer(build_boxes(env.world, "all"), Lens(16, 16, 30.0), "auto", "native", env.world)
    draw = jax.jit(lambda qpos: renderer.render_batch(jnp.zeros(1, jnp.int32), qpos[None], camera))
    reset, step = jax.jit(env.reset), jax.jit(env.step)
    first = reset(jax.random.PRNGKey(0))
    np.testing.assert_allclose(first.pipeline_state.qpos[env.world.layout.slot_qpos], rest, atol=1e-6)
    ajar = first.pipeline_state.qpos.at[jnp.array([at["cabinet_door_0"], at["drawer_0"]])].set(jnp.array([1.4, OPEN_M]))
    state = first.replace(pipeline_state=dataclasses.replace(first.pipeline_state, qpos=ajar))
    state = step(state, jnp.zeros(env.action_size))
    assert state.pipeline_state.qpos[at["cabinet_door_0"]] > 1.2 and state.pipeline_state.qpos[at["drawer_0"]] > 0.25
    again = reset(jax.random.PRNGKey(0))
    np.testing.assert_allclose(again.pipeline_state.qpos, first.pipeline_state.qpos, atol=1e-6)
    depths, ids = zip(*(draw(s.pipeline_state.qpos) for s in (first, state, again)), strict=True)
    np.testing.assert_array_equal(ids[0], ids[2])
    np.testing.assert_allclose(depths[0], depths[2], atol=1e-5)
    flap = class_id("cabinet_door", "all")
    shut, seen = (ids[0] == flap), (ids[1] == flap)
    assert shut.sum() > 80 > 20 > seen.sum()
    gone = shut & ~seen
    np.testing.assert_allclose(depths[1][gone] - depths[0][gone], 0.405, atol=0.02)  # to the wall behind the flap
