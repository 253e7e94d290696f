"""C MuJoCo, MJX-JAX and MJX-Warp step the same toy scenes alike; the upstream limits that we work round."""

import dataclasses
import functools
import importlib.util
from typing import Any

import jax
import jax.numpy as jnp
import mujoco
import numpy as np
import pytest
from mujoco import mjx

import interactive_nav
from interactive_nav.config import NavConfig, TaskRules
from interactive_nav.physics import (
    PhysicsState,
    StepSignals,
    base,
    compiler_options,
    keep_programs,
    make_physics,
    mjx_batch,
    resolve_backend,
)
from interactive_nav.physics import native as native_backend
from interactive_nav.robots import get_robot
from interactive_nav.scenes.scene import load_scene
from interactive_nav.scenes.world import build_world
from interactive_nav.task.wrappers import AutoResetEnv
from interactive_nav_common.errors import UserError
from tests.toys import write_room

HAS_WARP = importlib.util.find_spec("warp") is not None
STEPS, PUSH_STEPS = 20, 30
STEADY = slice(15, PUSH_STEPS)
"""Control steps in which the last scenario's robot pushes at constant speed."""
BLOCK_KG, BLOCK_FRICTION = 1.0, 0.2
"""Of the block that it pushes; slower pushes and more friction gave means below mu N (docs/navigation.md)."""
# float32 against float64 over 100 substeps of stick and slip: free driving agrees to 1 mm, a push to 2 cm.
FREE_M, PUSH_M = 1e-3, 2e-2

# Scenarios: scene, wheel commands (rad/s), start along x. Scene 0 has a 1 kg block 0.5 m ahead, scene 1 a wall. In
# scene 2 the robot starts 2 cm from a block that slides easily.
SCENE = np.array([0, 0, 0, 1, 1, 2])
CTRL = np.array([[0, 0], [-5, 5], [10, 10], [14, 14], [6, 10], [8, 8]], np.float32)
START_X = np.array([0, 0, 0, 0, 0, 0.17])
FIRST = slice(0, 5)
CONTACTS: dict[str, Any] = {"interaction_with": "anything"}
"""A setting that needs single contacts: forces by all options come from one run."""


@pytest.fixture(scope="module")
def world(tmp_path_factory):
    folder = tmp_path_factory.mktemp("backends")
    a = write_room(folder / "a", (4.0, 3.0), (("basket", 0.55, 0.0, 1.0, 0.5),))
    b = write_room(folder / "b", (1.6, 3.0), ())
    c = write_room(folder / "c", (4.0, 3.0), (("basket", 0.55, 0.0, BLOCK_KG, BLOCK_FRICTION),))
    scenes = (load_scene(a), load_scene(b), load_scene(c))
    return build_world(get_robot("turtlebot"), scenes, NavConfig.of(num_objects=0, **CONTACTS))


@dataclasses.dataclass(frozen=True)
class Run:
    """PUSH_STEPS control steps of all scenarios under constant commands, heading along x."""

    qpos: np.ndarray
    """[T, N, nq]."""
    qvel: np.ndarray
    signals: StepSignals
    """Leaves [T, N, ...]."""
    force_w: np.ndarray
    """[T, N, substeps, slots + 1, 3] of the robot on each body."""
    contacts: tuple[np.ndarray, np.ndarray, np.ndarray]
    """As `contacts.from_sensors`, leaves [T, N, substeps, (3)]."""

    def force_n(self, part: str, how: str) -> np.ndarray:
        """[T, N] F_t under the options."""
        # The sum of the normal forces' norms, wheels exempt, is what touches.
        norms = self.contacts[2] if part == "normal" else self.contacts[1]
        contacts, options = (self.contacts[0], norms, self.contacts[2]), TaskRules(force_part=part, force_sum=how)  # type: ignore[arg-type]
        return base.summarise_forces(self.force_w, np, contacts, options)["force_n"]


def trajectory(world, backend, settings=CONTACTS):
    seen = []
    real = base.summarise_forces

    def watched(force_w, xp=jnp, contacts=None, options=base.PAPER_FORCE):
        if xp is np:
            seen.append((force_w, contacts))
        else:
            jax.debug.callback(lambda *x: seen.append(jax.tree.map(np.asarray, x)), force_w, contacts)
        return real(force_w, xp, contacts, options)

    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(native_backend, "summarise_forces", watched)
        patch.setattr(mjx_batch, "summarise_forces", watched)
        config = NavConfig.of(backend=backend, num_objects=0, sleep=False, **settings)
        step = jax.jit(jax.vmap(make_physics(world, config).step))
        qpos = world.rest_qpos[SCENE].copy()
        qpos[:, :7] = [0, 0, 0, 1, 0, 0, 0]
        qpos[:, 0] = START_X
        still = jnp.zeros((len(SCENE), world.models[0].nv), jnp.float32)
        state = PhysicsState(jnp.asarray(qpos, jnp.float32), still, still)
        out = []
        for _ in range(PUSH_STEPS):
            state, signals = step(jnp.asarray(SCENE), state, jnp.asarray(CTRL))
            jax.block_until_ready(state)
            jax.effects_barrier()
            out.append((state.qpos, state.qvel, signals))
    assert len(seen) == PUSH_STEPS
    stack = jax.tree.map(
        lambda *x: np.stack([np.asarray(v) for v in x]), *[(*o, *s) for o, s in zip(out, seen, strict=True)]
    )
    return Run(*stack)


@pytest.fixture(scope="module")
def native(world):
    return trajectory(world, "native")


@pytest.fixture(scope="module")
def mjx_jax(world):
    return trajectory(world, "jax")


@pytest.fixture(scope="module")
def mjx_warp(world):
    return trajectory(world, "warp")


def test_native_scenarios_do_what_they_should(world, native):
    qpos, structure, box = native.qpos[:STEPS], native.signals.structure_force_n[:STEPS], world.layout.slot_qpos[0]
    np.testing.assert_allclose(qpos[-1, 0, :2], 0, atol=2e-3)  # stands
    np.testing.assert_allclose(qpos[-1, 1, :2], 0, atol=1e-2)  # turns in place
    assert abs(qpos[-1, 1, 3]) < 0.9  # ... and does turn
    # Drives 0.35 m/s for 2 s and pushes the block ahead of it.
    pushed = qpos[-1, 2, box] - qpos[0, 2, box]
    assert pushed > 0.2 and native.signals.slot_force_n[STEPS - 1, 2, 0] > 1.0
    assert structure[-1, 3] > 1.0 and (structure[:, 2] == 0).all()  # only the narrow room's wall is met


def assert_force_is_what_pushing_takes(world, run):
    """The push balances the floor's friction, mu times the block's weight and what the pusher's face presses down."""
    # Substeps' mean of the force on the block, in all steady steps.
    force_w = run.force_w[STEADY, -1, :, 0].mean((0, 1))
    force_w = force_w * np.sign(force_w[0])
    speed = run.qvel[STEADY, -1, world.layout.slot_qvel[0]]
    assert speed.mean() > 0.25 and speed.std() < 0.1 * speed.mean()  # at constant speed
    horizontal = np.hypot(force_w[0], force_w[1])
    load = BLOCK_KG * 9.81 - force_w[2]
    assert load > BLOCK_KG * 9.81 * 1.03  # the face does press down: without that part the balance would not close
    assert horizontal == pytest.approx(BLOCK_FRICTION * load, rel=0.05)
    # What the score sees is the norm.
    norm = np.sqrt((run.force_w[STEADY, -1].sum(-2) ** 2).sum(-1)).mean()
    assert run.signals.force_n[STEADY, -1].mean() == pytest.approx(norm, rel=1e-4)
    # Standing, turning in place and driving freely (0.35 m/s, before the block is met) give exactly 0.
    assert (run.signals.force_n[:, :2] == 0).all() and (run.signals.body_force_n[:, :2] == 0).all()
    assert run.qpos[3, 2, 0] > 0.05 and (run.signals.force_n[:4, 2] == 0).all()
    assert (run.signals.body_force_n[:4, 2] == 0).all()


def assert_options_order_as_they_must(world, run):
    full, normal = run.force_n("full", "vector")[STEADY, -1], run.force_n("normal", "vector")[STEADY, -1]
    contacts, last = run.force_n("full", "contacts")[STEADY, -1], run.force_n("full", "last_substep")[STEADY, -1]
    # The block's face is vertical: the normal part is the horizontal part.
    force_w = run.force_w[STEADY, -1, :, 0].mean((0, 1))
    assert normal.mean() == pytest.approx(np.hypot(force_w[0], force_w[1]), rel=0.03)
    assert (full >= normal - 1e-3).all() and full.mean() > 1.02 * normal.mean()
    assert (contacts >= full - 1e-3).all() and contacts.mean() < 1.5 * full.mean()
    assert run.force_n("normal", "contacts")[STEADY, -1].mean() == pytest.approx(normal.mean(), rel=0.05)
    np.testing.assert_allclose(last, np.sqrt((run.force_w[STEADY, -1, -1].sum(-2) ** 2).sum(-1)), rtol=1e-4)
    # Against the wall: touches count for `anything`, and the block and the wall are told apart.
    assert run.signals.body_force_n[STEPS - 1, 3] > 1.0 and run.signals.slot_force_n[:STEPS, 3].max() == 0


def test_the_force_on_a_pushed_block_on_native(world, native):
    assert_force_is_what_pushing_takes(world, native)
    assert_options_order_as_they_must(world, native)


@pytest.mark.heavy
def test_the_force_on_a_pushed_block_on_jax(world, mjx_jax):
    assert_force_is_what_pushing_takes(world, mjx_jax)
    assert_options_order_as_they_must(world, mjx_jax)


@pytest.mark.slow
@pytest.mark.skipif(not HAS_WARP, reason="the package warp-lang (extra 'warp') is not installed")
def test_the_force_on_a_pushed_block_on_warp(world, mjx_warp):
    assert_force_is_what_pushing_takes(world, mjx_warp)
    assert_options_order_as_they_must(world, mjx_warp)


@pytest.mark.parametrize(
    "backend",
    [
        "native",
        pytest.param("jax", marks=pytest.mark.heavy),
        pytest.param("warp", marks=[pytest.mark.heavy, pytest.mark.skipif(not HAS_WARP, reason="no warp-lang")]),
    ],
)
def test_the_chosen_force_is_what_the_signals_hold(world, native, backend):
    run = trajectory(world, backend, {"force_part": "normal", "force_sum": "contacts"})
    force_n = run.signals.force_n
    np.testing.assert_allclose(force_n, run.contacts[1].mean(-1), rtol=1e-4, atol=1e-3)
    # Wheels touch no object here: the normal forces' norms are all that touches.
    np.testing.assert_allclose(force_n, run.contacts[2].mean(-1), rtol=1e-3, atol=1e-2)
    assert force_n[STEADY, -1].mean() == pytest.approx(native.force_n("normal", "contacts")[STEADY, -1].mean(), rel=0.1)


def assert_agree(world, native, other, force_rtol):
    box = world.layout.slot_qpos[0]
    ours, theirs = native.qpos[:STEPS, FIRST], other.qpos[:STEPS, FIRST]
    np.testing.assert_allclose(theirs[:, :2, :7], ours[:, :2, :7], atol=FREE_M)
    np.testing.assert_allclose(theirs[:, 2:, :2], ours[:, 2:, :2], atol=PUSH_M)
    np.testing.assert_allclose(theirs[:, 2, box], ours[:, 2, box], atol=PUSH_M)
    # Sideways, a face pushed at its middle is unstable: rounding decides, so only the size is bounded.
    assert np.abs(theirs[:, 2, box + 1]).max() < 0.1
    for part, how in (("full", "vector"), ("normal", "vector"), ("normal", "contacts")):
        ours, theirs = (run.force_n(part, how)[:STEPS, FIRST].sum(0) for run in (native, other))
        np.testing.assert_allclose(theirs, ours, rtol=force_rtol, atol=0.5)
    assert other.signals.overflow.sum() == 0  # no buffer overflowed


@pytest.mark.slow
def test_mjx_jax_agrees_with_c_mujoco(world, native, mjx_jax):
    # MJX-JAX keeps other contact points of two boxes, so friction on the pusher's face differs.
    assert_agree(world, native, mjx_jax, force_rtol=0.2)


@pytest.mark.slow
@pytest.mark.skipif(not HAS_WARP, reason="the package warp-lang (extra 'warp') is not installed")
def test_mjx_warp_agrees_with_c_mujoco(world, native, mjx_warp):
    assert_agree(world, native, mjx_warp, force_rtol=0.05)


@pytest.mark.slow
@pytest.mark.skipif(not HAS_WARP, reason="the package warp-lang (extra 'warp') is not installed")
def test_overflowing_buffers_are_counted(world):
    config = NavConfig.of(backend="warp", num_objects=0, contacts_per_env=2, constraints_per_env=16, **CONTACTS)
    physics = make_physics(world, config)
    still = jnp.zeros((len(SCENE), world.models[0].nv), jnp.float32)
    state = PhysicsState(jnp.asarray(world.rest_qpos[SCENE], jnp.float32), still, still)
    _, signals = jax.jit(jax.vmap(physics.step))(jnp.asarray(SCENE), state, jnp.asarray(CTRL))
    assert int(np.asarray(signals.overflow).sum()) > 0


def test_sleep_changes_nothing_that_moves(world, native):
    physics = make_physics(world, NavConfig.of(backend="native", num_objects=0, sleep=True, **CONTACTS))
    qpos = world.rest_qpos[SCENE].copy()
    qpos[:, :7] = [0, 0, 0, 1, 0, 0, 0]
    qpos[:, 0] = START_X
    still = jnp.zeros((len(SCENE), world.models[0].nv), jnp.float32)
    state = PhysicsState(jnp.asarray(qpos, jnp.float32), still, still)
    step = jax.jit(jax.vmap(physics.step))
    for _ in range(STEPS):
        state, _ = step(jnp.asarray(SCENE), state, jnp.asarray(CTRL))
    np.testing.assert_allclose(np.asarray(state.qpos)[:, :2], native.qpos[STEPS - 1, :, :2], atol=PUSH_M)


def test_auto_picks_native_on_a_cpu():
    assert resolve_backend("auto") == ("native" if jax.default_backend() == "cpu" else resolve_backend("auto"))
    assert resolve_backend("jax") == "jax"


def test_upstream_mjx_jax_still_has_no_contact_sensors_between_bodies(world):
    """JaxPhysics sums contact forces itself on `jax`. When this fails, read the sensors there too."""
    with pytest.raises(NotImplementedError, match="Contact sensor"):
        mjx.put_model(world.models[0], impl="jax")


def test_upstream_mjx_warp_still_has_no_deterministic_mode():
    """google-deepmind/mujoco_warp#562. When this fails, ask for it where a run is to repeat, and tell it in
    docs/training.md."""
    types = pytest.importorskip("mujoco.mjx.third_party.mujoco_warp._src.types")
    names = {field.name for field in dataclasses.fields(types.Option)}
    assert {"timestep", "solver"} <= names and not [name for name in names if "determinis" in name]


MOTOR = """<mujoco><option timestep=".02" integrator="implicitfast"/><worldbody><body><joint name="j" axis="0 1 0"
armature=".001"/><geom size=".03" mass=".1"/></body></worldbody><actuator><velocity joint="j" kv=".15" {limit}/>
</actuator></mujoco>"""


def _first_step_speed(limit: str, joint: str, mjx_jax: bool) -> float:
    xml = MOTOR.format(limit=limit).replace('name="j"', f'name="j" {joint}')
    model = mujoco.MjModel.from_xml_string(xml)
    if mjx_jax:
        data = mjx.make_data(model, impl="jax").replace(ctrl=jnp.array([25.0]))
        with jax.numpy_rank_promotion("allow"):  # MJX counts on it
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
    with pytest.raises(UserError, match=r"pip install 'interactive-nav\[warp\]', or choose backend=native"):
        resolve_backend("warp")
    assert "turtlebot" in interactive_nav.robot_names()


HOST_PRIMITIVES = ("callback", "outside_call", "infeed", "outfeed")


def host_primitives(jaxpr) -> set[str]:
    """Names of what leaves the device in a program, its inner programs included."""
    found = set()
    for equation in jaxpr.eqns:
        name = equation.primitive.name
        if any(word in name for word in HOST_PRIMITIVES):
            found.add(name)
        for inner in jax.tree.leaves(list(equation.params.values()), is_leaf=lambda x: hasattr(x, "eqns")):
            inner = getattr(inner, "jaxpr", inner)
            if hasattr(inner, "eqns"):
                found |= host_primitives(inner)
    return found


@pytest.mark.heavy
def test_the_loop_is_traced_once_and_never_leaves_the_device(tmp_path):
    """Steps with episodes ending among them: one program, and nothing passes between host and device."""
    room = write_room(tmp_path / "room", (3.0, 3.0), ())
    traced = []

    class Counted(AutoResetEnv):
        def step(self, state, action):
            traced.append(1)
            return super().step(state, action)

    env = Counted(interactive_nav.make("turtlebot", [room], backend="jax", num_objects=1, episode_steps=2))
    native = AutoResetEnv(interactive_nav.make("turtlebot", [room], backend="native", num_objects=1, episode_steps=2))
    keys = jax.random.split(jax.random.PRNGKey(0), 2)
    state, action = jax.jit(env.reset)(keys), jnp.full((2, 2), 0.3)

    def loop(env, state, action):
        def one(state, _):
            state = env.step(state, action)
            return state, state.info["episode_done"]

        return jax.lax.scan(one, state, None, length=3)

    # The measure sees what it looks for: C MuJoCo is called from the host.
    seen = jax.make_jaxpr(functools.partial(loop, native))(jax.jit(native.reset)(keys), action)
    assert host_primitives(seen.jaxpr) == {"pure_callback"}
    assert host_primitives(jax.make_jaxpr(functools.partial(loop, env))(state, action).jaxpr) == set()

    traced.clear()
    run = jax.jit(functools.partial(loop, env)).lower(state, action).compile()
    assert "callback" not in (run.as_text() or "callback")
    state, done = run(state, action)  # takes the scenes' tables to the device
    ended = [done]
    with jax.transfer_guard("disallow"):
        for _ in range(2):
            state, done = run(state, action)
            ended.append(done)
    assert len(traced) == 1
    np.testing.assert_array_equal(np.concatenate(ended)[:, 0], [0, 1, 0, 1, 0, 1, 0, 1, 0])


@pytest.mark.parametrize(
    ("platform", "chosen", "kept"),
    [("gpu", None, "cache/programs"), ("gpu", "", None), ("cpu", None, None), ("gpu", "mine", "mine")],
)
def test_programs_of_an_accelerator_are_kept_unless_somebody_chose(platform, chosen, kept, monkeypatch, tmp_path):
    monkeypatch.chdir(tmp_path)
    monkeypatch.setenv("INTERACTIVE_NAV_CACHE", "cache")
    monkeypatch.delenv("JAX_COMPILATION_CACHE_DIR", raising=False)
    monkeypatch.setattr(jax, "default_backend", lambda: platform)
    before = jax.config.jax_compilation_cache_dir
    try:
        jax.config.update("jax_compilation_cache_dir", chosen or None)
        if chosen is not None:
            monkeypatch.setenv("JAX_COMPILATION_CACHE_DIR", chosen)
        keep_programs()
        assert jax.config.jax_compilation_cache_dir == kept
    finally:
        jax.config.update("jax_compilation_cache_dir", before)


def test_programs_on_a_cpu_leave_out_what_is_slow_there_if_xla_knows_it(monkeypatch):
    """The pinned XLA knows the option; one that does not, and an accelerator, get none."""
    make = compiler_options.__wrapped__
    assert make() == ({"xla_cpu_experimental_ynn_fusion_type": ""} if jax.default_backend() == "cpu" else None)
    monkeypatch.setattr(jax, "default_backend", lambda: "gpu")
    assert make() is None

    def unknown(*_, **__):
        raise jax.errors.JaxRuntimeError("INVALID_ARGUMENT: No such compile option")

    monkeypatch.setattr(jax, "default_backend", lambda: "cpu")
    monkeypatch.setattr(jax, "jit", lambda *_, **__: unknown)
    assert make() is None
