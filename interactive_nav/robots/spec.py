"""Define what the environment needs of a robot in one frozen record."""

import dataclasses
from collections.abc import Callable
from typing import Any, NamedTuple

import mujoco
import numpy as np

from interactive_nav_common.errors import ConfigError


class RobotState(NamedTuple):
    """The robot's part of the physics state that a control law may read; leading batch axes as the caller has them."""

    qpos: Any
    """[..., robot nq]: free joint (position, quaternion w x y z), then the robot's other joints in order."""
    qvel: Any
    """[..., robot nv]: linear velocity (world), angular velocity (body), then the joints'."""
    time_s: Any
    """[...] since the start of the episode."""


ControlLaw = Callable[[Any, RobotState, Any], Any]
"""(command [..., A], state, numpy or jax.numpy) -> actuator controls [..., nu]; pure, batched by its leading axes."""


@dataclasses.dataclass(frozen=True)
class RobotCamera:
    """The camera that images are rendered from; it looks along the body's x axis, world z kept up."""

    body: str
    pos_m: tuple[float, float, float]
    """In the body's frame."""
    pitch_rad: float = 0.0
    """Positive looks down."""
    fov_deg: float = 120.0
    """Vertical field of view of the interactive task (reference benchmark, section 1.3)."""


@dataclasses.dataclass(frozen=True)
class TwistMap:
    """How commands make the base move: what scripted drivers and planners need."""

    matrix: tuple[tuple[float, float], ...]
    """[A, 2]: command = matrix @ (linear m/s, angular rad/s); commands that are no part of driving have zero rows."""
    max_linear_m_s: float
    max_angular_rad_s: float


def check_mode(robot: str, mode: str, modes: tuple[str, ...]) -> None:
    """Raise ConfigError for a control mode that the robot does not have."""
    if mode not in modes:
        raise ConfigError(f"robot '{robot}' has no control mode '{mode}'; it has {', '.join(modes)}")


def set_servo(
    actuator: mujoco.MjsActuator, gains: tuple[float, float] | None, control_range: tuple[float, float] | None
) -> None:
    """Turn an actuator into a servo of its joint with stiffness and damping, or, without gains, a motor.

    Without stiffness the control is a velocity, else a position; a `control_range` of None is unlimited.
    """
    stiffness, damping = gains or (0.0, 0.0)
    actuator.gaintype = mujoco.mjtGain.mjGAIN_FIXED
    actuator.biastype = mujoco.mjtBias.mjBIAS_AFFINE if gains else mujoco.mjtBias.mjBIAS_NONE
    actuator.gainprm = [(stiffness or damping) if gains else 1.0] + [0.0] * 9
    actuator.biasprm = [0.0, -stiffness, -damping] + [0.0] * 7
    actuator.ctrllimited = control_range is not None
    if control_range is not None:
        actuator.ctrlrange = list(control_range)


@dataclasses.dataclass(frozen=True, kw_only=True)
class Figures:
    """Fields of a `RobotSpec` that tables of robots (`models/*.yaml`) have."""

    body_width_m: float
    """Success distance: the paper's 'width of the robot's body'."""
    footprint_radius_m: float
    """Smallest disc about the base frame that holds the body: erosion of maps, clearance of placements."""
    height_m: float
    """Top of the body above the floor."""
    camera: RobotCamera
    mass_kg: float | None = None
    """Mass by the robot's data sheet or URDF; none: not checked against the model's."""
    size_m: tuple[float, float, float] | None = None
    """Length, width, height of the body at its home pose."""
    drive_type: str = ""
    """How it moves, in words."""
    source: str = ""
    """Where the figures come from."""


@dataclasses.dataclass(frozen=True, kw_only=True)
class RobotSpec(Figures):
    """A robot under one control mode: its MJCF and the figures that the task needs. Frame: x forward, y left, z up."""

    name: str
    add_to: Callable[[mujoco.MjSpec], None]
    """Adds the robot to a world spec: one body `base_body` with a free joint, its actuators and sites."""
    base_body: str
    """Body whose free joint is the robot's pose; its subtree is 'the robot' for contact forces."""
    base_joint: str
    actuators: tuple[str, ...]
    """The model's actuators, in order."""
    action_low: tuple[float, ...]
    """Command at action -1, one per action, in the command's unit."""
    action_high: tuple[float, ...]
    """Command at action +1."""
    spawn_height_m: float
    """Height of the base frame above the floor when the robot stands."""
    action_names: tuple[str, ...] = ()
    """What each action commands, with its unit; by default the actuators."""
    home_qpos: tuple[tuple[str, float], ...] = ()
    """Joint -> position at the start of an episode; joints that are not named start at their model's zero."""
    rolling_bodies: tuple[str, ...] = ()
    """Wheels and casters: bodies whose contacts the original's code did not count."""
    hand: str = ""
    """Body that mode `hand` moves; empty: it has none."""
    root_link_kg: float = 0.0
    """Mass of the original URDF's root link, which one of its scores leaves out; 0: a massless footprint."""
    control_mode: str = "native"
    control_modes: tuple[str, ...] = ("native",)
    """Modes that `get_robot(name, mode)` answers."""
    control: ControlLaw | None = None
    """Command to actuator controls; none: the command is the controls."""
    control_every_substep: bool = False
    """The control law runs at every physics step, not once a control period."""
    contact_time_constant_s: float | None = None
    """Of the robot's contacts, where its gait needs a certain one; None: the environment's."""
    twist: TwistMap | None = None
    """None: scripted drivers cannot drive this mode."""
    kind: str = "wheeled"
    """'wheeled', 'legged' or 'flying': which evidence applies."""
    reference: str = ""
    """The file, or the function of a Python file, that `get_robot` builds it from again; empty if its name suffices."""

    @property
    def action_size(self) -> int:
        return len(self.action_low)

    def symmetric(self) -> "RobotSpec":
        """Return the robot with action 0 meaning no command: each range widened to plus and minus its larger end."""
        largest = tuple(max(abs(a), abs(b)) for a, b in zip(self.action_low, self.action_high, strict=True))
        return dataclasses.replace(self, action_low=tuple(-x for x in largest), action_high=largest)

    def hooked(self) -> "RobotSpec":
        """Return a wheeled robot with one more command, its hook's: positive couples, negative lets go, 0 neither."""
        if self.kind != "wheeled":
            raise ConfigError(
                f"hook_force_n is set, expected 0 with robot '{self.name}' ({self.kind}): only wheeled ones have a hook"
            )
        return dataclasses.replace(
            self,
            action_low=(*self.action_low, -1.0),
            action_high=(*self.action_high, 1.0),
            action_names=(*(self.action_names or self.actuators), "hook"),
            control=lambda command, state, xp: self.controls(command[..., :-1], state, xp),
            twist=self.twist and dataclasses.replace(self.twist, matrix=(*self.twist.matrix, (0.0, 0.0))),
        )

    def command(self, action, xp=np):
        """Map actions [..., A] in [-1, 1] (clipped) affinely to commands [..., A]."""
        low, high = self._command_range(action, xp)
        return low + 0.5 * (xp.clip(action, -1.0, 1.0) + 1.0) * (high - low)

    def action(self, command, xp=np):
        """Return the inverse of `command`: actions [..., A], clipped to [-1, 1]."""
        low, high = self._command_range(command, xp)
        return xp.clip(2.0 * (xp.asarray(command) - low) / (high - low) - 1.0, -1.0, 1.0)

    def _command_range(self, values, xp):
        """Return `action_low` and `action_high`, each in the shape of actions or commands [..., A]."""
        shape = xp.asarray(values).shape
        return (xp.broadcast_to(xp.asarray(end), shape) for end in (self.action_low, self.action_high))

    def controls(self, command, state: RobotState, xp=np):
        """Return actuator controls [..., nu] for commands [..., A]."""
        return command if self.control is None else self.control(command, state, xp)

    def drive(self, linear_m_s, angular_rad_s, xp=np):
        """Return actions [..., A] that request a velocity of the base."""
        if self.twist is None:
            raise ConfigError(
                f"robot '{self.name}' in control mode '{self.control_mode}' takes no base velocity; "
                f"choose another of its modes: {', '.join(self.control_modes)}"
            )
        return self.action(xp.stack([linear_m_s, angular_rad_s], -1) @ xp.asarray(self.twist.matrix).T, xp)
