"""Gymnasium's view: its own checker, its own `SyncVectorEnv` as the oracle of ours, seeds, masks, autoreset modes."""

import subprocess
import sys
import warnings

import gymnasium
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from gymnasium.utils.env_checker import check_env
from gymnasium.vector import AutoresetMode, SyncVectorEnv

import interactive_nav
from interactive_nav.interop import gym_env
from interactive_nav.interop.gym_env import InteractiveNavVectorEnv, env_id
from interactive_nav.task.terms import EPISODE_METRICS, REWARD_TERMS
from interactive_nav_common.errors import ConfigError, UserError

ID = "InteractiveNav-TurtleBot-v0"
N, STEPS = 3, 9


@pytest.fixture(scope="module")
def settings(room):
    return {"scenes": [room], "backend": "native", "num_objects": 2, "episode_steps": 4}


@pytest.fixture(scope="module")
def single(settings):
    return gymnasium.make(ID, **settings)


def vector(settings, mode: AutoresetMode | str = AutoresetMode.SAME_STEP, **more):
    return gymnasium.make_vec(
        ID, num_envs=N, vectorization_mode="vector_entry_point", autoreset_mode=mode, **settings, **more
    )


@pytest.fixture(scope="module")
def same_step(settings):
    return vector(settings)


def actions(steps=STEPS):
    return np.random.default_rng(0).uniform(-1, 1, (steps, N, 2)).astype(np.float32)


def test_every_robot_is_registered_once():
    assert env_id("turtlebot") == ID
    ids = [env_id(robot) for robot in interactive_nav.robot_names()]
    assert len(set(ids)) == len(ids) and set(ids) <= set(gymnasium.registry)
    before = dict(gymnasium.registry)
    gym_env.register_envs()
    assert gymnasium.registry == before


def test_gymnasiums_checker_passes(single):
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        # The observation has no natural bounds, which the checker mentions; nothing else may be said.
        warnings.filterwarnings("ignore", message=".*A Box observation space (minimum|maximum) value is -?infinity.*")
        check_env(single.unwrapped, skip_render_check=True, skip_close_check=True)
    assert single.observation_space.shape == (29,) and single.action_space.shape == (2,)


def test_one_environment_equals_the_jax_environment(single):
    env = single.unwrapped.env
    # One after the other: interleaved, the native backend would start each step from the rounded state.
    first, _ = single.reset(seed=5)
    played = [single.step(action) for action in actions(4)[:, 0]]
    state = jax.jit(env.reset)(jnp.asarray(gym_env._key(np.random.default_rng(5))))
    np.testing.assert_array_equal(first, state.obs)
    step = jax.jit(env.step)
    for action, (obs, reward, terminated, truncated, info) in zip(actions(4)[:, 0], played, strict=True):
        state = step(state, action)
        np.testing.assert_array_equal(obs, state.obs)
        assert reward == float(state.reward)
        assert sum(info[name] for name in REWARD_TERMS) == pytest.approx(reward, abs=1e-6)
        assert not terminated and truncated == bool(state.done)
    assert truncated and {name: info[name] for name in EPISODE_METRICS} == {
        name: float(state.metrics[name]) for name in EPISODE_METRICS
    }


def assert_same(ours, theirs, where=""):
    """Equal infos: dictionaries, masks, arrays of objects, numbers to float32."""
    if isinstance(theirs, dict):
        assert set(ours) == set(theirs), where
        for name in theirs:
            assert_same(ours[name], theirs[name], f"{where}/{name}")
    elif theirs.dtype == object:
        assert [x is None for x in ours] == [x is None for x in theirs], where
        for a, b in zip(ours, theirs, strict=True):
            if b is not None:
                np.testing.assert_allclose(a, b, atol=1e-5, err_msg=where)
    else:
        assert (ours.shape, ours.dtype) == (theirs.shape, theirs.dtype), where
        np.testing.assert_allclose(ours, theirs, atol=1e-5, err_msg=where)


@pytest.mark.parametrize(
    "mode", [pytest.param(AutoresetMode.SAME_STEP, marks=pytest.mark.heavy), AutoresetMode.NEXT_STEP]
)
def test_the_batch_equals_gymnasiums_own_vector_of_single_environments(settings, single, same_step, mode):
    """Observations, rewards, ends, infos, final observations and new episodes, over two episode ends."""
    envs = same_step if mode is AutoresetMode.SAME_STEP else vector(settings, mode)
    # One compiled program for all: fresh wrappers share the first one's functions.
    base = single.unwrapped

    def clone():
        copy, copy.batch = (object.__new__(type(env)) for env in (base, base.batch))
        copy.__dict__.update({**base.__dict__, "batch": copy.batch, "_np_random": None})
        copy.batch.__dict__.update(base.batch.__dict__, _state=None, _np_random=None)
        return copy

    oracle = SyncVectorEnv([clone] * N, autoreset_mode=mode)
    assert envs.metadata["autoreset_mode"] is mode
    assert envs.observation_space == oracle.observation_space and envs.action_space == oracle.action_space
    ours, theirs = envs.reset(seed=7), oracle.reset(seed=7)
    np.testing.assert_allclose(ours[0], theirs[0], atol=1e-5)
    assert ours[1] == theirs[1] == {}
    ends = 0
    for action in actions():
        mine, want = envs.step(action), oracle.step(action)
        for a, b in zip(mine[:4], want[:4], strict=True):
            np.testing.assert_allclose(a, b, atol=1e-5)
        assert mine[2].dtype == mine[3].dtype == np.bool_
        assert_same(mine[4], want[4])
        ends += mine[3].sum() + mine[2].sum()
    assert ends >= N
    assert mine[0] in envs.observation_space


def test_seeds_decide_everything_that_follows(same_step):
    def play(seed):
        seen = [same_step.reset(seed=seed)[0]]
        seen += [same_step.step(action)[0] for action in actions()]
        return np.stack(seen)

    first, other, again = play(11), play(12), play(11)
    np.testing.assert_array_equal(first, again)
    np.testing.assert_array_equal(first[0, 1:], other[0, :-1])  # environment i of seed s is that of seed s + i
    as_list = same_step.reset(seed=[11, None, 13])[0]
    np.testing.assert_array_equal(as_list[[0, 2]], first[0, [0, 2]])
    assert not np.array_equal(as_list[1], first[0, 1])
    assert not np.array_equal(same_step.reset()[0], as_list)  # without a seed each sequence goes on


def test_returned_arrays_are_the_callers_own(same_step):
    obs, _ = same_step.reset(seed=0)
    kept = obs.copy()
    after = same_step.step(actions()[0])[0]
    np.testing.assert_array_equal(obs, kept)
    after[:] = 0  # writable
    assert not np.array_equal(same_step.step(actions()[1])[0], after)


def test_without_autoreset_only_the_masked_environments_begin_anew(settings):
    envs = vector(settings, "Disabled")
    first, _ = envs.reset(seed=0)
    for action in actions(4):
        obs, _, terminated, truncated, info = envs.step(action)
    assert truncated.all() and info["_success"].all() and (info["episode_steps"] == 4).all()
    with pytest.raises(gymnasium.error.ResetNeeded, match=r"\[0, 1, 2\] are over"):
        envs.step(actions()[0])
    mask = np.array([True, False, True])
    new, _ = envs.reset(seed=0, options={"reset_mask": mask})
    np.testing.assert_allclose(new[mask], first[mask], atol=1e-6)  # drawn by two programs
    np.testing.assert_array_equal(new[1], obs[1])
    with pytest.raises(gymnasium.error.ResetNeeded, match=r"\[1\] are over"):
        envs.step(actions()[0])
    envs.reset(options={"reset_mask": ~mask})
    assert not envs.step(actions()[0])[3].any()


def test_a_given_start_is_played(same_step):
    env = same_step.env
    start = env.draw_start(jax.random.PRNGKey(3))
    batch = jax.tree.map(lambda x: jnp.stack([x] * N), start)
    obs, _ = same_step.reset(seed=0, options={"start": batch})
    np.testing.assert_array_equal(obs[0], obs[2])
    nav = same_step._state.info["nav"]
    np.testing.assert_allclose(nav.goal_xy_w[1], start.goal_xy_w)
    np.testing.assert_allclose(nav.robot_pos_w[1, :2], start.start_xy_w)


def test_wrong_use_is_refused_in_one_line(settings, same_step):
    with pytest.raises(UserError, match="num_envs is 0, expected at least 1"):
        InteractiveNavVectorEnv("turtlebot", num_envs=0, **settings)
    with pytest.raises(ValueError, match="'Later' is not a valid AutoresetMode"):  # Gymnasium's own
        InteractiveNavVectorEnv("turtlebot", num_envs=N, **settings, autoreset_mode="Later")
    for options, message in (
        ({"episode": 3}, "'episode' is unknown; known options: reset_mask, start"),
        ({"reset_mask": np.zeros(N, bool)}, "with 0 set"),
        ({"reset_mask": np.ones(N)}, "reset_mask is float64"),
    ):
        with pytest.raises(UserError, match=message):
            same_step.reset(options=options)
    with pytest.raises(UserError, match="seed has 2 entries"):
        same_step.reset(seed=[1, 2])
    with pytest.raises(UserError, match="did you mean 'k_int'"):
        gymnasium.make(ID, **settings, kint=0.1)
    fresh = InteractiveNavVectorEnv.__new__(InteractiveNavVectorEnv)
    fresh.__dict__.update(same_step.__dict__, _state=None)
    with pytest.raises(gymnasium.error.ResetNeeded, match="before reset"):
        fresh.step(actions()[0])


def test_gymnasiums_statistics_wrapper_counts_our_episodes(same_step):
    envs = gymnasium.wrappers.vector.RecordEpisodeStatistics(same_step)
    envs.reset(seed=0)
    for action in actions(4):
        info = envs.step(action)[4]
    assert info["_episode"].all()
    np.testing.assert_array_equal(info["episode"]["l"], 4)


@pytest.mark.parametrize(("dtype", "high"), [("float32", 1.0), ("float16", 1.0), ("uint8", 255)])
def test_images_are_bounded_in_their_own_type(room, dtype, high):
    env = interactive_nav.make("turtlebot", [room], backend="native", num_objects=0, image_size=32, image_dtype=dtype,
                               observations=("goal", "depth", "segmentation", "rgb", "normals"))  # fmt: skip
    space = gym_env.observation_space_of(env)
    assert isinstance(space, gymnasium.spaces.Dict)
    for name in ("pixels/depth", "pixels/segmentation"):
        assert space[name] == gymnasium.spaces.Box(0, high, (32, 32, 1), np.dtype(dtype).type)
    assert space["pixels/rgb"] == gymnasium.spaces.Box(0, high, (32, 32, 3), np.dtype(dtype).type)
    signed = np.float16 if dtype == "float16" else np.float32
    assert space["pixels/normals"] == gymnasium.spaces.Box(-1.0, 1.0, (32, 32, 3), signed)
    assert space["state"] == gymnasium.spaces.Box(-np.inf, np.inf, (3,), np.float32)


@pytest.mark.heavy
def test_each_environment_of_a_batch_keeps_its_scene(room, two_rooms):
    settings = {"scenes": [room, two_rooms], "backend": "native", "num_objects": 0, "episode_steps": 2}
    settings["scene_choice"] = "slot"
    for mode in (AutoresetMode.SAME_STEP, AutoresetMode.NEXT_STEP):
        envs = InteractiveNavVectorEnv("turtlebot", num_envs=3, autoreset_mode=mode, **settings)
        envs.reset(seed=1)
        goals = []
        for action in actions(4):
            nav = envs._state.info["nav"]
            assert nav.scene_index.tolist() == [0, 1, 0]
            goals.append(np.asarray(nav.goal_xy_w))
            envs.step(action)
        assert envs._state.info["nav"].scene_index.tolist() == [0, 1, 0]
        assert (goals[0] != goals[-1]).any(1).all()  # new episodes did begin
    one = gym_env.InteractiveNavEnv("turtlebot", slot=1, **settings)
    for seed in range(3):
        one.reset(seed=seed)
        assert one.batch._state.info["nav"].scene_index == 1
    with pytest.raises(ConfigError, match="scene_choice is 'slot' for one environment of 2 scenes"):
        gym_env.InteractiveNavEnv("turtlebot", **settings)
    with pytest.raises(ConfigError, match="slot is 1 with scene_choice='episode'"):
        gym_env.InteractiveNavEnv("turtlebot", slot=1, **{**settings, "scene_choice": "episode"})


def test_a_robot_alone_names_an_environment():
    env = gymnasium.make(ID, backend="native", num_objects=1)
    assert [scene.name for scene in env.unwrapped.env.scenes] == ["apartment_0"]
    batch = gymnasium.make_vec(ID, num_envs=2, backend="native", num_objects=1)
    assert [scene.name for scene in batch.unwrapped.env.scenes] == ["apartment_0"]  # pyright: ignore[reportAttributeAccessIssue]


def test_actions_that_are_not_finite_are_zero_and_counted(single, same_step):
    bad, zero = np.array([np.nan, np.inf], np.float32), np.zeros(2, np.float32)
    single.reset(seed=5)
    first = single.step(bad)
    single.reset(seed=5)
    second = single.step(zero)
    np.testing.assert_array_equal(first[0], second[0])
    assert (first[4]["nonfinite_actions"], second[4]["nonfinite_actions"]) == (2.0, 0.0)
    same_step.reset(seed=5)
    info = same_step.step(np.stack([bad, zero, [np.nan, 0.5]]).astype(np.float32))[4]
    assert info["nonfinite_actions"].tolist() == [2.0, 0.0, 1.0] and info["_nonfinite_actions"].all()


def test_pictures_have_textures(settings):
    env = gymnasium.make(ID, render_mode="rgb_array", backend="native", num_objects=2)
    env.reset(seed=3)
    frame = env.render()
    assert isinstance(frame, np.ndarray) and frame.shape == (360, 480, 3)
    wood = frame[300:].reshape(-1, 3).astype(int)  # the floor in front of the camera: brown, with a grain
    assert (wood[:, 0] > wood[:, 2]).mean() > 0.8 and len(np.unique(wood, axis=0)) > 300


WORKERS = """
import functools, sys, time
import gymnasium
from gymnasium.vector import AsyncVectorEnv
import interactive_nav.interop.gym_env
if __name__ == "__main__":
    one = functools.partial(gymnasium.make, "{id}", scenes=["{scene}"], backend="native", num_objects=1)
    envs = AsyncVectorEnv([one] * 2, context="{context}")
    print(envs.reset(seed=0)[0].shape, len(envs.processes), flush=True)
    print(len(envs.step(envs.action_space.sample())), flush=True)
    time.sleep(600)
"""


def start(tmp_path, room, context):
    path = tmp_path / "workers.py"
    path.write_text(WORKERS.format(id=ID, scene=room, context=context))
    return subprocess.Popen(
        [sys.executable, "-W", "ignore", path], stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True
    )


@pytest.mark.heavy
def test_forked_workers_are_refused_in_the_parent(tmp_path, room):
    out, error = start(tmp_path, room, "fork").communicate()
    assert out == "" and error.strip().splitlines()[-1].endswith(
        "ConfigError: the environment runs in a forked process, in which JAX hangs; expected a spawned one: "
        'AsyncVectorEnv(..., context="spawn"), or vector_kwargs={"context": "spawn"} of gymnasium.make_vec'
    )


@pytest.mark.heavy
def test_spawned_workers_step_and_end_with_their_parent(tmp_path, room):
    parent = start(tmp_path, room, "spawn")
    assert parent.stdout is not None
    assert parent.stdout.readline().startswith("(2, 29) ") and parent.stdout.readline() == "5\n"
    parent.kill()
    # Returns when nobody holds the output any more: the workers, which share it, have ended.
    assert parent.communicate()[0] == ""
