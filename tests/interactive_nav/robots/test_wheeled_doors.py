"""Hinged doors: pushed open by driving into them, pulled open by Fetch's gripper; scripted, on C MuJoCo."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from docs.studies.robots.hall import hall
from interactive_nav.config import NavConfig
from interactive_nav.physics import PhysicsState, make_physics
from interactive_nav.robots import get_robot
from interactive_nav.scenes.scene import Joint, Movable
from interactive_nav.scenes.world import build_world

LEAF_M, THICK_M, TALL_M, MASS_KG = 0.8, 0.04, 1.2, 8.0
BAR_Y_M, BAR_OUT_M, BAR_HALF_M = 0.7, 0.08, 0.0125


def _door(x, y, handle_z=None):
    """A closed door across the x axis at x, hinged at y, its free edge at y - 0.8; a bar handle towards -x."""
    boxes = [[0, -LEAF_M / 2, TALL_M / 2 + 0.01, 1, 0, 0, 0, THICK_M / 2, LEAF_M / 2, TALL_M / 2]]
    if handle_z is not None:
        # A bar 0.08 m before the leaf with a standoff at each end, as on a glass door.
        out = -THICK_M / 2 - BAR_OUT_M
        boxes.append([out, -BAR_Y_M, handle_z, 1, 0, 0, 0, BAR_HALF_M, BAR_HALF_M, 0.12])
        for end in (-0.11, 0.11):
            boxes.append([out / 2 - 0.01, -BAR_Y_M, handle_z + end, 1, 0, 0, 0, BAR_OUT_M / 2, 0.01, 0.01])
    joint = Joint(np.array([0.0, 0, 1]), np.zeros(3), (-2.0, 2.0), damping=0.5, frictionloss=0.5)
    across = MASS_KG / 12 * LEAF_M**2
    return Movable(
        name="door_0",
        category="door",
        mass_kg=MASS_KG,
        inertia=np.array([across + MASS_KG / 12 * TALL_M**2, MASS_KG / 12 * TALL_M**2, across]),
        com_m=np.array([0.0, -LEAF_M / 2, TALL_M / 2]),
        inertia_quat=np.array([1.0, 0, 0, 0]),
        pos_w=np.array([x, y, 0.0]),
        quat_w=np.array([1.0, 0, 0, 0]),
        friction=0.6,
        boxes=np.array(boxes, float),
        hulls=(),
        joint=joint,
    )


class _Stage:
    """One robot before one door, stepped like the environment does."""

    def __init__(self, robot, door):
        config = NavConfig.of(backend="native", num_objects=0, sleep=False, threads=1)
        self.robot, self.world = robot, build_world(robot, (hall((door,)),), config)
        self._step = jax.jit(make_physics(self.world, config).step)
        qpos = self.world.rest_qpos[0].copy()
        qpos[:7] = [0, 0, robot.spawn_height_m, 1, 0, 0, 0]
        still = jnp.zeros(self.world.models[0].nv, jnp.float32)
        self.state, self.time_s = PhysicsState(jnp.asarray(qpos, jnp.float32), still, still), 0.0
        self.touched_n = 0.0

    def step(self, command):
        self.state, signals = self._step(0, self.state, jnp.asarray(command, jnp.float32), self.time_s)
        self.time_s += 0.1
        self.touched_n = float(signals.slot_force_n[0])

    def qpos(self, joint):
        return float(self.state.qpos[self.world.models[0].joint(joint).qposadr[0]])

    @property
    def door_rad(self):
        return float(self.state.qpos[self.world.layout.slot_qpos[0]])


@pytest.mark.parametrize("name", ("turtlebot", "fetch"))
def test_driving_into_a_door_pushes_it_open(name):
    robot = get_robot(name, "twist")
    # 0.2 m from the hinge's side to the robot's middle line: it meets the leaf 0.5 m from the hinge.
    stage = _Stage(robot, _door(0.6, 0.5))
    command = robot.command(robot.drive(np.float64(0.4), np.float64(0.0)))
    for _ in range(30):
        stage.step(command)
    assert stage.door_rad > 1.0  # opens away from the robot: 57 degrees and more
    assert float(stage.state.qpos[0]) > 0.8  # and the robot is where the door was


READY = {
    "torso": 0.1,
    "shoulder_pan": 0.0,
    "shoulder_lift": 1.0,
    "upperarm_roll": 0.0,
    "elbow_flex": -1.5,
    "forearm_roll": 0.0,
    "wrist_flex": 0.5,
    "wrist_roll": 0.0,
}
"""Gripper level, 0.93 m ahead of the axle and 0.74 m high: by the link lengths, in a vertical plane."""


def test_fetch_pulls_a_door_open_by_its_handle():
    robot = get_robot("fetch", "position")
    reach, stand_off = 0.93, 0.25
    handle_x = reach + stand_off
    stage = _Stage(robot, _door(handle_x + BAR_OUT_M + THICK_M / 2, BAR_Y_M, handle_z=0.74))
    names = [a.removeprefix("fetch_") for a in robot.actuators]
    home = {j.removeprefix("fetch_"): q for j, q in robot.home_qpos}
    target = np.array([home.get(n, 0.0) for n in names])
    wheels, fingers = slice(0, 2), slice(12, 14)

    def go(seconds, wheel_advance=0.0, finger=0.05, **joints):
        """Moves linearly to joint positions in the given time, the wheels advancing by rad each 0.1 s."""
        nonlocal target
        end = target.copy()
        for joint, value in joints.items():
            end[names.index(joint)] = value
        start, steps = target, round(seconds / 0.1)
        for k in range(steps):
            target = start + (end - start) * (k + 1) / steps
            command = target.copy()
            command[wheels], command[fingers] = wheel_advance, finger
            stage.step(command)

    go(4.0, **READY)
    assert stage.door_rad == pytest.approx(0.0, abs=0.01)  # not touched so far
    # Drive until the bar stands between the open fingers.
    for _ in range(60):
        if float(stage.state.qpos[0]) > stand_off - 0.02:
            break
        go(0.1, wheel_advance=0.2)
    go(1.0)
    assert stage.door_rad == pytest.approx(0.0, abs=0.05)
    go(1.5, finger=0.0)
    held = stage.qpos("fetch_finger_left") + stage.qpos("fetch_finger_right")
    assert held == pytest.approx(2 * BAR_HALF_M, abs=0.006) and stage.touched_n > 0.1  # the bar is between them
    # Drive back; the arm gives way sideways as the handle swings about its hinge.
    for _ in range(60):
        angle = -stage.door_rad
        go(0.1, wheel_advance=-0.5, finger=0.0, shoulder_pan=min(0.35, 0.7 * (1 - np.cos(angle)) / 1.0))
        if angle > 0.8:
            break
    assert stage.door_rad < -0.7  # 40 degrees, towards the robot
    assert stage.touched_n > 1.0  # still by the handle
    go(2.0, finger=0.05)
    assert stage.touched_n < 0.05 and stage.door_rad < -0.7  # let go, it stays open
