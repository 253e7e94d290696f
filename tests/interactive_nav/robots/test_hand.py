"""Mode `hand`: inverse kinematics against C MuJoCo's Jacobian, where hand and base go, what hands observe and hold."""

import jax
import jax.numpy as jnp
import mujoco
import numpy as np
import pytest

import interactive_nav
from interactive_nav.robots import get_robot
from interactive_nav.robots.build import _ROWS, FOLDER, HAND_M_S, wheeled_robot
from interactive_nav.robots.files import read_file
from interactive_nav.robots.links import make_links
from interactive_nav.robots.spec import RobotState
from interactive_nav.sensing.description import describe
from interactive_nav.task.wrappers import AutoResetEnv
from interactive_nav.types import EpisodeStart
from interactive_nav_common.errors import ConfigError
from tests.interactive_nav.robots.test_wheeled import _alone, _simulate
from tests.interactive_nav.robots.test_wheeled_doors import READY
from tests.toys import write_room

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


POLE_M, POLE_HALF_M = (0.93, 0.0), (0.02, 0.02, 0.5)
"""Where the hand is in the pose `READY`, in the robot's frame, and a pole that fits between the fingers."""


@pytest.fixture(scope="module")
def make_env(tmp_path_factory):
    folder = write_room(
        tmp_path_factory.mktemp("hand") / "room", (6, 4), (("chair", *POLE_M, 2, 0.5),), half_m=POLE_HALF_M
    )

    def make(robot="fetch", mode="hand", backend="native", **settings):
        settings = {"observations": ("goal", "hand"), "num_objects": 0, "control_mode": mode, **settings}
        return interactive_nav.make(robot, [folder], backend=backend, **settings)

    return make


def _start(env, x_m=0.0, y_m=0.0, yaw_rad=0.0, **joints):
    """Return the first state from a pose, with joints of the robot's at given positions."""
    none = jnp.zeros((0, 2)), jnp.zeros(0), jnp.zeros(0, bool)
    f32 = [jnp.asarray(value, jnp.float32) for value in ([x_m, y_m], yaw_rad, [-2.5, 1.5])]
    episode = EpisodeStart(jnp.int32(0), f32[0], f32[1], f32[2], *none)
    state = jax.jit(env.reset_to)(episode, jax.random.PRNGKey(0))
    at = [int(env.world.models[0].joint(f"{env.robot.name}_{name}").qposadr[0]) for name in joints]
    qpos = state.pipeline_state.qpos.at[jnp.array(at, int)].set(jnp.array([*joints.values()], jnp.float32))
    return jax.jit(env.observe)(state.replace(pipeline_state=state.pipeline_state.replace(qpos=qpos)))


def _kinematics(env, state):
    data = mujoco.MjData(env.world.models[0])
    data.qpos[:] = np.asarray(state.pipeline_state.qpos)
    mujoco.mj_kinematics(env.world.models[0], data)
    return data


@pytest.mark.parametrize("backend", ("native", "jax"))
@pytest.mark.parametrize(("robot", "mode", "site", "joints"), [
    ("fetch", "hand", "fetch_grip", {**READY, "finger_left": 0.02, "finger_right": 0.03}),
    ("fetch", "whole_body", "fetch_grip", {"finger_left": 0.05}),
    ("jackrabbot2", "hand", "jackrabbot2_hand", {"arm_2": 4.0}),
])  # fmt: skip
def test_a_hand_observes_itself_and_what_is_nearest(make_env, robot, mode, site, joints, backend):
    env, yaw = make_env(robot, mode, backend), 0.4
    state = _start(env, -0.6, 0.3, yaw, **joints)
    data = _kinematics(env, state)
    into_robot = np.array([[np.cos(yaw), np.sin(yaw), 0], [-np.sin(yaw), np.cos(yaw), 0], [0, 0, 1]])
    grip, base, pole = data.site(site).xpos, data.body(env.robot.base_body).xpos, np.array([*POLE_M, POLE_HALF_M[2]])
    assert 0.05 < grip[2] < 1.0  # at the pole's height
    aside = np.maximum(np.abs(grip - pole)[:2] - POLE_HALF_M[:2], 0.0)
    opening_m = joints.get("finger_left", 0.0) + joints.get("finger_right", 0.0)
    near = np.hypot(*aside), 0, 2 / 11  # not touched; a chair
    want = [*into_robot @ (grip - base), opening_m, *near, *into_robot @ (pole - grip)]
    assert env.observation_size == 13
    np.testing.assert_allclose(state.obs[3:], want, atol=2e-4)  # the pole has sunk 0.1 mm into the floor


def test_above_everything_a_hand_is_near_nothing(make_env):
    state = _start(make_env(), torso=0.38, shoulder_lift=-1.2, shoulder_pan=0.0, elbow_flex=0.0, wrist_flex=0.0)
    assert float(state.obs[5]) > 1.2 and state.obs[7:].tolist() == [5, 0, 0, 0, 0, 0]


@pytest.mark.parametrize("mode", ("hand", "whole_body"))
def test_fingers_hold_a_pole_and_drag_it_along(make_env, mode):
    env = make_env(mode=mode)
    state, step = _start(env, **READY, finger_left=0.05, finger_right=0.05), jax.jit(env.step)
    assert state.obs[6:9].tolist() == pytest.approx([0.1, 0, 0], abs=1e-6)  # open around it, and not yet touching

    def run(steps, wheels, fingers_m):
        nonlocal state
        command = np.zeros(env.action_size)
        command[0], command[1], command[-1] = *wheels, fingers_m
        for _ in range(steps):
            state = step(state, jnp.asarray(env.robot.action(command), jnp.float32))
        return np.asarray(state.obs[6:]), float(state.info["nav"].object_pos_w[0, 0])

    (opening_m, gap_m, touched, *_), before_m = run(10, (0, 0), 0.0)
    assert opening_m == pytest.approx(2 * POLE_HALF_M[0], abs=0.006) and (gap_m, touched) == (0, 1)
    back = (-0.1, 0) if mode == "hand" else (-0.1 / 0.0613,) * 2
    (opening_m, gap_m, touched, *_), after_m = run(20, back, 0.0)
    assert after_m < before_m - 0.1 and opening_m > 0.03 and (gap_m, touched) == (0, 1)
    (opening_m, gap_m, touched, *_), _ = run(30, 3 * np.array(back), 0.05)  # away from what they have let go
    assert opening_m == pytest.approx(0.1, abs=0.01) and gap_m > 0.05 and touched == 0


def test_a_camera_at_the_hand_moves_with_it(make_env):
    views = [{"name": "head"}, {"name": "hand", "body": "fetch_gripper", "pos_m": [0.05, 0, 0], "pitch_deg": 0}]
    env = make_env(observations=("depth",), cameras=views, image_size=32)
    state, step, (_, camera) = _start(env, -1.0, **READY), jax.jit(env.step), env.sensors.cameras
    first = {name: np.asarray(image) for name, image in state.obs.items()}
    data = _kinematics(env, state)
    pose, frame = camera.mount.pose(state.pipeline_state.qpos), data.body("fetch_gripper").xmat.reshape(3, 3)
    np.testing.assert_allclose(pose.pos_w, data.body("fetch_gripper").xpos + frame @ [0.05, 0, 0], atol=1e-5)
    np.testing.assert_allclose(np.asarray(pose.axes_w)[:, 0], frame[:, 0], atol=1e-5)
    for _ in range(10):  # to its left, before a pole that hides the wall
        state = step(state, jnp.asarray(env.robot.action(np.array([0, 0, 0, 0.2, 0, 0])), jnp.float32))
    assert np.abs(np.asarray(state.info["nav"].robot_pos_w)[:2] - [-1, 0]).max() < 0.03
    changes = {name: np.abs(np.asarray(image) - first[name]).mean() for name, image in state.obs.items()}
    assert changes["pixels/hand/depth"] > 0.03 > 3 * changes["pixels/head/depth"]
    assert [camera["body"] for camera in describe(env)["cameras"]] == ["fetch_head_tilt", "fetch_gripper"]


def test_robots_without_a_hand_do_not_observe_one(make_env):
    with pytest.raises(ConfigError, match="observations has 'hand', expected .* robot 'freight' has none"):
        make_env("freight", "twist")


@pytest.mark.parametrize("mode", ("hand", "whole_body"))
def test_random_arms_stay_finite_and_commands_that_are_none_act_as_0(make_env, mode):
    env, rng = make_env(mode=mode), np.random.default_rng(0)
    batch, n = AutoResetEnv(env), 8
    state, step = jax.jit(batch.reset)(jax.random.split(jax.random.PRNGKey(0), n)), jax.jit(batch.step)
    broken = lost = 0
    for _ in range(40):
        action = rng.uniform(-1.5, 1.5, (n, env.action_size)).astype(np.float32)
        action[rng.random(action.shape) < 0.1] = rng.choice([np.nan, np.inf, -np.inf])
        before, state = state, step(state, jnp.asarray(action))
        assert np.isfinite(state.obs).all() and np.isfinite(state.pipeline_state.qpos).all()
        broken += float(state.metrics["nonfinite"].sum())
        lost += float((state.info["truncation"] - state.info["time_out"]).sum())
    assert (broken, lost) == (0, 0)
    zeros = step(before, jnp.asarray(np.where(np.isfinite(action), action, 0.0)))
    # Twice the same step differs by 1e-6 here, too.
    np.testing.assert_allclose(zeros.pipeline_state.qpos, state.pipeline_state.qpos, atol=1e-4)


def test_an_arms_joint_without_limits_turns_on_and_a_finger_needs_them():
    """Fetch's elbow turns freely, as three of JackRabbot 2's joints do."""
    (row,) = (row for row in _ROWS if row.base.name == "fetch")

    def build(joint):
        child = read_file(FOLDER / "fetch.xml", "base")
        child.joint(joint).limited, child.joint(joint).range = mujoco.mjtLimited.mjLIMITED_FALSE, [0, 0]
        return wheeled_robot("hand", parsed=child, **vars(row))

    robot = build("elbow_flex")
    model, data = _alone(robot)
    assert not model.jnt_limited[model.joint("fetch_elbow_flex").id]
    before = _in_base(robot, model, data)
    _simulate(robot, model, data, robot.action(np.array([0, 0, 0.2, 0, 0, 0])), 1.0)
    moved = _in_base(robot, model, data) - before
    assert np.isfinite(data.qpos).all() and moved[0] == pytest.approx(0.2, abs=0.05)
    with pytest.raises(ConfigError, match="finger joint 'finger_left' has no range, expected one; give limits"):
        build("finger_left")
