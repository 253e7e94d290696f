"""Build Quadrotor's `RobotSpec`.

Mass (0.5 kg), inertia, rotor arms (0.175 m along +x, +y, -x, -y), thrust (0 to 10 N a rotor) and rotor torque
(+/- 0.0245 N m per N, + on the x rotors) are those of GibsonEnv's `quadrotor.urdf`; rotors follow their command at
once. The flight controller is ours and runs at every physics step: velocity error -> acceleration -> tilt and total
thrust -> angular rate -> torque -> four thrusts.

The original moved the base kinematically: gravity off in the whole scene, six base velocities set. Mode `kinematic`
offers that without touching the scene: the robot alone is weightless, and six velocity servos act on its base.
"""

import functools
import math
from pathlib import Path

import mujoco
import numpy as np

from interactive_nav.metrics import GRAVITY
from interactive_nav.robots.build import FOLDER
from interactive_nav.robots.files import read_file
from interactive_nav.robots.spec import RobotCamera, RobotSpec, TwistMap, check_mode, set_servo
from interactive_nav_common.records import read_packaged
from interactive_nav_common.rotations import rotate_back, yaw_from_quat

MASS_KG = 0.5
INERTIA = (0.0023, 0.0023, 0.004)
ARM_M = 0.175
MAX_THRUST_N = 10.0
TORQUE_PER_THRUST_M = 0.0245
HOVER_HEIGHT_M = 0.8
ROTORS = tuple(f"quadrotor_rotor_{place}" for place in ("front", "left", "back", "right"))
_ROTOR_POS = ((ARM_M, 0.0), (0.0, ARM_M), (-ARM_M, 0.0), (0.0, -ARM_M))
_SPIN = (1.0, -1.0, 1.0, -1.0)
_AXES = tuple(f"quadrotor_{kind}_{axis}" for kind in ("linear", "angular") for axis in "xyz")
_MODES = ("native", "velocity", "rate", "thrust", "kinematic", "twist")

MAX_CLIMB_M_S = 0.5
MAX_RATE_RAD_S = 3.0
MAX_TILT_RAD = 0.4
_ALTITUDE_GAIN = 1.5
_VELOCITY_GAIN = 2.0
_TILT_GAIN = 5.0
_RATE_GAIN = 16.0
"""1/s each, ours; a loop is about a third as fast as the one inside it, and the innermost keeps clear of 1 / 0.02 s."""

_MIXER = np.linalg.inv(
    [
        [1.0, 1.0, 1.0, 1.0],
        [y for _, y in _ROTOR_POS],
        [-x for x, _ in _ROTOR_POS],
        [spin * TORQUE_PER_THRUST_M for spin in _SPIN],
    ]
)
"""(total thrust, torque about x, y, z) to four thrusts."""


def _add_to(spec: mujoco.MjSpec, mode: str) -> None:
    base = read_file(FOLDER / "quadrotor.xml").worldbody.first_body()
    base = spec.worldbody.add_frame().attach_body(base, "quadrotor_", "")
    base.name = "quadrotor"
    if mode == "kinematic":
        base.gravcomp = 1.0
        # Servos in the base frame; a velocity error halves within a physics step.
        for k, name in enumerate(_AXES):
            gear = [0.0] * 6
            gear[k] = 1.0
            gain = 30.0 * (MASS_KG if k < 3 else INERTIA[k - 3])
            centre, site = "quadrotor_centre", mujoco.mjtTrn.mjTRN_SITE
            set_servo(spec.add_actuator(name=name, target=centre, trntype=site, gear=gear), (0.0, gain), None)
        return
    for name, spin in zip(ROTORS, _SPIN, strict=True):
        spec.add_actuator(
            name=name,
            target=name,
            trntype=mujoco.mjtTrn.mjTRN_SITE,
            gear=[0.0, 0.0, 1.0, 0.0, 0.0, spin * TORQUE_PER_THRUST_M],
            ctrllimited=True,
            ctrlrange=[0.0, MAX_THRUST_N],
        )


def _fly_rates(rates, thrust_n, state, xp):
    """Convert angular rates [..., 3], rad/s, body frame, and a total thrust [...] to thrusts [..., 4] in 0 .. 10 N."""
    torque = _RATE_GAIN * (rates - state.qvel[..., 3:6]) * xp.broadcast_to(xp.asarray(INERTIA), rates.shape)
    wrench = xp.concatenate([thrust_n[..., None], torque], -1)
    return xp.clip(wrench @ xp.asarray(_MIXER).T, 0.0, MAX_THRUST_N)


def _velocity_law(command, state, xp):
    """Convert (vx, vy, vz m/s along the heading, yaw rate rad/s) to thrusts."""
    quat, velocity_w = state.qpos[..., 3:7], state.qvel[..., :3]
    heading = yaw_from_quat(quat)
    cos, sin = xp.cos(heading), xp.sin(heading)
    ahead, left, climb, turn = (command[..., k] for k in range(4))
    wanted_w = xp.stack([cos * ahead - sin * left, sin * ahead + cos * left, climb], -1)
    lift = _VELOCITY_GAIN * (wanted_w - velocity_w)
    most = GRAVITY * math.tan(MAX_TILT_RAD)
    across = xp.clip(lift[..., :2], -most, most)
    up = xp.clip(lift[..., 2:], -0.5 * GRAVITY, GRAVITY) + GRAVITY
    thrust_w = xp.concatenate([across, up], -1)
    size = xp.sqrt((thrust_w**2).sum(-1, keepdims=True))
    # The thrust axis in the body frame is z; turning it onto the wanted direction d takes z x d.
    d = rotate_back(quat, thrust_w / size)
    yaw_rate_w = xp.stack([0 * heading, 0 * heading, turn], -1)
    rates = rotate_back(quat, yaw_rate_w) + _TILT_GAIN * xp.stack([-d[..., 1], d[..., 0], 0 * heading], -1)
    thrust = MASS_KG * size[..., 0] * xp.maximum(d[..., 2], 0.0)
    return _fly_rates(xp.clip(rates, -MAX_RATE_RAD_S, MAX_RATE_RAD_S), thrust, state, xp)


def _twist_law(command, state, xp):
    """Convert (forward m/s, yaw rate rad/s) to thrusts, at the hover height."""
    climb = xp.clip(_ALTITUDE_GAIN * (HOVER_HEIGHT_M - state.qpos[..., 2]), -MAX_CLIMB_M_S, MAX_CLIMB_M_S)
    zero = xp.zeros_like(climb)
    return _velocity_law(xp.stack([command[..., 0], zero, climb, command[..., 1]], -1), state, xp)


_TABLE = read_packaged(
    Path(__file__).with_suffix(".yaml"),
    dict[str, tuple[tuple[str, ...], tuple[float, ...], tuple[float, ...], tuple[tuple[float, float], ...]]],
)
"""Mode -> action names, commands at -1 and +1, matrix of a `TwistMap` (empty: none)."""
_LAWS = {"native": _velocity_law, "velocity": _velocity_law, "twist": _twist_law,
         "rate": lambda command, state, xp: _fly_rates(command[..., :3], command[..., 3], state, xp)}  # fmt: skip


def quadrotor(control_mode: str = "native") -> RobotSpec:
    """Return the Quadrotor's spec.

    Mode `velocity`, also called `native`, is velocity along the heading and yaw rate, flown physically; `twist` forward
    velocity and yaw rate at a height of 0.8 m; `rate` angular rates and total thrust; `thrust` four rotor thrusts.
    """
    check_mode("quadrotor", control_mode, _MODES)
    (names, low, high, matrix), law = _TABLE[control_mode], _LAWS.get(control_mode)
    return RobotSpec(
        name="quadrotor",
        add_to=functools.partial(_add_to, mode=control_mode),
        base_body="quadrotor",
        base_joint="quadrotor_free",
        actuators=_AXES if control_mode == "kinematic" else ROTORS,
        action_low=low,
        action_high=high,
        action_names=names,
        body_width_m=0.592,
        footprint_radius_m=0.32,
        height_m=HOVER_HEIGHT_M + 0.1,
        spawn_height_m=HOVER_HEIGHT_M,
        camera=RobotCamera("quadrotor", (0.0, 0.05, -0.05)),
        kind="flying",
        mass_kg=MASS_KG,
        size_m=(0.592, 0.592, 0.09),
        drive_type="4 rotors",
        source="GibsonEnv quadrotor.urdf",
        control_mode=control_mode,
        control_modes=_MODES,
        control=law,
        control_every_substep=law is not None,
        twist=None if not matrix else TwistMap(matrix, high[0], high[-1]),
    )
