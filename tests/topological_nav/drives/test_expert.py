"""The expert against arithmetic by hand and a robot that moves exactly as commanded."""

import functools

import jax
import jax.numpy as jnp
import numpy as np
import pytest
import shapely

from interactive_nav_common.grids import clearance
from topological_nav.config import ExpertConfig
from topological_nav.drives import expert
from topological_nav.scenes.space import FreeSpace

CONFIG = ExpertConfig()
HALF_M = np.array([0.25, 0.225])


def space_of(free: np.ndarray, resolution_m: float = 0.1) -> FreeSpace:
    return FreeSpace(clearance(free, resolution_m), resolution_m, (0.0, 0.0))


def terrain_of(space: FreeSpace, goals_w, config=CONFIG) -> expert.Terrain:
    return expert.Terrain(
        jnp.asarray(space.clearance_m[None], jnp.float32),
        jnp.zeros((1, 2)),
        jnp.full(1, space.resolution_m),
        jnp.asarray(expert.way_field(space, np.asarray(goals_w), config, 50.0)),
    )


def test_the_way_left_is_straight_in_the_open():
    space = space_of(np.ones((41, 61), bool))
    field = expert.way_field(space, np.array([[1.05, 2.05]]), CONFIG, 50.0)[0]
    # Along a row, well off the rim: 3.0 m to the cell 30 columns on.
    assert field[20, 40] == pytest.approx(3.0, abs=1e-5) and field[20, 10] == 0.0
    # The move (1, 3) exists: ten of them, root of 10 cells each.
    assert field[30, 40] == pytest.approx(10 * np.sqrt(10) * 0.1, abs=1e-5)


def test_a_metre_beside_a_wall_counts_for_more_and_walls_are_gone_round():
    free = np.ones((40, 60), bool)
    free[:, 30] = False
    free[30:, 30] = True  # a gap of 1 m at the upper end
    space, config = space_of(free), ExpertConfig(near_cost=0.0)
    plain = expert.way_field(space, np.array([[1.05, 1.05]]), config, 50.0)[0]
    # Not nearer than the way over the gap's lower corner, which keeps radius_m from the wall's end at (3.05, 3.0).
    straight = np.hypot(2.0, 2.0)
    assert straight * 2 < plain[10, 50] < straight * 2 + 1.0
    costly = expert.way_field(space, np.array([[1.05, 1.05]]), CONFIG, 50.0)[0]
    assert costly[10, 50] > plain[10, 50]
    # Row 3 lies 0.35 m from the rim: 0.08 m beyond the radius, so each metre counts 1 + 3 (1 - 0.08 / 0.3).
    along = costly[3, 20] - costly[3, 19]
    assert 0 < along <= 0.1 * (1 + 3 * (1 - 0.08 / 0.3)) + 1e-6
    assert np.isfinite(costly).all()


def test_blocked_cells_lead_out():
    free = np.ones((30, 30), bool)
    free[10:20, 10:20] = False
    field = expert.way_field(space_of(free), np.array([[0.55, 1.45]]), CONFIG, 50.0)[0]
    # Inside the block the value rises by 0.4 m a cell from the nearest cell with room.
    assert field[15, 11] > field[15, 9] > field[15, 7]


def test_what_cannot_be_entered_anywhere_has_a_field_of_distances():
    field = expert.way_field(space_of(np.zeros((4, 4), bool)), np.array([[0.05, 0.05]]), CONFIG, 9.0)[0]
    assert field[0, 3] == pytest.approx(0.3, abs=1e-6) and field[3, 3] == pytest.approx(0.3 * np.sqrt(2), abs=1e-6)


def test_bilinear_sampling_is_exact_on_planes():
    x, y = np.meshgrid(np.arange(6) + 0.5, np.arange(5) + 0.5)
    grid = jnp.asarray(2.0 * x - 3.0 * y, jnp.float32)
    points = np.array([[1.0, 1.0], [2.3, 3.9], [5.4, 0.6]])
    found = expert.sample(grid, jnp.zeros(2), jnp.float32(1.0), jnp.asarray(points))
    assert np.asarray(found) == pytest.approx(2 * points[:, 0] - 3 * points[:, 1], abs=1e-2)
    # Beyond the middles of the rim's cells, the rim's own value.
    assert float(expert.sample(grid, jnp.zeros(2), jnp.float32(1.0), jnp.asarray([-5.0, 2.5]))) == pytest.approx(-6.5)


def test_the_window_holds_what_a_control_period_can_reach():
    linear, angular = expert.window(jnp.asarray([0.2, -0.5]), CONFIG)
    assert len(linear) == 5 * 11
    # 1 m/s^2 and 4 rad/s^2 for 0.1 s: 0.1 to 0.3 m/s, and -0.9 (cut at -0.5) to -0.1 rad/s.
    assert np.unique(np.round(linear, 4)).tolist() == pytest.approx([0.1, 0.125, 0.25, 0.3])
    assert np.unique(np.round(angular, 4)).tolist() == pytest.approx([-0.5, -0.4, -0.3, -0.2, -0.1])
    linear, angular = expert.window(jnp.zeros(2), CONFIG)
    assert linear.min() == 0 and np.abs(np.asarray(angular)).min() < 1e-6


@pytest.mark.parametrize(("v", "w"), [(0.5, 0.0), (0.5, 0.5), (0.25, -0.3), (0.0, 0.5), (0.4, 1e-6)])
def test_arcs_are_what_small_steps_add_up_to(v, w):
    times = jnp.asarray([0.4, 1.6])
    found = np.asarray(expert.arcs(jnp.asarray([v]), jnp.asarray([w]), times))[0]
    for time, pose in zip((0.4, 1.6), found, strict=True):
        t = (np.arange(20_000) + 0.5) / 20_000 * time
        summed = [v * np.cos(w * t).mean() * time, v * np.sin(w * t).mean() * time, w * time]
        assert pose == pytest.approx(summed, abs=1e-5)


def test_gaps_of_a_turned_rectangle_agree_with_shapely():
    rng = np.random.default_rng(0)
    points = rng.uniform(-1, 1, (40, 2))
    points[3] = np.inf
    poses = np.concatenate([rng.uniform(-1, 1, (6, 2)), rng.uniform(-3, 3, (6, 1))], 1)
    found = np.asarray(expert.scan_gap(jnp.asarray(poses), jnp.asarray(points), jnp.asarray(HALF_M)))
    for pose, gap in zip(poses, found, strict=True):
        cos, sin = np.cos(pose[2]), np.sin(pose[2])
        corners = np.array([[1, 1], [-1, 1], [-1, -1], [1, -1]]) * HALF_M @ np.array([[cos, sin], [-sin, cos]])
        body = shapely.Polygon(corners + pose[:2])
        assert gap == pytest.approx(
            min(body.distance(shapely.Point(p)) for p in points if np.isfinite(p).all()), abs=1e-5
        )
    nothing = expert.scan_gap(jnp.zeros(3), jnp.full((4, 2), jnp.inf), jnp.asarray(HALF_M))
    assert np.isinf(nothing)


def test_beams_end_where_they_should():
    config = ExpertConfig(lidar_rays=4, lidar_fov_deg=360.0, lidar_range_m=4.0)
    ends = np.asarray(expert.scan_points(jnp.asarray([1.0, 2.0, 4.0, 3.0]), config, (0.17, 0.0)))
    # From behind over the right: -180, -90, 0 and 90 degrees.
    assert ends[[0, 1, 3]] == pytest.approx(np.array([[-0.83, 0], [0.17, -2], [0.17, 3]]), abs=1e-6)
    assert np.isinf(ends[2]).all()


def rays_to(boxes: list[shapely.Polygon], pose: np.ndarray, config: ExpertConfig) -> np.ndarray:
    """Where a scanner at a pose sees the outlines of boxes, m."""
    step = config.lidar_fov_deg / config.lidar_rays
    angle = pose[2] + np.radians(-0.5 * config.lidar_fov_deg + np.arange(config.lidar_rays) * step)
    start = pose[:2] + 0.17 * np.array([np.cos(pose[2]), np.sin(pose[2])])
    far = start + config.lidar_range_m * np.stack([np.cos(angle), np.sin(angle)], -1)
    outlines, out = shapely.union_all([b.exterior for b in boxes]), []
    for end in far:
        met = outlines.intersection(shapely.LineString([start, end]))
        out.append(config.lidar_range_m if met.is_empty else met.distance(shapely.Point(start)))
    return np.array(out)


@functools.cache
def asked():
    def step(terrain, pose, velocity, ranges, config):
        points = expert.scan_points(ranges, config, (0.17, 0.0))
        velocity, _ = expert.command(terrain, 0, 0, pose, velocity, points, jnp.asarray(HALF_M), config)  # type: ignore[arg-type]
        arc = expert.arcs(velocity[None, 0], velocity[None, 1], jnp.asarray([expert.CONTROL_S]))
        return velocity, expert.moved(pose, arc[0, 0])

    return jax.jit(step, static_argnames="config")


def kinematic(terrain, pose, boxes, steps: int, goal_w, config=CONFIG):
    """Poses of a robot that moves exactly as the expert commands it, until it is within `reached_m` of the goal."""
    velocity, poses = np.zeros(2), [np.asarray(pose, float)]
    for _ in range(steps):
        now = poses[-1]
        velocity, after = asked()(terrain, now, velocity, rays_to(boxes, now, config), config)
        poses.append(np.asarray(after))
        if np.linalg.norm(poses[-1][:2] - goal_w) < config.reached_m:
            break
    return np.stack(poses)


def body(pose: np.ndarray) -> shapely.Polygon:
    turned = shapely.affinity.rotate(shapely.box(*-HALF_M, *HALF_M), pose[2], (0, 0), use_radians=True)
    return shapely.affinity.translate(turned, *pose[:2])


def gaps_on_the_way(low: float, known: bool) -> tuple[np.ndarray, np.ndarray]:
    """Poses on a straight way of 4 m along y = 2, begun turned away by 0.5 rad, and gaps to a block of 0.6 m beside it.

    Args:
        low: y of the block's lower side, m.
        known: the map has the block; else only the scan shows it.
    """
    block, goal = shapely.box(2.7, low, 3.3, low + 0.6), np.array([5.0, 2.0])
    free = np.ones((80, 120), bool)
    if known:
        x, y = np.meshgrid((np.arange(120) + 0.5) * 0.05, (np.arange(80) + 0.5) * 0.05)
        free &= ~shapely.contains_xy(block, x, y)
    terrain = terrain_of(space_of(free, 0.05), [goal])
    poses = kinematic(terrain, [1.0, 2.0, 0.5], [block], 150, goal)
    speed = np.linalg.norm(np.diff(poses[:, :2], axis=0), axis=1) / expert.CONTROL_S
    turn = np.abs(np.diff(poses[:, 2])) / expert.CONTROL_S
    assert speed.max() <= 0.5 + 1e-3 and turn.max() <= 0.5 + 1e-3
    return poses, np.array([body(pose).distance(block) for pose in poses])


def test_it_goes_round_an_obstacle_in_the_middle_of_the_way():
    poses, gaps = gaps_on_the_way(1.8, known=True)
    assert np.linalg.norm(poses[-1, :2] - [5.0, 2.0]) < CONFIG.reached_m and gaps.min() >= 0.03
    # Nobody slows down for the node at the end.
    assert np.linalg.norm(poses[-1, :2] - poses[-2, :2]) > 0.04


def test_what_only_the_scan_sees_is_passed_with_a_gap_or_stopped_before():
    """The map knows nothing of it; nobody plans round it."""
    poses, gaps = gaps_on_the_way(2.42, known=False)
    assert poses[-1, 0] > 4.6 and gaps.min() >= 0.03
    poses, gaps = gaps_on_the_way(1.8, known=False)
    assert 2.0 < poses[-1, 0] < 2.45 and 0.03 <= gaps.min() < 0.4


def test_it_turns_on_the_spot_where_there_is_a_wall_ahead():
    """In the corner of a corridor with the goal behind it."""
    goal = np.array([1.0, 0.6])
    free = np.ones((24, 80), bool)
    terrain = terrain_of(space_of(free, 0.05), [goal])
    walls = [shapely.box(-1, -1, 5, 0), shapely.box(-1, 1.2, 5, 2), shapely.box(4, -1, 5, 2)]
    poses = kinematic(terrain, [3.3, 0.6, 0.2], walls, 250, goal)
    assert np.linalg.norm(poses[-1, :2] - goal) < CONFIG.reached_m
    assert min(body(pose).distance(wall) for pose in poses for wall in walls) > 0.02


def test_a_batch_is_asked_as_one_is():
    free = np.ones((60, 60), bool)
    free[20:30, 20:30] = False
    terrain = terrain_of(space_of(free, 0.05), [[2.5, 2.5], [0.6, 2.0]])
    rng = np.random.default_rng(1)
    poses, goals = jnp.asarray(rng.uniform(0.4, 2.6, (5, 3))), jnp.asarray([0, 1, 0, 1, 1])
    velocity, points = jnp.asarray(rng.uniform(0, 0.3, (5, 2))), jnp.asarray(rng.uniform(-2, 2, (5, 9, 2)))

    def one(scene, goal, pose, velocity, points):
        return expert.command(terrain, scene, goal, pose, velocity, points, jnp.asarray(HALF_M), CONFIG)

    many = jax.jit(jax.vmap(functools.partial(one, 0)))(goals, poses, velocity, points)
    one = jax.jit(one)
    for i in range(5):
        alone = one(0, goals[i], poses[i], velocity[i], points[i])
        assert np.asarray(many[0][i]) == pytest.approx(np.asarray(alone[0]), abs=1e-5)
        assert float(many[1][i]) == pytest.approx(float(alone[1]), abs=1e-5)
