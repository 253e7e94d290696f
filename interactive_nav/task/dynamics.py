"""Draw each episode's dynamics from the ranges of `RandomDynamics`, and delay its commands and observations."""

import dataclasses
from collections.abc import Callable
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from brax.envs.base import State

from interactive_nav.config import RandomDynamics
from interactive_nav.physics.base import ModelChange
from interactive_nav.robots import RobotSpec
from interactive_nav.sensing.sensors import stream
from interactive_nav.types import EpisodeDynamics, NavInfo
from interactive_nav_common.errors import ConfigError
from interactive_nav_common.rotations import scale_sides


class Dynamics:
    """Apply an environment's random dynamics; functions are pure and see one environment."""

    def __init__(self, config: RandomDynamics, robot: RobotSpec):
        """Raise `ConfigError` for ranges that the robot's control mode cannot follow."""
        ranges = {f.name: (getattr(config, f.name), f.default) for f in dataclasses.fields(RandomDynamics)}
        self._ranges = {name: drawn for name, (drawn, default) in ranges.items() if drawn != default}
        self._wait, self._latency = config.random_motor_delay_steps[1], config.random_sensor_delay_steps[1]
        self._drives = self._ranges.keys() & {"random_motor_gain", "random_wheel_slip"}
        if self._drives and robot.twist is None:
            raise ConfigError(
                f"{min(self._drives)} is {self._ranges[min(self._drives)]}, expected its default: robot '{robot.name}' "
                f"in mode '{robot.control_mode}' takes no base velocity; choose one of {', '.join(robot.control_modes)}"
            )
        self._to_command = np.asarray(robot.twist.matrix if robot.twist else [[0, 0]] * robot.action_size, np.float32)
        self._to_twist, wheels = np.linalg.pinv(self._to_command), self._to_command[self._to_command.all(1)]
        # Where the command has no wheels, slip acts at the sides of the body, as in the topological evaluation.
        self._half_m = float(abs(wheels[0, 1] / wheels[0, 0])) if len(wheels) else robot.body_width_m / 2

    def begin(self, state: State, observe: Callable[[State], Any]) -> State:
        """Return the first state with the dynamics that its key draws, each range by its stream."""
        drawn = {}
        for name, (low, high) in self._ranges.items():
            key, shape = stream(state.info["rng"], name, jnp.int32(0)), (2,) if name == "random_wheel_slip" else ()
            uniform = jax.random.uniform(key, shape, minval=low, maxval=high)
            drawn[name] = jax.random.randint(key, (), low, high + 1) if name.endswith("_steps") else uniform
        commands = jnp.zeros((self._wait, len(self._to_command))) if self._wait else None
        seen, room = jax.eval_shape(observe, state) if self._latency else None, self._latency + 2
        seen = jax.tree.map(lambda x: jnp.zeros((room, *x.shape), x.dtype), seen)
        nav = state.info["nav"].replace(dynamics=EpisodeDynamics(drawn, commands, seen))
        return state.replace(info=state.info | {"nav": nav}) if drawn else state

    def execute(self, nav: NavInfo, command: jax.Array, fields: Any) -> tuple[NavInfo, jax.Array, ModelChange | None]:
        """Return `nav`, what the robot executes now, given a command (A,), and how the model changes, with `fields`."""
        dynamics = nav.dynamics
        drawn = {} if dynamics is None else dynamics.drawn
        if dynamics is not None and dynamics.commands is not None:
            queue, delay = jnp.concatenate([dynamics.commands, command[None]]), drawn["random_motor_delay_steps"]
            command = jnp.where(nav.step_count < delay, 0.0, queue[self._wait - delay])
            nav = nav.replace(dynamics=dynamics.replace(commands=queue[1:]))
        if self._drives:
            share = drawn.get("random_motor_gain", 1.0) * (1.0 - drawn.get("random_wheel_slip", jnp.zeros(2)))
            twist = (self._to_twist * command[None]).sum(-1)
            executed = jnp.stack(scale_sides(twist[0], twist[1], share[0], share[1], self._half_m))
            # Whatever else a command has, such as an arm's velocities, stays.
            command = command + (self._to_command * (executed - twist)[None]).sum(-1)
        change = ModelChange(drawn.get("random_mass"), drawn.get("random_friction"), fields)
        return nav, command, change if jax.tree.leaves(change) else None

    def show(self, state: State, obs: Any) -> State:
        """Return the state with the observation of some steps ago; it keeps `obs`, of now, and may do so repeatedly."""
        if not self._latency:
            return state.replace(obs=obs)
        nav, turns = state.info["nav"], self._latency + 1
        now, then = nav.step_count, nav.step_count - nav.dynamics.drawn["random_sensor_delay_steps"]
        places = jnp.stack([now % turns, jnp.where(now == 0, turns, now % turns)])
        seen = jax.tree.map(lambda seen, x: seen.at[places].set(x), nav.dynamics.seen, obs)
        obs = jax.tree.map(lambda x: x[jnp.where(then > 0, then % turns, turns)], seen)
        nav = nav.replace(dynamics=nav.dynamics.replace(seen=seen))
        return state.replace(obs=obs, info=state.info | {"nav": nav})
