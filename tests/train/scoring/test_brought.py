"""Policies that users bring: the rows that the same law gives inside, whatever arrays they return; mistakes."""

from __future__ import annotations

import re
import sys
from pathlib import Path
from types import SimpleNamespace

import jax
import jax.numpy as jnp
import numpy as np
import pyarrow.parquet as pq
import pytest

from interactive_nav.task.rollout import episode_keys
from interactive_nav_common.errors import ConfigError
from tests.train.toy_env import ToyEnv
from tests.train.toy_run import build_toy
from train import evaluate
from train.scoring.brought import BroughtPolicy, _on_host, describe_env, named
from train.scoring.evaluation import BatchPlayer
from train.scoring.policies import make_follower

KEYS = episode_keys(5, 8)

FOLLOWER = '''
import numpy as np

class Follower:
    """The follower's law, written out again."""

    def __init__(self, env):
        self.env, self.log = env, []

    def reset(self, episodes):
        self.log.append(("reset", episodes.tolist()))

    def __call__(self, obs, first):
        self.log.append(("act", len(first), bool(first.all()), bool(first.any())))
        x, y = obs["state"][:, self.env.state_parts["waypoints"]][:, 2:4].T
        bearing = np.arctan2(y, x)
        speed = np.where(abs(bearing) < np.pi / 3, 0.5 * np.cos(bearing), 0.0)
        turn = np.clip(4.0 * bearing, -2.0, 2.0)
        obs["state"][:] = np.nan  # its own copy
        return self.env.drive(speed, turn)

class Constant:
    def __init__(self, env):
        self.actions = np.array([0.5, 0.75])

    def __call__(self, obs, first):
        return np.tile(self.actions, (len(first), 1))

number = 3

def broken(env):
    raise RuntimeError("no weights here\\nsecond line")

def not_callable(env):
    return 7

def wrong_shape(env):
    return lambda obs, first: np.zeros((len(first), 3))

def no_return(env):
    return lambda obs, first: None

def no_numbers(env):
    return lambda obs, first: [["left", "right"]] * len(first)

def not_finite(env):
    def act(obs, first):
        actions = np.zeros((len(first), 2))
        actions[1, 0] = np.inf if not first.any() else 0
        return actions
    return act

def raises(env):
    def act(obs, first):
        return obs["stat"]
    return act
'''


@pytest.fixture(scope="module")
def env():
    return ToyEnv()


@pytest.fixture(scope="module")
def player(env):
    return BatchPlayer(env)


@pytest.fixture
def module(tmp_path, monkeypatch):
    (tmp_path / "my_policy.py").write_text(FOLLOWER)
    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr(sys, "path", list(sys.path))
    yield "my_policy"
    sys.modules.pop("my_policy", None)


def of(act, env, monkeypatch):
    """A policy whose factory returns `act`."""
    monkeypatch.setitem(sys.modules, "made_here", SimpleNamespace(make=lambda description: act))
    return BroughtPolicy("mine=made_here:make", env)


def test_the_followers_law_in_numpy_gives_the_followers_episodes(env, player, module):
    policy = BroughtPolicy("mine=my_policy:Follower", env)
    brought = player.play(policy, KEYS, record=8, batch=5)
    inside = player.play(make_follower(env), KEYS, record=8, batch=5)
    for name, values in inside.metrics.items():
        np.testing.assert_allclose(brought.metrics[name], values, rtol=1e-4, err_msg=name)
    np.testing.assert_allclose(brought.paths.robot_xy_w, inside.paths.robot_xy_w, atol=1e-4)
    # One reset a batch, before its first step; the batch stays as large though the native backend's shrinks.
    log = policy._act.log
    begins = [i for i, entry in enumerate(log) if entry[0] == "reset"]
    assert [log[i][1] for i in begins] == [[0, 1, 2, 3, 4], [5, 6, 7, 8, 9]]
    assert all(log[i + 1] == ("act", 5, True, True) for i in begins)
    assert {entry[1:] for i, entry in enumerate(log) if entry[0] == "act" and i - 1 not in begins} == {
        (5, False, False)
    }


def test_constant_actions_go_where_a_hand_stepped_environment_goes(env, player, module):
    played = player.play(BroughtPolicy("mine=my_policy:Constant", env), KEYS[:2], record=2)
    step = jax.jit(env.step)
    for i in range(2):
        state = env.reset(KEYS[i])
        track = [np.asarray(state.info["nav"].robot_pos_w[:2])]
        while not state.done:
            state = step(state, jnp.array([0.5, 0.75]))
            track.append(np.asarray(state.info["nav"].robot_pos_w[:2]))
        assert played.metrics["episode_steps"][i] == len(track) - 1
        np.testing.assert_allclose(played.paths.robot_xy_w[i, : len(track)], track, atol=1e-5)


def test_jax_arrays_play_as_numpy_does(env, player, module, monkeypatch):
    """The goal lies at 20 and 21 of the vector: a law that turns towards it."""
    law = jax.jit(lambda s: jnp.stack([s[:, 20] - s[:, 21], s[:, 20] + s[:, 21]], 1) / 3.0)
    as_jax = player.play(of(lambda obs, first: law(obs["state"]), env, monkeypatch), KEYS)

    def in_numpy(obs, first):
        x, y = obs["state"][:, 20], obs["state"][:, 21]
        return np.stack([x - y, x + y], 1).astype(np.float64) / 3.0

    as_numpy = player.play(of(in_numpy, env, monkeypatch), KEYS)
    np.testing.assert_allclose(as_jax.metrics["robot_path_m"], as_numpy.metrics["robot_path_m"], rtol=1e-4)
    assert as_jax.metrics["success"].sum() > 4


def test_torch_tensors_with_a_gradient(env, player, monkeypatch):
    torch = pytest.importorskip("torch")
    weights = torch.zeros(29, 2, requires_grad=True)
    of_torch = of(lambda obs, first: torch.from_numpy(obs["state"]) @ weights + 0.5, env, monkeypatch)
    of_numpy = of(lambda obs, first: np.full((len(first), 2), 0.5), env, monkeypatch)
    paths = [player.play(policy, KEYS[:2]).metrics["robot_path_m"] for policy in (of_torch, of_numpy)]
    np.testing.assert_array_equal(*paths)


def test_tensors_leave_their_graph_and_device_first():
    """As PyTorch's do, which is no dependency here: NumPy takes them only detached and on the CPU."""

    class Tensor:
        done = ()

        def detach(self):
            self.done = (*self.done, "detached")
            return self

        def cpu(self):
            self.done = (*self.done, "cpu")
            return self

        def __array__(self, *arguments, **keywords):
            assert self.done == ("detached", "cpu")
            return np.array([[0.25]])

    assert _on_host(Tensor()).tolist() == [[0.25]]


def test_what_a_factory_is_told(env):
    description = describe_env(env)
    assert description.robot == "turtlebot" and description.scenes == ("plane",)
    assert {name: (x.shape, x.dtype) for name, x in description.observations.items()} == {
        "state": ((29,), np.dtype(np.float32))
    }
    assert description.state_parts == {"waypoints": slice(0, 20), "goal": slice(20, 23), "velocity": slice(23, 29)}
    assert (description.action_size, description.control_dt_s) == (2, 0.1)
    # 0.2 m/s with wheels of 0.0352 m; -1 is -12.5 rad/s, 1 is 25 rad/s.
    straight = description.drive(np.array([0.2]), np.array([0.0]))
    np.testing.assert_allclose(straight, [[2 * (0.2 / 0.0352 + 12.5) / 37.5 - 1] * 2], rtol=1e-5)


def test_the_pages_example_arrives(env, player, tmp_path):
    page = Path(__file__).parents[3] / "docs" / "benchmark-your-policy.md"
    (code,) = re.findall(r"```python\n(.*?)```", page.read_text(encoding="utf-8"), re.DOTALL)
    assert len(code.splitlines()) <= 25
    (tmp_path / "of_page.py").write_text(code)
    played = player.play(BroughtPolicy(f"mine={tmp_path}/of_page.py:Seeker", env), KEYS)
    assert played.metrics["success"].all()


@pytest.mark.parametrize(
    ("word", "expected"),
    [
        ("a.b:make", "a.b:make=a.b:make"),
        ("mine=a:make", "mine=a:make"),
        ("some/where/mine.py:Make", "mine:Make=some/where/mine.py:Make"),
    ],
)
def test_names(word, expected):
    assert named(word) == expected


@pytest.mark.parametrize("word", ["make", "a:", ":make", "a:1x", "ran dom=a:b", "namo:2=a:b", "follower=a:b", "=a:b"])
def test_words_that_name_no_policy(word):
    with pytest.raises(ConfigError, match="--policy: "):
        named(word)


def test_rows_of_a_command(module, tmp_path):
    """With a built-in policy on the same episodes, and alone; a file's path does as well as a module's name."""
    words = ["--scenes", "plane", "--episodes", "6", "--record", "2", "--out"]
    rows = tmp_path / "rows.parquet"
    asked = ["--policies", "follower", "--policy", "mine=my_policy:Follower"]
    assert evaluate.main([*words, str(rows), *asked], build_env=build_toy) == 0
    table = pq.read_table(rows)
    frame = table.to_pydict()
    assert frame["policy"] == ["follower"] * 6 + ["mine"] * 6 and set(frame["algorithm"]) == {None}
    np.testing.assert_allclose(frame["ins_0.5"][6:], frame["ins_0.5"][:6], rtol=1e-4)
    assert np.load(rows.with_suffix(".npz"))["mine/robot_xy_w"].shape[0] == 2
    assert b"mine=my_policy:Follower" in table.schema.metadata[b"asked"]
    alone = tmp_path / "alone.parquet"
    path = str(tmp_path / "my_policy.py") + ":Follower"
    assert evaluate.main([*words, str(alone), "--policy", path], build_env=build_toy) == 0
    again = pq.read_table(alone).to_pydict()
    assert again["policy"] == ["my_policy:Follower"] * 6 and again["ins_0.5"] == frame["ins_0.5"][6:]


@pytest.mark.parametrize(
    ("words", "message"),
    [
        (
            ["nowhere:make"],
            "--policy: cannot import nowhere (ModuleNotFoundError: No module named 'nowhere'); expected",
        ),
        (["nowhere.py:make"], "--policy: cannot import nowhere.py (FileNotFoundError: "),
        (
            ["my_policy:folower"],
            "--policy: my_policy has no 'folower', did you mean 'Follower'?; expected one of its functions: "
            "Follower, Constant, broken, not_callable, ",
        ),
        (["my_policy:number"], "--policy: my_policy has 'number' of type int; expected one of its functions"),
        (["m=my_policy:broken"], "policy m: factory: raised RuntimeError: no weights here at my_policy.py:32"),
        (["m=my_policy:not_callable"], "policy m: its factory returned type int, expected a callable"),
        (["m=my_policy:wrong_shape"], "policy m: actions have shape (2, 3), expected (2, 2)"),
        (["m=my_policy:no_return"], "policy m: returned None at step 0, expected actions (2, 2); is there a return?"),
        (["m=my_policy:no_numbers"], "policy m: policy's actions: raised ValueError: could not convert string"),
        (["m=my_policy:not_finite"], "policy m: actions of episode 1 at step 1 are [inf  0.], expected finite numbers"),
        (["m=my_policy:raises"], "policy m: policy: raised KeyError: 'stat' at my_policy.py:55"),
        (["m=my_policy:raises", "m=my_policy:broken"], "--policy: name 'm' is taken, expected another one"),
    ],
)
def test_mistakes_are_one_line_and_exit_2(module, tmp_path, capsys, words, message):
    brought = [word for policy in words for word in ("--policy", policy)]
    asked = ["--scenes", "plane", "--episodes", "2", "--out", str(tmp_path / "rows.parquet"), *brought]
    assert evaluate.main(asked, build_env=build_toy) == 2
    (line,) = capsys.readouterr().err.splitlines()
    assert line.startswith("train.evaluate: ") and message in line
