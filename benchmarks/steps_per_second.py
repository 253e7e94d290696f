"""Measure the environment steps per second of a scene, without and with learning; write a JSON row per measurement.

    python -m benchmarks.steps_per_second --backend warp --num-envs 4096 --mode simulation train

`simulation` drives random wheel commands through `AutoResetEnv.step`; new episodes are drawn as old ones
end. `physics`, `task` and `observed` are the same with parts left out, for their shares of a step.
`train` trains with `python -m train`'s own code and a preset of any algorithm, and reads the rate that it
logs, compiling and checkpoints apart. Rows carry device, versions and commit, and are appended to
`benchmarks/results/steps_per_second.jsonl.gz`.
"""

import datetime
import functools
import gzip
import json
import os
import resource
import statistics
import sys
import tempfile
import time
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Annotated, Any, Literal

import jax
import jax.numpy as jnp
import numpy as np
from rich.console import Console

import interactive_nav
from interactive_nav.physics import resolve_backend
from interactive_nav.task.wrappers import AutoResetEnv, ShardedEnv
from interactive_nav.types import FAILURES
from interactive_nav_common.commands import Command, option, parse
from interactive_nav_common.config import AtLeastOne
from interactive_nav_common.errors import reports_errors
from interactive_nav_common.versions import commit, package_versions
from train import config_io
from train.runs.processes import one_for_each_gpu
from train.runs.run import train_run

RESULTS = Path("benchmarks/results")
SCENE = "scenes_mjcf/apartment_0"
PACKAGES = ("mujoco", "mujoco-mjx", "warp-lang", "jax", "brax")


def origin(commit_told: str | None = None, packages: Sequence[str] = PACKAGES) -> dict[str, Any]:
    """Return the columns of a row that say where it comes from: device, versions, commit and date."""
    device, found = jax.devices()[0], commit() or "unknown"
    return {
        "device": device.device_kind if device.platform != "cpu" else f"cpu, {os.cpu_count()} cores",
        "versions": package_versions(packages),
        "commit": commit_told or (found[:7] + ("+dirty" if found.endswith("+dirty") else "")),
        "date": datetime.date.today().isoformat(),
    }


def append_row(path: Path, row: dict[str, Any], hidden: Sequence[str] | None = ()) -> None:
    """Add a row to a file of JSON lines, or a packed one (.gz), and print it without the hidden columns (None: all)."""
    path.parent.mkdir(parents=True, exist_ok=True)
    with gzip.open(path, "at") if path.suffix == ".gz" else open(path, "a", encoding="utf-8") as out:
        out.write(json.dumps(row, separators=(",", ":")) + "\n")
    if hidden is not None:
        print(json.dumps({name: value for name, value in row.items() if name not in hidden}), flush=True)


def timed(call: Callable[..., Any], *arguments: Any) -> tuple[Any, float]:
    """Return the result of a call once it has been computed, and the seconds that it took."""
    began = time.perf_counter()
    out = jax.block_until_ready(call(*arguments))
    return out, time.perf_counter() - began


def random_driving(
    step: Callable[[Any, jax.Array], tuple[Any, Any]],
    shape: tuple[int, int],
    steps: int,
    low: float = -1.0,
    high: float = 1.0,
) -> Callable[[Any, jax.Array], tuple[Any, Any]]:
    """State and key to the state after `steps` steps of uniform actions, and what each step counted, stacked.

    `shape` is environments and numbers in an action, which lie between `low` and `high`.
    """

    def one(state: Any, key: jax.Array) -> tuple[Any, Any]:
        return step(state, jax.random.uniform(key, shape, minval=low, maxval=high))

    return lambda state, key: jax.lax.scan(one, state, jax.random.split(key, steps))


CHUNK = 20
"""Steps in one compiled scan."""


@functools.lru_cache(maxsize=1)
def _make(robot: str, scenes: tuple[str, ...], backend: str, settings: str):
    """Build the environment; keep it for the next mode, since the tables of many large scenes take a minute."""
    return interactive_nav.make(robot, scenes, backend=backend, **json.loads(settings))


def _peak_memory_mib() -> dict[str, float] | None:
    """Most memory that this process has held on its first GPU: JAX's arrays, and Warp's beside them."""
    device = jax.local_devices()[0]
    if device.platform == "cpu":
        return None
    stats = device.memory_stats() or {}
    peak = {"jax": stats.get("peak_bytes_in_use", 0) / 2**20}
    if "warp" in sys.modules:
        import warp

        peak["warp"] = warp.get_mempool_used_mem_high(f"cuda:{device.local_hardware_id or 0}") / 2**20
    return {name: round(mib) for name, mib in peak.items()}


def step_of(env: Any, part: str, num_envs: int, batch: Any = None) -> Any:
    """State and actions to state, with parts left out: see `simulation`; `batch` is what resets itself."""

    def step(state, action):
        if part == "physics":
            nav, command = state.info["nav"], jnp.asarray(env.robot.command(action, jnp), jnp.float32)
            physics, _ = jax.vmap(env.physics.step)(nav.scene_index, state.pipeline_state, command, jnp.zeros(num_envs))
            return state.replace(pipeline_state=physics.replace(control_steps=state.pipeline_state.control_steps))
        state = jax.vmap(env.advance)(state, action)
        return jax.vmap(env.observe)(state) if part == "observed" else state

    return (batch or AutoResetEnv(env)).step if part == "simulation" else step


def _counting(step: Any) -> Any:
    """Return a step that also returns the quantities to count."""

    def counted(state, action):
        state = step(state, action)
        finished = state.info["episode_metrics"]
        ended = state.info["episode_done"] > 0
        seen = {k: jnp.sum(jnp.where(ended, finished[k], 0.0)) for k in FAILURES}
        obs = jax.tree.leaves(state.obs)
        bad = sum(jnp.sum(~jnp.isfinite(x.astype(jnp.float32))) for x in obs)
        return state, {**seen, "episodes": ended.sum(), "nonfinite_observations": bad}

    return counted


def simulation(
    robot: str,
    scenes: list[str],
    backend: str,
    num_envs: int,
    steps: int,
    settings: dict[str, Any],
    part: str = "simulation",
    devices: int = 1,
) -> dict[str, Any]:
    """Rate of random driving: chunks of steps, each one compiled scan; the first chunk is not counted.

    `part` selects what runs: `physics` steps the backend alone, `task` adds scores and rewards, `observed` adds the
    observation, `simulation` adds new episodes. `make_s` builds the environment, `reset_s` compiles and draws the first
    episodes; `tables_mb` of homes are on the device, and the process has held at most `host_mib`.
    """
    env, make_s = timed(_make, robot, tuple(scenes), backend, json.dumps(settings))
    batch: Any = AutoResetEnv(env)
    if devices > 1:
        batch = ShardedEnv(batch, jax.devices()[:devices])
    step = _counting(step_of(env, part, num_envs, batch))
    keys = np.asarray(jax.vmap(jax.random.PRNGKey)(jnp.arange(2 + max(1, steps // CHUNK))))  # the same in each process
    state, reset_s = timed(jax.jit(lambda key: batch.reset(jax.random.split(key, num_envs))), keys[0])
    # Not donated: the first state may share buffers with constants.
    program = jax.jit(random_driving(step, (num_envs, env.action_size), CHUNK))
    (state, _), compile_s = timed(program, state, keys[1])
    rates, totals = [], {name: 0.0 for name in (*FAILURES, "episodes", "nonfinite_observations")}
    for key in keys[2:]:
        (state, seen), took_s = timed(program, state, key)
        rates.append(CHUNK * num_envs / took_s)
        for name in totals:
            totals[name] += float(seen[name].sum())
    nav, physics = state.info["nav"], env.physics
    window = getattr(physics, "window", None)
    rate, clock = statistics.median(rates), env.config
    return {
        "env_steps_per_s": round(rate),
        "physics_steps_per_s": round(rate * round(clock.control_dt_s / clock.sim_dt_s)),
        "make_s": round(make_s, 1),
        "reset_s": round(reset_s, 1),
        "compile_s": round(compile_s, 1),
        "tables_mb": round(sum(np.asarray(leaf).nbytes for leaf in jax.tree.leaves(env.tables)) / 1e6, 1),
        "host_mib": resource.getrusage(resource.RUSAGE_SELF).ru_maxrss // 1024,
        "steps": CHUNK * len(rates),
        "env_steps": CHUNK * len(rates) * num_envs,
        **totals,
        "running": {name: int(nav.memory[name].sum()) for name in FAILURES if name in nav.memory},
        "peak_memory_mib": _peak_memory_mib(),
        "nv": window.model.nv if window else physics.nv,
        **{name: getattr(physics, name, None) for name in ("active_dofs", "contacts_per_env", "constraints_per_env")},
        "movables": int(env.world.slots.occupied.sum(1).max()),
    }


def training(
    scenes: list[str],
    backend: str,
    num_envs: int,
    steps: int,
    settings: dict[str, Any],
    preset: str,
    learner: list[str],
) -> dict[str, Any]:
    """Rate of `python -m train` with a preset and `learner` words laid over it: median over its log lines."""
    algorithm = config_io.load_config(preset).algorithm
    with tempfile.TemporaryDirectory() as folder:
        overrides = [
            f"env.scenes=[{','.join(scenes)}]",
            f"env.backend={backend}",
            f"{algorithm}.num_envs={num_envs}",
            f"run.num_timesteps={steps * num_envs}",
            "run.log_every_steps=1",
            f"run.checkpoint_every_steps={10 * steps * num_envs}",
            f"run.out_dir={folder}",
            "run.name=benchmark",
            "run.tensorboard=false",
            *(f"env.{k}={json.dumps(v)}" for k, v in settings.items()),
            *learner,
        ]
        _, run_folder, _ = train_run(config_io.load_config(preset, overrides), Console(quiet=True))
        if jax.process_index():
            return {}  # process 0 has the run folder
        lines = [json.loads(line) for line in run_folder.metrics.read_text(encoding="utf-8").splitlines()]
    rates = [line["env_steps_per_s"] for line in lines[1:]] or [lines[0]["env_steps_per_s"]]
    last = lines[-1]
    return {
        "env_steps_per_s": round(statistics.median(rates)),
        "compile_s": round(last["compile_s"], 1),
        "steps": steps,
        "mode": algorithm,
        "preset": preset,
        "learner": learner,
        "episodes": sum(line["episodes"] for line in lines),
        "nonfinite": sum(line.get("episode/nonfinite", 0.0) * line["episodes"] for line in lines),
        "overflow_steps": sum(line.get("episode/overflow_steps", 0.0) * line["episodes"] for line in lines),
        "peak_memory_mib": _peak_memory_mib(),
    }


class Bench(Command):
    """Measure environment steps per second, and append a row for each measurement."""

    scenes: tuple[str, ...] = (SCENE,)
    """Scene folders."""
    robot: str = "turtlebot"
    """Name of the robot."""
    environment: Annotated[tuple[str, ...], option(name="set", metavar="KEY=JSON")] = ()
    """Environment setting to override, with its value as JSON."""
    backend: str = "auto"
    """Physics backend."""
    devices: AtLeastOne = 1
    """Number of devices to spread the environments over."""
    num_envs: tuple[AtLeastOne, ...] = (64,)
    """Numbers of environments to measure, one row each."""
    steps: AtLeastOne = 200
    """Number of control steps of every environment."""
    mode: tuple[Literal["physics", "task", "observed", "simulation", "train"], ...] = ("simulation",)
    """What to measure, one row each."""
    preset: str = "turtlebot_ppo"
    """Preset of `python -m train`, for --mode train."""
    learner: Annotated[tuple[str, ...], option(metavar="KEY=VALUE")] = ()
    """Settings that override the preset, for --mode train."""
    commit: Annotated[str | None, option()] = None
    """Commit to record in the row (default: that of git's HEAD)."""
    out: Path = RESULTS / "steps_per_second.jsonl.gz"
    """File to append rows to."""


@reports_errors("benchmarks.steps_per_second")
def main(argv: Sequence[str] | None = None) -> int:
    """Measure and append rows."""
    args = parse(Bench, "python -m benchmarks.steps_per_second", argv)
    settings = {name: json.loads(value) for name, _, value in (word.partition("=") for word in args.environment)}
    training_on = config_io.load_config(args.preset, args.learner).run.devices if "train" in args.mode else 1
    command = [sys.executable, "-m", "benchmarks.steps_per_second", *(sys.argv[1:] if argv is None else argv)]
    with one_for_each_gpu(max(args.devices, training_on), command):
        for num_envs in args.num_envs:
            for mode in args.mode:
                row = measured(args, mode, num_envs, settings)
                if jax.process_index() == 0:
                    append_row(args.out, row)
    return 0


def measured(args: Bench, mode: str, num_envs: int, settings: dict[str, Any]) -> dict[str, Any]:
    """Return a row."""
    row: dict[str, Any] = {
        "mode": mode,
        "backend": resolve_backend(args.backend),
        "num_envs": num_envs,
        "scenes": list(args.scenes),
        "settings": settings,
        **({"processes": jax.process_count()} if jax.process_count() > 1 else {}),
        **origin(args.commit),
    }
    measure = (list(args.scenes), args.backend, num_envs, args.steps, settings)
    if mode == "train":
        return row | training(*measure, args.preset, list(args.learner))
    row |= {"robot": args.robot, "devices": args.devices}
    return row | simulation(args.robot, *measure, part=mode, devices=args.devices)


if __name__ == "__main__":
    sys.exit(main())
