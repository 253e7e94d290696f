"""Small objects in passage images: labels by hand and as of furniture, layouts, balance, pictures; none by default."""

import hashlib
import math

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from interactive_nav.robots import get_robot
from interactive_nav.scenes.objects import pick
from interactive_nav.scenes.scene import load_scene
from interactive_nav_common.config import overridden
from interactive_nav_common.errors import ConfigError
from interactive_nav_common.grids import cell_centres, clearance
from scenes_mjcf.look import Lens
from tests.topological_nav.conftest import WORDS
from tests.topological_nav.maps.test_sight import two_rooms_space
from topological_nav.__main__ import main
from topological_nav.config import DataConfig
from topological_nav.data import dataset
from topological_nav.data.dataset import draw_passages, free_lengths
from topological_nav.data.folders import lens_of
from topological_nav.data.objects import bodies, clear_of, fewer_at_furniture, strew
from topological_nav.scenes.rendering import SceneRenderer, camera_pose
from topological_nav.scenes.space import FreeSpace, Rooms

BASKET = 0.38, 0.28, 0.24
"""m, length, width and height of the first small object; its boxes fill that rectangle of the floor."""
TINY = ["positions=20", "max_per_room=1", "passage_sources=6", "passage_targets=8"]
ROOMS = Rooms(np.array([[-1.5, 0.0], [1.5, 0.0]]), np.array([0, 1], np.int32), "kmeans", "config")


def answers(x_m, y_m, yaw_deg=0.0, heading_deg=0.0, **changed):
    """The labels of a path along a heading from the origin, with the basket at x, y."""
    layout, heading = np.array([[[x_m, y_m, math.radians(yaw_deg)]]]), np.deg2rad([[heading_deg]])
    return clear_of(layout, np.zeros((1, 2)), heading, DataConfig(**changed))[0, 0].astype(int).tolist()


def test_labels_by_hand():
    """Lengths are 0.5 to 2.5 m, the margin is 0.225 m."""
    assert pick(1)[0].name == "basket_laundry"
    # Its front is 1.2 - 0.19 = 1.01 m ahead: free up to 0.785 m.
    assert answers(1.2, 0.0) == [1, 0, 0, 0, 0]
    assert answers(1.2, 0.0, heading_deg=180) == [1, 1, 1, 1, 1]
    assert answers(-1.2, 0.0) == [1, 1, 1, 1, 1]
    assert answers(0.0, 1.2, yaw_deg=90, heading_deg=90) == [1, 0, 0, 0, 0]
    # Without a margin, a path of 1 m ends 1 cm before it.
    assert answers(1.2, 0.0, passage_margin_m=0.0) == [1, 1, 0, 0, 0]
    # Its side is 0.4 - 0.14 = 0.26 m from the path; turned by 90 degrees, 0.4 - 0.19 = 0.21 m.
    assert answers(1.2, 0.4) == [1, 1, 1, 1, 1]
    assert answers(1.2, 0.4, yaw_deg=90) == [1, 0, 0, 0, 0]
    # The farthest one blocks the longest path alone: 2.9 - 0.19 - 0.225 = 2.485 m.
    assert answers(2.9, 0.0) == [1, 1, 1, 1, 0]


def test_of_several_objects_the_nearest_decides_and_absent_ones_never():
    away = [np.nan] * 3
    layouts = np.array([[away, away], [away, [1.2, 0.0, 0.0]], [[1.9, 0.0, 0.0], [1.2, 0.0, 0.0]]])
    free = clear_of(layouts, np.zeros((3, 2)), np.zeros((3, 1)), DataConfig())[:, 0]
    assert free[0].all()
    assert (free[1] == free[2]).all() and free[1].tolist() == [True, False, False, False, False]


@settings(deadline=None, max_examples=30)
@given(st.floats(0.7, 2.4), st.floats(-math.pi, math.pi), st.floats(-math.pi, math.pi), st.floats(0.06, 0.3))
def test_objects_are_judged_as_furniture_on_a_fine_map(away_m, angle, yaw, margin_m):
    """A map in cells of 2 cm, in which the basket is an obstacle, gives the same labels but for its cells' size."""
    at, cell_m, half_m = away_m * np.array([math.cos(angle), math.sin(angle)]), 0.02, np.array(BASKET[:2]) / 2
    x, y = (cell_centres(np.ones((300, 300), bool), cell_m, (-3.0, -3.0)) - at).T
    along, across = math.cos(yaw) * x + math.sin(yaw) * y, math.cos(yaw) * y - math.sin(yaw) * x
    taken = (np.abs(along) <= half_m[0]) & (np.abs(across) <= half_m[1])
    space = FreeSpace(clearance(~taken.reshape(300, 300), cell_m), cell_m, (-3.0, -3.0))
    heading = np.linspace(0, 2 * math.pi, 24, endpoint=False)

    def by_map(margin_m):
        config = DataConfig(passage_margin_m=margin_m)
        return free_lengths(space, np.zeros((24, 2)), heading, config)

    layout = np.array([[[*at, yaw]]])
    free = clear_of(layout, np.zeros((1, 2)), heading[None], DataConfig(passage_margin_m=margin_m))[0]
    assert (free >= by_map(margin_m + 0.04)).all() and (free <= by_map(margin_m - 0.04)).all()


@pytest.fixture(scope="module")
def drawn():
    """Passages of two empty rooms with up to four objects about each of 60 sources."""
    config = DataConfig(objects=4, passage_sources=30)
    return config, draw_passages(two_rooms_space(), ROOMS, config, np.random.default_rng(5))


def test_layouts_differ_and_stand_on_free_floor_in_sight(drawn):
    space, config = two_rooms_space(), drawn[0]
    sources = np.repeat([[-1.5, -0.5], [1.0, 0.5]], 40, 0)
    layouts = strew(space, sources, config, np.random.default_rng(0))
    assert layouts.shape == (80, 4, 3)
    assert np.array_equal(layouts, strew(space, sources, config, np.random.default_rng(0)), equal_nan=True)
    there = ~np.isnan(layouts[..., 0])
    assert set(there.sum(1).tolist()) == {0, 1, 2, 3, 4} and there.any(0).all()
    assert len(np.unique(layouts[there], axis=0)) == there.sum()
    radii = np.array([thing.radius_m for thing in pick(4)])
    for source, layout, mask in zip(sources, layouts, there, strict=True):
        xy, radius = layout[mask, :2], radii[mask]
        front = np.linalg.norm(xy - source, axis=1) - radius
        assert (front >= config.passage_clearance_m - 1e-9).all() and (front <= 2.5 + 1e-9).all()
        assert (space.at(xy) >= radius).all()
        assert space.segment_free(np.broadcast_to(source, xy.shape), xy, 200, 0.0).all()
        apart = np.linalg.norm(xy[:, None] - xy, axis=-1) + 9 * np.eye(len(xy))
        assert (apart >= radius[:, None] + radius).all()


def test_both_splits_are_balanced_and_objects_alone_block_a_good_share(drawn):
    config, passages = drawn
    space, scored = two_rooms_space(), config.passage_column
    bare = free_lengths(space, passages.xy_w, passages.heading_rad, config)
    clear = clear_of(passages.small_w, passages.xy_w, passages.heading_rad[:, None], config)[:, 0]
    assert (passages.free == (bare & clear)).all()
    assert (passages.free[:, :-1] >= passages.free[:, 1:]).all()
    for held in (False, True):
        mine = passages.free[passages.test == held, scored]
        assert len(mine) >= 20 and 2 * mine.sum() == len(mine)
    free, by_objects = passages.free[:, scored], bare[:, scored] & ~passages.free[:, scored]
    assert 0.3 < by_objects.sum() / (~free).sum() < 0.7
    # Most free paths lead past objects, and all paths of a source see the same ones.
    assert (~np.isnan(passages.small_w[free][..., 0])).any(1).mean() > 0.5
    for source in np.unique(passages.source):
        mine = passages.small_w[passages.source == source]
        assert np.array_equal(mine, np.broadcast_to(mine[:1], mine.shape), equal_nan=True)


def test_furniture_gives_way_by_hand():
    """Six paths are free but for objects, six end at furniture; two blocked by objects leave two at furniture."""
    bare = np.arange(12) < 6
    free = bare & (np.arange(12) >= 2)
    kept = fewer_at_furniture(bare, free, np.random.default_rng(0))
    assert kept[:6].tolist() == [0, 1, 2, 3, 4, 5] and len(kept) == 8
    # If objects block five, there are as many at furniture, although only one path is free.
    kept = fewer_at_furniture(bare, np.arange(12) == 0, np.random.default_rng(0))
    assert len(kept) == 11


def test_without_objects_the_same_passages_are_drawn_as_ever():
    """The digest is of the commit before there were any."""
    passages = draw_passages(two_rooms_space(), ROOMS, DataConfig(), np.random.default_rng(3))
    whole = [np.rint(1000 * passages.xy_w), np.rint(1000 * passages.heading_rad), passages.free, passages.source]
    whole = [np.asarray(part, np.int32).tobytes() for part in (*whole, passages.room, passages.test)]
    assert hashlib.sha256(b"".join(whole)).hexdigest()[:16] == "13346754a0c162cc"
    assert passages.small_w.shape == (len(passages), 0, 3)


def test_a_scene_without_room_for_objects_is_refused():
    space = FreeSpace(np.full((10, 10), 0.1), 0.1, (0.0, 0.0))
    with pytest.raises(ConfigError, match="none of 3 small objects fits on the floor within 2.5 m of 4 places; leave"):
        strew(space, np.full((4, 2), 0.5), DataConfig(objects=3), np.random.default_rng(0))


@pytest.mark.parametrize("word", ["objects=-1", "objects=101"])
def test_impossible_numbers_are_refused_in_one_line(word, painted, capsys):
    assert main(["data", str(painted), word]) != 0
    error = capsys.readouterr().err.strip()
    assert f"objects is {word[8:]}, expected between 0 and 100" in error and "\n" not in error


@pytest.fixture(scope="module")
def strewn(painted, tmp_path_factory):
    """A tiny dataset with objects, its settings, and the two kinds of renderer of its scene."""
    out, config = tmp_path_factory.mktemp("strewn") / "data", overridden(DataConfig(), [*WORDS, *TINY, "objects=3"])
    dataset.make_dataset([painted], out, config)
    scene, lens = load_scene(painted), lens_of(config, get_robot("ttbot"))
    return out, config, SceneRenderer(scene, lens), SceneRenderer(scene, lens, small=pick(3))


def test_rooms_are_shown_without_objects_and_passages_with_those_of_the_plan(strewn):
    out, config, bare, full = strewn
    robot, plan, rooms = get_robot("ttbot"), dataset.load_plan(out, "painted"), dataset.load_rooms(out)
    level = bare.draw(camera_pose(robot, plan.xy_w[0], dataset.headings(config), np.zeros(18)))
    assert (rooms.images[0, 1] == level).all()
    images, passages = dataset.load_passages(out).images, plan.passages
    assert len(passages) >= 8 and passages.small_w.shape == (len(passages), 3, 3)
    pose = camera_pose(robot, passages.xy_w, passages.heading_rad, np.zeros(len(passages)))
    assert (images == full.draw(pose, bodies(passages.small_w))).all()
    changed = (images != bare.draw(pose)).any((1, 2, 3))
    assert changed.any() and not changed[np.isnan(passages.small_w[..., 0]).all(1)].any()


def test_an_image_changes_only_where_the_object_stands(painted):
    """The basket stands 1.2 m ahead of the source and 0.2 m to the left; all of its corners are projected by hand."""
    scene, robot, lens = load_scene(painted), get_robot("ttbot"), Lens(64, 64, 120.0)
    bare, full = SceneRenderer(scene, lens), SceneRenderer(scene, lens, small=pick(3))
    pose = camera_pose(robot, np.array([[1.0, -1.5]]), np.array([np.pi / 2]), np.zeros(1))
    layout = np.full((1, 3, 3), np.nan)
    layout[0, 0] = 0.8, -0.3, np.pi / 2
    before, after = bare.draw(pose)[0].astype(int), full.draw(pose, bodies(layout))[0].astype(int)
    (forward, left, up), (length, width, height) = robot.camera.pos_m, BASKET
    # In pixels from the middle; its rim and grips stand out by up to 3 cm.
    focal, reach = lens.height / 2 / math.tan(math.radians(lens.fov_deg) / 2), 0.03
    x = 1.2 - forward + np.array([-1, 1]) * (length / 2 + reach)
    y = 0.2 - left + np.array([-1, 1]) * (width / 2 + reach)
    columns = lens.width / 2 - focal * np.array([a / b for a in y for b in x])
    rows = lens.height / 2 + focal * np.array([a / b for a in (up, up - height - reach) for b in x])
    row, column = np.nonzero(np.abs(after - before).max(-1) > 2)
    assert len(row) >= 15 and (before == bare.draw(pose)[0]).all()
    assert rows.min() - 1 <= row.min() and row.max() <= rows.max() and row.max() >= rows.max() - 4
    assert columns.min() - 1 <= column.min() and column.max() <= columns.max()
