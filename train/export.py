"""Run `python -m train.export RUN_DIR -o policy.onnx`: write a run's policy as an ONNX file that describes itself."""

import dataclasses
import functools
import sys
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import Annotated, Any

import jax
import jax.numpy as jnp
import numpy as np
import pyarrow.compute as pc

from interactive_nav.interop.onnx_file import convert
from interactive_nav.physics import compiler_options
from interactive_nav.sensing.description import describe, inputs_of, twist_matrix
from interactive_nav.task.rollout import PolicyFn, episode_keys
from interactive_nav.task.wrappers import AutoResetEnv
from interactive_nav_common.commands import Command, Words, option, parse, word
from interactive_nav_common.errors import ConfigError, reports_errors
from interactive_nav_common.files import whole_file, writing
from interactive_nav_common.jobs.progress import SafeConsole
from interactive_nav_common.rows import read_rows
from interactive_nav_common.versions import versions
from train.config import EnvConfig, TrainConfig
from train.learners.memory import lost
from train.learners.networks import PIXELS
from train.runs.checkpoint import CheckpointMeta
from train.runs.run import build_env, config_to_play
from train.runs.run_folder import RunFolder
from train.scoring import LEARNED, SEED
from train.scoring.evaluation import load_policy
from train.scoring.rows import SCORES
from train.scoring.session import ROWS

OBSERVATIONS, ENVS = 1000, 20
"""Recorded for the comparison with JAX, and the environments that they come from."""


class Export(Command):
    """Export the policy of a run as an ONNX file."""

    run: Annotated[Path, *word("RUN_DIR")]
    """Run folder that `python -m train` wrote."""
    out: Annotated[Path, option("-o", metavar="FILE.onnx")]
    """ONNX file to write."""
    checkpoint: Annotated[str, option(metavar="best|last|STEPS")] = "best"
    """Checkpoint to export."""
    settings: Words = ()
    """Override environment settings, such as env.scenes, the homes in which observations are recorded."""


def outputs_of(env: Any, policy: PolicyFn, names: Sequence[str], *inputs: jax.Array) -> tuple[jax.Array, ...]:
    """Return actions and commands [B, A], and with a base that takes one its twist [B, 2], of inputs by their names."""
    observation = dict(zip(names, inputs, strict=True))
    state = [observation.pop(name) for name in names if not name.startswith(PIXELS)]
    vector = {"state": jnp.concatenate(state, -1)} if state else {}
    action = policy({**vector, **observation} if observation else vector["state"], jax.random.PRNGKey(0))
    command = env.robot.command(action, jnp)
    twist = [command @ jnp.asarray(twist_matrix(env.robot).T, jnp.float32)] if env.robot.twist else []
    return action, command, *twist


def record(env: Any, policy: PolicyFn) -> Any:
    """Return observations [N, ...] of a policy that drives in the environment's scenes."""
    batched, key = AutoResetEnv(env), jax.random.PRNGKey(0)

    def step(state: Any, _: None) -> tuple[Any, Any]:
        return batched.step(state, policy(state.obs, key)), state.obs

    def play(keys: jax.Array) -> Any:
        return jax.lax.scan(step, batched.reset(keys), None, length=OBSERVATIONS // ENVS)[1]

    obs = jax.jit(play, compiler_options=compiler_options())(episode_keys(SEED, ENVS))
    return jax.tree.map(lambda x: np.asarray(x).reshape(-1, *x.shape[2:]), obs)


def convert_policy(env: Any, policy: PolicyFn, observations: Any, about: Mapping[str, Any]) -> bytes:
    """Return a policy as an ONNX model with its description, compared over observations [N, ...]; see `convert`."""
    inputs = inputs_of(env, observations)
    with jax.default_matmul_precision("highest"):
        actions = np.asarray(jax.jit(policy)(observations, jax.random.PRNGKey(0)))
    expected = {"action": actions, "command": env.robot.command(actions)}
    if env.robot.twist:
        expected["twist"] = expected["command"] @ twist_matrix(env.robot).T
    return convert(functools.partial(outputs_of, env, policy, list(inputs)), inputs, expected, about)


def describe_policy(folder: RunFolder, config: TrainConfig, meta: CheckpointMeta) -> dict[str, Any]:
    """Describe a checkpoint: where it comes from and its scores; those of `train.evaluate` too, where it has played."""
    about: dict[str, Any] = {"run": config.run.name, "algorithm": config.algorithm, "env_steps": meta.env_steps}
    about |= {"trained_in": list(meta.scenes), "train_score": {config.run.best_metric: meta.score}}
    about |= {"train_commit": folder.origin()["commit"], "export_commit": versions()["commit"]}
    path = folder.path / ROWS
    if path.is_file():
        rows = read_rows([path])
        rows = rows.filter((pc.field("policy") == LEARNED) & (pc.field("checkpoint_steps") == meta.env_steps))
        if len(rows):
            scores = {name: pc.mean(rows[name].cast("float64")).as_py() for name in SCORES}  # type: ignore[attr-defined]
            scenes = sorted(set(rows["scene"].to_pylist()))
            about["evaluation"] = {"episodes": len(rows), "scenes": scenes, **scores}
    return about


@reports_errors("train.export")
def main(argv: Sequence[str] | None = None, build_env: Callable[[EnvConfig], Any] = build_env) -> int:
    arguments, console = parse(Export, "python -m train.export", argv), SafeConsole()
    if arguments.out.suffix != ".onnx":
        raise ConfigError(f"--out is {str(arguments.out)!r}, expected a file that ends in .onnx")
    folder = RunFolder(arguments.run)
    config = config_to_play(folder, ["env.backend=native", *arguments.settings], None, console)
    if config.network.memory != "none":
        raise lost("an ONNX file")
    config = dataclasses.replace(config, network=dataclasses.replace(config.network, compute_dtype="float32"))
    env = build_env(config.env)
    policy, meta = load_policy(folder, config, env, arguments.checkpoint, deterministic=True)
    about = {**describe(env), "policy": describe_policy(folder, config, meta)}
    content = convert_policy(env, policy, record(env, policy), about)
    with writing(arguments.out, "choose another --out"), whole_file(arguments.out) as partial:
        partial.write_bytes(content)
    text = f"{arguments.out}: {config.algorithm}, {meta.env_steps:,} steps; as JAX over {OBSERVATIONS:,} observations"
    console.print(text)
    return 0


if __name__ == "__main__":
    sys.exit(main())
