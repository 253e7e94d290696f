"""Environment steps per second of a scene, without and with learning: settings in, one JSON row a measurement out.

    python -m benchmarks.steps_per_second --backend warp --num-envs 4096 --mode simulation ppo

`simulation` drives random wheel commands through `AutoResetEnv.step`; new episodes are drawn as old ones
end. `ppo` trains with `python -m train`'s own code and a preset, and reads the rate that it logs, compiling
and checkpoints apart. Rows carry device, versions and commit, and are appended to
`benchmarks/results/steps_per_second.jsonl`.
"""

from __future__ import annotations

import argparse
import datetime
import importlib.metadata
import json
import os
import statistics
import subprocess
import tempfile
import time
from typing import Any

import jax
import jax.numpy as jnp
from rich.console import Console

import interactive_nav
from interactive_nav.physics import resolve_backend
from interactive_nav.wrappers import AutoResetEnv
from train import config_io
from train.run import train_run

PACKAGES = ("mujoco", "mujoco-mjx", "warp-lang", "jax", "brax")


def _versions() -> dict[str, str]:
    found = {}
    for name in PACKAGES:
        try:
            found[name] = importlib.metadata.version(name)
        except importlib.metadata.PackageNotFoundError:
            continue
    return found


def _commit() -> str:
    try:
        out = subprocess.run(["git", "rev-parse", "--short", "HEAD"], capture_output=True, text=True, check=True)
    except (OSError, subprocess.CalledProcessError):
        return "unknown"
    return out.stdout.strip()


def simulation(scenes: list[str], backend: str, num_envs: int, steps: int, settings: dict[str, Any]) -> dict[str, Any]:
    """Rate of random driving: chunks of 20 steps, each one compiled scan; the first chunk is not counted."""
    env = interactive_nav.make("turtlebot", scenes, backend=backend, **settings)
    batch = AutoResetEnv(env)
    chunk = 20

    def advance(state, key):
        def one(state, key):
            action = jax.random.uniform(key, (num_envs, env.action_size), minval=-1.0, maxval=1.0)
            state = batch.step(state, action)
            finished = state.info["episode_metrics"]
            ended = state.done > 0
            seen = {k: jnp.sum(jnp.where(ended, finished[k], 0.0)) for k in ("nonfinite", "overflow_steps")}
            return state, {**seen, "episodes": ended.sum()}

        return jax.lax.scan(one, state, jax.random.split(key, chunk))

    state = jax.jit(batch.reset)(jax.random.split(jax.random.PRNGKey(0), num_envs))
    clock = time.perf_counter()
    # Not donated: the first state may share buffers with constants.
    program = jax.jit(advance).lower(state, jax.random.PRNGKey(1)).compile()
    state, _ = jax.block_until_ready(program(state, jax.random.PRNGKey(1)))
    compile_s = time.perf_counter() - clock
    rates, totals = [], {"nonfinite": 0.0, "overflow_steps": 0.0, "episodes": 0.0}
    for i in range(max(1, steps // chunk)):
        clock = time.perf_counter()
        state, seen = jax.block_until_ready(program(state, jax.random.PRNGKey(2 + i)))
        rates.append(chunk * num_envs / (time.perf_counter() - clock))
        for name in totals:
            totals[name] += float(seen[name].sum())
    nav = state.info["nav"]
    physics = env.physics
    return {
        "env_steps_per_s": round(statistics.median(rates)),
        "compile_s": round(compile_s, 1),
        "steps": chunk * len(rates),
        **totals,
        "overflow_steps_running": int(nav.overflow_steps.sum()),
        "contacts_per_env": getattr(physics, "contacts_per_env", None),
        "constraints_per_env": getattr(physics, "constraints_per_env", None),
        "nv": physics.nv,
    }


def ppo(
    scenes: list[str], backend: str, num_envs: int, steps: int, settings: dict[str, Any], preset: str
) -> dict[str, Any]:
    """Rate of `python -m train` with a preset: median over its log lines."""
    with tempfile.TemporaryDirectory() as folder:
        overrides = [
            f"env.scenes=[{','.join(scenes)}]",
            f"env.backend={backend}",
            f"ppo.num_envs={num_envs}",
            f"run.num_timesteps={steps * num_envs}",
            "run.log_every_steps=1",
            f"run.checkpoint_every_steps={10 * steps * num_envs}",
            f"run.out_dir={folder}",
            "run.name=benchmark",
            "run.tensorboard=false",
            *(f"env.{k}={v}" for k, v in settings.items()),
        ]
        _, run_folder, _ = train_run(config_io.load(preset, overrides), Console(quiet=True))
        lines = [json.loads(line) for line in run_folder.metrics.read_text(encoding="utf-8").splitlines()]
    rates = [line["env_steps_per_s"] for line in lines[1:]] or [lines[0]["env_steps_per_s"]]
    last = lines[-1]
    return {
        "env_steps_per_s": round(statistics.median(rates)),
        "compile_s": round(last["compile_s"], 1),
        "steps": steps,
        "preset": preset,
        "episodes": sum(line["episodes"] for line in lines),
        "nonfinite": sum(line.get("episode/nonfinite", 0.0) * line["episodes"] for line in lines),
        "overflow_steps": sum(line.get("episode/overflow_steps", 0.0) * line["episodes"] for line in lines),
    }


def main() -> None:
    """Measures and appends rows."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--scenes", nargs="+", default=["scenes_mjcf/apartment_0"])
    parser.add_argument("--backend", default="auto")
    parser.add_argument("--num-envs", type=int, nargs="+", default=[64])
    parser.add_argument("--steps", type=int, default=200, help="control steps of every environment")
    parser.add_argument("--mode", nargs="+", choices=("simulation", "ppo"), default=["simulation"])
    parser.add_argument("--preset", default="turtlebot_ppo", help="of `python -m train`, for ppo")
    parser.add_argument("--set", nargs="*", default=[], metavar="key=value", help="environment settings")
    parser.add_argument("--commit", default=None, help="recorded in the row; default: git's HEAD")
    parser.add_argument("--out", default="benchmarks/results/steps_per_second.jsonl")
    args = parser.parse_args()
    settings = {k: json.loads(v) for k, v in (item.split("=", 1) for item in args.set)}
    device = jax.devices()[0]
    for num_envs in args.num_envs:
        for mode in args.mode:
            row: dict[str, Any] = {
                "mode": mode,
                "backend": resolve_backend(args.backend),
                "num_envs": num_envs,
                "scenes": args.scenes,
                "settings": settings,
                "device": device.device_kind if device.platform != "cpu" else f"cpu, {os.cpu_count()} cores",
                "versions": _versions(),
                "commit": args.commit or _commit(),
                "date": datetime.date.today().isoformat(),
            }
            measure = (args.scenes, args.backend, num_envs, args.steps, settings)
            row |= simulation(*measure) if mode == "simulation" else ppo(*measure, args.preset)
            with open(args.out, "a", encoding="utf-8") as out:
                out.write(json.dumps(row) + "\n")
            print(json.dumps(row), flush=True)


if __name__ == "__main__":
    main()
