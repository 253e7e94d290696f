"""Episodes are uniform, far enough apart and free of contact: 10,000 draws in a toy room with a partition."""

import jax
import jax.numpy as jnp
import mujoco
import numpy as np
import pytest
from scipy import stats

import interactive_nav
from interactive_nav.config import NavConfig, TaskRules
from interactive_nav.navigation.placement import CLEARANCE_M, draw_episode, miss_m
from interactive_nav.navigation.tables import build_tables
from interactive_nav.robots import get_robot
from interactive_nav.scenes.scene import load_scene
from interactive_nav.scenes.world import build_world
from interactive_nav.types import EpisodeStart
from scenes_mjcf.schema import SceneError
from tests.interactive_nav.test_geodesic import field_to

DRAWS = 10_000
CONFIG = NavConfig.of(num_objects=10)


@pytest.fixture(scope="module")
def built(two_rooms):
    world = build_world(get_robot("turtlebot"), (load_scene(two_rooms),), CONFIG)
    return world, build_tables(world, CONFIG)


@pytest.fixture(scope="module")
def draws(built):
    world, tables = built
    radii = jnp.asarray([o.radius_m for o in world.small_objects])

    def draw(key):
        return draw_episode(key, tables, radii, world.robot.footprint_radius_m, TaskRules())

    drawn = jax.jit(jax.vmap(draw))(jax.random.split(jax.random.PRNGKey(0), DRAWS))
    return jax.tree.map(np.asarray, drawn)


def uniform_p_value(points: np.ndarray, weights: np.ndarray, cells: np.ndarray, side_m: float) -> float:
    """Chi-square of points [n, 2] against expected shares of cells' middles [c, 2], in blocks of 0.4 m."""
    block = 0.4
    low = cells.min(0) - side_m / 2
    at = np.floor((points - low) / block + 1e-6).astype(int)
    own = np.floor((cells - low) / block + 1e-6).astype(int)
    shape = own.max(0) + 2
    counts = np.bincount(np.ravel_multi_index(np.minimum(at, shape - 1).T, shape), minlength=shape.prod())
    expected = np.bincount(np.ravel_multi_index(own.T, shape), weights=weights, minlength=shape.prod())
    expected *= len(points) / expected.sum()
    some = expected >= 5
    rest = (counts[~some].sum(), expected[~some].sum())
    observed = np.append(counts[some], rest[0]) if rest[1] >= 1 else counts[some]
    hoped = np.append(expected[some], rest[1]) if rest[1] >= 1 else expected[some]
    return float(stats.chisquare(observed, hoped * observed.sum() / hoped.sum()).pvalue)


def pair_shares(cells: np.ndarray) -> np.ndarray:
    """Share of starts in each cell where start and goal are uniform pairs at least 1 m apart."""
    far = np.linalg.norm(cells[:, None] - cells[None], axis=-1) >= 1.0
    return far.sum(1).astype(float)


def test_starts_and_goals_are_uniform_among_pairs_a_metre_apart(built, draws):
    _, tables = built
    cells = np.asarray(tables.start_xy_w[0])[: int(tables.num_starts[0])]
    shares = pair_shares(cells)
    assert uniform_p_value(draws.start_xy_w, shares, cells, tables.fine_m) > 1e-3
    assert uniform_p_value(draws.goal_xy_w, shares, cells, tables.fine_m) > 1e-3
    # The test can fail: half as much again in one room than in the other would be seen.
    skewed = shares * np.where(cells[:, 0] > 0, 1.5, 1.0)
    assert uniform_p_value(draws.start_xy_w, skewed, cells, tables.fine_m) < 1e-6
    # Goals lie anywhere inside their cells, not on centres.
    within = (draws.goal_xy_w - cells.min(0)) / tables.fine_m % 1.0
    assert stats.kstest(within.ravel(), "uniform").pvalue > 1e-3


@pytest.mark.parametrize("k", [0, 9])
def test_small_objects_are_uniform_given_what_lies_already(built, draws, k):
    world, tables = built
    cells = np.asarray(tables.clutter_xy_w[0])[: int(tables.num_clutter[0])]
    radii = np.array([o.radius_m for o in world.small_objects])
    few = slice(0, 2000)
    placed = draws.small_placed[few, : k + 1]
    taken = np.zeros(len(cells))
    for start, goal, small, there in zip(
        draws.start_xy_w[few], draws.goal_xy_w[few], draws.small_xy_w[few], placed, strict=True
    ):
        if there[k]:
            others = np.stack([start, goal, *small[:k][there[:k]]])
            reach = np.array([world.robot.footprint_radius_m] * 2 + radii[:k][there[:k]].tolist())
            gaps = np.linalg.norm(cells[:, None] - others, axis=-1) - reach
            ok = (gaps > radii[k] + CLEARANCE_M).all(-1)
            taken += ok / ok.sum()
    points = draws.small_xy_w[few, k][placed[:, k]]
    assert uniform_p_value(points, taken, cells, tables.fine_m) > 1e-3
    assert uniform_p_value(points, taken * np.where(cells[:, 0] > 0, 1.5, 1.0), cells, tables.fine_m) < 1e-6


def test_c_mujoco_finds_no_contact_at_the_start_nor_of_the_robot_at_the_goal(built, draws):
    """The engine's own collisions, where the other tests measure footprints."""
    world, _ = built
    model, layout = world.models[0], world.layout
    data = mujoco.MjData(model)
    floor = model.geom("floor").id
    own = {*layout.robot_bodies.tolist(), *layout.slot_body[:10].tolist()}

    def touches() -> bool:
        mujoco.mj_kinematics(model, data)
        mujoco.mj_comPos(model, data)
        mujoco.mj_collision(model, data)
        pairs = data.contact.geom
        bodies = model.geom_bodyid[pairs]
        return bool(np.any(np.isin(bodies, list(own)).any(1) & (pairs != floor).all(1)))

    def turned(xy, yaw, z):
        return [*xy, z, np.cos(yaw / 2), 0.0, 0.0, np.sin(yaw / 2)]

    robot, height = layout.robot_qpos, world.robot.spawn_height_m
    for i in range(0, 10_000, 20):
        data.qpos[:] = world.rest_qpos[0]
        for k in np.flatnonzero(draws.small_placed[i]):
            at = layout.slot_qpos[k]
            data.qpos[at : at + 7] = turned(draws.small_xy_w[i, k], draws.small_yaw_rad[i, k], 0.0)
        for place in (draws.start_xy_w[i], draws.goal_xy_w[i]):
            data.qpos[robot : robot + 7] = turned(place, draws.start_yaw_rad[i], height)
            assert not touches(), i
    # It would see one: the robot where the last object lies.
    data.qpos[robot : robot + 2] = draws.small_xy_w[i, k]
    assert touches()


def test_yaws_are_uniform(draws):
    turn = (draws.start_yaw_rad + np.pi) / (2 * np.pi)
    assert stats.kstest(turn, "uniform").pvalue > 1e-3
    assert stats.kstest((draws.small_yaw_rad[:, 3] + np.pi) / (2 * np.pi), "uniform").pvalue > 1e-3


def test_nothing_overlaps_and_all_is_far_enough_apart(built, draws):
    world, tables = built
    apart = np.linalg.norm(draws.start_xy_w - draws.goal_xy_w, axis=-1)
    assert apart.min() >= 1.0
    radii = np.array([o.radius_m for o in world.small_objects])
    robot = world.robot.footprint_radius_m
    assert draws.small_placed.mean() > 0.99
    xy = np.where(draws.small_placed[..., None], draws.small_xy_w, np.arange(10)[:, None] * 100.0 + 1e4)
    for place in (draws.start_xy_w, draws.goal_xy_w):
        gap = np.linalg.norm(xy - place[:, None], axis=-1) - radii - robot
        assert gap.min() > CLEARANCE_M - 1e-4
    between = np.linalg.norm(xy[:, :, None] - xy[:, None], axis=-1) - radii[:, None] - radii[None]
    assert between[:, ~np.eye(10, dtype=bool)].min() > CLEARANCE_M - 1e-4
    # Walls and furniture: the fixture's cubes of 0.4 m and its room of 5 x 4 m.
    cubes = np.array([[1.2, 0.0], [-1.2, 1.0]])
    for place, radius in ((draws.start_xy_w, robot), (draws.goal_xy_w, robot), (xy[draws.small_placed], radii.min())):
        off = np.maximum(np.abs(place[:, None] - cubes) - 0.2, 0.0)
        assert np.linalg.norm(off, axis=-1).min() >= radius
        assert (np.abs(place) <= np.array([2.5, 2.0]) - radius).all()


def test_a_largest_distance_holds(built):
    world, tables = built

    def draw(key):
        return draw_episode(
            key, tables, jnp.zeros(0), world.robot.footprint_radius_m, TaskRules(max_goal_distance_m=2.0)
        )

    drawn = jax.tree.map(np.asarray, jax.jit(jax.vmap(draw))(jax.random.split(jax.random.PRNGKey(1), 200)))
    free = np.asarray(tables.free[0])
    origin = tuple(np.asarray(tables.grid_origin_w[0]).tolist())
    for i in range(0, 200, 40):
        distances = field_to(drawn.goal_xy_w[i], free, tables.fine_m, origin)  # the other solver
        c, r = np.floor((drawn.start_xy_w[i] - origin) / tables.fine_m).astype(int)
        assert distances[r, c] <= 2.0 * 1.02 + 0.05
    assert np.linalg.norm(drawn.start_xy_w - drawn.goal_xy_w, axis=-1).min() >= 1.0
    # A limit that is given with the key is the same as one in the settings, and an infinite one is none.
    rules, keys = TaskRules(), jax.random.split(jax.random.PRNGKey(1), 200)

    def limited(key, **limit):
        return draw_episode(key, tables, jnp.zeros(0), world.robot.footprint_radius_m, rules, **limit)

    for limit_m, expected in ((2.0, drawn), (jnp.inf, jax.jit(jax.vmap(limited))(keys))):
        got = jax.jit(jax.vmap(limited))(keys, limit_m=jnp.full(200, limit_m))
        jax.tree.map(np.testing.assert_array_equal, got, expected)


def draw_pairs(tables, count, least_m, largest_m):
    rules = TaskRules(min_goal_distance_m=least_m, max_goal_distance_m=largest_m)

    def draw(key):
        start = draw_episode(key, tables, jnp.zeros(0), 0.3, rules)
        miss = miss_m(tables, start.scene_index, start.start_xy_w, start.goal_xy_w, least_m, largest_m)
        return start.start_xy_w, start.goal_xy_w, miss

    return map(np.asarray, jax.jit(jax.vmap(draw))(jax.random.split(jax.random.PRNGKey(2), count)))


def test_rare_distances_are_met_too_and_uniformly(built):
    """Across a room of 5 x 4 m so few pairs qualify that the first 64 mostly hold none."""
    _, tables = built
    starts, goals, miss = draw_pairs(tables, 300, 4.4, 4.6)
    assert (miss == 0).all()
    straight = np.linalg.norm(starts - goals, axis=-1)
    assert straight.min() >= 4.4 and straight.max() <= 4.6
    places = [np.asarray(getattr(tables, n))[0] for n in ("start_xy_w", "goal_xy_w")]
    counts = int(tables.num_starts[0]), int(tables.num_goals[0])
    rng = np.random.default_rng(0)
    a, b = (xy[rng.integers(0, n, 200_000)] for xy, n in zip(places, counts, strict=True))
    apart = np.linalg.norm(a - b, axis=-1)
    share = ((apart >= 4.4) & (apart <= 4.6)).mean()
    assert 0 < 64 * share < 1.0, share
    # Either end is the start as often: the pairs are uniform.
    assert stats.binomtest(int((starts[:, 0] > goals[:, 0]).sum()), 300).pvalue > 1e-3


@pytest.mark.parametrize("largest_m", [np.inf, 5.85])
def test_distances_that_next_to_no_pair_has_are_met(two_rooms, largest_m):
    """From one corner of the room to the other: drawing mostly finds none, so known pairs are taken."""
    config = NavConfig.of(num_objects=0, min_goal_distance_m=5.5, max_goal_distance_m=largest_m)
    world = build_world(get_robot("turtlebot"), (load_scene(two_rooms),), config)
    tables = build_tables(world, config)
    starts, goals, miss = draw_pairs(tables, 40, 5.5, largest_m)
    assert miss.max() < 1e-5 and len(np.unique(starts, axis=0)) > 8
    assert np.linalg.norm(starts - goals, axis=-1).min() > 5.5 - 1e-5
    known = np.asarray(tables.fallback_pairs_xy_w[0]).reshape(-1, 4)
    drawn = np.concatenate([starts, goals], -1)
    assert (np.abs(drawn[:, None] - known[None]).max(-1).min(1) < 1e-6).sum() > 8  # a fifth


def test_distances_that_no_pair_has_are_refused_with_those_that_there_are(two_rooms):
    def refusal(least_m, largest_m):
        config = NavConfig.of(num_objects=0, min_goal_distance_m=least_m, max_goal_distance_m=largest_m)
        world = build_world(get_robot("turtlebot"), (load_scene(two_rooms),), config)
        with pytest.raises(SceneError) as refused:
            build_tables(world, config)
        return str(refused.value)

    # From corner to corner the straight line would be 5.6 m, but the partition's gap is a way round of 5.8 m.
    text = refusal(5.6, 5.62)
    assert "no start and goal of robot 'turtlebot' are at least 5.6 m apart and at most 5.62 m by the way" in text
    assert "the shortest way so far is 5.96 m; raise max_goal_distance_m or lower" in text
    assert "9.0 m apart for robot 'turtlebot', the farthest are 5.63 m apart; lower" in refusal(9.0, np.inf)


def test_an_episode_off_its_distances_is_counted(room):
    env = interactive_nav.make("turtlebot", [room], backend="native", num_objects=0, episode_steps=1,
                               max_goal_distance_m=1.5)  # fmt: skip

    def start(x):
        return EpisodeStart(jnp.asarray(0), jnp.asarray([-1.5, -1.0]), jnp.asarray(0.0), jnp.asarray([x, -1.0]),
                            jnp.zeros((0, 2)), jnp.zeros(0), jnp.zeros(0, bool))  # fmt: skip

    reset, step = jax.jit(env.reset_to), jax.jit(env.advance)
    off = [step(reset(start(x), jax.random.PRNGKey(0)), jnp.zeros(2)).metrics["off_distance"] for x in (-1.0, 0.0, 0.5)]
    assert [float(v) for v in off] == [1.0, 0.0, 1.0]
