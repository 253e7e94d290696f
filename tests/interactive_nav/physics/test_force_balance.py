"""The force measure against Newton's second law: the robot's push, the floor's friction, the block's momentum.

Fifteen pushes (mass, friction, speed). The floor's force on the block is read like the robot's, from the engine's
contacts; gravity and the block's momentum are known. So a force that is lost, counted twice or sampled at the wrong
time shows, whatever the floor's friction happens to be.
"""

import copy
import dataclasses
import importlib.util
from collections.abc import Sequence

import jax
import jax.numpy as jnp
import mujoco
import numpy as np
import pytest

from interactive_nav.config import NavConfig
from interactive_nav.physics import PhysicsState, base, make_physics, mjx_batch
from interactive_nav.physics import native as native_backend
from interactive_nav.robots import get_robot
from interactive_nav.scenes import world as spec_module
from interactive_nav.scenes.scene import load_scene
from interactive_nav.scenes.world import build_world
from interactive_nav_common.config import replace
from tests.toys import write_room

HAS_WARP = importlib.util.find_spec("warp") is not None
BLOCKS = ((1.0, 0.2), (2.0, 0.2), (5.0, 0.2), (1.0, 0.5), (1.0, 0.8))
"""(kg, friction) that the TurtleBot (2.7 kg) can push at every speed."""
WHEELS_RAD_S = (4.0, 8.0, 12.0)
CASES = [(kg, mu, wheel) for kg, mu in BLOCKS for wheel in WHEELS_RAD_S]
SCENE = np.repeat(np.arange(len(BLOCKS)), len(WHEELS_RAD_S))
KG, FRICTION, WHEEL = np.array(CASES).T
STEPS, FROM = 40, 15
"""Control steps, and the first of those with a mean speed that is constant."""
G = 9.81
PERIOD_S = 0.1


@dataclasses.dataclass(frozen=True)
class Push:
    """Control steps FROM to STEPS of N cases, heading along x."""

    kg: np.ndarray
    friction: np.ndarray
    robot_n: np.ndarray
    """[T, N, substeps, 3] of the robot on the block, world frame."""
    floor_n: np.ndarray
    """[T, N, substeps, 3] of the floor on it."""
    velocity_m_s: np.ndarray
    """[T + 1, N, 3] of the block's centre of mass, around those steps."""
    score_n: np.ndarray
    """[T, N] F_t."""

    def horizontal_n(self, force_n: np.ndarray) -> np.ndarray:
        """[N] norm of the horizontal part of the mean force."""
        return np.hypot(*force_n.mean((0, 2))[:, :2].T)

    @property
    def coulomb_n(self) -> np.ndarray:
        """[N] friction times what the floor carries by the measured push: weight, and what the face presses down."""
        return self.friction * (self.kg * G - self.robot_n.mean((0, 2))[:, 2])


def make_world(folder, **settings):
    scenes = []
    for i, (kg, mu) in enumerate(BLOCKS):
        write_room(folder / str(i), (8.0, 3.0), (("basket", 0.55, 0.0, kg, mu),))
        scenes.append(load_scene(folder / str(i)))
    config = NavConfig.of(num_objects=0, sleep=False, **settings)
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(spec_module, "_finish", _with_floor_sensors)
        return build_world(get_robot("turtlebot"), tuple(scenes), config), config


_finish = spec_module._finish


def _with_floor_sensors(spec, robot, walls, count, slots, config):
    """The environment's sensors, and after them the same of the floor on each body."""
    _finish(spec, robot, walls, count, slots, config)
    for i, (name, _) in enumerate([*slots, ("structure", "")]):
        spec.add_sensor(
            name=f"floor_{i}",
            type=mujoco.mjtSensor.mjSENS_CONTACT,
            objtype=mujoco.mjtObj.mjOBJ_GEOM,
            objname="floor",
            reftype=mujoco.mjtObj.mjOBJ_XBODY,  # with its feet, which are a body of their own on native
            refname=name,
            intprm=[1 << int(mujoco.mjtConDataField.mjCONDATA_FORCE), 3, 1],
        )


def _read_both(physics, world):
    """Makes the physics hand the floor's forces on, too: after the robot's on each slot and the structure."""
    if physics.name == "jax":
        view, slot = copy.copy(physics), physics._slot_of_geom
        view._slot_of_geom = np.where(slot == -1, mjx_batch._ROBOT, np.where(slot == mjx_batch._ROBOT, -1, slot))
        robots = physics._forces_from_contacts
        physics._forces_from_contacts = lambda data: (
            jnp.concatenate([robots(data)[0], view._forces_from_contacts(data)[0]]),
            None,
        )
    else:
        model = world.models[0] if physics.name == "native" else physics.mj_model
        floors = np.array([model.sensor(f"floor_{i}").adr[0] for i in range(len(physics._sensors))])
        physics._sensors = np.concatenate([physics._sensors, floors[:, None] + np.arange(3)])
    if physics.name != "native":
        spread = physics.window.spread_forces
        physics.window.spread_forces = lambda forces, chosen: jnp.concatenate(
            [spread(part, chosen) for part in jnp.split(forces, 2, -2)], -2
        )


def run(world, config, backend, cases: Sequence[int] = range(len(CASES))) -> Push:
    seen = []
    real = base.summarise_forces

    def watched(force_w, xp=jnp, contacts=None, options=base.PAPER_FORCE):
        if xp is np:
            seen.append(force_w)
        else:
            jax.debug.callback(lambda f: seen.append(np.asarray(f)), force_w)
        return real(xp.split(force_w, 2, -2)[0], xp, contacts, options)

    cases = list(cases)
    scene, wheel = SCENE[cases], WHEEL[cases]
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(native_backend, "summarise_forces", watched)
        patch.setattr(mjx_batch, "summarise_forces", watched)
        patch.setattr(spec_module, "_finish", _with_floor_sensors)
        physics = make_physics(world, replace(config, backend=backend))
        _read_both(physics, world)
        step = jax.jit(jax.vmap(physics.step))
        qpos = world.rest_qpos[scene].copy()
        qpos[:, :7] = [0.17, 0, 0, 1, 0, 0, 0]  # 2 cm from the block
        still = jnp.zeros((len(scene), world.models[0].nv), jnp.float32)
        state = PhysicsState(jnp.asarray(qpos, jnp.float32), still, still)
        command = jnp.asarray(np.repeat(wheel[:, None], 2, 1), jnp.float32)
        at = world.layout.slot_qvel[0]
        speeds, scores = [np.zeros((len(scene), 3))], []
        for _ in range(STEPS):
            state, signals = step(jnp.asarray(scene), state, command)
            jax.block_until_ready(state)
            jax.effects_barrier()
            speeds.append(np.asarray(state.qvel)[:, at : at + 3])
            scores.append(np.asarray(signals.force_n))
    assert len(seen) == STEPS
    force_w = np.stack(seen)[FROM:]  # [T, N, substeps, robot on (block, structure) and floor on (block, structure), 3]
    assert force_w.shape[2:] == (config.substeps, 4, 3) and (force_w[..., 1::2, :] == 0).all()
    return Push(
        KG[cases],
        FRICTION[cases],
        force_w[..., 0, :],
        force_w[..., 2, :],
        np.stack(speeds)[FROM:],
        np.stack(scores)[FROM:],
    )


def assert_balanced(push: Push):
    # Newton's second law in every control step, all three components, to 0.1 % of the floor's friction.
    weight = np.zeros_like(push.robot_n)
    weight[..., 2] = -(push.kg * G)[:, None]
    gained = push.kg[:, None] * np.diff(push.velocity_m_s, axis=0)
    given = (push.robot_n + push.floor_n + weight).mean(2) * PERIOD_S
    scale = push.friction * push.kg * G * PERIOD_S
    assert (np.abs(given - gained).max((0, 2)) < 1e-3 * scale).all()
    # At constant speed the push is the floor's friction.
    assert (push.velocity_m_s.mean(0)[:, 0] > 0.05).all()
    np.testing.assert_allclose(push.horizontal_n(push.robot_n), push.horizontal_n(push.floor_n), rtol=0.05)
    # The floor's friction never exceeds Coulomb's, in no substep.
    along = np.hypot(push.floor_n[..., 0], push.floor_n[..., 1])
    assert (along <= push.friction[:, None] * push.floor_n[..., 2] * (1 + 1e-4) + 1e-4).all()
    # The score sees the mean over substeps of the force's norm.
    np.testing.assert_allclose(push.score_n, np.linalg.norm(push.robot_n, axis=-1).mean(-1), rtol=1e-4, atol=1e-4)


def test_fifteen_pushes_balance_on_native(tmp_path):
    push = run(*make_world(tmp_path), "native")
    assert_balanced(push)
    # Fast pushes slide: the floor gives mu N. Slow ones rattle, and it gives less (the next test says why).
    share = push.horizontal_n(push.robot_n) / push.coulomb_n
    assert (np.abs(share[WHEEL > 4.0][FRICTION[WHEEL > 4.0] < 0.8] - 1.0) < 0.05).all()
    assert (share < 1.05).all() and 0.85 < share.min() < 0.95
    # A force read in the last substep only, or lost in one of them, would be seen.
    lost = push.robot_n.copy()
    lost[:, :, 0] = 0.0
    for wrong in (np.repeat(push.robot_n[:, :, -1:], lost.shape[2], 2), lost):
        with pytest.raises(AssertionError):
            assert_balanced(dataclasses.replace(push, robot_n=wrong))


def test_small_steps_and_round_cones_give_coulombs_friction(tmp_path):
    """What lies below mu N at 0.02 s is the block's rattling between robot and floor, which small steps resolve."""
    push = run(*make_world(tmp_path, sim_dt_s=0.002, cone="elliptic", solver_iterations=100), "native")
    assert_balanced(push)
    np.testing.assert_allclose(push.horizontal_n(push.robot_n), push.coulomb_n, rtol=0.05)


FEW = [1, 6, 10]


@pytest.mark.heavy
def test_pushes_balance_on_jax(tmp_path):
    assert_balanced(run(*make_world(tmp_path), "jax", FEW))


@pytest.mark.slow
@pytest.mark.skipif(not HAS_WARP, reason="the package warp-lang (extra 'warp') is not installed")
def test_pushes_balance_on_warp(tmp_path):
    assert_balanced(run(*make_world(tmp_path), "warp", FEW))
