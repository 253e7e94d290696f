"""Build the `RobotSpec`s of the legged robots from rows of `legged.yaml`, gaits and `mjcf/<robot>.xml`.

Control modes: `native`, the original's action (Ant, hip and ankle of legs front left, back left, back right, front
right, and Humanoid: torques); `position` or `velocity` of each joint, Minitaur also `torque`, or `leg`: swing and
extension of each leg; or `twist`, linear and angular velocity of the base through the gait.

Ant: shape and joints are those of the MuJoCo and GibsonEnv `ant.xml` at GibsonEnv's default scale of 0.25: at full size
it is 1.39 m wide and passes no door. Two readings of that file's mass exist, 0.911 kg (MuJoCo, density 5) and 182 kg
(PyBullet, density 1000), both at scale 1. Ours is the second at scale 0.25: 182 / 4^3 = 2.85 kg. Torques follow
gravity's, which goes with the fourth power of the scale: the original's 250 N m become 250 / 4^4 = 0.98 N m, twice what
the ankles need to stand.

Humanoid: shape, masses (42.1 kg), joints and their springs are those of the MuJoCo and GibsonEnv `humanoid.xml`; torque
limits are iGibson's gains times 0.41. Two things are ours. The feet: the original's are spheres, on which no
stance without steps exists; here each is a capsule, 0.24 m long, of the same mass and the same sole height. And
limbs do not collide with each other. The gait also balances it.

Minitaur: masses (6.0 kg), motor positions and link lengths are those of GibsonEnv's `minitaur.urdf`, whose inertias are
placeholders; here they follow from the shapes. A leg is a closed chain: two upper links on a motor each, one
fore and one aft, and two lower links that a `connect` constraint joins at the toe. Bodies are authored in the
original's reset pose (motors at pi/2, knees at -2.1834 rad), where the chains are closed. A motor's angle is that of
its upper link from straight down, positive outwards: a smaller angle is a longer leg. Torque is bounded to the motor's
3.5 N m. Ours: all links of a leg in one plane, the servo's gains, the ranges, which keep the chains from folding
through themselves, and no collisions of the robot's parts with each other.
"""

import dataclasses
import functools
import math
from pathlib import Path
from typing import Any, NamedTuple

import mujoco

from interactive_nav.robots.build import FOLDER
from interactive_nav.robots.files import read_file
from interactive_nav.robots.spec import ControlLaw, Figures, RobotSpec, RobotState, TwistMap, check_mode, set_servo
from interactive_nav_common.records import read_packaged
from interactive_nav_common.rotations import yaw_from_quat


@dataclasses.dataclass(frozen=True)
class Servo:
    """Gains of a robot's joint servos; torque is bounded by the joints (`actuatorfrcrange`)."""

    stiffness: float
    """Position mode, N m/rad."""
    damping: float
    """Position mode, N m s/rad."""
    velocity_gain: float
    """Velocity mode, N m s/rad."""


class BaseMotion(NamedTuple):
    """How the base leans and moves, in the frame that has its heading; each [...]."""

    pitch: Any
    """Forward lean, rad."""
    roll: Any
    """Lean to the right, rad."""
    pitch_rate: Any
    roll_rate: Any
    forward: Any
    """m/s"""
    left: Any
    """m/s"""


def base_motion(state: RobotState, xp: Any) -> BaseMotion:
    """Return the base's lean and velocity in its heading frame."""
    quat = state.qpos[..., 3:7]
    w, x, y, z = (quat[..., k] for k in range(4))
    up_x, up_y, up_z = 2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y)
    heading = yaw_from_quat(quat)
    cos, sin = xp.cos(heading), xp.sin(heading)
    vx, vy = state.qvel[..., 0], state.qvel[..., 1]
    return BaseMotion(
        pitch=xp.arctan2(-up_x, up_z),
        roll=xp.arctan2(up_y, up_z),
        pitch_rate=state.qvel[..., 4],
        roll_rate=state.qvel[..., 3],
        forward=cos * vx + sin * vy,
        left=-sin * vx + cos * vy,
    )


@dataclasses.dataclass(frozen=True)
class Legged:
    """A legged robot's body, its J driven joints and its gait."""

    name: str
    base_body: str
    """Of the file, with the free joint `free`; names there are without the robot's in front."""
    joints: tuple[str, ...]
    """[J] names in the model; their actuators have the same."""
    home: tuple[float, ...]
    """[J] rad."""
    servo: Servo
    max_speed_rad_s: float
    """Of a joint in mode `velocity`."""
    frequency_hz: float
    """Cycles of the gait a second."""
    max_linear_m_s: float
    max_angular_rad_s: float
    modes: tuple[str, ...] = ("native", "position", "velocity", "twist")
    native: str = "torque"
    """What the original's actions are: `torque` or `position` of the joints."""

    def body(self) -> mujoco.MjSpec:
        """Return the robot's file, parsed."""
        return read_file(FOLDER / f"{self.name}.xml")

    @functools.cached_property
    def _joints_of_file(self) -> list[mujoco.MjsJoint]:
        body = self.body()
        return [body.joint(name.removeprefix(f"{self.name}_")) for name in self.joints]

    @property
    def ranges(self) -> tuple[tuple[float, float], ...]:
        """Return [J] least and largest target, rad."""
        return tuple((float(joint.range[0]), float(joint.range[1])) for joint in self._joints_of_file)

    @property
    def torque_nm(self) -> tuple[float, ...]:
        """Return [J] torque limits."""
        return tuple(float(joint.actfrcrange[1]) for joint in self._joints_of_file)


@dataclasses.dataclass(frozen=True, kw_only=True)
class Row(Figures):
    """A robot of `legged.yaml`."""

    legs: Legged
    spawn_height_m: float
    contact_time_constant_s: float | None = None
    gait: dict[str, tuple[float, float]] = dataclasses.field(default_factory=dict)
    """Figures of its gait when it is commanded to go, and to stand; the other robots' stand with their gaits."""


ROWS = {row.legs.name: row for row in read_packaged(Path(__file__).with_suffix(".yaml"), tuple[Row, ...])}
"""Name -> robot."""


def _ant_trot(phase, command, base, xp):
    """Trot, offsets from home [..., 8]: diagonal pairs swing half a cycle apart; a leg in swing lifts its ankle."""
    # Five figures by a random search for tracking; gains are over the kinematic sweep: servos lag and feet slip.
    lift_rad, press, stride_gain, turn_gain, reach_m = 0.325, 0.1, 1.07, 1.16, 0.104
    forward, turn = command[..., 0], command[..., 1]
    effort = xp.clip(8.0 * xp.abs(forward) + 2.0 * xp.abs(turn), 0.0, 1.0)
    offsets = []
    for sign, (x, y) in zip((1.0, -1.0, -1.0, 1.0), ((1, 1), (-1, 1), (-1, -1), (1, -1)), strict=True):
        at = phase + (0.0 if x * y > 0 else math.pi)
        # A foot on the left (y > 0) goes forward when its hip turns clockwise, one on the right the other way; it
        # travels `reach_m` per radian.
        sweep = (turn_gain * turn - y * stride_gain * forward / reach_m) / (4.0 * ROWS["ant"].legs.frequency_hz)
        offsets.append(-sweep * xp.cos(at))
        # Legs on the ground push down by the share `press` of the lift.
        offsets.append(-sign * lift_rad * effort * (xp.maximum(xp.sin(at), 0.0) - press))
    return xp.stack(offsets, -1)


class Stepping(NamedTuple):
    """A walk with feedback, after SIMBICON (Yin et al. 2007): the leg in swing steps to where the body falls, the
    leg in stance holds the torso upright. Figures by the cross-entropy method over random twists and pushes."""

    frequency_hz: float
    hip_lift: float
    knee_lift: float
    sway: float
    """Of the hips towards the leg in stance, rad."""
    sway_phase: float
    waist: float
    """Of the waist against the sway, rad."""
    stride: float
    """Hip swing over that of a step of v / (2 f)."""
    lean: float
    """Of the thighs, rad per m/s."""
    width: float
    """Outward hips, rad."""
    bend: float
    """Of the waist forward, rad per m/s."""
    place_forward: float
    """Hip of the swing leg, rad per m/s of velocity error."""
    place_side: float
    """The same sideways, rad per m/s."""
    pitch: float
    pitch_rate: float
    roll: float
    roll_rate: float
    """Hips of the stance leg, rad per rad and per rad/s."""
    swing_pitch: float
    """Hip of the swing leg against the torso's lean, rad per rad."""
    waist_roll: float
    turn: float
    """Hip yaw over that of a turn of w / (2 f) a step."""
    slip: float
    """Velocity by which the walk lags behind, m/s."""
    step_speed: float
    step_lean: float
    step_threshold: float
    """Untold, it steps in so far as step_speed * speed + step_lean * (|pitch| + |roll|) exceeds the threshold."""


_STEPPING = ROWS["humanoid"].gait
WALK, STAND = (Stepping(**dict(zip(_STEPPING, row, strict=True))) for row in zip(*_STEPPING.values(), strict=True))


def _walk(phase, command, base, xp):
    """Return the walk of `Stepping` p as offsets from home, [..., 17]; without command or force to step it stands."""
    forward, turn = command[..., 0], command[..., 1]
    commanded = xp.clip(10.0 * xp.abs(forward) + 5.0 * xp.abs(turn), 0.0, 1.0)
    p = Stepping(*(commanded * a + (1.0 - commanded) * b for a, b in zip(WALK, STAND, strict=True)))
    speed = xp.sqrt(base.forward**2 + base.left**2 + 1e-6)
    forced = p.step_speed * speed + p.step_lean * (xp.abs(base.pitch) + xp.abs(base.roll)) - p.step_threshold
    going = xp.clip(xp.maximum(commanded, forced), 0.0, 1.0)
    forward = forward + p.slip * going
    sway = going * xp.cos(phase - p.sway_phase)
    joints = [name.removeprefix("humanoid_") for name in ROWS["humanoid"].legs.joints]
    out = {name: 0.0 * forward for name in joints}
    for side, shift, left in (("right", 0.0, -1.0), ("left", math.pi, 1.0)):
        swing = going * xp.maximum(xp.sin(phase + shift), 0.0)
        stance = 1.0 - swing
        stride = p.stride * forward / (4.0 * p.frequency_hz) / 0.75 * xp.cos(phase + shift)
        out[f"{side}_hip_y"] = (
            stride
            - p.hip_lift * swing
            - p.lean * forward
            - swing * (p.place_forward * (base.forward - forward) + p.swing_pitch * base.pitch)
            + stance * (p.pitch * base.pitch + p.pitch_rate * base.pitch_rate)
        )
        out[f"{side}_knee"] = -p.knee_lift * swing
        out[f"{side}_hip_x"] = -p.width * going - left * (
            p.sway * sway
            + swing * p.place_side * base.left
            # On both feet this would push to and fro: the legs, the floor and the hips are one closed chain.
            + going * stance * (p.roll * base.roll + p.roll_rate * base.roll_rate)
        )
        out[f"{side}_hip_z"] = left * p.turn * turn / (4.0 * p.frequency_hz) * xp.cos(phase + shift)
    out["abdomen_x"] = p.waist * sway + p.waist_roll * base.roll
    out["abdomen_y"] = p.bend * forward
    return xp.stack([out[name] for name in joints], -1)


_UPPER_M, _LOWER_M, _FOOT_Y_M = 0.115, 0.2, 0.107
_DROP_M = math.sqrt(_LOWER_M**2 - _UPPER_M**2)
_KNEE_HOME_RAD = math.atan2(_DROP_M, _UPPER_M) - math.pi
_MINITAUR = ROWS["minitaur"].legs
_LEGS = (("front_left", 1, 1), ("back_left", -1, 1), ("front_right", 1, -1), ("back_right", -1, -1))
"""Of Minitaur: name, sign of x, sign of y; the original's order of motors."""


def _minitaur_trot(phase, command, base, xp):
    """Trot, with offsets from home [..., 8]: diagonal legs together; strides of left and right differ in a turn."""
    # Figures as Ant's; the sweep leads the lift by `lag_rad` of the phase.
    lift_rad, press, lag_rad, stride_gain, turn_gain = 0.285, 0.17, 0.47, 0.615, 4.63
    forward, turn = command[..., 0], command[..., 1]
    effort = xp.clip(8.0 * xp.abs(forward) + 3.0 * xp.abs(turn), 0.0, 1.0)
    out = []
    for _, x, y in _LEGS:
        at = phase + (0.0 if x * y > 0 else math.pi)
        # A foot on the ground sweeps v / (2 f), 0.164 m below its hip.
        speed = stride_gain * forward - y * turn_gain * _FOOT_Y_M * turn
        swing = -speed / (4.0 * _MINITAUR.frequency_hz) / _DROP_M * xp.cos(at + lag_rad)
        lift = lift_rad * effort * (xp.maximum(xp.sin(at), 0.0) - press)
        out += [swing + lift, -swing + lift]
    return xp.stack(out, -1)


_REFERENCES = {"ant": _ant_trot, "humanoid": _walk, "minitaur": _minitaur_trot}
"""Name -> gait: (phase [...], command [..., 2], base, numpy or jax.numpy) -> target offsets from home [..., J], rad."""


def gait_law(legs: Legged) -> ControlLaw:
    """Return the law from a twist to joint targets [..., J], rad, within the joints' ranges."""

    def law(command, state, xp):
        phase = 2.0 * math.pi * legs.frequency_hz * state.time_s
        offsets = _REFERENCES[legs.name](phase, command, base_motion(state, xp), xp)
        of_joints = (legs.home, *zip(*legs.ranges, strict=True))
        home, low, high = (xp.broadcast_to(xp.asarray(x), offsets.shape) for x in of_joints)
        return xp.clip(home + offsets, low, high)

    return law


def _commands(legs: Legged, mode: str) -> list[tuple[str, float, float]]:
    """Return each action's name with its unit and its command at -1 and +1, which but for positions are symmetric:
    action 0 stands."""
    if mode == "twist":
        speeds = ("forward m/s", legs.max_linear_m_s), ("turn rad/s", legs.max_angular_rad_s)
        return [(name, -most, most) for name, most in speeds]
    unit, ends = "N m", tuple((-most, most) for most in legs.torque_nm)
    if mode in ("position", "velocity"):
        most = legs.max_speed_rad_s
        unit, ends = ("rad", legs.ranges) if mode == "position" else ("rad/s", ((-most, most),) * len(legs.joints))
    return [(f"{joint.split('_', 1)[1]} {unit}", *end) for joint, end in zip(legs.joints, ends, strict=True)]


def _add_to(legs: Legged, mode: str, world: mujoco.MjSpec) -> None:
    """Attach the robot to a world, with one actuator per joint: torque, velocity, or position otherwise."""
    world.worldbody.add_frame().attach_body(legs.body().worldbody.first_body(), f"{legs.name}_", "")
    servo = legs.servo
    for joint, torque, limits in zip(legs.joints, legs.torque_nm, legs.ranges, strict=True):
        gains = {"velocity": (0.0, servo.velocity_gain), "torque": None}.get(mode, (servo.stiffness, servo.damping))
        actuator = world.add_actuator(name=joint, target=joint, trntype=mujoco.mjtTrn.mjTRN_JOINT)
        set_servo(actuator, gains, {"velocity": (-100.0, 100.0), "torque": (-torque, torque)}.get(mode, limits))


def legged_robot(name: str, control_mode: str = "native", **figures: Any) -> RobotSpec:
    """Return the spec of a legged robot in one of `legs.modes`: `native` is `legs.native` of each joint, `twist` the
    base's linear and angular velocity through the gait."""
    row = vars(ROWS[name])
    legs = row["legs"]
    check_mode(name, control_mode, legs.modes)
    joint_mode = legs.native if control_mode == "native" else control_mode
    twist = control_mode == "twist"
    names, low, high = zip(*_commands(legs, joint_mode), strict=True)
    fields: dict[str, Any] = {
        "action_low": low,
        "action_high": high,
        "action_names": names,
        "home_qpos": tuple(zip(legs.joints, legs.home, strict=True)),
        "control": gait_law(legs) if twist else None,
    }
    return RobotSpec(
        name=name,
        add_to=functools.partial(_add_to, legs, joint_mode),
        base_body=f"{legs.name}_{legs.base_body}",
        base_joint=f"{legs.name}_free",
        actuators=legs.joints,
        kind="legged",
        control_mode=control_mode,
        control_modes=legs.modes,
        control_every_substep=twist,
        twist=TwistMap(((1.0, 0.0), (0.0, 1.0)), legs.max_linear_m_s, legs.max_angular_rad_s) if twist else None,
        **(fields | {field: row[field] for field in row.keys() - {"legs", "gait"}} | figures),
    )


def _leg_angles(command, state, xp):
    """Convert swing, then extension of each leg, [..., 8] in [-1, 1], to motor angles: the original's coordinates."""
    swing, extension = command[..., :4], command[..., 4:]
    middle = math.pi - 0.25 * math.pi * (extension + 1.5)
    angles = xp.stack([middle + 0.25 * math.pi * swing, middle - 0.25 * math.pi * swing], -1)
    return xp.clip(angles.reshape((*angles.shape[:-2], 8)), *_MINITAUR.ranges[0])


def minitaur(control_mode: str = "native") -> RobotSpec:
    parts = (("motor", _MINITAUR.home[0]), ("knee", _KNEE_HOME_RAD))
    home = tuple((joint.replace("motor", part), value) for joint in _MINITAUR.joints for part, value in parts)
    figures: dict[str, Any] = {"home_qpos": home}
    if control_mode == "leg":
        names = tuple(f"{leg} {what}" for what in ("swing", "extension") for leg, _, _ in _LEGS)
        figures |= {"action_low": (-1.0,) * 8, "action_high": (1.0,) * 8, "action_names": names, "control": _leg_angles}
    return legged_robot("minitaur", control_mode, **figures)


LEGGED = {name: functools.partial(legged_robot, name) for name in ("ant", "humanoid")} | {"minitaur": minitaur}
"""Name -> control mode -> spec."""
