"""Maps by hand: weights, angles, ways, files; ways against another implementation of Dijkstra's algorithm."""

import dataclasses
import itertools
import math

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.sparse.csgraph import dijkstra

from interactive_nav.scenes.scene import load_scene
from interactive_nav_common.errors import FileError
from topological_nav.config import MapConfig
from topological_nav.maps import graph
from topological_nav.scenes.space import find_rooms, free_space, spread


def hand_map(probability: dict[tuple[int, int], float], xy=((0.0, 0.0), (2.0, 0.0), (2.0, 2.0), (0.0, 9.0))):
    """A map of points whose edges have the given probabilities, 0.5 elsewhere."""
    xy = np.asarray(xy)
    return graph.assemble(
        "hand",
        "d" * 64,
        xy,
        np.zeros(len(xy)),
        np.arange(2.0 * len(xy)).reshape(len(xy), 1, 2),
        2.9,
        lambda edges, angle: np.array([probability.get(tuple(e), 0.5) for e in edges.tolist()]),
        {"made": "by hand"},
    )


def test_every_near_pair_has_an_edge_both_ways():
    made = hand_map({})
    # 0-1 and 1-2 are 2 m apart, 0-2 2.83 m; 3 is 7 m from the nearest.
    assert made.edges.tolist() == [[0, 1], [0, 2], [1, 0], [1, 2], [2, 0], [2, 1]]
    exact = graph.near_pairs(np.array([[0.0, 0.0], [2.5, 0.0], [2.49, 1.0]]), 2.5)
    assert exact.tolist() == [[1, 2], [2, 1]]  # 2.5 m apart is not nearer than 2.5 m


def test_angles_are_absolute():
    made = hand_map({})
    quarter = math.pi / 4
    assert made.angle_rad.tolist() == pytest.approx(
        [0.0, quarter, math.pi, 2 * quarter, -3 * quarter, -2 * quarter], abs=1e-6
    )


def test_the_way_most_likely_free_is_taken():
    # Straight 0 -> 2: -log 0.6 = 0.511. By node 1: -log(0.9 * 0.8) = -log 0.72 = 0.329.
    made = hand_map({(0, 2): 0.6, (0, 1): 0.9, (1, 2): 0.8})
    nodes, cost = made.plan(0, 2)
    assert nodes == [0, 1, 2]
    assert cost == pytest.approx(0.3285, abs=1e-4)
    # Back, the edges are others: 0.5 straight (0.693) against 0.25 (1.386).
    assert made.plan(2, 0)[0] == [2, 0]
    # Better straight: 0.73 beats 0.72.
    assert hand_map({(0, 2): 0.73, (0, 1): 0.9, (1, 2): 0.8}).plan(0, 2)[0] == [0, 2]
    assert made.plan(1, 1) == ([1], 0.0)


def test_certain_edges_stay_finite_and_cost_something():
    # Edges are 0-1, 0-2, 1-0, 1-2, 2-0 and 2-1.
    none, half, certain, *_ = hand_map({(0, 1): 0.0, (0, 2): 0.5, (1, 0): 1.0}).weight
    assert none == pytest.approx(-math.log(1e-6)) and half == pytest.approx(math.log(2))
    assert 0.0 < certain < 1e-5


def test_no_way_and_no_node_are_refused():
    made = hand_map({})
    with pytest.raises(FileError, match="no way from node 0 to 3 in the map of 'hand'"):
        made.plan(0, 3)
    with pytest.raises(FileError, match="node 4 is not in the map of 'hand', expected 0 to 3"):
        made.plan(0, 4)


@settings(deadline=None)
@given(st.integers(0, 10_000))
def test_ways_cost_what_scipy_finds(seed):
    rng = np.random.default_rng(seed)
    xy = rng.uniform(0, 6, (12, 2))
    p = {}
    made = hand_map({tuple(e): p.setdefault(tuple(e), rng.uniform()) for e in graph.near_pairs(xy, 2.9).tolist()}, xy)
    dense = np.zeros((12, 12))
    for (a, b), value in p.items():
        dense[a, b] = -math.log(min(max(np.float32(value), 1e-6), 1 - 1e-6))
    expected = dijkstra(dense, indices=0)
    for goal in range(12):
        if np.isfinite(expected[goal]):
            nodes, cost = made.plan(0, goal)
            assert cost == pytest.approx(expected[goal], rel=1e-5, abs=1e-9)
            assert sum(dense[a, b] for a, b in itertools.pairwise(nodes)) == pytest.approx(cost, rel=1e-5, abs=1e-9)
        else:
            with pytest.raises(FileError):
                made.plan(0, goal)


def test_parts_that_open_edges_join():
    made = hand_map({(0, 1): 0.9, (1, 0): 0.9, (1, 2): 0.9, (2, 1): 0.4})
    assert made.open_parts(0.6) == [[0, 1], [2], [3]]  # to 2 and not back
    assert made.open_parts(0.3) == [[0, 1, 2], [3]]


def test_a_map_is_one_file_and_of_one_scene(tmp_path):
    made, path = hand_map({(0, 1): 0.9}), tmp_path / "map.npz"
    graph.save_map(made, path)
    back = graph.load_map(path, "d" * 64)
    assert back.about == {"made": "by hand"} and back.scene == "hand"
    for name in ("xy_w", "room", "embeddings", "edges", "p", "angle_rad"):
        assert (getattr(back, name) == getattr(made, name)).all()
    assert [p.name for p in tmp_path.iterdir()] == ["map.npz"]
    with pytest.raises(
        FileError, match="made in scene 'hand' with digest dddddddddddd, the scene here has eeeeeeeeeeee"
    ):
        graph.load_map(path, "e" * 64)
    path.write_bytes(path.read_bytes()[:300])
    with pytest.raises(FileError, match="not readable"):
        graph.load_map(path)


def test_another_format_is_refused(tmp_path, monkeypatch):
    monkeypatch.setattr(graph, "FORMAT", 2)
    graph.save_map(hand_map({}), tmp_path / "map.npz")
    monkeypatch.undo()
    with pytest.raises(FileError, match="format 2, expected 1; build the map again"):
        graph.load_map(tmp_path / "map.npz")


@pytest.fixture(scope="module")
def plan(two_rooms):
    """5 x 4 m, cut at x = 0 from y = -2 to 1."""
    space = free_space(load_scene(two_rooms), 1.1)
    return space, find_rooms(space, "kmeans", 2, None, 0, 0.2)


def parts(space, xy) -> int:
    """Parts that free edges join."""
    import networkx as nx

    edges = graph.near_pairs(xy, 2.5)
    made = nx.Graph(edges[space.segment_free(xy[edges[:, 0]], xy[edges[:, 1]], 50, 0.225)].tolist())
    made.add_nodes_from(range(len(xy)))
    return nx.number_connected_components(made)


def test_rooms_have_their_nodes_and_no_place_is_far_from_one(plan):
    space, rooms = plan
    config = MapConfig(min_per_room=5, spacing_m=1.2, connect=False)
    xy, lacking = graph.place_nodes(space, rooms, config, 0.225, 50)
    assert (np.bincount(rooms.of(xy)) >= 5).all() and lacking == []
    assert (space.at(xy) >= config.clearance_m).all()
    places = space.centres(config.clearance_m)
    assert np.linalg.norm(places[:, None] - xy, axis=-1).min(1).max() <= 1.2
    # As many places far from each other would stand along walls.
    apart = places[spread(places, len(xy), np.random.default_rng(0))]
    assert space.at(xy).mean() > space.at(apart).mean()


def test_parts_that_a_way_joins_are_joined(plan):
    space, rooms = plan
    sparse = MapConfig(min_per_room=1, spacing_m=100.0, connect=False)
    xy, _ = graph.place_nodes(space, rooms, sparse, 0.225, 50)
    assert len(xy) == 2 and parts(space, xy) == 2  # one node a room: the partition stands between them
    xy, lacking = graph.place_nodes(space, rooms, MapConfig(min_per_room=1, spacing_m=100.0), 0.225, 50)
    assert parts(space, xy) == 1 and lacking == [] and len(xy) > 2
    # Where there is room, they keep off the walls: the gap is 1 m wide, and a shortest way would graze its edge.
    assert (space.at(xy[2:]) >= 0.4).all()


def test_rooms_that_no_way_joins_are_told(plan):
    space, rooms = plan
    config = MapConfig(min_per_room=1, spacing_m=100.0)
    _, lacking = graph.place_nodes(space, rooms, config, 0.6, 50)
    assert len(lacking) == 1 and "parts of the scene are not joined by any way with 0.6 m clearance" in lacking[0]


@settings(deadline=None)
@given(st.integers(0, 10_000))
def test_the_next_edge_begins_the_cheapest_way_also_where_edges_were_refused(seed):
    rng = np.random.default_rng(seed)
    xy = rng.uniform(0, 5, (9, 2))
    made = hand_map({tuple(e): rng.uniform(0.05, 0.95) for e in graph.near_pairs(xy, 2.9).tolist()}, xy)
    made = dataclasses.replace(made, metre_cost=rng.choice([0.0, 0.2]))
    refused = rng.choice([0.0, 3.0], len(made.edges))
    for penalty in (None, np.zeros(len(made.edges)), refused):
        dense = np.zeros((9, 9))
        dense[made.edges[:, 0], made.edges[:, 1]] = made.weight + (0.0 if penalty is None else penalty)
        left = dijkstra(dense)
        for start in range(9):
            for goal in set(range(9)) - {start}:
                edge = made.next_edge(start, goal, penalty)
                if not np.isfinite(left[start, goal]):
                    assert edge == -1
                    continue
                a, b = made.edges[edge]
                assert a == start and dense[a, b] + left[b, goal] == pytest.approx(left[start, goal], abs=1e-9)
