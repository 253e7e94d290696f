"""Nearest nodes and their scores, by hand."""

import numpy as np
import pytest

from topological_nav.learn.networks import Places, localisation_scores


def matched(queries, nodes):
    """The node of each query [Q, D]: the only one in a room where the query counts as right."""
    xy, rooms = np.zeros((1, 2)), np.arange(len(nodes))
    places = Places(nodes, np.zeros((len(nodes), 2)), rooms)
    return [
        next(k for k in rooms if localisation_scores(Places(one[None, None], xy, rooms[[k]]), places)["room"] == 1.0)
        for one in queries
    ]


def test_the_node_of_the_nearest_image_wins():
    nodes = np.array([[[0.0, 0.0], [5.0, 0.0]], [[2.0, 0.0], [9.0, 9.0]]])
    queries = np.array([[4.0, 0.0], [2.5, 0.0], [9.0, 8.0]])
    assert matched(queries, nodes) == [0, 1, 1]


def test_brute_force_agrees():
    rng = np.random.default_rng(0)
    queries, nodes = rng.normal(size=(40, 7)), rng.normal(size=(12, 18, 7))
    every = np.linalg.norm(queries[:, None, None] - nodes, axis=-1).min(2)
    assert matched(queries, nodes) == every.argmin(1).tolist()


def test_scores_by_hand():
    nodes = np.array([[[0.0]], [[1.0]], [[2.0]]])
    node_xy, node_room = np.array([[0.0, 0.0], [1.0, 0.0], [4.0, 0.0]]), np.array([0, 0, 1])
    # Looks like node 0, 1, 2; taken 0.1 m from node 0, 0.6 m from node 0 (0.4 from 1), 0.5 m from node 1.
    xy = np.array([[0.1, 0.0], [0.6, 0.0], [1.5, 0.0]])
    scores = localisation_scores(
        Places(np.arange(3.0)[:, None, None], xy, np.zeros(3, int)), Places(nodes, node_xy, node_room)
    )
    assert scores["node"] == pytest.approx(2 / 3)
    assert scores["room"] == pytest.approx(2 / 3)
    assert scores["error_m"] == pytest.approx(0.4)  # of 0.1, 0.4 and 2.5
    assert scores["least_error_m"] == pytest.approx(0.4)  # of 0.1, 0.4 and 0.5
