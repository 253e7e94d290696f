"""The environment's contract, its task memory across episode ends, and its scores against a plain-Python oracle."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import interactive_nav
from interactive_nav import metrics
from interactive_nav.task.terms import EPISODE_METRICS, SETTLE_STEPS
from interactive_nav.task.wrappers import AutoResetEnv
from interactive_nav_common.errors import UserError

N = 6


@pytest.fixture(scope="module")
def env(room, two_rooms):
    return interactive_nav.make(
        "turtlebot", [room, two_rooms], backend="native", num_objects=4, episode_steps=40, k_int=0.5
    )


@pytest.fixture(scope="module")
def programs(env):
    return jax.jit(jax.vmap(env.reset)), jax.jit(jax.vmap(env.step))


@pytest.fixture(scope="module")
def batched(env):
    """Reset and step of a batch that resets itself, and a list that grows with each time the step is traced."""
    auto, traces = AutoResetEnv(env), []

    def step(state, action):
        traces.append(1)
        return auto.step(state, action)

    return jax.jit(auto.reset), jax.jit(step), traces


def keys(seed, n=N):
    return jax.random.split(jax.random.PRNGKey(seed), n)


def drawn(reset, seed, n):
    """States of at least n episodes, N at a time: [batches, N, ...]."""
    return jax.tree.map(lambda *x: np.stack(x), *(reset(k) for k in keys(seed, n).reshape(-1, N, 2)))


def drive(obs):
    """Steers at the second waypoint."""
    ahead = obs[:, 2:4]
    angle = jnp.arctan2(ahead[:, 1], ahead[:, 0])
    speed, turn = jnp.where(jnp.abs(angle) < 0.6, 0.6, 0.0), jnp.clip(3 * angle, -2, 2)
    wheels = jnp.stack([speed - turn * 0.115, speed + turn * 0.115], -1) / 0.0352
    return (wheels + 12.5) / 18.75 - 1


def test_shapes_and_names(env, programs):
    reset, step = programs
    state = reset(keys(0))
    assert (env.observation_size, env.action_size, env.backend) == (29, 2, "native")
    assert state.obs.shape == (N, 29) and state.obs.dtype == jnp.float32
    after = step(state, jnp.zeros((N, 2)))
    assert jax.tree.structure(after) == jax.tree.structure(state)
    assert set(EPISODE_METRICS) <= set(after.metrics)
    contract = (
        "success path_efficiency effort_efficiency kinematic_effort dynamic_effort ins_0.5 robot_path_m "
        "shortest_path_m object_displacement_kg_m force_sum_n episode_steps nonfinite"
    )
    assert set(contract.split()) <= set(after.metrics)
    assert all(np.isfinite(x).all() for x in jax.tree.leaves((after.obs, after.reward, after.metrics)))


def test_observation_holds_goal_waypoints_and_velocity_in_the_robot_frame(env, programs):
    reset, step = programs
    state = reset(keys(1))
    for _ in range(5):
        state = step(state, jnp.full((N, 2), 0.2))
    nav, obs = state.info["nav"], np.asarray(state.obs)
    yaw = np.asarray(nav.yaw_rad)
    offset = np.asarray(nav.goal_xy_w - nav.robot_pos_w[:, :2])
    want_x = np.cos(yaw) * offset[:, 0] + np.sin(yaw) * offset[:, 1]
    want_y = -np.sin(yaw) * offset[:, 0] + np.cos(yaw) * offset[:, 1]
    np.testing.assert_allclose(obs[:, 20], want_x, atol=0.02)  # the base pitches by under half a degree
    np.testing.assert_allclose(obs[:, 21], want_y, atol=0.02)
    np.testing.assert_allclose(obs[:, :20].reshape(N, 10, 2), nav.waypoints_b, atol=1e-6)
    # Wheels at -12.5 + 0.6 * 37.5 = 10 rad/s: 0.35 m/s ahead, for robots that met nothing.
    free = np.asarray(nav.memory["force_sum_n"]) == 0
    assert free.any()
    np.testing.assert_allclose(obs[free, 23], 10 * 0.0352, rtol=0.05)
    np.testing.assert_allclose(obs[free, 24:29], 0, atol=0.1)


def test_waypoints_are_equally_spaced_and_end_at_the_goal(programs):
    state = jax.tree.map(np.concatenate, drawn(programs[0], 2, 42))
    nav = state.info["nav"]
    points = np.concatenate([np.zeros((42, 1, 2)), np.asarray(nav.waypoints_b)], 1)
    steps = np.linalg.norm(np.diff(points, axis=1), axis=-1)
    assert steps.max() <= 0.2 + 1e-3  # chords of arcs of 0.2 m
    near = np.asarray(nav.geodesic_m) < 1.7
    goal_b = np.asarray(state.obs)[:, 20:22]
    assert near.any()
    np.testing.assert_allclose(points[near, -1], goal_b[near], atol=0.02)


def test_same_key_same_trajectory(programs):
    reset, step = programs

    def run():
        state = reset(keys(3))
        for _ in range(8):
            state = step(state, drive(state.obs))
        return state

    for a, b in zip(jax.tree.leaves(run()), jax.tree.leaves(run()), strict=True):
        np.testing.assert_array_equal(a, b)


def test_starts_and_goals_keep_their_distance_and_nothing_touches_at_the_start(env, programs):
    reset, step = programs
    batches = drawn(reset, 4, 66)
    nav = jax.tree.map(np.concatenate, batches).info["nav"]
    apart = np.linalg.norm(np.asarray(nav.goal_xy_w - nav.start_xy_w), axis=-1)
    assert apart.min() >= 1.0 - 1e-5
    assert np.asarray(nav.objects_dropped).sum() == 0
    small = np.asarray(nav.object_pos_w)[:, :4, :2]
    gaps = np.linalg.norm(small - np.asarray(nav.start_xy_w)[:, None], axis=-1)
    radii = [o.radius_m for o in env.world.small_objects]
    assert (gaps > 0.18 + np.asarray(radii) - 0.05).all()  # centres of mass lie off the frames by centimetres
    assert {0, 1} == set(np.asarray(nav.scene_index).tolist())
    # Standing still for a step touches nothing.
    still = (0 + 12.5) / 18.75 - 1
    for i in range(11):
        after = step(jax.tree.map(lambda x, i=i: x[i], batches), jnp.full((N, 2), still))
        assert float(after.info["nav"].memory["force_sum_n"].max()) == 0.0


def test_following_the_path_succeeds_and_the_reward_adds_up(programs):
    reset, step = programs
    state = reset(keys(9))
    total, potential, ended = np.zeros(N), np.zeros(N), np.zeros(N, bool)
    start = np.asarray(state.info["nav"].geodesic_m)
    success = np.zeros(N, bool)
    for _ in range(40):
        before = np.asarray(state.info["nav"].geodesic_m)
        state = step(state, drive(state.obs))
        live = ~ended
        terms = {k: np.asarray(state.metrics[f"reward/{k}"]) for k in ("success", "potential", "interaction")}
        np.testing.assert_allclose(state.reward, sum(terms.values()), atol=1e-5)
        nearer = before - np.asarray(state.info["nav"].geodesic_m)
        np.testing.assert_allclose(terms["potential"], np.where(live, nearer, 0.0), atol=1e-5)
        assert set(np.unique(terms["interaction"])) <= {0.0, -0.5}
        potential += live * terms["potential"]
        total += live * np.asarray(state.reward)
        success |= live & (np.asarray(state.metrics["success"]) > 0)
        ended |= np.asarray(state.done) > 0
    assert success.sum() >= N // 2
    # The potential telescopes to the distance covered: all of L* but the goal region.
    assert (potential[success] > start[success] - 0.45).all() and (potential <= start + 0.1).all()


def test_time_limit_truncates_and_metrics_are_zero_until_the_end(programs):
    reset, step = programs
    state = reset(keys(6))
    backwards = jnp.full((N, 2), -1.0)
    for t in range(1, 41):
        state = step(state, backwards)
        if t < 40:
            live = np.asarray(state.done) == 0
            assert (np.asarray(state.metrics["episode_steps"])[live] == 0).all()
            assert (np.asarray(state.info["truncation"])[live] == 0).all()
    timed = np.asarray(state.info["truncation"]) > 0
    assert timed.any()
    assert (np.asarray(state.done)[timed] == 1).all()
    assert (np.asarray(state.metrics["episode_steps"])[timed] == 40).all()
    assert (np.asarray(state.metrics["success"])[timed] == 0).all()
    assert (np.asarray(state.metrics["path_efficiency"])[timed] == 0).all()


def test_scores_equal_a_plain_python_oracle_over_real_physics(env, programs):
    reset, step = programs
    state = reset(keys(7))
    masses = np.asarray(env.tables.mass_kg)[np.asarray(state.info["nav"].scene_index)]
    tracks, forces = [[] for _ in range(N)], [[] for _ in range(N)]
    touched: list[list[np.ndarray]] = [[] for _ in range(N)]
    done_at: list[dict[str, float]] = [{} for _ in range(N)]
    previous = np.zeros(N)
    for i in range(N):
        nav = state.info["nav"]
        tracks[i].append(np.vstack([nav.robot_pos_w[i], nav.object_pos_w[i]]))
    for _ in range(40):
        state = step(state, drive(state.obs))
        nav = state.info["nav"]
        for i in range(N):
            if not done_at[i]:
                tracks[i].append(np.vstack([nav.robot_pos_w[i], nav.object_pos_w[i]]))
                touched[i].append(np.asarray(nav.memory["object_contact_steps"][i]) > 0)
                forces[i].append(float(nav.memory["force_sum_n"][i]) - previous[i])
                if state.done[i]:
                    done_at[i] = {k: float(v[i]) for k, v in state.metrics.items()}
                    done_at[i]["shortest"] = float(nav.shortest_path_m[i])
        previous = np.asarray(nav.memory["force_sum_n"])
    pushed = 0.0
    for i in range(N):
        got = done_at[i]
        moved = np.linalg.norm(np.diff(np.asarray(tracks[i], float), axis=0), axis=-1)
        moved[moved < 1e-4] = 0.0
        moved[:SETTLE_STEPS, 1:][~np.asarray(touched[i][:SETTLE_STEPS])] = 0.0
        paths = moved.sum(0)
        paths[1:][masses[i, 1:] == 0] = 0.0
        work = masses[i] * paths
        weight = 2.673 * 9.81 * len(forces[i])
        e_eff = 0.5 * (work[0] / work.sum() + weight / (weight + sum(forces[i])))
        p_eff = got["success"] * min(1.0, got["shortest"] / paths[0])
        assert got["effort_efficiency"] == pytest.approx(e_eff, rel=1e-3)
        assert got["path_efficiency"] == pytest.approx(p_eff, rel=1e-3)
        assert got["ins_0.5"] == pytest.approx(0.5 * p_eff + 0.5 * e_eff, rel=1e-3)
        assert got["object_displacement_kg_m"] == pytest.approx(work[1:].sum(), rel=1e-3, abs=1e-4)
        assert got["robot_path_m"] == pytest.approx(paths[0], rel=1e-3)
        pushed += work[1:].sum()
        full = metrics.effort_efficiency(masses[i], paths, np.asarray(forces[i]), len(forces[i]))
        assert got["effort_efficiency"] == pytest.approx(full, rel=1e-3)
    assert pushed > 0.01  # something was pushed, or the oracle proved little


def test_auto_reset_draws_a_new_episode_and_nothing_leaks(batched):
    reset, step, _ = batched
    state = reset(keys(8))
    seen = [set() for _ in range(N)]
    for _ in range(90):
        old = state
        state = step(state, drive(state.obs))
        done = np.asarray(state.done) > 0
        nav = state.info["nav"]
        for i in np.flatnonzero(done):
            seen[i].add(tuple(np.asarray(nav.goal_xy_w[i]).round(3)))
        # A new episode starts from nothing; a running one goes on.
        assert (np.asarray(nav.step_count)[done] == 0).all()
        assert (np.asarray(nav.memory["robot_path_m"])[done] == 0).all() and (
            np.asarray(nav.memory["force_sum_n"])[done] == 0
        ).all()
        np.testing.assert_array_equal(nav.step_count[~done], np.asarray(old.info["nav"].step_count)[~done] + 1)
        np.testing.assert_array_equal(state.info["episode_done"], state.done)
        lengths = np.asarray(state.info["episode_metrics"]["length"])
        assert (lengths[done] == np.asarray(old.info["nav"].step_count)[done] + 1).all()
    assert max(len(s) for s in seen) >= 2


def test_a_broken_world_ends_its_own_episode_only(batched):
    reset, step, _ = batched
    state = reset(keys(9))
    qpos = state.pipeline_state.qpos.at[2, 0].set(jnp.nan)
    state = state.replace(pipeline_state=state.pipeline_state.replace(qpos=qpos))
    after = step(state, jnp.zeros((N, 2)))
    assert float(after.done[2]) == 1.0 and float(after.info["truncation"][2]) == 0.0
    assert float(after.info["episode_metrics"]["nonfinite"][2]) == 1.0
    assert float(after.info["episode_metrics"]["success"][2]) == 0.0
    assert np.isfinite(np.asarray(after.obs)).all() and np.isfinite(np.asarray(after.reward)).all()
    assert np.asarray(after.done)[[0, 1, 3, 4, 5]].sum() == 0
    again = step(after, jnp.zeros((N, 2)))
    assert np.isfinite(np.asarray(again.pipeline_state.qpos)).all()


def test_non_finite_actions_count_as_zero(programs):
    reset, step = programs
    state = reset(keys(10))
    a = step(state, jnp.zeros((N, 2)))
    b = step(state, jnp.zeros((N, 2)).at[0, 0].set(jnp.nan).at[1, 1].set(0.0))
    np.testing.assert_array_equal(a.obs, b.obs)


def test_single_environment_and_nested_vmap_equal_the_batch(env, programs):
    reset, step = programs
    state = reset(keys(11))
    action = jnp.linspace(-1, 1, 2 * N).reshape(N, 2)
    want = step(state, action)
    one = jax.jit(env.step)(jax.tree.map(lambda x: x[3], state), action[3])
    np.testing.assert_allclose(one.obs, want.obs[3], atol=1e-5)
    folded = jax.tree.map(lambda x: x.reshape(2, N // 2, *x.shape[1:]), state)
    got = jax.jit(jax.vmap(jax.vmap(env.step)))(folded, action.reshape(2, N // 2, 2))
    np.testing.assert_allclose(got.obs.reshape(N, -1), want.obs, atol=1e-5)


def test_the_loop_is_traced_once(batched):
    reset, step, traces = batched
    state = reset(keys(12))
    for _ in range(3):
        state = step(state, jnp.zeros((N, 2)))
    assert len(traces) == 1


def test_observation_parts_can_be_chosen(room):
    env = interactive_nav.make("turtlebot", [room], backend="native", num_objects=0, observations=("goal", "velocity"))
    state = jax.jit(env.reset)(jax.random.PRNGKey(0))
    assert env.observation_size == 9 and state.obs.shape == (9,)


@pytest.mark.parametrize(
    ("settings", "message"),
    [
        ({"k_itn": 0.1}, "unknown setting 'k_itn'; did you mean 'k_int'"),
        ({"backend": "bullet"}, "backend is 'bullet', expected one of auto, warp, jax, native"),
        ({"sim_dt_s": 0.03}, "sim_dt_s is 0.03, expected a divisor of control_dt_s"),
        ({"observations": ("goal", "smell")}, "observations is .*smell"),
        ({"collision": "hulls", "backend": "jax"}, "expected backend='native'"),
        ({"episode_steps": 0}, "episode_steps is 0, expected at least 1"),
    ],
)
def test_bad_settings_are_refused(room, settings, message):
    with pytest.raises(UserError, match=message):
        interactive_nav.make("turtlebot", [room], **settings)


def test_unknown_robot_lists_the_known_ones(room):
    with pytest.raises(UserError, match="unknown robot 'turtlbot', did you mean 'turtlebot'"):
        interactive_nav.make("turtlbot", [room])
    with pytest.raises(UserError, match="expected a list of scene folders"):
        interactive_nav.make("turtlebot", str(room))
