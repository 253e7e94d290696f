"""TurtleBot v2 (Kobuki base): nothing in, its `RobotSpec` out.

Figures are those of iGibson's TurtleBot URDF unless marked 'ours': 2.673 kg in all, wheels of radius
0.0352 m at y = +/- 0.115 m, body disc of radius 0.176 m, casters without friction, success distance
0.333 m, wheel command -12.5 .. +25 rad/s for action -1 .. +1 (reference benchmark, section 2). The
original's wheel torque was unlimited; ours is the 1.0 N m of the robot's Gazebo plugin.
"""

from __future__ import annotations

import math

import mujoco

from interactive_nav.robots.spec import Camera, RobotSpec, TwistMap, wheel_twist

WHEEL_RADIUS_M = 0.0352
HALF_TRACK_M = 0.115
WHEEL_TORQUE_NM = 1.0
BODY_RADIUS_M = 0.176
WHEEL_SPEED_RAD_S = (-12.5, 25.0)
CAMERA_POS_M = (-0.087, -0.0125, 0.272)
_VELOCITY_GAIN = 0.15
"""N m s/rad, ours: the torque limit is reached at a speed error of 6.7 rad/s."""


def _add_to(spec: mujoco.MjSpec) -> None:
    base = spec.worldbody.add_body(name="turtlebot", pos=[0.0, 0.0, 0.0])
    base.add_freejoint(name="turtlebot_free")
    # Masses: base 2.4, two casters 0.01, three plates 0.01, poles and camera about 0.023.
    base.explicitinertial = True
    base.mass = 2.473
    base.ipos = [0.01, 0.0, 0.0697]
    base.inertia = [0.0200, 0.0200, 0.0368]
    base.add_site(name="turtlebot_eyes", pos=list(CAMERA_POS_M), size=[0.005] * 3)

    def collide(name: str, **kwargs) -> None:
        base.add_geom(name=name, group=3, mass=0.0, friction=[0.3, 0.005, 0.0001], condim=3, **kwargs)

    # The body disc as four rectangles whose union is a regular octagon of circumradius 0.176 m: MJX has
    # no fast cylinder-box collision.
    half_length = BODY_RADIUS_M * math.cos(math.pi / 8)
    half_width = BODY_RADIUS_M * math.sin(math.pi / 8)
    for i in range(4):
        collide(
            f"turtlebot_body_{i}",
            type=mujoco.mjtGeom.mjGEOM_BOX,
            size=[half_length, half_width, 0.0547],
            pos=[0.0, 0.0, 0.0697],
            quat=[math.cos(i * math.pi / 8), 0.0, 0.0, math.sin(i * math.pi / 8)],
        )
    # Plates and poles above the body, 0.41 m high in all; narrower than the disc below (ours).
    collide(
        "turtlebot_tower",
        type=mujoco.mjtGeom.mjGEOM_BOX,
        size=[0.12, 0.12, 0.1428],
        pos=[0.0, 0.0, 0.2672],
    )
    for name, x, z in (("front", 0.115, 0.0172), ("back", -0.135, 0.0192)):
        base.add_geom(
            name=f"turtlebot_caster_{name}",
            type=mujoco.mjtGeom.mjGEOM_SPHERE,
            size=[0.017, 0.0, 0.0],
            pos=[x, 0.0, z],
            group=3,
            mass=0.0,
            condim=1,
            priority=1,
            friction=[0.0, 0.0, 0.0],
        )
    for side, sign in (("left", 1.0), ("right", -1.0)):
        wheel = base.add_body(name=f"turtlebot_wheel_{side}", pos=[0.0, sign * HALF_TRACK_M, WHEEL_RADIUS_M])
        # The torque limit sits on the joint: with an actuator's own limit, C MuJoCo drops the implicit
        # damping of a saturated motor and MJX-JAX keeps it, so that their robots accelerate differently.
        wheel.add_joint(
            name=f"turtlebot_wheel_{side}_joint",
            type=mujoco.mjtJoint.mjJNT_HINGE,
            axis=[0.0, 1.0, 0.0],
            armature=1e-3,
            actfrclimited=True,
            actfrcrange=[-WHEEL_TORQUE_NM, WHEEL_TORQUE_NM],
        )
        wheel.explicitinertial = True
        wheel.mass = 0.1
        wheel.ipos = [0.0, 0.0, 0.0]
        wheel.inertia = [4e-5, 6.2e-5, 4e-5]
        wheel.add_geom(
            name=f"turtlebot_wheel_{side}",
            type=mujoco.mjtGeom.mjGEOM_SPHERE,
            size=[WHEEL_RADIUS_M, 0.0, 0.0],
            group=3,
            condim=3,
            priority=1,
            friction=[1.0, 0.005, 0.0001],
        )
        spec.add_actuator(
            name=f"turtlebot_wheel_{side}",
            target=f"turtlebot_wheel_{side}_joint",
            trntype=mujoco.mjtTrn.mjTRN_JOINT,
            gaintype=mujoco.mjtGain.mjGAIN_FIXED,
            biastype=mujoco.mjtBias.mjBIAS_AFFINE,
            gainprm=[_VELOCITY_GAIN] + [0.0] * 9,
            biasprm=[0.0, 0.0, -_VELOCITY_GAIN] + [0.0] * 7,
            ctrllimited=True,
            ctrlrange=list(WHEEL_SPEED_RAD_S),
        )


_MODES = ("native", "twist")


def turtlebot(control_mode: str = "native") -> RobotSpec:
    """TurtleBot v2's spec.

    Args:
        control_mode: `native`, two wheel velocities, left then right; or `twist`, linear and angular
            velocity of the base.

    Raises:
        ValueError: unknown mode.
    """
    if control_mode not in _MODES:
        raise ValueError(f"robot 'turtlebot' has no control mode '{control_mode}'; it has {', '.join(_MODES)}")
    wheels = wheel_twist(WHEEL_RADIUS_M, 2 * HALF_TRACK_M, (-1, 1))
    low, high = (v * WHEEL_RADIUS_M for v in WHEEL_SPEED_RAD_S)
    turn = -low / HALF_TRACK_M
    native = control_mode == "native"

    def mix(command, state, xp):
        del state
        return command @ xp.asarray(wheels).T

    return RobotSpec(
        name="turtlebot",
        add_to=_add_to,
        base_body="turtlebot",
        base_joint="turtlebot_free",
        actuators=("turtlebot_wheel_left", "turtlebot_wheel_right"),
        action_low=(WHEEL_SPEED_RAD_S[0],) * 2 if native else (low, -turn),
        action_high=(WHEEL_SPEED_RAD_S[1],) * 2 if native else (high, turn),
        action_names=("left wheel rad/s", "right wheel rad/s") if native else ("forward m/s", "turn rad/s"),
        body_width_m=0.333,
        footprint_radius_m=0.18,
        height_m=0.41,
        spawn_height_m=0.0,
        camera=Camera("turtlebot", CAMERA_POS_M),
        rolling_bodies=("turtlebot_wheel_left", "turtlebot_wheel_right"),
        control_mode=control_mode,
        control_modes=_MODES,
        control=None if native else mix,
        twist=TwistMap(wheels if native else ((1.0, 0.0), (0.0, 1.0)), high, turn),
    )
