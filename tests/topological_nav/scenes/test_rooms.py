"""Clusters of positions whose rooms are known."""

from pathlib import Path

import numpy as np
import pytest
from sklearn.metrics import adjusted_rand_score

from interactive_nav.scenes.scene import load_scene
from interactive_nav_common.errors import UserError
from scenes_mjcf.sets import packaged_set
from topological_nav.scenes import space as rooms
from topological_nav.scenes.space import RECORDED, free_space

SCENE = Path(__file__).parents[3] / "scenes_mjcf" / "apartment_0"


def three_squares() -> tuple[np.ndarray, np.ndarray]:
    """Squares of 2 m, 1 m apart along x, drawn right to left."""
    rng = np.random.default_rng(0)
    truth = np.repeat([2, 1, 0], 80)
    return rng.uniform(0, 2, (240, 2)) + np.stack([3.0 * truth, 0.0 * truth], -1), truth


@pytest.mark.parametrize("method", rooms.METHODS)
def test_separate_squares_are_found_and_numbered_from_the_left(method):
    points, truth = three_squares()
    assert (rooms.cluster(points, method, 3, 0) == truth).all()
    assert (rooms.cluster(points, method, 1, 0) == 0).all()


@pytest.mark.parametrize("method", rooms.METHODS)
def test_same_seed_same_rooms(method):
    points = np.random.default_rng(1).uniform(0, 5, (150, 2))
    assert (rooms.cluster(points, method, 5, 3) == rooms.cluster(points, method, 5, 3)).all()


def test_the_number_of_squares_is_chosen():
    points, _ = three_squares()
    assert rooms.choose_count(points, "kmeans", 0, 6) == (3, "silhouette")
    blobs = np.concatenate([np.random.default_rng(k).normal(6 * k, 0.5, (100, 2)) for k in range(4)])
    assert rooms.choose_count(blobs, "gmm", 0, 6) == (4, "bic")


def test_wrong_requests_are_refused():
    with pytest.raises(UserError, match="count is 6, expected between 1 and the 5 points"):
        rooms.cluster(np.zeros((5, 2)), "gmm", 6, 0)


def test_each_packaged_scene_has_the_rooms_recorded_that_its_free_space_lies_in():
    names = (SCENE.name, *packaged_set("sparse").scenes)
    assert len(names) == len(RECORDED)
    for name in names:
        scene = load_scene(SCENE.parent / name)
        known = rooms.recorded_rooms(scene.digest)
        assert known is not None
        free = free_space(scene, 1.1).centres(0.2)
        inside = ((free[:, None] > known[:, :2]) & (free[:, None] < known[:, 2:])).all(-1)
        assert inside.sum(1).max() == 1 and inside.sum(1).mean() > 0.95  # the rest stands in doorways
        assert inside.sum(0).min() > 0
        assert name != SCENE.name or known.shape == (4, 4)  # scenes_mjcf/README.md: four rooms


def test_other_scenes_have_none(room):
    assert rooms.recorded_rooms(load_scene(room).digest) is None


def test_a_doorway_belongs_to_the_nearer_room():
    known = np.array([[0.0, 0.0, 2.0, 2.0], [2.2, 0.0, 4.0, 2.0]])
    points = np.array([[1.0, 1.0], [2.05, 1.0], [2.15, 1.0], [3.0, 1.0]])
    assert rooms.room_of(known, points).tolist() == [0, 0, 1, 1]


def test_known_rooms_decide_the_number_and_are_agreed_with():
    known = rooms.recorded_rooms(load_scene(SCENE).digest)
    assert known is not None
    space = free_space(load_scene(SCENE), 1.1)
    found = rooms.find_rooms(space, "spectral", None, known, 0, 0.2)
    assert (found.count, found.chosen_by) == (4, "recorded")
    rand = rooms.agreement(found, known)
    assert rand == adjusted_rand_score(rooms.room_of(known, found.points_w), found.labels)
    assert rand > 0.8
    assert rooms.find_rooms(space, "gmm", 3, known, 0, 0.2).count == 3
    assert (found.of(found.points_w) == found.labels).all()
