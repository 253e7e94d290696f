"""Robots from files of other packages drive, and the follower reaches a goal; skipped where the files are missing."""

import importlib.util
import warnings

import jax
import mujoco
import numpy as np
import pytest

import interactive_nav
from docs.studies.robots import bodies
from docs.studies.robots.pictures import stage
from interactive_nav import robots
from interactive_nav_common.errors import MissingPackage
from tests.toys import write_room
from train.scoring.policies import make_follower


def _needs(package):
    return pytest.mark.skipif(importlib.util.find_spec(package) is None, reason=f"needs {package}")


def _quietly(make, *arguments):
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        return make(*arguments)


@pytest.mark.parametrize(
    ("make", "mass_kg", "width_m"),
    [
        # The sums of the masses in the files, and of Spot's wheels and feet.
        pytest.param(bodies.stretch, 24.3254, 0.3708, marks=_needs("stretch_urdf")),
        pytest.param(bodies.tiago, 75.9667, 0.5, marks=_needs("robosuite")),
        pytest.param(bodies.spot, 52.7406, 0.4653, marks=_needs("robosuite")),
    ],
)
def test_it_drives_and_the_follower_reaches_its_goal(tmp_path, make, mass_kg, width_m):
    factory = _quietly(make)
    robot = factory("native")
    assert robot.mass_kg == pytest.approx(mass_kg, abs=1e-3) and robot.body_width_m >= width_m - 1e-3
    model, data = stage(robot)
    data.ctrl[:2] = 4.0
    for _ in range(int(2.0 / model.opt.timestep)):
        mujoco.mj_step(model, data)
    speed_m_s = 4.0 / robot.twist.matrix[0][0]
    assert data.qpos[0] == pytest.approx(2.0 * speed_m_s, rel=0.06)  # less what it loses as it starts
    assert abs(data.qpos[1]) < 0.03 and data.body(robot.base_body).xmat[8] > 0.999
    room = write_room(tmp_path / "room", (4.0, 4.0), ())
    env = interactive_nav.make(
        factory("twist"), [room], num_objects=0, backend="native", min_goal_distance_m=1.5, max_goal_distance_m=2.5
    )
    follow, step, state = jax.jit(make_follower(env)), jax.jit(env.step), jax.jit(env.reset)(jax.random.PRNGKey(0))
    for k in range(400):
        state = step(state, follow(state.obs, jax.random.PRNGKey(k)))
        if state.done:
            break
    assert state.metrics["success"] == 1.0


@pytest.mark.parametrize(
    ("name", "meshes"),
    [
        pytest.param("fetch", 15, marks=_needs("gymnasium_robotics")),
        pytest.param("husky", 9, marks=_needs("pybullet_data")),
    ],
)
def test_with_meshes_a_robot_moves_as_without(name, meshes):
    seen = []
    for robot in (robots.get_robot(name, "twist"), getattr(bodies, name)("twist")):
        model, data = stage(robot)
        data.ctrl[:2] = 5.0, 8.0
        for _ in range(200):
            mujoco.mj_step(model, data)
        seen.append(data.qpos.copy())
    np.testing.assert_array_equal(*seen)
    assert (model.geom_type == mujoco.mjtGeom.mjGEOM_MESH).sum() == meshes


def test_without_its_package_a_robot_names_the_remedy(monkeypatch):
    monkeypatch.setattr(importlib.util, "find_spec", lambda name: None)
    with pytest.raises(MissingPackage, match="pip install --no-deps hello-robot-stretch-urdf"):
        bodies.stretch()
