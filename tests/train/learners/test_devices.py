"""PPO on two devices learns what one device learns, and its checkpoints continue on either."""

import dataclasses
import functools
import os
import re
import signal
import subprocess
import sys
import time
from pathlib import Path
from typing import Any

import jax
import numpy as np
import pytest
from rich.console import Console

from interactive_nav.task.wrappers import ShardedEnv
from interactive_nav_common.errors import ConfigError
from interactive_nav_common.jobs.gpus import Gpu
from tests.train.learners.test_ppo import Recorder, copy_snapshot, make_config
from tests.train.runs.test_run import quiet
from tests.train.toy_env import batched
from tests.train.toy_pixels import SMALL, ToyPixels
from tests.train.toy_run import build_toy, toy_config
from train.config import SACConfig, TrainConfig, validate
from train.learners import ppo
from train.learners.algorithms import ALGORITHMS
from train.runs import processes
from train.runs.run import train_run

ROOT = Path(__file__).parents[3]
DEVICES = 2
EXCHANGED = re.compile(r"= (.*?) (all-gather|all-reduce|all-to-all|collective-permute)(?:-start)?\(")


def on_devices(config: TrainConfig, devices: int) -> TrainConfig:
    return dataclasses.replace(config, run=dataclasses.replace(config.run, devices=devices))


def same(mine: Any, theirs: Any) -> None:
    """An update moves weights by about 1e-3: sums differ in float32's rounding only."""
    jax.tree.map(lambda a, b: np.testing.assert_allclose(a, b, rtol=1e-5, atol=2e-6), mine, theirs)


def images_stay() -> None:
    """Two updates; the compiled program exchanges sums, of no more numbers than there are parameters."""
    config = dataclasses.replace(on_devices(make_config(2), DEVICES), network=SMALL)
    ended, text = [], ""
    for env in (batched(ToyPixels()), ShardedEnv(batched(ToyPixels()))):
        parts = ppo.make_agent(env, config)
        first = ppo.start(parts, env, seed=0)
        learner: Any = first.learner
        env_state: Any = first.env_state
        if isinstance(env, ShardedEnv):
            learner = jax.device_put(learner, env.replicated)
        update = jax.jit(functools.partial(ppo.update, parts, env))
        text = update.lower(learner, env_state).compile().as_text()
        for _ in range(2):
            learner, env_state, _ = update(learner, env_state)
        ended.append((learner, env_state.obs))
    same(*ended)
    exchanged = EXCHANGED.findall(text or "")
    assert exchanged and {kind for _, kind in exchanged} == {"all-reduce"}, exchanged


def checkpoints_continue(folder: Path) -> None:
    """Two updates on one number of devices and two on another, against one process that never stops to change."""
    for before, after in ((1, DEVICES), (DEVICES, 1)):
        out = folder / f"{before}-{after}"
        stopped, _, _ = train_run(toy_config(out, updates=2, devices=before), quiet(), build_env=build_toy)
        leaves = jax.tree.leaves(stopped.snapshot.env_state)
        assert {len(leaf.sharding.device_set) for leaf in leaves} == {before}
        straight = on_devices(toy_config(out, updates=4), after)
        single = jax.device_put((stopped.snapshot.learner, stopped.snapshot.env_state), jax.devices()[0])
        resumed = copy_snapshot(dataclasses.replace(stopped.snapshot, learner=single[0], env_state=single[1]))
        # On one device, in as many groups.
        expected = ALGORITHMS["ppo"].train(batched(), straight, Recorder(resumed)).snapshot
        result, _, _ = train_run(straight, quiet(), build_env=build_toy)
        assert result.completed and result.snapshot.env_steps == expected.env_steps == 2 * stopped.snapshot.env_steps
        same(result.snapshot.learner, expected.learner)


def train_toy(folder: Path, updates: int, gpus: int = 0, seed: int = 0) -> None:
    """Train on all devices of this process, or of one for each of so many GPUs, and save what was learned."""
    processes.find_gpus = lambda: [Gpu(str(i), 80.0) for i in range(gpus)]
    with processes.one_for_each_gpu(DEVICES, sys.orig_argv):
        config = toy_config(folder, updates, devices=DEVICES)
        config = dataclasses.replace(config, run=dataclasses.replace(config.run, seed=seed))
        result, _, _ = train_run(config, Console(), build_env=build_toy)
    if os.environ.get(processes.INDEX, "0") == "0":
        np.savez(folder / "learned.npz", *map(np.asarray, jax.tree.leaves(result.snapshot.learner)))


def lose_the_second_process() -> None:
    """Join two processes, of which the second ends with an error."""
    processes.find_gpus = lambda: [Gpu(str(i), 80.0) for i in range(2)]
    with processes.one_for_each_gpu(2, sys.orig_argv):
        if os.environ[processes.INDEX] == "1":
            raise RuntimeError("no memory statistics")


def start(call: str, devices: int, **variables: str) -> subprocess.Popen[str]:
    flags = f"{os.environ['XLA_FLAGS']} --xla_force_host_platform_device_count={devices}"
    return subprocess.Popen(
        [sys.executable, "-c", f"import interactive_nav\nfrom tests.train.learners import test_devices as t\nt.{call}"],
        cwd=ROOT,
        env={**os.environ, "XLA_FLAGS": flags, "JAX_PLATFORMS": "cpu", "PYTHONPATH": str(ROOT), **variables},
        stdout=subprocess.PIPE,
        stderr=subprocess.PIPE,
        text=True,
    )


def in_two_devices(call: str) -> None:
    process = start(call, DEVICES)
    _, errors = process.communicate(timeout=300)
    assert process.returncode == 0, errors[-3000:]


@pytest.mark.heavy
def test_two_processes_learn_as_one_and_one_continues_their_run(tmp_path):
    one, two = tmp_path / "one", tmp_path / "two"
    process = start(f"train_toy(t.Path({str(two)!r}), 3, gpus=2)", 1)
    printed, errors = process.communicate(timeout=300)
    assert process.returncode == 0, errors[-3000:]
    assert " ".join(printed.split()).count("done at 768 steps") == 1  # a long path breaks the line
    for updates in (3, 5):  # 5: each goes on from its checkpoint
        in_two_devices(f"train_toy(t.Path({str(one)!r}), {updates})")
        if updates == 5:
            in_two_devices(f"train_toy(t.Path({str(two)!r}), 5)")
        mine, theirs = (np.load(folder / "learned.npz") for folder in (one, two))
        same(dict(mine), dict(theirs))


@pytest.mark.heavy
def test_a_signal_to_one_of_two_processes_stops_both_and_an_error_of_one_ends_both(tmp_path):
    call = f"train_toy(t.Path({str(tmp_path)!r}), 100_000, gpus=2)"
    process = start(call, 1)
    metrics = next_file(tmp_path, "metrics.jsonl", process)
    process.send_signal(signal.SIGTERM)
    printed, errors = process.communicate(timeout=120)
    assert process.returncode == 0 and "stopped at" in printed, errors[-3000:]
    assert list(metrics.parent.glob("checkpoints/*"))
    process = start(call.replace("gpus=2", "gpus=2, seed=7"), 1)
    _, errors = process.communicate(timeout=120)
    assert process.returncode == 1 and "has run.seed = 0, this one 7" in errors
    assert "Check failure" not in errors and "another process" not in errors


@pytest.mark.heavy
def test_an_error_of_another_process_at_the_end_is_in_the_exit_code():
    process = start("lose_the_second_process()", 1)
    _, errors = process.communicate(timeout=120)
    assert process.returncode == 1 and "RuntimeError: no memory statistics" in errors
    assert "ConfigError: another process ended with an error, which it prints above" in errors


def next_file(folder: Path, name: str, process: subprocess.Popen[str]) -> Path:
    """Return a file with something in it, once the process has written it."""
    while process.poll() is None:
        if paths := [path for path in folder.rglob(name) if path.stat().st_size]:
            return paths[0]
        time.sleep(0.2)
    raise AssertionError(process.communicate())


@pytest.mark.heavy
def test_two_devices_learn_as_one_and_exchange_no_images():
    in_two_devices("images_stay()")


@pytest.mark.heavy
def test_checkpoints_continue_on_another_number_of_devices(tmp_path):
    in_two_devices(f"checkpoints_continue(t.Path({str(tmp_path)!r}))")


def test_sequences_are_shuffled_within_groups(monkeypatch):
    """Of 8 sequences in 2 groups, each of 2 minibatches takes 2 from 0 to 3 and 2 from 4 to 7; each is taken once."""
    config = make_config(1, num_envs=8, batch_size=4, num_minibatches=2, num_updates_per_batch=1)
    env = batched()
    parts = ppo.make_agent(env, on_devices(config, 2))
    first = ppo.start(parts, env, seed=0)
    _, data, _ = jax.jit(lambda s, e: ppo.collect(parts, env, s, e, jax.random.PRNGKey(3)))(
        first.learner, first.env_state
    )
    data = data._replace(reward=np.broadcast_to(np.arange(8.0)[:, None], data.reward.shape).astype(np.float32))

    def loss(params, normalizer_params, batch, key, **_):
        total = sum(leaf.sum() for leaf in jax.tree.leaves(params))
        return 0.0 * total, {"taken": batch.reward[:, 0], "kl_mean": 0.0}

    monkeypatch.setattr(ppo.ppo_losses, "compute_ppo_loss", loss)
    _, _, losses = ppo.learn(parts, first.learner, data, first.learner.normalizer_params, jax.random.PRNGKey(5))
    taken = np.asarray(losses["taken"])[0]
    assert taken.shape == (2, 4) and sorted(taken.ravel()) == list(range(8))
    assert ((taken < 4).sum(1) == 2).all() and (taken[:, :2] < 4).all()


def test_unequal_shares_are_refused():
    def refused(match: str, config: TrainConfig) -> None:
        with pytest.raises(ConfigError, match=match):
            validate(config)

    uneven = on_devices(make_config(1, num_envs=15, batch_size=15), 2)
    refused(r"ppo.num_envs is 15, expected a multiple of run.devices \(2\).*; take 14", uneven)
    refused(
        r"ppo.batch_size is 15, expected a multiple of run.devices \(2\)",
        on_devices(make_config(1, num_envs=10, batch_size=15), 2),
    )
    one = TrainConfig(env=make_config(1).env, algorithm="sac", sac=SACConfig())
    validate(one)
    refused("run.devices is 2, expected 1 with algorithm sac.*run.devices=1, or algorithm=ppo", on_devices(one, 2))


def test_more_devices_than_there_are_is_refused(tmp_path):
    number = len(jax.local_devices()) + 1
    config = toy_config(tmp_path / "runs", devices=number)
    config = dataclasses.replace(
        config, ppo=dataclasses.replace(config.ppo, num_envs=8 * number, batch_size=8 * number)
    )
    with pytest.raises(
        ConfigError, match=rf"run.devices is {number}, expected at most {number - 1}, the cpu devices here"
    ):
        train_run(config, quiet(), build_env=build_toy)
    assert not (tmp_path / "runs").exists()
