"""`python -m docs.studies.policies.learners NAME...`: learners of other libraries beside ours, a row each.

Each learner trains a TurtleBot on short goals in one apartment, by the function of its example in `docs/examples`, with
`--num-envs` environments and 32 steps of each in a rollout. `ours` is `python -m train`'s PPO with the same network,
rollout and number of epochs. `env_steps_per_s` is the median over rollouts, learning included, without the first, which
compiles; `success` and `ins_0.5` are means over the episodes that ended in the last tenth of the steps.
"""

import argparse
import contextlib
import json
import math
import runpy
import statistics
import tempfile
import time
from collections.abc import Sequence
from pathlib import Path

import torch  # pyright: ignore[reportMissingImports]
from rich.console import Console

import interactive_nav
from benchmarks.steps_per_second import RESULTS, append_row, origin
from interactive_nav.interop.torch_bridge import TorchVectorEnv
from train import config_io
from train.runs.run import train_run

LEARNERS = {"cleanrl": "torch", "rsl_rl": "rsl-rl-lib", "skrl": "skrl", "sb3": "stable-baselines3"}
"""Names of examples -> the package whose version a row names."""
TASK = {"scenes": ["scenes_mjcf/apartment_0"], "episode_steps": 400, "max_goal_distance_m": 4.0}
ROLLOUT = 32
"""Steps of each environment between two updates."""


class Timed(TorchVectorEnv):
    """Environments that note when each step ended, and number and mean scores of the episodes that ended with it."""

    def __init__(self, *args, **kwargs):
        super().__init__(*args, **kwargs)
        self.times_s: list[float] = []
        self.scores: list[tuple[int, int, float, float]] = []

    def step(self, actions):
        obs, reward, terminated, truncated, info = super().step(actions)
        if info:
            ended = int((terminated | truncated).sum())
            success, ins = (float(info["episode"][name]) for name in ("success", "ins_0.5"))
            self.scores.append((len(self.times_s), ended, success, ins))
        self.times_s.append(time.perf_counter())
        return obs, reward, terminated, truncated, info


def means(rows: list[tuple[int, float, float]]) -> dict[str, float]:
    """Return scores from rows of episodes, mean success and mean INS; NaN without episodes."""
    episodes = sum(row[0] for row in rows)
    names = ("success", "ins_0.5")
    return {k: sum(r[0] * r[i] for r in rows) / episodes if episodes else math.nan for i, k in enumerate(names, 1)}


def of_example(name: str, backend: str, num_envs: int, iterations: int) -> dict[str, float]:
    """Train by an example's function; return rate and scores."""
    train = runpy.run_path(str(Path(__file__).parents[2] / "examples" / f"{name}_ppo.py"))["train"]
    env = interactive_nav.make("turtlebot", backend=backend, **TASK)
    envs = Timed(env, num_envs, final_obs=name in ("cleanrl", "sb3"))
    with tempfile.TemporaryDirectory() as folder, contextlib.chdir(folder):  # skrl writes where it is
        if name == "sb3":
            torch.set_num_threads(1)  # as the example does: its networks are on the CPU, and gain nothing from more
            train(envs, iterations * ROLLOUT * num_envs, n_steps=ROLLOUT)
        else:
            train(envs, iterations)
    rounds = envs.times_s[ROLLOUT - 1 :: ROLLOUT]
    rates = [ROLLOUT * num_envs / (b - a) for a, b in zip(rounds[1:], rounds[2:], strict=False)]
    last = [row[1:] for row in envs.scores if row[0] >= 0.9 * len(envs.times_s)]
    return {"env_steps_per_s": round(statistics.median(rates)), **means(last)}


def of_ours(backend: str, num_envs: int, iterations: int) -> dict[str, float]:
    """Train by `python -m train`; return rate and scores."""
    steps = iterations * ROLLOUT * num_envs
    ppo = {"num_envs": num_envs, "unroll_length": ROLLOUT, "batch_size": num_envs // 4, "num_minibatches": 4}
    ppo |= {"num_updates_per_batch": 4, "learning_rate": 1e-3, "entropy_cost": 0.0}
    ppo |= {"policy_hidden_layer_sizes": [64, 64], "value_hidden_layer_sizes": [64, 64]}
    with tempfile.TemporaryDirectory() as folder:
        run = {"num_timesteps": steps, "log_every_steps": 1, "checkpoint_every_steps": steps}
        run |= {"out_dir": folder, "name": "ours", "tensorboard": False}
        words = [f"env.backend={backend}"]
        for part, values in (("env", TASK), ("ppo", ppo), ("run", run)):
            words += [f"{part}.{key}={json.dumps(value)}" for key, value in values.items()]
        _, run_folder, _ = train_run(config_io.load_config("turtlebot_ppo", words), Console(quiet=True))
        lines = [json.loads(line) for line in run_folder.metrics.read_text(encoding="utf-8").splitlines()]
    ended = [line for line in lines if line["env_steps"] > 0.9 * steps and line["episodes"]]
    last = [(line["episodes"], line["episode/success"], line["episode/ins_0.5"]) for line in ended]
    rate = statistics.median(line["env_steps_per_s"] for line in lines[1:])
    return {"env_steps_per_s": round(rate), **means(last)}


def main(argv: Sequence[str] | None = None) -> int:
    """Append a row for each learner."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("learners", nargs="+", choices=["ours", *LEARNERS])
    parser.add_argument("--backend", default="auto")
    parser.add_argument("--num-envs", type=int, default=4096)
    parser.add_argument("--iterations", type=int, default=50)
    parser.add_argument("--commit")
    parser.add_argument("--out", type=Path, default=RESULTS / "learners.jsonl")
    args = parser.parse_args(argv)
    for name in args.learners:
        packages = (LEARNERS.get(name, "brax"), "jax", "mujoco-mjx")
        row = {"learner": name, "num_envs": args.num_envs, "env_steps": args.iterations * ROLLOUT * args.num_envs}
        shape = (args.backend, args.num_envs, args.iterations)
        result = of_ours(*shape) if name == "ours" else of_example(name, *shape)
        append_row(args.out, row | result | origin(args.commit, packages))
    return 0


if __name__ == "__main__":
    raise SystemExit(main())
