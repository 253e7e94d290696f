"""Environments spread over two devices, and over two processes, step as on one."""

import os
import socket
import subprocess
import sys
from pathlib import Path

import jax
import numpy as np
import pytest

from interactive_nav.task.wrappers import ShardedEnv, start_distributed
from interactive_nav_common.errors import UserError
from tests.toys import write_room

ROOT = Path(__file__).parents[3]

ONE_PROCESS = """
import sys
import interactive_nav
import jax, jax.numpy as jnp, numpy as np
from interactive_nav.task.wrappers import ShardedEnv
from interactive_nav.task.wrappers import AutoResetEnv

env = AutoResetEnv(interactive_nav.make("turtlebot", [sys.argv[1]], backend="native", num_objects=1,
                                        sleep=False, episode_steps=6))
keys = jax.random.split(jax.random.PRNGKey(0), 4)
actions = jax.random.uniform(jax.random.PRNGKey(1), (8, 4, 2), minval=-1.0)

def run(env):
    state = jax.jit(env.reset)(keys)
    step, out = jax.jit(env.step), []
    for action in actions:
        state = step(state, action)
        out.append(np.asarray(state.obs))
    return state, np.stack(out)

sharded = ShardedEnv(env)
assert sharded.num_devices == 2
state, split = run(sharded)
assert len(state.obs.sharding.device_set) == 2 and state.obs.addressable_shards[0].data.shape == (2, 29)
np.testing.assert_allclose(split, run(env)[1], atol=1e-6)
kept = interactive_nav.make("turtlebot", sys.argv[1:3], backend="native", num_objects=1, scene_choice="slot")
index = jax.jit(ShardedEnv(AutoResetEnv(kept)).reset)(keys).info["nav"].scene_index
assert index.tolist() == [0, 1, 0, 1], index
print("equal")
"""

TWO_PROCESSES = """
import sys
import interactive_nav
from interactive_nav.task.wrappers import ShardedEnv, start_distributed
start_distributed(sys.argv[2], 2, int(sys.argv[3]))
import jax, jax.numpy as jnp
from interactive_nav.task.wrappers import AutoResetEnv

env = AutoResetEnv(interactive_nav.make("turtlebot", [sys.argv[1]], backend="native", num_objects=1,
                                        sleep=False))
sharded = ShardedEnv(env)
state = jax.jit(lambda: sharded.reset(jax.random.split(jax.random.PRNGKey(0), 4)))()
for _ in range(3):
    state = jax.jit(sharded.step)(state, jnp.zeros((4, 2)))
mean = jax.jit(lambda s: jnp.mean(s.info["nav"].memory["robot_path_m"]))(state)
print("devices", jax.device_count(), "local", jax.local_device_count(), "mean", round(float(mean), 6))
"""


def _environment(devices: int) -> dict[str, str]:
    flags = f"{os.environ['XLA_FLAGS']} --xla_force_host_platform_device_count={devices}"
    return {**os.environ, "XLA_FLAGS": flags, "JAX_PLATFORMS": "cpu", "PYTHONPATH": str(ROOT)}


@pytest.fixture(scope="module")
def scene(tmp_path_factory):
    return write_room(tmp_path_factory.mktemp("sharding") / "room", (4.0, 3.0), ())


@pytest.mark.heavy
@pytest.mark.slow
def test_two_devices_step_as_one(scene, room):
    done = subprocess.run(
        [sys.executable, "-c", ONE_PROCESS, str(scene), str(room)],
        cwd=ROOT,
        env=_environment(2),
        capture_output=True,
        text=True,
    )
    assert done.returncode == 0, done.stderr[-3000:]
    assert done.stdout.strip().endswith("equal")


@pytest.mark.heavy
@pytest.mark.slow
def test_two_processes_share_one_batch(scene):
    with socket.socket() as probe:
        probe.bind(("127.0.0.1", 0))
        address = f"127.0.0.1:{probe.getsockname()[1]}"
    command = [sys.executable, "-c", TWO_PROCESSES, str(scene), address]
    started = [
        subprocess.Popen([*command, str(i)], cwd=ROOT, env=_environment(1), stdout=subprocess.PIPE,
                         stderr=subprocess.PIPE, text=True)
        for i in range(2)
    ]  # fmt: skip
    results = [p.communicate(timeout=300) for p in started]
    lines = [out.strip().splitlines()[-1] if out.strip() else err[-3000:] for out, err in results]
    assert lines[0] == lines[1] and lines[0].startswith("devices 2 local 1 mean 0."), lines


class _Nothing:
    """Stands where an environment would: construction reads no more of it."""

    def reset(self, rng, slot):
        return rng

    def step(self, state, action):
        return state


class _Told:
    """Says which environments it is told that it has."""

    def reset(self, rng, slot):
        return slot

    def step(self, state, action):
        return state


TOLD = """
import jax
from interactive_nav.task.wrappers import ShardedEnv
from tests.interactive_nav.task.test_sharding import _Told
print(ShardedEnv(_Told()).reset(jax.random.split(jax.random.PRNGKey(0), 4)).tolist())
"""


def test_each_device_is_told_which_environments_it_has():
    done = subprocess.run([sys.executable, "-c", TOLD], cwd=ROOT, env=_environment(2), capture_output=True, text=True)
    assert done.stdout.strip().endswith("[0, 1, 2, 3]"), done.stderr[-3000:]


def test_a_batch_that_does_not_divide_is_refused():
    sharded = ShardedEnv(_Nothing(), [jax.devices()[0]])  # pyright: ignore[reportArgumentType]
    keys = jax.random.split(jax.random.PRNGKey(0), 3)
    np.testing.assert_array_equal(sharded.reset(keys), keys)
    sharded.mesh = type("Mesh", (), {"size": 2})()
    with pytest.raises(UserError, match="3 environments over 2 devices, expected a multiple: take 2"):
        sharded.reset(keys)


def test_impossible_processes_are_refused():
    with pytest.raises(UserError, match="process_id is 2, expected 0 to 1"):
        start_distributed("localhost:1234", 2, 2)
    with pytest.raises(UserError, match="expected host:port"):
        start_distributed("localhost", 2, 0)
