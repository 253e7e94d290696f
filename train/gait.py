"""`python -m train.gait`: a legged robot's name in, a network that corrects its scripted gait out.

The robot stands alone on a plane and follows a twist command (forward m/s, turn rad/s) that is drawn anew every
few seconds, under the navigation task's own physics (0.02 s steps, its solver, its contacts). An action is the
correction of the joint targets at every physics step; observation and action are those of
`interactive_nav.robots.gait`, so that what is learned is what the robot's `twist` mode runs. PPO is the same as
for navigation. The network is exported to OUT/<robot>.npz after every log interval; copy it to
`interactive_nav/robots/gaits/` to use it, if it is better than the script alone:

    python -m train.gait --robot humanoid --max-seconds 240 --out runs/gait
    python -m train.gait --robot humanoid --evaluate runs/gait
"""

from __future__ import annotations

import argparse
import dataclasses
import importlib
import time
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from brax.envs.base import Env, State

from interactive_nav.config import NavConfig
from interactive_nav.physics import PhysicsState, make_physics, resolve_backend
from interactive_nav.robots import get_robot
from interactive_nav.robots.gait import (
    Gait,
    Network,
    base_motion,
    load_network,
    observe,
    phase_at,
    save_network,
    targets,
)
from interactive_nav.robots.spec import RobotState
from interactive_nav.scenes.scene import Scene
from interactive_nav.scenes.world import build_world
from interactive_nav_common.rotations import rotate_back
from scenes_mjcf.schema import SceneManifest, SceneMaps
from train.config import AUTO_PPO, PPOConfig, RunConfig, TrainConfig
from train.learners import ppo
from train.learners.learner import Snapshot, Update

ROBOTS = ("ant", "humanoid", "minitaur")
METRICS = ("forward_error_m_s", "turn_error_rad_s", "fallen", "length", "sum_reward")


def get_gait(robot: str) -> Gait:
    """The gait of a legged robot."""
    return importlib.import_module(f"interactive_nav.robots.models.{robot}").GAIT


def empty_plane() -> Scene:
    """A scene with nothing but the floor."""
    maps = SceneMaps(np.ones((4, 4), bool), 1.0, (-2.0, -2.0), 0.0)
    manifest = SceneManifest("plane", "train", {"format": "plane"}, "CC0-1.0", 16.0, (), {}, {}, {})
    return Scene(Path("plane"), "plane", "train", "", manifest, maps, np.zeros((0, 10)), ())


@dataclasses.dataclass(frozen=True)
class GaitTask:
    """Commands, disturbances and reward weights; a reward is per second."""

    episode_s: float = 10.0
    command_s: float = 4.0
    """Mean time between two commands."""
    stand_share: float = 0.2
    """Share of commands that are zero."""
    turn_share: float = 0.2
    """Share of commands that turn on the spot."""
    backward: float = 0.3
    """Fastest backward command over the fastest forward one."""
    average_s: float = 0.4
    """Time constant over which velocities are averaged before they are compared with the command."""
    push_s: float = 4.0
    """Mean time between two pushes."""
    push_share: float = 0.6
    """Largest change of the base's horizontal velocity by a push over the fastest forward command."""
    forward_weight: float = 2.0
    turn_weight: float = 1.0
    reference_weight: float = 0.2
    upright_weight: float = 0.5
    alive_weight: float = 0.5
    vertical_weight: float = 0.5
    """Of squared vertical and roll and pitch velocities."""
    smooth_weight: float = 0.15
    """Of the mean squared change of the correction."""
    torque_weight: float = 0.2
    """Of the mean squared torque over its limit."""
    still_weight: float = 0.3
    """Of the mean squared distance of joints from home under a zero command."""


class GaitEnv(Env):
    """N robots on a plane, natively batched, each finished episode followed by a new one."""

    def __init__(self, gait: Gait, backend: str, task: GaitTask | None = None):
        self.gait, self.task = gait, task or GaitTask()
        spec = dataclasses.replace(get_robot(gait.robot, "position"), control=None, control_every_substep=False)
        config = NavConfig(backend=backend, num_objects=0, control_dt_s=0.02, sleep=False)
        self._world = build_world(spec, (empty_plane(),), config)
        self.physics = make_physics(self._world, config)
        self._rest = jnp.asarray(self._world.rest_qpos[0], jnp.float32)
        self._start = self._rest.at[:7].set(jnp.asarray([0, 0, spec.spawn_height_m, 1, 0, 0, 0], jnp.float32))
        self._dt = config.sim_dt_s
        names = [actuator for actuator in spec.actuators]
        assert tuple(names) == gait.joints, "the gait's joints must be the actuators"

    @property
    def observation_size(self) -> int:
        """Length of the observation."""
        return self.gait.observation_size

    @property
    def action_size(self) -> int:
        """One correction per driven joint."""
        return len(self.gait.joints)

    @property
    def backend(self) -> str:
        """Physics backend in use."""
        return self.physics.name

    def _draw_command(self, key: jax.Array, n: int) -> jax.Array:
        """[N, 2] forward m/s, turn rad/s."""
        keys, task = jax.random.split(key, 3), self.task
        forward = jax.random.uniform(keys[0], (n,), minval=-task.backward, maxval=1.0) * self.gait.max_linear_m_s
        turn = jax.random.uniform(keys[1], (n,), minval=-1.0, maxval=1.0) * self.gait.max_angular_rad_s
        kind = jax.random.uniform(keys[2], (n,))
        forward = jnp.where(kind < task.stand_share + task.turn_share, 0.0, forward)
        turn = jnp.where((kind < task.stand_share) | (kind > 0.9), 0.0, turn)
        return jnp.stack([forward, turn], -1)

    def _draw_start(self, key: jax.Array, n: int) -> tuple[PhysicsState, jax.Array]:
        keys = jax.random.split(key, 3)
        noise = 0.05 * jax.random.normal(keys[0], (n, len(self.gait.joints)))
        qpos = jnp.broadcast_to(self._start, (n, self.physics.nq))
        if not self.gait.offsets:  # closed chains start closed
            qpos = qpos.at[:, 7 + self.gait.joint_index].add(noise)
        yaw = jax.random.uniform(keys[1], (n,), maxval=2 * jnp.pi)
        qpos = qpos.at[:, 3].set(jnp.cos(yaw / 2)).at[:, 6].set(jnp.sin(yaw / 2))
        still = jnp.zeros((n, self.physics.nv), jnp.float32)
        # The clock starts anywhere in the cycle.
        time_s = jax.random.uniform(keys[2], (n,)) / self.gait.frequency_hz
        return PhysicsState(qpos, still, still), time_s

    def reset(self, rng: jax.Array) -> State:
        """[N, 2] keys to N states."""
        n = rng.shape[0]
        key, command_key, start_key = jax.random.split(rng[0], 3)
        physics, time_s = self._draw_start(start_key, n)
        zero = jnp.zeros(n)
        info = {
            "rng": key,
            "command": self._draw_command(command_key, n),
            "time_s": time_s,
            "steps": zero,
            "last_action": jnp.zeros((n, self.action_size)),
            "twist": jnp.zeros((n, 3)),
            "truncation": zero,
            "running": {name: zero for name in METRICS},
            "episode_done": zero,
            "episode_metrics": {name: zero for name in METRICS},
        }
        obs = self._observe(physics, info["command"], time_s)
        return State(physics, obs, zero, zero, {}, info)  # pyright: ignore[reportArgumentType]

    def _observe(self, physics: PhysicsState, command: jax.Array, time_s: jax.Array) -> jax.Array:
        return observe(self.gait, command, RobotState(physics.qpos, physics.qvel, time_s), jnp)

    def step(self, state: State, action: jax.Array) -> State:
        """N states and [N, J] corrections to N states."""
        gait, task, info = self.gait, self.task, state.info
        n = action.shape[0]
        rng, command_key, start_key, push_key, draw_key = jax.random.split(info["rng"], 5)
        action = jnp.clip(action, -1.0, 1.0)
        before: PhysicsState = state.pipeline_state  # pyright: ignore[reportAssignmentType]
        wanted = jnp.asarray(
            targets(gait, info["command"], action, RobotState(before.qpos, before.qvel, info["time_s"]), jnp),
            jnp.float32,
        )
        after, signals = self.physics.step_batch(jnp.zeros(n, jnp.int32), before, wanted, info["time_s"])
        broken = signals.nonfinite > 0
        qpos = jnp.where(broken[:, None], self._start, after.qpos)
        qvel = jnp.where(broken[:, None], 0.0, jnp.clip(after.qvel, -100.0, 100.0))
        warm = jnp.where(broken[:, None], 0.0, after.qacc_warmstart)
        time_s = info["time_s"] + self._dt

        down_b = rotate_back(qpos[:, 3:7], jnp.array([0.0, 0.0, -1.0]) + jnp.zeros((n, 3)))
        fallen = broken | (qpos[:, 2] < gait.fall_height_m) | (down_b[:, 2] > -0.5)
        now = RobotState(qpos, qvel, time_s)
        base = base_motion(now, jnp)
        share = self._dt / task.average_s
        twist = (1 - share) * info["twist"] + share * jnp.stack([base.forward, base.left, qvel[:, 5]], -1)
        reward, errors = self._reward(now, base, twist, down_b, wanted, action, info)
        reward = jnp.where(fallen, -1.0, reward)

        steps = info["steps"] + 1
        timed_out = ~fallen & (steps * self._dt >= task.episode_s)
        done = fallen | timed_out
        running = {name: info["running"][name] + errors[name] * self._dt / task.episode_s for name in errors}
        running |= {
            "fallen": fallen.astype(jnp.float32),
            "length": steps,
            "sum_reward": info["running"]["sum_reward"] + reward,
        }
        finished = dict(running)
        for name in errors:  # means over the time lived
            finished[name] = running[name] * task.episode_s / (steps * self._dt)

        draw = jax.random.uniform(draw_key, (n, 2))
        command = jnp.where(
            (done | (draw[:, 0] < self._dt / task.command_s))[:, None],
            self._draw_command(command_key, n),
            info["command"],
        )
        push = jax.random.uniform(push_key, (n, 2), minval=-1.0, maxval=1.0) * task.push_share * gait.max_linear_m_s
        pushed = (draw[:, 1] < self._dt / task.push_s).astype(jnp.float32)[:, None]
        qvel = qvel.at[:, :2].add(pushed * push)
        fresh, fresh_time = self._draw_start(start_key, n)
        physics = jax.tree.map(
            lambda new, old: jnp.where(done[:, None], new, old), fresh, PhysicsState(qpos, qvel, warm)
        )
        time_s = jnp.where(done, fresh_time, time_s)
        info = {
            "rng": rng,
            "command": command,
            "time_s": time_s,
            "steps": jnp.where(done, 0.0, steps),
            "last_action": jnp.where(done[:, None], 0.0, action),
            "twist": jnp.where(done[:, None], 0.0, twist),
            "truncation": timed_out.astype(jnp.float32),
            "running": {name: jnp.where(done, 0.0, value) for name, value in running.items()},
            "episode_done": done.astype(jnp.float32),
            "episode_metrics": {
                name: jnp.where(done, value, info["episode_metrics"][name]) for name, value in finished.items()
            },
        }
        return state.replace(
            pipeline_state=physics,
            obs=self._observe(physics, command, time_s),
            reward=reward,
            done=done.astype(jnp.float32),
            info=info,
        )

    def _reward(self, now, base, twist, down_b, wanted, action, info) -> tuple[jax.Array, dict[str, jax.Array]]:
        """[N] reward of a step, and the tracking errors [N] that are logged; the twist counts as averaged."""
        gait, task, command = self.gait, self.task, info["command"]
        qpos, qvel = now.qpos, now.qvel
        forward, left, turn = twist[:, 0], twist[:, 1], twist[:, 2]
        scale_v, scale_w = 0.5 * gait.max_linear_m_s, 0.5 * gait.max_angular_rad_s
        off = ((forward - command[:, 0]) ** 2 + left**2) / scale_v**2
        spin = ((turn - command[:, 1]) / scale_w) ** 2
        joints = qpos[:, 7 + gait.joint_index]
        speeds = qvel[:, 6 + gait.joint_index]
        offsets = joints - jnp.asarray(gait.home)
        reference = gait.reference(phase_at(gait, now.time_s), command, base, jnp)
        follow = jnp.exp(-10.0 * jnp.mean((offsets - reference)[:, np.asarray(gait.tracked)] ** 2, -1))
        limits = jnp.asarray(gait.torque_nm)
        torque = gait.servo.stiffness * (wanted - joints) - gait.servo.damping * speeds
        standing = (jnp.abs(command).sum(-1) == 0).astype(jnp.float32)
        reward = (
            task.forward_weight * jnp.exp(-off)
            + task.turn_weight * jnp.exp(-spin)
            + task.reference_weight * follow
            + task.upright_weight * jnp.exp(-5.0 * (down_b[:, :2] ** 2).sum(-1))
            + task.alive_weight
            - task.vertical_weight * jnp.minimum(qvel[:, 2] ** 2 + 0.05 * (qvel[:, 3:5] ** 2).sum(-1), 4.0)
            - task.smooth_weight * jnp.mean((action - info["last_action"]) ** 2, -1)
            - task.torque_weight * jnp.mean((jnp.clip(torque, -limits, limits) / limits) ** 2, -1)
            - task.still_weight * standing * jnp.mean(offsets**2, -1)
        )
        errors = {
            "forward_error_m_s": jnp.abs(forward - command[:, 0]),
            "turn_error_rad_s": jnp.abs(turn - command[:, 1]),
        }
        return reward * self._dt * 10.0, errors


def export(parts: ppo.PPOParts, learner: ppo.PPOState) -> Network:
    """The deterministic policy of a learner as a `Network`."""
    layers = learner.params.policy["params"]  # type: ignore[index]
    names = sorted(layers, key=lambda name: int(name.rsplit("_", 1)[1]))
    weights = [(np.asarray(layers[name]["kernel"]), np.asarray(layers[name]["bias"])) for name in names]
    kernel, bias = weights[-1]
    # The second half of the outputs is the spread of the exploration.
    weights[-1] = kernel[:, : kernel.shape[1] // 2], bias[: len(bias) // 2]
    seen = learner.normalizer_params
    return Network(np.asarray(seen.mean), np.asarray(seen.std), tuple(weights))


class GaitCallbacks:
    """Prints a line per log interval, exports the network, stops at the deadline."""

    def __init__(self, robot: str, out: Path, deadline: float, parts: ppo.PPOParts):
        self._robot, self._out, self._deadline, self._parts = robot, out, deadline, parts
        self._began = time.perf_counter()
        self.finished = False

    def restore(self, template: Snapshot) -> Snapshot | None:
        """Begins at the scripted gait: corrections near 0, explored with a deviation of 0.26 before tanh."""
        learner: ppo.PPOState = template.learner
        layers = dict(learner.params.policy["params"])  # type: ignore[index]
        last = max(layers, key=lambda name: int(name.rsplit("_", 1)[1]))
        kernel, bias = layers[last]["kernel"], layers[last]["bias"]
        spread = jnp.where(jnp.arange(len(bias)) < len(bias) // 2, 0.0, -1.2)
        layers[last] = {"kernel": 0.05 * kernel, "bias": bias + spread}
        params = learner.params.replace(policy={"params": layers})  # type: ignore[attr-defined]
        return dataclasses.replace(template, learner=learner.replace(params=params))  # type: ignore[attr-defined]

    def should_stop(self) -> bool:
        """True after the deadline."""
        return time.perf_counter() > self._deadline

    def on_start(self, snapshot: Snapshot, total_steps: int) -> None:
        """Says what is about to happen."""
        del snapshot
        print(f"{self._robot}: compiling; at most {total_steps:,} steps, {self._left():.0f} s left", flush=True)

    def _left(self) -> float:
        return max(self._deadline - time.perf_counter(), 0.0)

    def on_update(self, env_steps: int) -> None:
        """Nothing."""

    def on_log(self, env_steps: int, metrics: dict[str, float]) -> None:
        """One line."""
        words = [f"{name} {metrics.get(f'episode/{name}', float('nan')):.3f}" for name in METRICS]
        print(
            f"{self._robot}: {time.perf_counter() - self._began:5.0f} s  {env_steps:>12,} steps  "
            f"{metrics['env_steps_per_s']:,.0f} steps/s  {'  '.join(words)}  "
            f"reward/step {metrics['loss/reward_per_step']:.3f}  {self._left():.0f} s left",
            flush=True,
        )

    def on_checkpoint(self, snapshot: Snapshot) -> None:
        """Exports the network."""
        self._out.mkdir(parents=True, exist_ok=True)
        save_network(export(self._parts, jax.device_get(snapshot.learner)), self._out / f"{self._robot}.npz")

    def on_diverged(self, before: Snapshot, update: Update) -> str:
        """Keeps the network from before."""
        del update
        self.on_checkpoint(before)
        return str(self._out)


def train_config(backend: str, num_envs: int | None, seed: int, num_timesteps: int, log_every: int) -> TrainConfig:
    """PPO's settings for gaits: those of navigation, with a larger first step and more passes on a CPU."""
    sizes: dict[str, Any] = dict(AUTO_PPO[backend])
    if num_envs:
        per_env = max(sizes["batch_size"] * sizes["num_minibatches"] // sizes["num_envs"], 1)
        sizes |= {"num_envs": num_envs, "batch_size": max(num_envs * per_env // sizes["num_minibatches"], 1)}
    settings = PPOConfig(
        **sizes,
        learning_rate_schedule="adaptive_kl",
        desired_kl=0.012,
        discounting=0.98,
        entropy_cost=4e-3,
        policy_hidden_layer_sizes=(256, 128),
        value_hidden_layer_sizes=(256, 256),
    )
    run = RunConfig(seed=seed, num_timesteps=num_timesteps, log_every_steps=log_every, checkpoint_every_steps=log_every)
    return TrainConfig(ppo=settings, run=run)


def train_gait(
    robot: str, backend: str, num_envs: int | None, seed: int, max_seconds: float, steps: int, log_every: int, out: Path
) -> dict[str, float]:
    """Trains one robot's correction; the metrics of the last log interval."""
    deadline = time.perf_counter() + max_seconds
    env = GaitEnv(get_gait(robot), backend)
    config = train_config(env.backend, num_envs, seed, steps, log_every)
    parts = ppo.make_parts(config.ppo, env.observation_size, env.action_size)
    callbacks = GaitCallbacks(robot, out, deadline, parts)
    print(f"{robot}: backend {env.backend}, {config.ppo.num_envs} environments", flush=True)
    return ppo.train(env, config, callbacks).metrics


def evaluate(robot: str, backend: str, network: Network | None, num_envs: int, seed: int) -> dict[str, float]:
    """Means over the first episode of every environment, with a network's corrections or with none."""
    env = GaitEnv(get_gait(robot), backend)

    def correct(observation: jax.Array) -> jax.Array:
        return jnp.zeros((num_envs, env.action_size)) if network is None else network(observation, jnp)

    reset, step = jax.jit(env.reset), jax.jit(lambda state: env.step(state, correct(state.obs)))
    state = reset(jax.random.split(jax.random.PRNGKey(seed), num_envs))
    first = {name: np.full(num_envs, np.nan) for name in METRICS}
    for _ in range(round(env.task.episode_s / 0.02)):
        state = step(state)
        ended = np.asarray(state.done) > 0
        for name, values in first.items():
            new = ended & np.isnan(values)
            values[new] = np.asarray(state.info["episode_metrics"][name])[new]
    return {name: float(values.mean()) for name, values in first.items()}


def _positive(kind: type) -> Callable[[str], Any]:
    def number(text: str) -> Any:
        if not kind(text) > 0:
            raise argparse.ArgumentTypeError(f"{text}, expected above 0")
        return kind(text)

    return number


def main(argv: Sequence[str] | None = None) -> int:
    """The command line."""
    made = argparse.ArgumentParser(
        prog="python -m train.gait", description="Trains the network that corrects a legged robot's scripted gait."
    )
    made.add_argument("--robot", nargs="+", choices=ROBOTS, required=True, help="one after the other")
    made.add_argument(
        "--backend", default="auto", choices=("auto", "warp", "jax", "native"), help="physics: warp, jax, native, auto"
    )
    made.add_argument("--num-envs", type=_positive(int), help="environments stepped together (default: by backend)")
    made.add_argument("--seed", type=int, default=0)
    made.add_argument(
        "--max-seconds", type=_positive(float), nargs="+", default=[3600.0], help="per robot, compiling included"
    )
    made.add_argument("--steps", type=_positive(int), default=1_000_000_000, help="environment steps at most")
    made.add_argument("--log-every", type=_positive(int), help="environment steps between two lines and exports")
    made.add_argument("--out", type=Path, default=Path("runs/gait"))
    made.add_argument(
        "--evaluate", type=Path, help="train nothing: compare the script with OUT/<robot>.npz of this OUT"
    )
    args = made.parse_args(argv)
    missing = [robot for robot in args.robot if args.evaluate and not (args.evaluate / f"{robot}.npz").is_file()]
    if missing:
        made.error(f"--evaluate {args.evaluate}: holds no {missing[0]}.npz; train it first (--out)")
    try:
        backend = resolve_backend(args.backend)
    except ValueError as error:
        made.error(str(error))
    if args.evaluate:
        for robot in args.robot:
            networks = {"script": None, "network": load_network(args.evaluate / f"{robot}.npz")}
            for label, network in networks.items():
                means = evaluate(robot, backend, network, args.num_envs or 64, args.seed)
                print(f"{robot}, {label}: " + "  ".join(f"{name} {value:.3f}" for name, value in means.items()))
        return 0
    log_every = args.log_every or (2_000_000 if backend == "warp" else 50_000)
    seconds = args.max_seconds * len(args.robot) if len(args.max_seconds) == 1 else args.max_seconds
    if len(seconds) != len(args.robot):
        made.error(f"--max-seconds has {len(seconds)} values, expected 1 or one per robot ({len(args.robot)})")
    for robot, limit in zip(args.robot, seconds, strict=True):
        train_gait(robot, backend, args.num_envs, args.seed, limit, args.steps, log_every, args.out)
    return 0


if __name__ == "__main__":
    raise SystemExit(main())
