"""A batch sorted by need steps as with one window; nobody is lost, and who has too little room is counted."""

import importlib.util
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from interactive_nav.config import NavConfig, WindowTier, parse_window_tiers
from interactive_nav.physics import PhysicsState, make_physics, mjx_batch
from interactive_nav.physics.mjx_batch import TieredPhysics, assign, propose_tiers, tier_sizes
from interactive_nav.robots import get_robot
from interactive_nav.scenes.scene import load_scene
from interactive_nav.scenes.world import build_world
from interactive_nav_common.errors import ConfigError
from tests.toys import write_room

FURNITURE = (
    ("chair", 0.7, 0.0, 2.0, 0.4),
    ("chair", 1.4, 0.0, 2.0, 0.4),
    ("table", -3.0, 0.0, 9.0, 0.5),
)
ALL: dict[str, Any] = {"active_furniture": 0, "active_small": 0, "active_doors": 0, "active_walls": 0}
BETWEEN, BESIDE, ALONE = (1.05, 0.0), (0.0, 0.0), (-1.2, -0.5)
"""Two chairs in reach, one, and nothing."""
STARTS = (ALONE, BETWEEN, BESIDE, ALONE, BETWEEN, BESIDE, BETWEEN, ALONE)
# 100 control steps without contact; one with or without.
FREE_M, STEP_M_S = 1e-3, 2e-2


@pytest.mark.parametrize(
    ("count", "shares", "sizes"),
    [
        (16384, (0.7, 0.2), (11469, 3277, 1638)),
        (10, (0.5,), (5, 5)),
        (7, (0.33, 0.33), (2, 3, 2)),  # rounded ends: 2.31, 4.62
        (3, (0.6, 0.39), (2, 0, 1)),
        (1, (0.9,), (0, 1)),
    ],
)
def test_sizes_sum_to_the_batch_and_the_whole_window_has_a_place(count, shares, sizes):
    assert tier_sizes(count, shares) == sizes


def test_everybody_is_assigned_once_and_has_room_unless_too_many_need_it():
    rng = np.random.default_rng(0)
    for _ in range(60):
        kinds, count = int(rng.integers(2, 5)), int(rng.integers(1, 90))
        shares = rng.dirichlet(np.ones(kinds))[:-1]
        sizes = tier_sizes(count, shares)
        needed = rng.choice(kinds, size=count, p=rng.dirichlet(np.ones(kinds))).astype(np.int32)
        places = [np.asarray(p) for p in assign(jnp.asarray(needed), sizes)]
        assert tuple(len(p) for p in places) == sizes and sum(sizes) == count and sizes[-1] >= 1
        assert sorted(np.concatenate(places)) == list(range(count))
        given = np.empty(count, int)
        for tier, own in enumerate(places):
            given[own] = tier
        for tier in range(1, kinds):
            # Those that need at least this tier have its places and those above; what is over is left out.
            need, room = int((needed >= tier).sum()), sum(sizes[tier:])
            assert int(((needed >= tier) & (given >= tier)).sum()) == min(need, room)


def test_equal_needs_keep_their_order():
    first, last = assign(jnp.array([1, 0, 1, 0, 0]), (2, 3))
    assert (first.tolist(), last.tolist()) == ([1, 3], [4, 0, 2])


def test_tiers_hold_what_was_counted():
    """Half of the places need one chair, a third two and a wall more, the others three, a door and all walls."""
    counts = {
        "free": np.repeat([1, 2, 3], [50, 33, 17]),
        "small": np.zeros(100, int),
        "hinge": np.repeat([0, 0, 1], [50, 33, 17]),
        "walls": np.repeat([2, 3, 4], [50, 33, 17]),
    }
    # With twice as many in need as counted, 0.8 must fit the first tier of 0.6, and 0.5 one without share.
    assert propose_tiers(counts, (0.6,)) == (WindowTier(0.6, 2, 0, 0, 3),)
    assert propose_tiers(counts, (0.6, 0.3)) == (WindowTier(0.6, 2, 0, 0, 3), WindowTier(0.3, 3, 0, 1, 4))


@pytest.mark.parametrize(
    "words", [["0.7 2 1 1"], ["0.7 2 1 1 x"], ["0.6 2 1 1 9", "0.5 3 1 1 9"], ["0.6 2 1 1 9", "0.2 1 1 1 9"], "auto"]
)
def test_tiers_that_cannot_be_are_refused(words):
    with pytest.raises(ConfigError, match="expected (such as|a list)"):
        NavConfig.of(windows=words)
    assert parse_window_tiers(["0.7 2 1 1 12"]) == (WindowTier(0.7, 2, 1, 1, 12),)


@pytest.fixture(scope="module")
def world(tmp_path_factory):
    return world_in(tmp_path_factory.mktemp("tiers"))


def world_in(base):
    full = write_room(base / "full", (8.0, 5.0), FURNITURE)
    empty = write_room(base / "empty", (3.0, 3.0), (("basket", 0.7, 0.0, 1.0, 0.3),))
    return build_world(get_robot("turtlebot"), (load_scene(full), load_scene(empty)), NavConfig.of(num_objects=1))


@pytest.fixture(scope="module")
def engines(world):
    # Iterations until it has converged: see the comparison of steps.
    config = {"backend": "jax", "num_objects": 1, "solver_iterations": 100, **ALL}
    tiered = make_physics(world, NavConfig.of(windows=("0.75 1 0 0 2",), **config))
    assert isinstance(tiered, TieredPhysics)
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(mjx_batch, "LEAST_ENVS", 8)
        step, state, scene = jax.jit(jax.vmap(tiered.step)), *_start(world)
        step(scene, state, jnp.zeros((8, 2)))  # compiled while small batches are sorted
        yield tiered, step, jax.jit(make_physics(world, NavConfig.of(**config)).step_batch)


def _start(world):
    scene = jnp.zeros(8, jnp.int32).at[7].set(1)
    qpos = np.array(world.rest_qpos, np.float32)[np.asarray(scene)]
    qpos[:, :7] = [0, 0, 0, 1, 0, 0, 0]
    qpos[:, :2] = STARTS
    still = jnp.zeros((8, world.models[0].nv))
    return PhysicsState(jnp.asarray(qpos), still, still), scene


@pytest.mark.heavy
def test_those_without_room_are_counted(world, engines):
    """Sizes are 6 and 2: of three robots between two chairs the first has a window with one of them only."""
    tiered, step, one = engines
    state, scene = _start(world)
    assert [tier.window.room["free"] for tier in tiered.tiers] == [1, 3]
    assert [tier.window.model.nv for tier in tiered.tiers] == [tiered.nv - 6 * 3, tiered.nv], "a chair, no small one"
    new, signals = step(scene, state, jnp.zeros((8, 2)))
    assert signals.left_out.tolist() == [0, 1, 0, 0, 0, 0, 0, 0]
    assert one(scene, state, jnp.zeros((8, 2)), jnp.zeros(8))[1].left_out.tolist() == [0] * 8
    counts: dict[str, Any] = {
        "free": jnp.array([0, 1, 2, 1]),
        "small": jnp.array([0, 0, 0, 1]),
        "hinge": jnp.zeros(4, int),
        "slide": jnp.zeros(4, int),
    }
    assert tiered.needed({**counts, "walls": jnp.array([2, 2, 0, 0])}).tolist() == [0, 0, 1, 1]
    assert new.qpos.shape == state.qpos.shape


@pytest.mark.heavy
@pytest.mark.slow
@pytest.mark.skipif(importlib.util.find_spec("warp") is None, reason="needs the package warp-lang")
def test_warp_steps_two_windows_in_one_program(world, monkeypatch):
    """Each with buffers of its own, and in the order of the batch."""
    monkeypatch.setattr(mjx_batch, "LEAST_ENVS", 8)
    config = NavConfig.of(backend="warp", num_objects=1, windows=("0.75 1 0 0 2",), **ALL)
    tiered = make_physics(world, config)
    assert isinstance(tiered, TieredPhysics)
    narrow, whole = tiered.tiers
    assert 0 < narrow.constraints_per_env < whole.constraints_per_env
    state, scene = _start(world)
    command = jnp.asarray(np.linspace(2.0, 9.0, 16).reshape(8, 2), jnp.float32)
    new, signals = jax.jit(tiered.step_batch)(scene, state, command, jnp.zeros(8))
    same, _ = jax.jit(whole.step_batch)(scene, state, command, jnp.zeros(8))
    assert signals.left_out.tolist() == [0, 1, 0, 0, 0, 0, 0, 0] and signals.overflow.sum() == 0
    free = np.array([0, 2, 3, 5, 7])  # of both windows; the others stand against chairs
    np.testing.assert_allclose(new.qpos[free], same.qpos[free], atol=FREE_M)
    assert float(jnp.abs(same.qpos - state.qpos)[free, :2].max()) > 10 * FREE_M, "they drive"


@pytest.mark.heavy
def test_each_step_is_that_of_one_window(world, engines):
    """100 steps of random driving, each also from the same state in one window; and three undisturbed runs of both.

    The control is one window again, from speeds that differ by 1e-5: 3 of 728 steps part, and none of the tiers'. With
    10 iterations Newton's method has not converged where a chair is pushed, and what it stops at hangs on rounding.
    Then 6 steps part, and 7 of the control; with other widths or the slots in reverse one window parts from itself in
    13 and 3. C MuJoCo in double precision parts in 7 between 10 iterations and 100.
    """
    tiered, step, one = engines
    state, scene = _start(world)
    alone, rng, kinds = state, np.random.default_rng(1), np.zeros((2, 8), bool)
    needs = jax.jit(
        lambda s: tiered.needed(jax.vmap(lambda *x: tiered.window.needs(tiered.window.measure(*x)))(scene, s))
    )
    command, compared, worst, nudged, own = np.zeros((8, 2)), 0, [], [], np.random.default_rng(5)
    for k in range(100):
        if k % 10 == 0:
            command = jnp.asarray(rng.uniform(-6, 10, (8, 1)) + rng.uniform(-3, 3, (8, 2)), jnp.float32)
        same, _ = one(scene, state, command, jnp.zeros(8))
        alone, _ = one(scene, alone, command, jnp.zeros(8))
        nudge = 1e-5 * own.standard_normal(state.qvel.shape) * (state.qvel != 0)
        other, _ = one(scene, state.replace(qvel=state.qvel + jnp.asarray(nudge, jnp.float32)), command, jnp.zeros(8))
        kinds[np.asarray(needs(state)), np.arange(8)] = True
        state, tiered_signals = step(scene, state, command)
        had_room = np.asarray(tiered_signals.left_out) == 0
        compared += had_room.sum()
        worst.append(np.where(had_room, np.abs(np.asarray(state.qvel - same.qvel)).max(1), 0))
        nudged.append(np.where(had_room, np.abs(np.asarray(other.qvel - same.qvel)).max(1), 0))
    apart = np.abs(np.asarray(state.qpos - alone.qpos)).max(1)
    assert compared > 700 and kinds.all(0).any(), "somebody changes tiers"
    assert apart[[0, 3, 7]].max() < FREE_M
    # Bodies that rest outside of a window have no speed there: in one window they keep what the solver leaves, 0.01.
    parted, control = ((np.asarray(gaps) > STEP_M_S).sum() for gaps in (worst, nudged))
    assert parted <= control, (parted, control)
    assert parted < 0.005 * compared


@pytest.mark.heavy
def test_the_solvers_warm_start_crosses_tiers(world, engines):
    """What the whole window's solver leaves, the smaller one's begins with: of the robot and of the chair it holds."""
    narrow, whole = (tier.window for tier in engines[0].tiers)
    state = jax.tree.map(lambda x: x[2], _start(world)[0])
    state = state.replace(qacc_warmstart=1.0 + jnp.arange(world.models[0].nv, dtype=jnp.float32))
    measured = jax.jit(whole.measure)(0, state)
    chosen = whole.select(measured)[0]
    after = whole.leave(state, whole.enter(state, chosen), chosen)
    inner = narrow.enter(after, narrow.select(measured)[0]).qacc_warmstart
    layout, chair = world.layout, world.layout.slot_qvel[world.slots.names[0].index("chair_0")]
    robot = layout.robot_qvel + np.arange(layout.robot_nv)
    expected = 1.0 + np.concatenate([robot, chair + np.arange(6)])
    assert sorted(inner.tolist()) == sorted(expected.tolist())
