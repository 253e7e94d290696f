"""C MuJoCo, MJX-JAX and MJX-Warp step the same toy scenes alike; the two upstream limits that we work round."""

import importlib.util

import jax
import jax.numpy as jnp
import mujoco
import numpy as np
import pytest
from mujoco import mjx

import interactive_nav
from interactive_nav.config import NavConfig
from interactive_nav.physics import PhysicsState, make_physics, resolve_backend
from interactive_nav.robots import get_robot
from interactive_nav.scene import load_scene
from interactive_nav.world import build_world
from tests.toys import write_room

HAS_WARP = importlib.util.find_spec("warp") is not None
STEPS = 20
# float32 against float64 over 100 substeps of stick and slip: free driving agrees to 1 mm, a push to 2 cm.
FREE_M, PUSH_M = 1e-3, 2e-2

# Scenarios: scene, wheel commands (rad/s). Scene 0 has a 1 kg block 0.5 m ahead, scene 1 a wall and an 8 kg door.
SCENE = np.array([0, 0, 0, 1, 1])
CTRL = np.array([[0, 0], [-5, 5], [10, 10], [14, 14], [6, 10]], np.float32)


@pytest.fixture(scope="module")
def world(tmp_path_factory):
    base = tmp_path_factory.mktemp("backends")
    a = write_room(base / "a", (4.0, 3.0), (("basket", 0.55, 0.0, 1.0, 0.5),))
    b = write_room(base / "b", (1.6, 3.0), ())
    scenes = (load_scene(a), load_scene(b))
    return build_world(get_robot("turtlebot"), scenes, NavConfig(num_objects=0))


def trajectory(world, backend):
    """[STEPS, N, ...] positions and forces under constant commands, from the room's centre heading along x."""
    physics = make_physics(world, NavConfig(backend=backend, num_objects=0, sleep=False))
    qpos = world.rest_qpos[SCENE].copy()
    qpos[:, :7] = [0, 0, 0, 1, 0, 0, 0]
    still = jnp.zeros((len(SCENE), world.models[0].nv), jnp.float32)
    state = PhysicsState(jnp.asarray(qpos, jnp.float32), still, still)
    step = jax.jit(jax.vmap(physics.step))
    out = []
    for _ in range(STEPS):
        state, signals = step(jnp.asarray(SCENE), state, jnp.asarray(CTRL))
        out.append((state.qpos, signals.force_n, signals.slot_force_n, signals.structure_force_n, signals.overflow))
    return [np.stack([np.asarray(o[i]) for o in out]) for i in range(5)]


@pytest.fixture(scope="module")
def native(world):
    return trajectory(world, "native")


def test_native_scenarios_do_what_they_should(world, native):
    qpos, force, slots, structure, _ = native
    box = world.layout.slot_qpos[0]
    np.testing.assert_allclose(qpos[-1, 0, :2], 0, atol=2e-3)  # stands
    np.testing.assert_allclose(qpos[-1, 1, :2], 0, atol=1e-2)  # turns in place
    assert abs(qpos[-1, 1, 3]) < 0.9  # ... and does turn
    # Drives 0.35 m/s for 2 s and pushes the block ahead of it.
    pushed = qpos[-1, 2, box] - qpos[0, 2, box]
    assert pushed > 0.2 and slots[-1, 2, 0] > 1.0
    # Pushing at constant speed: the horizontal force is the floor's friction, 0.5 * 1 kg * 9.81 = 4.9 N;
    # friction on the robot's face may add a vertical part of up to 0.5 of it.
    assert 4.9 * 0.95 < np.median(force[-6:, 2]) < 4.9 * 1.2
    assert (force[:, :2] == 0).all()  # touching nothing gives exactly 0
    assert structure[-1, 3] > 1.0 and (structure[:, 2] == 0).all()  # only the narrow room's wall is met


def assert_agree(world, native, other, force_rtol):
    box = world.layout.slot_qpos[0]
    np.testing.assert_allclose(other[0][:, :2, :7], native[0][:, :2, :7], atol=FREE_M)
    np.testing.assert_allclose(other[0][:, 2:, :2], native[0][:, 2:, :2], atol=PUSH_M)
    np.testing.assert_allclose(other[0][:, 2, box], native[0][:, 2, box], atol=PUSH_M)
    # Sideways, a face pushed at its middle is unstable: rounding decides, so only the size is bounded.
    assert np.abs(other[0][:, 2, box + 1]).max() < 0.1
    np.testing.assert_allclose(other[1].sum(0), native[1].sum(0), rtol=force_rtol, atol=0.5)
    assert other[4].sum() == 0  # no buffer overflowed


@pytest.mark.slow
def test_mjx_jax_agrees_with_c_mujoco(world, native):
    # MJX-JAX keeps other contact points of two boxes, so friction on the pusher's face differs.
    assert_agree(world, native, trajectory(world, "jax"), force_rtol=0.15)


@pytest.mark.slow
@pytest.mark.skipif(not HAS_WARP, reason="the package warp-lang (extra 'warp') is not installed")
def test_mjx_warp_agrees_with_c_mujoco(world, native):
    assert_agree(world, native, trajectory(world, "warp"), force_rtol=0.05)


@pytest.mark.slow
@pytest.mark.skipif(not HAS_WARP, reason="the package warp-lang (extra 'warp') is not installed")
def test_overflowing_buffers_are_counted(world):
    config = NavConfig(backend="warp", num_objects=0, contacts_per_env=2, constraints_per_env=16)
    physics = make_physics(world, config)
    still = jnp.zeros((len(SCENE), world.models[0].nv), jnp.float32)
    state = PhysicsState(jnp.asarray(world.rest_qpos[SCENE], jnp.float32), still, still)
    _, signals = jax.jit(jax.vmap(physics.step))(jnp.asarray(SCENE), state, jnp.asarray(CTRL))
    assert int(np.asarray(signals.overflow).sum()) > 0


def test_sleep_changes_nothing_that_moves(world, native):
    physics = make_physics(world, NavConfig(backend="native", num_objects=0, sleep=True))
    qpos = world.rest_qpos[SCENE].copy()
    qpos[:, :7] = [0, 0, 0, 1, 0, 0, 0]
    still = jnp.zeros((len(SCENE), world.models[0].nv), jnp.float32)
    state = PhysicsState(jnp.asarray(qpos, jnp.float32), still, still)
    step = jax.jit(jax.vmap(physics.step))
    for _ in range(STEPS):
        state, _ = step(jnp.asarray(SCENE), state, jnp.asarray(CTRL))
    np.testing.assert_allclose(np.asarray(state.qpos)[:, :2], native[0][-1][:, :2], atol=PUSH_M)


def test_auto_picks_native_on_a_cpu():
    assert resolve_backend("auto") == ("native" if jax.default_backend() == "cpu" else resolve_backend("auto"))
    assert resolve_backend("jax") == "jax"


def test_upstream_mjx_jax_still_has_no_contact_sensors_between_bodies(world):
    """MjxPhysics sums contact forces itself on `jax`. When this fails, read the sensors there too."""
    with pytest.raises(NotImplementedError, match="Contact sensor"):
        mjx.put_model(world.models[0], impl="jax")


MOTOR = """<mujoco><option timestep=".02" integrator="implicitfast"/><worldbody><body><joint name="j" axis="0 1 0"
armature=".001"/><geom size=".03" mass=".1"/></body></worldbody><actuator><velocity joint="j" kv=".15" {limit}/>
</actuator></mujoco>"""


def _first_step_speed(limit: str, joint: str, mjx_jax: bool) -> float:
    xml = MOTOR.format(limit=limit).replace('name="j"', f'name="j" {joint}')
    model = mujoco.MjModel.from_xml_string(xml)
    if mjx_jax:
        data = mjx.make_data(model, impl="jax").replace(ctrl=jnp.array([25.0]))
        return float(jax.jit(mjx.step)(mjx.put_model(model, impl="jax"), data).qvel[0])
    data = mujoco.MjData(model)
    data.ctrl[:] = 25.0
    mujoco.mj_step(model, data)
    return float(data.qvel[0])


def test_upstream_mjx_jax_still_damps_a_saturated_motor():
    """A saturated motor has no velocity feedback: C MuJoCo drops its derivative, MJX-JAX keeps it.

    Hence the TurtleBot's torque limit sits on the joint, where both keep it. When the first assertion
    fails, the limit can move back to the actuator.
    """
    at_motor = 'forcelimited="true" forcerange="-1 1"'
    at_joint = 'actuatorfrclimited="true" actuatorfrcrange="-1 1"'
    assert _first_step_speed(at_motor, "", True) < 0.5 * _first_step_speed(at_motor, "", False)
    assert _first_step_speed("", at_joint, True) == pytest.approx(_first_step_speed("", at_joint, False), rel=1e-4)


def test_warp_is_refused_with_the_remedy_where_it_is_missing(monkeypatch):
    monkeypatch.setattr(importlib.util, "find_spec", lambda name: None)
    with pytest.raises(ValueError, match="install the gpu extra"):
        resolve_backend("warp")
    assert "turtlebot" in interactive_nav.robot_names()
