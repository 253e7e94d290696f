"""Terms: values by hand, memory over resets, and every place that takes them from the environment."""

from __future__ import annotations

import dataclasses
from types import SimpleNamespace
from typing import Any

import flax.struct
import jax
import jax.numpy as jnp
import numpy as np
import pytest

import interactive_nav
from interactive_nav.interop.gym_env import InteractiveNavEnv
from interactive_nav.pictures.replay import EpisodePlayer
from interactive_nav.sensing.boxes import box_gaps_m2
from interactive_nav.task.rollout import HostPolicy, Recorder, episode_keys, rollout
from interactive_nav.task.terms import EPISODE_METRICS, REWARD_TERMS, TERMS, Term
from interactive_nav.task.wrappers import AutoResetEnv
from interactive_nav.types import EpisodeStart
from interactive_nav_common.errors import ConfigError
from tests.toys import write_room

STEPS = 5
WALL = Term("wall", "Minus 0.5 in a step in which the robot touches a wall.", "reward",
            lambda _, step: -0.5 * step.hits_structure)  # fmt: skip
FARTHEST = Term("farthest_m", "Largest distance from the start.", "metric", lambda far_m, step: far_m,
                start=lambda nav: jnp.zeros(()),
                update=lambda far_m, step: jnp.maximum(
                    far_m, jnp.linalg.norm(step.nav.robot_pos_w[:2] - step.nav.start_xy_w)))  # fmt: skip
BEFORE = Term("before", "Robot's position one control step ago, world frame.", "observation",
              lambda pos_w, at: pos_w, start=lambda nav: nav.robot_pos_w[:2],
              update=lambda pos_w, step: step.last.robot_pos_w[:2], size=2)  # fmt: skip


@pytest.fixture(scope="module")
def env(tmp_path_factory):
    room = write_room(tmp_path_factory.mktemp("terms") / "room", (4.0, 3.0), (("basket", 0.0, 0.3, 1.0, 0.4),))
    return interactive_nav.make("turtlebot", [room], (WALL, FARTHEST, BEFORE), backend="native", num_objects=1,
                                episode_steps=STEPS)  # fmt: skip


def test_the_benchmarks_terms_have_names_of_their_own_and_say_what_they_are():
    assert EPISODE_METRICS[:6] == (
        *("success", "path_efficiency", "effort_efficiency", "kinematic_effort", "dynamic_effort", "ins_0.5"),
    )
    assert REWARD_TERMS == ("reward/success", "reward/potential", "reward/interaction")
    assert all(term.doc.endswith(".") and (term.size > 0) == (term.kind == "observation") for term in TERMS)


def test_clearance_is_the_gap_between_disc_and_nearest_box_in_the_robots_heights(env):
    """By hand, in a room of 4 x 3 m with a cube of 0.4 m at (0, 0.3), and the small object outside."""
    start = EpisodeStart(
        *(jnp.int32(0), jnp.zeros(2), jnp.zeros(()), jnp.ones(2)),
        *(jnp.zeros((1, 2)), jnp.zeros(1), jnp.zeros(1, bool)),
    )
    qpos = env.initial_physics(start).qpos

    def near_m(x, y, low=0.02, high=0.4):
        heights_m = low, high
        gaps_m2 = jax.jit(lambda xy: box_gaps_m2(env.sensors.boxes, jnp.int32(0), qpos, xy, heights_m))
        return float(jnp.sqrt(gaps_m2(jnp.array([x, y])).min()))

    assert near_m(-0.9, 0.3) == pytest.approx(0.7, abs=1e-5)  # to the cube's face
    assert near_m(-0.5, -0.3) == pytest.approx(0.5, abs=1e-5)  # to its edge: 0.3 and 0.4 m away
    assert near_m(-1.0, 1.2) == pytest.approx(0.3, abs=1e-5)  # to the upper wall
    assert near_m(0.1, 0.3) == 0.0  # inside
    assert near_m(-0.9, 0.3, low=0.45, high=0.6) == pytest.approx(1.1, abs=1e-5)  # above the cube: the left wall


def test_turning_is_per_metre_of_the_path_and_clearance_a_mean(env):
    """Two steps of 0.3 and -0.5 rad, with 0.2 and 0.1 m of room; the path is 0.4 m, which counts as 1, then 2 m."""
    terms: dict[str, Any] = {term.name: term for term in TERMS if term.kind == "metric"}
    names = "clearance_m", "least_clearance_m", "turning_rad_per_m"
    memory = {name: terms[name].start(None) for name in names}
    yaw = 3.0
    for count, (turn, clear_m) in enumerate(((0.3, 0.2), (-0.5, 0.1)), 1):
        nav = [
            SimpleNamespace(yaw_rad=jnp.arctan2(jnp.sin(y), jnp.cos(y)), step_count=count) for y in (yaw, yaw + turn)
        ]
        step = SimpleNamespace(last=nav[0], nav=nav[1], clearance_m=jnp.float32(clear_m))
        yaw, memory = yaw + turn, {name: terms[name].updated(memory[name], step) for name in names}
    for path_m, turning in ((0.4, 0.8), (2.0, 0.4)):
        step.nav.memory = {"robot_path_m": jnp.float32(path_m)}
        values = [float(terms[name].evaluate(memory[name], step)) for name in names]
        assert values == pytest.approx([0.15, 0.1, turning], abs=1e-6)


def test_a_batch_rewards_reports_and_observes_added_terms_and_forgets_at_a_reset(env):
    auto = AutoResetEnv(env)
    step = jax.jit(auto.step)
    states = [jax.jit(auto.reset)(jax.random.split(jax.random.PRNGKey(0), 3))]
    assert auto.observation_size == 31 and states[0].obs.shape == (3, 31)
    for _ in range(STEPS + 2):
        states.append(step(states[-1], jnp.full((3, 2), 0.6)))
    for last, state in zip(states, states[1:], strict=False):
        begun = np.asarray(state.info["nav"].step_count) == 0
        want = np.where(begun[:, None], state.info["nav"].robot_pos_w[:, :2], last.info["nav"].robot_pos_w[:, :2])
        np.testing.assert_allclose(state.obs[:, 29:], want, atol=1e-6)
        terms = sum(np.asarray(state.metrics[name]) for name in env.reward_names)
        np.testing.assert_allclose(state.reward, terms, atol=1e-6)
        hits = np.asarray(state.metrics["reward/wall"])
        assert set(hits.tolist()) <= {0.0, -0.5}
    # The clock ends all three episodes at once, unless one reached its goal before.
    end = states[STEPS]
    path_m, far_m = (np.asarray(end.info["episode_metrics"][name]) for name in ("robot_path_m", "farthest_m"))
    assert (far_m > 0.05).all() and (far_m <= path_m + 1e-5).all()
    assert (np.asarray(end.info["nav"].memory["farthest_m"]) == 0).all()


@pytest.mark.heavy
def test_gymnasium_replays_and_rollouts_report_them(env):
    def forwards(obs, key):
        return jnp.full(2, 0.6)

    class Forwards(HostPolicy):
        def act(self, state, episode, running, step):
            return np.full((len(episode), 2), 0.6, np.float32)

    recorders = {
        "far_m": Recorder(lambda state, action: state.metrics["farthest_m"]),
        "start_m": Recorder(lambda state, action: state.info["nav"].memory["farthest_m"], "start"),
        "xy_w": Recorder(lambda state, action: state.info["nav"].robot_pos_w[:, :2], "step"),
    }
    keys = episode_keys(3, 4)
    played, on_host = (rollout(env, policy, keys, recorders, batch=3) for policy in (forwards, Forwards()))
    assert played.values["far_m"].shape == (4,) and (played.values["start_m"] == 0).all()
    assert played.values["xy_w"].shape == (4, played.num_steps.max(), 2) and (played.num_steps <= STEPS).all()
    for i, steps in enumerate(played.num_steps):
        away = np.linalg.norm(played.values["xy_w"][i, :steps] - played.first.start_xy_w[i], axis=-1)
        assert played.values["far_m"][i] == pytest.approx(away.max(), abs=1e-6)
        np.testing.assert_allclose(on_host.values["xy_w"][i, :steps], played.values["xy_w"][i, :steps], atol=1e-5)
    replay = EpisodePlayer(env, Forwards()).play(keys[2])
    assert replay.metrics["farthest_m"] == pytest.approx(float(played.values["far_m"][2]), abs=1e-5)
    assert replay.num_steps == played.num_steps[2]
    gym = InteractiveNavEnv("turtlebot", [str(env.scenes[0].path)], terms=(WALL, FARTHEST), backend="native",
                            num_objects=1, episode_steps=1)  # fmt: skip
    gym.reset(seed=0)
    info = gym.step(np.zeros(2, np.float32))[-1]
    assert info["reward/wall"] == 0.0 and 0 <= info["farthest_m"] < 0.1


def test_two_terms_of_one_name_are_refused(env):
    twice = Term("success", "Twice.", "reward", lambda _, step: jnp.zeros(()))
    with pytest.raises(ConfigError, match="two are called 'reward/success', expected different names; rename one"):
        env.__class__(env.robot, env.scenes, env.config, (twice,))


@pytest.mark.parametrize(
    ("fields", "words"),
    [
        ({"kind": "metric"}, "'x' \\(metric\\): value is None, expected \\(memory, Step\\) -> \\[\\]"),
        ({"kind": "memory", "value": lambda m, s: m, "start": jnp.zeros}, "\\(memory\\): value is .*, expected none"),
        ({"kind": "observation", "value": lambda m, at: m}, "size is 0, expected its length for kind='observation'"),
        ({"kind": "reward", "value": lambda m, s: m, "size": 2}, "size is 2, expected 0 for kind='reward'"),
        ({"kind": "metric", "value": lambda m, s: m, "update": lambda m, s: m}, "no start, .*; give start="),
        ({"kind": "memory"}, "no start, expected"),
    ],
)
def test_terms_whose_fields_do_not_fit_are_refused(fields, words):
    with pytest.raises(ConfigError, match=words):
        Term("x", "Anything.", **fields)


@pytest.mark.parametrize(
    ("term", "words"),
    [
        (dataclasses.replace(BEFORE, size=3), "'before': its value has shape \\(2,\\), expected \\(3,\\)"),
        (dataclasses.replace(BEFORE, name="lidar"), "two are called 'lidar'"),
        (dataclasses.replace(WALL, value=lambda _, step: step.touches),
         "'wall': its value has shape .*, expected \\(\\)"),
        (dataclasses.replace(FARTHEST, update=lambda far_m, step: step.touches),
         "'farthest_m': update returns bool.*, expected what start returns: float32\\[\\]"),
    ],
)  # fmt: skip
def test_values_and_memories_of_another_shape_are_refused_with_the_terms_name(env, term, words):
    with pytest.raises(ConfigError, match=words):
        other = env.__class__(env.robot, env.scenes, env.config, (term,))
        jax.eval_shape(lambda key: other.step(other.reset(key), jnp.zeros(2)), jax.random.PRNGKey(0))


@flax.struct.dataclass
class Counted:
    """Drives ahead and ends episode i before step `limits[i]`; it remembers what it has done."""

    limits: jax.Array

    def start(self, state, episode):
        return {"limit": self.limits[episode], "steps": jnp.zeros((), jnp.int32)}

    def act(self, memory, state, key):
        steps = memory["steps"] + 1
        return jnp.full(2, 0.6), {**memory, "steps": steps}, memory["steps"] >= memory["limit"]


def test_policies_end_episodes_themselves_on_the_device_and_on_the_host(env):
    """Before their step and past the environment's own end, in the same numbers as one that ends them by its clock."""
    limits, keys = np.array([2, STEPS + 3, 4], np.int32), episode_keys(0, 3)

    class OnHost(HostPolicy):
        observes = False

        def act(self, state, episode, running, step):
            return np.full((len(episode), 2), 0.6, np.float32), step >= limits[episode]

    recorders = {"xy": Recorder(lambda state, action: state.info["nav"].robot_pos_w[:, :2], "step"),
                 "end": Recorder(lambda state, action: state.info["nav"].robot_pos_w[:, :2])}  # fmt: skip
    steps = {"steps": Recorder(lambda state, action: state.info["policy"]["steps"], "step")}
    ours = rollout(env, Counted(jnp.asarray(limits)), keys, recorders | steps)
    host = rollout(env, OnHost(), keys, recorders)
    usual = rollout(env, lambda obs, key: jnp.full(2, 0.6), keys, recorders)
    assert ours.num_steps.tolist() == host.num_steps.tolist() == limits.tolist() and usual.num_steps.max() == STEPS
    assert (ours.values["steps"][1] == np.arange(1, STEPS + 4)).all()
    for i, limit in enumerate(limits):
        np.testing.assert_allclose(ours.values["xy"][i, :limit], host.values["xy"][i, :limit], atol=1e-5)
        np.testing.assert_allclose(ours.values["end"][i], ours.values["xy"][i, limit - 1], atol=0)
        both = min(limit, STEPS)
        np.testing.assert_allclose(ours.values["xy"][i, :both], usual.values["xy"][i, :both], atol=1e-5)
