"""Mode `hand`: inverse kinematics against C MuJoCo's Jacobian, and where hand and base go in simulation."""

import jax.numpy as jnp
import mujoco
import numpy as np
import pytest

import interactive_nav
from interactive_nav.robots import get_robot
from interactive_nav.robots.build import HAND_M_S
from interactive_nav.robots.links import make_links
from interactive_nav.robots.spec import RobotState
from interactive_nav_common.errors import ConfigError
from tests.interactive_nav.robots.test_wheeled import _alone, _simulate

HANDS = {"fetch": "fetch_gripper", "jackrabbot2": "jackrabbot2_hand"}


def _in_base(robot, model, data):
    """The hand's place in the base's frame."""
    base, hand = model.body(robot.base_body).id, model.body(HANDS[robot.name]).id
    return data.xmat[base].reshape(3, 3).T @ (data.xpos[hand] - data.xpos[base])


def _arm(robot, model):
    """Ids of the joints that carry the hand, but for the base's free joint."""
    body, joints = model.body(HANDS[robot.name]).id, []
    while model.body_parentid[body]:
        joints = [*range(model.body_jntadr[body], model.body_jntadr[body] + model.body_jntnum[body]), *joints]
        body = model.body_parentid[body]
    return [j for j in joints if model.jnt_type[j] != mujoco.mjtJoint.mjJNT_FREE]


@pytest.mark.parametrize("name", HANDS)
def test_the_jacobian_is_c_mujocos(name):
    robot, rng = get_robot(name, "hand"), np.random.default_rng(0)
    model, data = _alone(robot)
    base, hand, arm = model.body(robot.base_body).id, model.body(HANDS[name]).id, _arm(robot, model)
    bodies = [b for b in range(1, model.nbody) if model.body_rootid[b] == base]
    links, states, expected = make_links(model, bodies), [], []
    for _ in range(5):
        data.qpos[:3], turn = rng.uniform(-1, 1, 3), rng.normal(size=4)
        data.qpos[3:7] = turn / np.linalg.norm(turn)
        data.qpos[7:] = rng.uniform(-1, 1, model.nq - 7)
        mujoco.mj_forward(model, data)
        jacobian = np.zeros((3, model.nv))
        mujoco.mj_jacBody(model, data, jacobian, None, hand)
        expected.append(data.xmat[base].reshape(3, 3).T @ jacobian[:, model.jnt_dofadr[arm]])
        states.append(data.qpos.copy())
    at = model.jnt_qposadr[arm].tolist()
    ours = links.jacobian(np.array(states), bodies.index(hand), at)
    np.testing.assert_allclose(ours, expected, atol=1e-9)
    jitted = links.jacobian(jnp.asarray(np.array(states), jnp.float32), bodies.index(hand), at)
    np.testing.assert_allclose(jitted, expected, atol=1e-5)


@pytest.mark.parametrize("axis", range(3))
def test_fetchs_hand_goes_where_it_is_sent_and_the_base_stands(axis):
    robot = get_robot("fetch", "hand")
    assert robot.action_names == ("forward m/s", "turn rad/s", "hand forward m/s", "hand left m/s", "hand up m/s",
                                  "finger opening m")  # fmt: skip
    model, data = _alone(robot)
    command = np.zeros(6)
    if axis != 0:  # folded in, the arm goes ahead first
        command[2] = 0.2
        _simulate(robot, model, data, robot.action(command), 1.0)
        command[2] = 0.0
    before = _in_base(robot, model, data)
    command[2 + axis], command[-1] = 0.2, 0.04
    _simulate(robot, model, data, robot.action(command), 1.0)
    moved = _in_base(robot, model, data) - before
    assert moved[axis] == pytest.approx(0.2, abs=0.05)  # damping: a little behind
    assert np.abs(np.delete(moved, axis)).max() < 0.035 and np.abs(data.qpos[:2]).max() < 0.02
    assert data.qpos[model.joint("fetch_finger_left").qposadr[0]] == pytest.approx(0.04, abs=0.003)


def test_a_stretched_arm_gets_finite_speeds_below_its_largest():
    robot = get_robot("fetch", "hand")
    model, data = _alone(robot)
    data.qpos[7:] = 0.0
    state = RobotState(data.qpos, data.qvel, 0.0)
    ahead = robot.controls(np.array([0, 0, HAND_M_S, 0, 0, 0]), state)
    assert np.isfinite(ahead).all() and np.abs(ahead).max() < 0.05  # no joint moves a straight arm's hand ahead
    aside = robot.controls(np.array([0, 0, 0, 10.0, 0, 0]), state)
    fastest = {"torso": 0.1, "shoulder_pan": 1.256, "shoulder_lift": 1.454, "elbow_flex": 1.521, "wrist_flex": 2.268}
    shares = [abs(v) / fastest[n.removeprefix("fetch_")] for n, v in zip(robot.actuators, aside, strict=True)
              if n.removeprefix("fetch_") in fastest]  # fmt: skip
    assert max(shares) == pytest.approx(1.0) and min(shares) >= 0.0


def test_the_environment_drives_a_hand_and_refuses_it_without_an_arm(room):
    env = interactive_nav.make("fetch", [room], backend="native", num_objects=0, control_mode="hand")
    assert env.action_size == 6 and env.robot.twist is not None
    with pytest.raises(ConfigError, match="robot 'freight' has no control mode 'hand'"):
        get_robot("freight", "hand")
