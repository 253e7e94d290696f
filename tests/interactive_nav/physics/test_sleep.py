"""What rests in the window sleeps on `warp`: pushes and chains of them are C MuJoCo's, and what is not met stays."""

import dataclasses
import importlib.util

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from interactive_nav.config import NavConfig
from interactive_nav.physics import PhysicsState, make_physics
from interactive_nav.physics.mjx_batch import measure_buffers
from interactive_nav.physics.nearness import Nearness
from interactive_nav.physics.window import AWAKE_M, PhysicsWindow
from interactive_nav.robots import get_robot
from interactive_nav.scenes.scene import load_scene
from interactive_nav.scenes.world import build_world
from tests.toys import write_room

HALF_M = 0.2
FURNITURE = (("chair", 0.6, 0.0, 2.0, 2 * HALF_M), ("chair", 1.1, 0.0, 2.0, 2 * HALF_M), ("table", -2.0, 1.5, 9.0, 0.5))
FIRST, SECOND, TABLE = range(3)
STEPS = 30
ALL = NavConfig.of(num_objects=0, active_furniture=0)


@pytest.fixture(scope="module")
def world(tmp_path_factory):
    folder = write_room(tmp_path_factory.mktemp("sleep") / "room", (8.0, 5.0), FURNITURE)
    return build_world(get_robot("turtlebot"), (load_scene(folder),), NavConfig.of(num_objects=0))


@pytest.fixture(scope="module")
def room(tmp_path_factory):
    folder = write_room(tmp_path_factory.mktemp("door") / "room", door=True)
    return build_world(get_robot("turtlebot"), (load_scene(folder),), NavConfig.of(num_objects=0))


def start(world, x_m: float) -> PhysicsState:
    qpos = np.array(world.rest_qpos[0], np.float32)
    qpos[world.layout.robot_qpos :][:7] = [x_m, 0, 0, 1, 0, 0, 0]
    still = jnp.zeros(world.models[0].nv, jnp.float32)
    return PhysicsState(jnp.asarray(qpos), still, still)


def test_what_moves_or_may_be_touched_is_awake(world):
    window, radius_m = PhysicsWindow(world, ALL), world.robot.footprint_radius_m
    touching, measure = 0.6 - HALF_M - radius_m, jax.jit(window.measure)
    for x_m, speed, awake in (
        (touching - AWAKE_M - 0.01, 0.0, []),
        (touching - AWAKE_M + 0.01, 0.0, [FIRST]),
        (-1.0, 0.1, [SECOND]),
        (-1.0, 0.01, []),
    ):
        state = start(world, x_m)
        state = state.replace(qvel=state.qvel.at[world.layout.slot_qvel[SECOND]].set(speed))
        measured = measure(jnp.int32(0), state)
        chosen, _, _ = window.select(measured)
        slots = np.concatenate([g.slots[np.asarray(i)] for g, i in zip(window.groups, chosen, strict=True)])
        assert slots[np.asarray(window.awake(measured, chosen))].tolist() == awake, x_m


@pytest.mark.parametrize(
    ("category", "speed", "acceleration", "moves"),
    [
        ("door", 0.01, 0.0, True),
        ("door", 0.001, 0.0, False),
        ("door", 0.0, 2.0, False),
        ("chair", 0.0, 2.0, True),
        ("chair", 0.01, 0.5, False),
    ],
)
def test_a_coasting_door_and_a_tipping_chair_are_not_at_rest(room, category, speed, acceleration, moves):
    """An 8 kg leaf with 0.5 N m s/rad coasts by I w / d = 1.7 x 0.05 / 0.5 = 0.17 rad from 0.05 rad/s. A chair on its
    edge stands still where it turns round, and falls back."""
    state, slot = start(room, -3.0), room.layout.slot_kind.index("hinge" if category == "door" else "free")
    at = room.layout.slot_qvel[slot]
    state = state.replace(qvel=state.qvel.at[at].set(speed), qacc_warmstart=state.qvel.at[at].set(acceleration))
    _, moving, _ = jax.jit(Nearness(room).measure)(jnp.int32(0), state, 0.6)
    assert np.flatnonzero(moving).tolist() == ([slot] if moves else [])


def test_room_is_measured_for_what_is_awake(world):
    """The robot has 8 and each piece 6; with two they fit two tiles of 16, of which one column is the solver's."""
    window = PhysicsWindow(world, ALL)
    assert window.layout.robot_nv == 8 and window.model.nv == 8 + 3 * 6
    assert window.awake_at_rest == 31, "two pieces at 49 of 4,000 places, one at 214"
    whole, some = measure_buffers(world, window, 8 + 3 * 6, 1.0), measure_buffers(world, window, 8 + 6, 1.0)
    # Furniture stands on four feet; the head room is 24 contacts and 96 rows.
    assert whole[0] - some[0] == 2 * 4 and some[0] >= 4 + 24 and whole[1] > some[1]


def driven(step, world, table_rad_s: float = 0.0) -> tuple[np.ndarray, list]:
    """Return [STEPS, 4, 2] m of the robot and the three pieces, pushed ahead for three seconds, and the signals.

    The table is turned again before each step."""
    state, out, all_signals = start(world, 0.0), [], []
    turn = world.layout.slot_qvel[TABLE] + 5
    places = np.concatenate([[world.layout.robot_qpos], world.layout.slot_qpos[:3]])[:, None] + np.arange(2)
    for k in range(STEPS):
        state = state.replace(qvel=state.qvel.at[turn].set(table_rad_s))
        state, signals = step(jnp.int32(0), state, jnp.full(2, 0.35 / 0.036, jnp.float32), 0.1 * k)
        out.append(np.asarray(state.qpos)[places])
        all_signals.append(jax.tree.map(np.asarray, signals))
    return np.stack(out), all_signals


@pytest.mark.heavy
@pytest.mark.skipif(importlib.util.find_spec("warp") is None, reason="needs the package warp-lang")
def test_a_chain_of_pushes_is_c_mujocos(world):
    configs = [dataclasses.replace(ALL, backend="native"), dataclasses.replace(ALL, backend="warp", active_dofs=20)]
    on_c, on_warp = (jax.jit(make_physics(world, config).step) for config in configs)
    c, _ = driven(on_c, world)
    warp, signals = driven(on_warp, world)
    moved = np.linalg.norm(c[-1] - c[0], axis=-1)
    assert moved[1 + FIRST] > 0.3 and moved[1 + SECOND] > 0.2, "the first chair pushes the second"
    np.testing.assert_allclose(np.linalg.norm(warp[-1] - warp[0], axis=-1), moved, rtol=0.1, atol=1e-3)
    assert (warp[:, 1 + TABLE] == warp[0, 1 + TABLE]).all(), "nothing meets the table"
    assert sum(int(s.crowded) for s in signals) == 0, "the robot and two chairs are 20 degrees of freedom"
    _, signals = driven(on_warp, world, table_rad_s=0.5)
    assert sum(int(s.crowded) for s in signals) > 5, "the table turns as well, and there is room for two"
