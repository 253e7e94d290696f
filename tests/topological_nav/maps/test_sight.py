"""Eyes: distances of embeddings against plain arithmetic, the truth in a room known by hand, the baseline's swing."""

import dataclasses

import numpy as np
import pytest

from interactive_nav_common.errors import FileError
from tests.topological_nav.maps.test_graph import hand_map
from topological_nav.learn.training import Networks, Trained
from topological_nav.maps.build import OUT_OF_SIGHT_M, NetworkSight, PassagePolicy, TrueSight, localisation_check
from topological_nav.scenes.space import FreeSpace


def two_rooms_space() -> FreeSpace:
    """6 x 4 m in cells of 0.1 m, walls of 0.1 m around, and along x = 0 up to y = 1."""
    from interactive_nav_common.grids import clearance

    free = np.zeros((42, 62), bool)
    free[1:-1, 1:-1] = True
    free[:31, 30:32] = False  # x from -0.1 to 0.1, y up to 1
    return FreeSpace(clearance(free, 0.1), 0.1, (-3.1, -2.1))


class Fake(Trained):
    """A network: an image's first numbers are its embedding, or its logits for 1 and 2 m."""

    def __init__(self, digest):
        super().__init__(None, {}, {"digest": digest, "lengths_m": [1.0, 2.0]})  # type: ignore[arg-type]

    def embed(self, images):
        return np.asarray(images, np.float32)

    def logits(self, images):
        return np.asarray(images, np.float32)


@pytest.fixture()
def made():
    rng = np.random.default_rng(0)
    about = {"localiser": "one", "detector": "two"}
    return dataclasses.replace(hand_map({}), embeddings=rng.normal(size=(4, 6, 5)).astype(np.float32), about=about)


def test_aligned_images_are_compared_with_those_of_their_heading(made):
    rng = np.random.default_rng(1)
    images = rng.normal(size=(4, 5))
    sight = NetworkSight(made, Networks(Fake("one"), Fake("two")), "aligned")  # type: ignore[arg-type]
    # Headings of a node's images: 0, 60, 120, ... degrees; the nearest of these counts, around the circle.
    found = sight.distances(images, np.deg2rad([89.0, -29.0, 331.0, 360.0 + 120.0]))
    for row, k in enumerate((1, 0, 0, 2)):
        expected = [np.linalg.norm(images[row] - made.embeddings[n, k]) for n in range(4)]
        assert found[row] == pytest.approx(expected, rel=1e-5)
    assert sight.summed


def test_nearest_images_are_compared_with_all(made):
    images = np.random.default_rng(2).normal(size=(3, 5))
    sight = NetworkSight(made, Networks(Fake("one"), Fake("two")), "nearest")  # type: ignore[arg-type]
    expected = [[min(np.linalg.norm(i - e) for e in made.embeddings[n]) for n in range(4)] for i in images]
    assert sight.distances(images, np.zeros(3)) == pytest.approx(np.array(expected), rel=1e-5)
    assert not sight.summed
    asked = np.array([[np.log(3.0), 0.0], [np.log(3.0), -np.log(3.0)]])
    assert sight.passage(asked, np.array([0.5, 1.5])) == pytest.approx([0.75, 0.5])
    assert sight.passage(asked, 2.0) == pytest.approx([0.5, 0.25])
    assert sight.passage(asked, np.array([[2.0, 1.0], [1.0, 3.0]])) == pytest.approx(
        np.array([[0.5, 0.75], [0.75, 0.25]])
    )


def test_a_map_of_other_networks_is_refused(made):
    with pytest.raises(FileError, match="built with localiser one, this one is three"):
        NetworkSight(made, Networks(Fake("three"), Fake("two")))  # type: ignore[arg-type]
    with pytest.raises(FileError, match="built with detector two, this one is three"):
        NetworkSight(made, Networks(Fake("one"), Fake("three")))  # type: ignore[arg-type]


def test_how_well_a_map_localises_by_hand():
    made = hand_map({}, ((0.0, 0.0), (2.0, 0.0), (2.0, 2.0), (0.0, 2.0)))

    class Told:
        """Images are the distances themselves."""

        summed = True

        def distances(self, images, heading_rad):
            return images

    places = np.array([[0.0, 0.1], [2.0, 1.8]])  # nearest nodes 0 and 2, 0.1 and 0.2 m away
    images = np.array([[[1, 0, 2, 3], [1, 4, 2, 3]], [[9, 9, 1, 9], [9, 9, 1, 9]]], float)
    # The first place: sums 2, 4, 4, 6: node 0; its first image alone: node 1, 2.00 m away. The second: node 2.
    said = localisation_check(Told(), made, images, np.zeros(2), places)  # type: ignore[arg-type]
    assert said == {
        "localised by 2 images, aligned": "nearest node 1.000, within 1.5 m 1.000, median error 0.15 m "
        "(least possible 0.15 m)",
        "localised by 1 image, aligned": "nearest node 0.500, within 1.5 m 0.500, median error 1.10 m "
        "(least possible 0.15 m)",
    }


def test_the_truth_sees_nodes_and_ways():
    made = hand_map({}, ((-1.0, 0.0), (1.0, 0.0), (1.0, 1.5), (-1.0, 1.5)))
    sight = TrueSight(made, two_rooms_space(), margin_m=0.225)
    poses = np.array([[-1.0, 1.5, 0.0], [-1.0, 0.0, 0.0], [-1.0, 0.0, np.pi]])
    found = sight.distances(poses, np.zeros(3))
    # From (-1, 1.5) the gap shows (1, 1.5); the wall hides (1, 0). From (-1, 0) it hides both beyond.
    hidden = OUT_OF_SIGHT_M
    assert found[0] == pytest.approx([1.5, hidden + 2.5, 2.0, 0.0])
    assert found[1] == pytest.approx([0.0, hidden + 2.0, hidden + 2.5, 1.5])
    # 1 m through the gap is free; 1 m to the wall leaves no margin; 1 m to the far side does.
    assert sight.passage(poses, 1.0).tolist() == [1.0, 0.0, 1.0]
    # To the wall's side at x = -0.1 are 0.9 m, less 0.225 m: 0.6 m are free, 0.8 m not; to the outer wall 1.9 m.
    assert sight.passage(poses, np.array([1.5, 0.6, 1.7])).tolist() == [1.0, 1.0, 1.0]
    both = np.array([[1.5, 5.0], [0.6, 0.8], [1.7, 1.9]])
    assert sight.passage(poses, both).tolist() == [[1.0, 0.0], [1.0, 0.0], [1.0, 0.0]]
    # 0.15 m from the wall on the left (the middle of the nearest free cell): along it and towards it not, away from it.
    near = np.array([[-2.85, 0.0, angle] for angle in (np.pi / 2, np.pi, 0.0, np.pi / 4, 3 * np.pi / 4)])
    assert sight.passage(near, np.full(5, 1.0)).tolist() == [0.0, 0.0, 1.0, 1.0, 0.0]


class Gate:
    """A sight whose images are the probability itself; who asks for 1 m is told it."""

    def passage(self, images, ahead_m):
        assert ahead_m == 1.0
        return images[:, 0]


def test_the_baseline_drives_while_the_way_is_free_and_swings_ever_wider():
    policy = PassagePolicy(Gate(), passable=0.5)  # type: ignore[arg-type]
    state = policy.start(1)
    state, linear, angular = policy.act(state, np.array([[0.5]]))
    assert (linear[0], angular[0], state[0]) == (0.4, 0.0, 0)
    sides = []
    for _ in range(37):
        state, linear, angular = policy.act(state, np.array([[0.49]]))
        assert linear[0] == 0.0
        sides.append(float(np.sign(angular[0])))
    # 4 looks to the left, 12 to the right, 20 to the left, then right again.
    assert sides == [1.0] * 4 + [-1.0] * 12 + [1.0] * 20 + [-1.0]
    state, linear, _ = policy.act(state, np.array([[0.9]]))
    assert linear[0] == 0.4 and state[0] == 0
    # Episodes are on their own.
    state, linear, angular = policy.act(np.array([0, 5, 3]), np.array([[0.9], [0.1], [0.1]]))
    assert linear.tolist() == [0.4, 0.0, 0.0] and angular.tolist() == [0.0, -0.5, 0.5] and state.tolist() == [0, 6, 4]
