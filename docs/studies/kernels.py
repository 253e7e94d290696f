"""What an environment step spends its time on, kernel by kernel, on a GPU: settings in, a table and JSON rows out.

    python -m docs.studies.kernels --scenes scenes_mjcf/alder scenes_mjcf/birch --num-envs 8192

Runs `AutoResetEnv.step`, or parts of it, under JAX's profiler, which sees Warp's kernels too, and adds up the device
time of each kernel. Two parts' difference is what lies between them: `--part simulation` less `observed` is drawing new
episodes. `--preset NAME` profiles PPO instead: `--part collect` acts for an update, `--part update` learns from it too.
`busy` is the share of the time between the first and the last kernel in which at least one ran: the rest is launching.
The kernels' row is appended to `benchmarks/results/kernels.jsonl.gz`.
"""

from __future__ import annotations

import collections
import re
import tempfile
import time
from pathlib import Path
from typing import Any

import jax
from rich.console import Console
from rich.table import Table

import interactive_nav
from benchmarks.steps_per_second import append_row, origin, random_driving, step_of
from docs.studies import command_line
from interactive_nav.task.wrappers import AutoResetEnv
from interactive_nav_common.errors import ConfigError
from train import config_io
from train.config import TrainConfig, resolve
from train.learners import ppo
from train.runs.run import build_env, num_envs

PARTS = (
    ("networks", r"gemm|cudnn|cutlass|nvjet|xmma|implicit_con|fprop|dgrad|wgrad|nchw|nhwc|conv2d|convolve"),
    ("rendering", r"render|bvh"),
    ("solver", r"solve|linesearch|cholesky|gradient|JTDA|update_constraint|zero_qfrc_constraint|mul_m"),
    ("collision", r"broadphase|narrowphase|ccd|collision|contact_match|contact_sort"),
    ("sleeping", r"sleep|wake|island"),
    ("constraint rows", r"efc|friction_dof|limit_|equality"),
    (
        "smooth dynamics",
        r"smooth|kinematics|com_|comvel|crb|_rne|cinert|cdof|gravity|geom_local|passive|implicit|derivative|"
        r"qfrc|actuator|next_|tendon|camlight|cacc|cvel|qM|xpos",
    ),
    ("copies", r"memcpy|memset|memtile"),
)
"""Parts of a step by what their kernels are called; the first that fits. XLA's own fusions are the rest."""


def part_of(kernel: str) -> str:
    """The part of a step that a kernel belongs to, by its name."""
    for part, pattern in PARTS:
        if re.search(pattern, kernel, re.IGNORECASE):
            return part
    return "task, observation, window, learner (XLA)"


def plain_name(kernel: str) -> str:
    """A kernel's name without Warp's hashes and XLA's numbers."""
    name = re.sub(r"(_[0-9a-f]{8})+(_cuda_kernel_(forward|backward))?$", "", kernel)
    return re.sub(r"[._]\d+$", "", name)


def busy_share(spans: list[tuple[float, float]]) -> float:
    """Share of the time from the first begin to the last end that intervals (begin, end) cover."""
    if not spans:
        return 0.0
    spans = sorted(spans)
    first = reached = spans[0][0]
    covered = 0.0
    for begin, end in spans:
        covered += max(0.0, end - max(begin, reached))
        reached = max(reached, end)
    return covered / max(reached - first, 1e-12)


def device_events(folder: Path) -> list[tuple[str, float, float]]:
    """(name, begin, end) in ns of every kernel and copy on the first GPU in a profile.

    Raises:
        ConfigError: the profile has no GPU in it.
    """
    found = []
    for path in folder.rglob("*.xplane.pb"):
        for plane in jax.profiler.ProfileData.from_file(str(path)).planes:
            if "GPU:0" not in plane.name:
                continue
            for line in plane.lines:
                if "Stream" not in line.name:
                    continue  # summaries by module or operation, which would count twice
                found += [(e.name, e.start_ns, e.start_ns + e.duration_ns) for e in line.events]
    if not found:
        raise ConfigError(f"{folder}: no kernels of a GPU in the profile; it needs an NVIDIA GPU and CUPTI")
    return found


def stepping(env: Any, num_envs: int, steps: int, part: str) -> tuple[Any, Any]:
    """A program of `steps` environment steps of random driving, (state, key) to (state, _), and its first state."""
    batch = AutoResetEnv(env)
    step = step_of(env, part, num_envs, batch)
    drive = random_driving(lambda state, action: (step(state, action), None), (num_envs, env.action_size), steps)
    return drive, jax.jit(batch.reset)(jax.random.split(jax.random.PRNGKey(0), num_envs))


def learning(config: TrainConfig, part: str) -> tuple[Any, Any, int, int]:
    """A program of one update of PPO, or of acting for one, its first state, environments, and steps of each."""
    env: Any = build_env(config.env)
    config, env = resolve(config, env.backend), AutoResetEnv(env)
    agent = ppo.make_agent(env, config)

    def program(state: Any, key: jax.Array) -> tuple[Any, Any]:
        learner, env_state = state
        if part == "collect":
            env_state, data, _ = ppo.collect(agent, env, learner, env_state, key)
            return (learner, env_state), data
        learner, env_state, done = ppo.update(agent, env, learner, env_state)
        return (learner, env_state), done.losses

    first = ppo.start(agent, env, seed=0)
    return program, (first.learner, first.env_state), num_envs(config), agent.steps_per_update // num_envs(config)


def profile(program: Any, state: Any, num_envs: int, steps: int) -> dict[str, Any]:
    """Device time by kernel of a program that takes `steps` steps in each environment: (state, key) to (state, _)."""
    program = jax.jit(program)
    for i in range(3):
        state, _ = jax.block_until_ready(program(state, jax.random.PRNGKey(i)))
    began = time.perf_counter()
    state, _ = jax.block_until_ready(program(state, jax.random.PRNGKey(8)))
    wall_s = time.perf_counter() - began
    with tempfile.TemporaryDirectory() as folder:
        with jax.profiler.trace(folder):
            jax.block_until_ready(program(state, jax.random.PRNGKey(9)))
        events = device_events(Path(folder))
    spent: collections.defaultdict[str, float] = collections.defaultdict(float)
    launched: dict[str, int] = collections.Counter()
    for name, begin, end in events:
        spent[plain_name(name)] += end - begin
        launched[plain_name(name)] += 1
    total = sum(spent.values())
    parts: collections.defaultdict[str, float] = collections.defaultdict(float)
    for name, ns in spent.items():
        parts[part_of(name)] += ns
    return {
        "num_envs": num_envs,
        "steps": steps,
        "wall_ms_per_step": round(wall_s / steps * 1e3, 3),
        "device_ms_per_step": round(total / steps / 1e6, 3),
        "launches_per_step": round(sum(launched.values()) / steps, 1),
        "busy": round(busy_share([(begin, end) for _, begin, end in events]), 4),
        "parts_ms": {k: round(v / steps / 1e6, 3) for k, v in sorted(parts.items(), key=lambda kv: -kv[1])},
        "kernels": [
            {"name": k, "part": part_of(k), "ms": round(v / steps / 1e6, 4), "launches": round(launched[k] / steps, 1)}
            for k, v in sorted(spent.items(), key=lambda kv: -kv[1])[:25]
        ],
    }


def main(argv: list[str] | None = None) -> int:
    """Measures, prints and appends a row."""
    parser = command_line(__doc__, "kernels", settings=True)
    parser.add_argument("--num-envs", type=int, default=8192)
    parser.add_argument(
        "--part", choices=("physics", "task", "observed", "simulation", "collect", "update"), default="simulation"
    )
    parser.add_argument("--steps", type=int, default=4, help="environment steps under the profiler")
    parser.add_argument("--preset", help="of `python -m train`, for `collect` and `update`: its scenes and sizes")
    parser.add_argument("--learner", nargs="*", default=[], metavar="KEY=VALUE", help="laid over the preset")
    args = parser.parse_args(argv)
    if (args.part in ("collect", "update")) != bool(args.preset):
        parser.error("--part collect and update need a --preset, and only they take one")
    row: dict[str, Any] = {"part": args.part}
    if args.preset:
        config = config_io.load_config(args.preset, args.learner)
        row |= {"preset": args.preset, "learner": args.learner, "scenes": list(config.env.scenes)}
        row |= profile(*learning(config, args.part))
    else:
        settings = dict(args.settings)
        row |= {"robot": args.robot, "scenes": args.scenes, "settings": settings}
        env = interactive_nav.make(args.robot, args.scenes, backend="warp", **settings)
        row |= profile(*stepping(env, args.num_envs, args.steps, args.part), args.num_envs, args.steps)
    row |= origin(args.commit)
    append_row(args.out, row, hidden=None)
    console = Console(width=120)
    table = Table("kernel", "part", "ms a step", "launches a step", title=f"{row['device_ms_per_step']} ms a step")
    for kernel in row["kernels"]:
        table.add_row(kernel["name"], kernel["part"], f"{kernel['ms']:.3f}", f"{kernel['launches']:.1f}")
    console.print(table)
    for part, ms in row["parts_ms"].items():
        console.print(f"{part}: {ms:.3f} ms, {ms / row['device_ms_per_step']:.0%}")
    console.print(f"GPU busy {row['busy']:.1%} of the time")
    return 0


if __name__ == "__main__":
    raise SystemExit(main())
