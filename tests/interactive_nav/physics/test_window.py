"""The window's numbers are those of each scene's own model; it holds what is near, and leaves the rest at rest."""

import importlib.util
from typing import Any

import jax
import jax.numpy as jnp
import mujoco
import numpy as np
import pytest

from interactive_nav.config import NavConfig
from interactive_nav.physics import PhysicsState, make_physics, mjx_batch
from interactive_nav.physics.window import FIELDS, PhysicsWindow
from interactive_nav.robots import get_robot
from interactive_nav.scenes.scene import load_scene
from interactive_nav.scenes.world import FEET, build_world
from tests.toys import write_room

# Chairs at x = 0.7 and 1.4 m in front of the robot, tables to the left and far behind.
FURNITURE = (
    ("chair", 0.7, 0.0, 2.0, 0.4),
    ("chair", 1.4, 0.0, 2.0, 0.4),
    ("table", 0.0, 1.5, 9.0, 0.5),
    ("table", -3.0, 0.0, 9.0, 0.5),
)
ALL: dict[str, Any] = {"active_furniture": 0, "active_small": 0, "active_doors": 0, "active_walls": 0}


@pytest.fixture(scope="module")
def world(tmp_path_factory):
    base = tmp_path_factory.mktemp("window")
    full = write_room(base / "full", (8.0, 5.0), FURNITURE)
    empty = write_room(base / "empty", (3.0, 3.0), (("basket", 0.7, 0.0, 1.0, 0.3),))
    return build_world(get_robot("turtlebot"), (load_scene(full), load_scene(empty)), NavConfig.of(num_objects=2))


def _state(world, scene, robot_xy=(0.0, 0.0)):
    qpos = world.rest_qpos[scene].copy()
    qpos[:7] = [*robot_xy, 0, 1, 0, 0, 0]
    still = jnp.zeros(world.models[0].nv)
    return PhysicsState(jnp.asarray(qpos, jnp.float32), still, still)


def _select(window):
    return jax.jit(lambda scene, state: window.select(window.measure(scene, state)))


@pytest.mark.parametrize("scene", [0, 1])
def test_complete_window_has_the_fields_of_the_scenes_own_model(world, scene):
    window = PhysicsWindow(world, NavConfig.of(num_objects=2, **ALL))
    assert sum(group.width for group in window.groups) == world.layout.num_slots
    chosen, walls, missed = _select(window)(jnp.asarray(scene), _state(world, scene))
    fields = jax.jit(window.fields)(jnp.asarray(scene), chosen, walls)
    model, inner, outer = world.models[scene], window, world
    assert int(missed) == 0 and set(fields) == set(FIELDS)
    for a, b in zip(inner.layout.slot_body, outer.layout.slot_body, strict=True):
        for name in ("body_mass", "body_inertia", "body_ipos", "body_invweight0", "body_subtreemass"):
            np.testing.assert_allclose(fields[name][a], getattr(model, name)[b], rtol=1e-5, atol=1e-6)
        mine, own = int(inner.model.body_geomadr[a]), int(model.body_geomadr[b])
        count = int(model.body_geomnum[b]) - FEET
        for name in ("geom_size", "geom_pos", "geom_rbound", "geom_friction"):
            np.testing.assert_allclose(
                fields[name][mine : mine + count], getattr(model, name)[own : own + count], rtol=1e-5, atol=1e-6
            )
            feet = slice(mine + int(inner.model.body_geomnum[a]) - FEET, mine + int(inner.model.body_geomnum[a]))
            np.testing.assert_allclose(
                fields[name][feet], getattr(model, name)[own + count : own + count + FEET], rtol=1e-5, atol=1e-6
            )
    xpos, _ = window.static_poses(jnp.asarray(scene), walls)
    data = mujoco.MjData(model)
    mujoco.mj_kinematics(model, data)
    np.testing.assert_allclose(
        xpos[inner.model.geom_bodyid == inner.layout.structure_body],
        data.geom_xpos[model.geom_bodyid == outer.layout.structure_body],
        atol=1e-5,
    )


def test_the_nearest_are_chosen_and_what_is_left_out_within_reach_is_told(world):
    two = PhysicsWindow(world, NavConfig.of(num_objects=2, active_furniture=2))
    kinds = {tuple(g.slots): i for i, g in enumerate(two.groups)}
    free = next(i for slots, i in kinds.items() if len(slots) == 4)
    group, select = two.groups[free], _select(two)

    def names(xy):
        chosen, _, missed = select(jnp.asarray(0), _state(world, 0, xy))
        return {world.slots.names[0][s] for s in group.slots[np.asarray(chosen[free])]}, int(missed)

    assert names((0.0, 0.0)) == ({"chair_0", "chair_1"}, 0)
    assert names((-2.0, 0.0))[0] >= {"table_1"}
    one = PhysicsWindow(world, NavConfig.of(num_objects=2, active_furniture=1))
    # Between the chairs both are within 0.18 + 0.6 m; only one is simulated.
    assert int(_select(one)(jnp.asarray(0), _state(world, 0, (1.05, 0.0)))[2]) == 1


def test_sizes_are_measured_where_none_are_set(world):
    auto = PhysicsWindow(world, NavConfig.of(num_objects=2, active_small=1))
    assert auto.widths == {"small": 1, "free": 2, "hinge": 1, "slide": 1, "walls": 2}, (
        "two chairs or the table; a corner"
    )
    kinds = [world.layout.slot_kind[group.slots[0]] for group in auto.groups]
    assert dict(zip(kinds, (g.width for g in auto.groups), strict=True)) == {"small": 1, "free": 2}
    assert auto.n_walls == 2 < PhysicsWindow(world, NavConfig.of(num_objects=2, **ALL)).n_walls


def test_a_moving_object_outranks_one_at_rest(world):
    one = PhysicsWindow(world, NavConfig.of(num_objects=2, active_furniture=1))
    state = _state(world, 0)
    slot = world.slots.names[0].index("chair_1")
    moving = state.replace(qvel=state.qvel.at[world.layout.slot_qvel[slot]].set(0.5))
    free = next(i for i, g in enumerate(one.groups) if slot in g.slots)
    select = _select(one)
    picked = [int(one.groups[free].slots[int(select(jnp.asarray(0), s)[0][free][0])]) for s in (state, moving)]
    assert [world.slots.names[0][p] for p in picked] == ["chair_0", "chair_1"]


def test_enter_and_leave_are_inverse(world):
    window = PhysicsWindow(world, NavConfig.of(num_objects=2, active_furniture=2))
    state = _state(world, 0)
    key = jax.random.PRNGKey(0)
    state = state.replace(qpos=state.qpos + 0.01 * jax.random.normal(key, state.qpos.shape))
    chosen, _, _ = _select(window)(jnp.asarray(0), state)
    inner, leave = jax.jit(window.enter)(state, chosen), jax.jit(window.leave)
    back = leave(state, inner, chosen)
    np.testing.assert_array_equal(back.qpos, state.qpos)
    moved = leave(state, inner.replace(qpos=inner.qpos + 1.0), chosen)
    changed = np.asarray(moved.qpos != state.qpos)
    left_out = [s for i, g in enumerate(window.groups) for s in np.delete(g.slots, np.asarray(chosen[i]))]
    assert len(left_out) == 2
    for slot in left_out:
        assert not changed[world.layout.slot_qpos[slot] : world.layout.slot_qpos[slot] + 7].any()


@pytest.fixture(scope="module")
def furnished(tmp_path_factory):
    """Without small objects: the time that MJX-JAX takes to compile grows with the pairs of what may meet."""
    room = write_room(tmp_path_factory.mktemp("furnished") / "full", (8.0, 5.0), FURNITURE)
    return build_world(get_robot("turtlebot"), (load_scene(room),), NavConfig.of(num_objects=0))


@pytest.mark.heavy
def test_a_push_in_a_window_is_that_of_the_whole_building(furnished):
    """The robot pushes one chair into the next for 1.5 s: C MuJoCo with everything, MJX-JAX with two of four."""
    world = furnished

    def run(backend, **settings):
        physics = make_physics(world, NavConfig.of(backend=backend, num_objects=0, sleep=False, **settings))
        state = jax.tree.map(lambda x: x[None], _state(world, 0))
        step = jax.jit(jax.vmap(physics.step))
        for _ in range(15):
            state, signals = step(jnp.zeros(1, jnp.int32), state, jnp.full((1, 2), 14.0))
        return np.asarray(state.qpos[0]), np.asarray(signals.slot_force_n[0])

    whole, force = run("native")
    window, window_force = run("jax", active_furniture=2)
    chair = world.layout.slot_qpos[world.slots.names[0].index("chair_0")]
    assert whole[chair] - world.rest_qpos[0][chair] > 0.05
    np.testing.assert_allclose(window[chair : chair + 3], whole[chair : chair + 3], atol=0.02)
    for name in ("table_0", "table_1"):
        slot = world.slots.names[0].index(name)
        at = world.layout.slot_qpos[slot]
        np.testing.assert_allclose(window[at : at + 7], np.float32(world.rest_qpos[0][at : at + 7]), atol=1e-4)
        assert window_force[slot] == 0.0 == force[slot]


@pytest.fixture(scope="module")
def narrow(tmp_path_factory):
    """A sofa of 1.6 m lies along a room 1.6 m wide, 0.05 m from its end; the robot stands behind it."""
    sofa = (("sofa", 1.65, 0.0, 3.0, 0.3),)
    folder = write_room(tmp_path_factory.mktemp("narrow") / "room", (5.0, 1.6), sofa, half_m=(0.8, 0.2, 0.2))
    return build_world(get_robot("turtlebot"), (load_scene(folder),), NavConfig.of(num_objects=0))


def test_a_pushed_sofa_does_not_enter_a_wall_in_a_window(narrow):
    """For 2 s, the window's own model in C MuJoCo against everything: the wall is 1.9 m away from the robot."""
    world, window = narrow, PhysicsWindow(narrow, NavConfig.of(num_objects=0, active_walls=1))
    physics = make_physics(world, NavConfig.of(num_objects=0, backend="native", sleep=False))
    model, data = window.model, mujoco.MjData(window.model)
    # C MuJoCo's trees of boxes are those of the model as compiled: without them geoms may be resized.
    model.opt.disableflags |= int(mujoco.mjtDisableBit.mjDSBL_MIDPHASE)
    model.bvh_aabb[:, 3:] = 10.0

    @jax.jit
    def enter(state):
        chosen, walls, _ = window.select(window.measure(jnp.asarray(0), state))
        return chosen, window.fields(jnp.asarray(0), chosen, walls), window.enter(state, chosen)

    step, command = jax.jit(physics.step), jnp.full(2, 14.0)
    first = whole = part = _state(world, 0, (0.6, 0.0))
    for _ in range(20):
        whole, _ = step(jnp.asarray(0), whole, command)
        chosen, fields, inner = enter(part)
        for name, value in fields.items():
            getattr(model, name)[:] = np.asarray(value).reshape(getattr(model, name).shape)
        data.qpos[:], data.qvel[:], data.qacc_warmstart[:] = inner.qpos, inner.qvel, inner.qacc_warmstart
        data.ctrl[:] = command
        mujoco.mj_step(model, data, nstep=5)
        qpos, qvel, warmstart = (jnp.asarray(x, jnp.float32) for x in (data.qpos, data.qvel, data.qacc_warmstart))
        part = window.leave(part, PhysicsState(qpos, qvel, warmstart), chosen)
    sofa = world.layout.slot_qpos[world.slots.names[0].index("sofa_0")]
    moved = [float(s.qpos[sofa] - first.qpos[sofa]) for s in (whole, part)]
    assert moved == pytest.approx([0.05, 0.05], abs=2e-3), "0.05 m to the wall"


def test_walls_left_out_behind_what_may_be_pushed_are_told(narrow):
    one, two = (PhysicsWindow(narrow, NavConfig.of(num_objects=0, active_walls=n)) for n in (1, 2))
    beside = _state(narrow, 0, (0.6, 0.4))  # 0.4 m from a side wall, 1.9 m from the wall behind the sofa
    far = _state(narrow, 0, (-0.5, 0.4))  # out of the sofa's reach
    selects = {1: _select(one), 2: _select(two)}
    left = {n: [int(select(0, s)[2]) for s in (beside, far)] for n, select in selects.items()}
    assert left == {1: [1, 0], 2: [0, 0]}


@pytest.mark.skipif(importlib.util.find_spec("warp") is None, reason="needs the package warp-lang")
def test_overflow_bits_are_the_engines():
    from mujoco.mjx.third_party.mujoco_warp._src.types import OverflowType as Bit

    dropped = Bit.NEFC | Bit.NJMAX_NNZ | Bit.BROADPHASE | Bit.NARROWPHASE | Bit.CCD | Bit.CONTACT_MATCH
    assert int(Bit.NVMAX) == mjx_batch._CROWDED
    assert int(dropped) == mjx_batch._DROPPED and int(Bit.ITERATIONS) == mjx_batch._UNCONVERGED
