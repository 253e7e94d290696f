"""Drives are decided on along free edges, turn little, begin clear, and repeat."""

import dataclasses

import numpy as np
import pytest

from interactive_nav_common.errors import ConfigError
from interactive_nav_common.grids import clearance
from topological_nav.config import DriveConfig
from topological_nav.drives.dataset import draw_routes, drivable
from topological_nav.drives.expert import way_field
from topological_nav.scenes.space import FreeSpace

CONFIG = DriveConfig(drives=200, turn_deg=50.0)
NODES = np.array([[0.6, 0.6], [2.4, 0.6], [4.2, 0.6], [4.2, 2.4], [2.4, 2.4]])
"""0 - 1 - 2 in a row below, 3 above 2, 4 above 1 behind a wall with a far gap."""


@pytest.fixture(scope="module")
def space():
    free = np.ones((60, 100), bool)
    free[30, :70] = False
    return FreeSpace(clearance(free, 0.05), 0.05, (0.0, 0.0))


@pytest.fixture(scope="module")
def edges(space):
    return drivable(space, NODES, way_field(space, NODES, CONFIG, 20.0), CONFIG)


def test_edges_behind_a_wall_are_not_driven(edges):
    pairs = {tuple(e) for e in edges.tolist()}
    assert {(0, 1), (1, 0), (1, 2), (2, 1), (2, 3), (3, 2), (3, 4), (4, 3)} == pairs


def test_routes_follow_edges_and_turn_little(space, edges):
    routes = draw_routes(space, NODES, edges, CONFIG, np.random.default_rng(0))
    pairs = {tuple(e) for e in edges.tolist()}
    for nodes, legs in zip(routes.nodes, routes.legs, strict=True):
        way = nodes[: legs + 1].tolist()
        assert all((a, b) in pairs for a, b in zip(way, way[1:], strict=False))
        assert len(set(way)) == len(way) and (nodes[legs:] == nodes[legs]).all()
    # Straight on from 0 over 1 to 2 is the only way with two legs here, and back.
    longer = {tuple(n[: k + 1].tolist()) for n, k in zip(routes.nodes, routes.legs, strict=True) if k > 1}
    assert longer == {(0, 1, 2), (2, 1, 0)}
    assert set(routes.nodes[:, 0]) == {0, 1, 2, 3, 4}


def test_starts_are_near_their_node_clear_and_turned_within_bounds(space, edges):
    routes = draw_routes(space, NODES, edges, CONFIG, np.random.default_rng(0))
    away = np.linalg.norm(routes.start_xy_w - NODES[routes.nodes[:, 0]], axis=1)
    assert away.max() <= CONFIG.start_off_m + 1e-9 and away.max() > 0.2
    assert space.at(routes.start_xy_w).min() >= CONFIG.start_clear_m
    towards = NODES[routes.nodes[:, 1]] - routes.start_xy_w
    off = np.degrees(routes.start_yaw_rad - np.arctan2(towards[:, 1], towards[:, 0]))
    off = (off + 180) % 360 - 180
    assert np.abs(off).max() <= 15.0 and off.min() < -11 and off.max() > 11


def test_a_seed_repeats_and_whole_nodes_are_held_out(space, edges):
    config = dataclasses.replace(CONFIG, test_share=0.4)
    a, b, c = (draw_routes(space, NODES, edges, config, np.random.default_rng(s)) for s in (3, 3, 4))
    assert all((getattr(a, f.name) == getattr(b, f.name)).all() for f in dataclasses.fields(a))
    assert (a.start_xy_w != c.start_xy_w).any()
    tests = {int(n) for n in a.nodes[a.test, 0]}
    assert len(tests) == 2 and tests.isdisjoint(a.nodes[~a.test, 0].tolist())


def test_short_edges_begin_no_drive(space):
    nodes = np.array([[0.6, 0.6], [1.2, 0.6], [2.6, 0.6]])
    edges = drivable(space, nodes, way_field(space, nodes, CONFIG, 20.0), CONFIG)
    assert (0, 1) in {tuple(e) for e in edges.tolist()}
    routes = draw_routes(space, nodes, edges, CONFIG, np.random.default_rng(0))
    assert {tuple(n[:2]) for n in routes.nodes.tolist()} == {(0, 2), (1, 2), (2, 0), (2, 1)}


def test_a_scene_without_edges_is_refused(space):
    with pytest.raises(ConfigError, match="no two of 1 nodes are joined"):
        draw_routes(space, NODES[:1], np.zeros((0, 2), int), CONFIG, np.random.default_rng(0))
