"""A scene's free space in, drives along its graph out: which nodes after each other, begun where and turned how."""

import dataclasses

import numpy as np

from topological_nav.config import DriveConfig
from topological_nav.errors import SpaceError
from topological_nav.maps.graph import angles, near_pairs
from topological_nav.scenes.space import FreeSpace

CANDIDATES = 32
"""Starts tried about a node; the best is taken if none is clear."""


@dataclasses.dataclass(frozen=True)
class Routes:
    """Drives of one scene; n of them."""

    nodes: np.ndarray
    """[n, legs + 1] i32 nodes one after the other; the last repeated where a drive is shorter."""
    legs: np.ndarray
    """[n] i32 edges driven."""
    start_xy_w: np.ndarray
    """[n, 2] m."""
    start_yaw_rad: np.ndarray
    """[n]."""
    test: np.ndarray
    """[n] bool: for testing only."""


def drivable(space: FreeSpace, nodes_w: np.ndarray, to_go_m: np.ndarray, config: DriveConfig) -> np.ndarray:
    """[E, 2] i32: the ordered pairs of nodes nearer than `edge_m` whose planned way is no long detour.

    Args:
        nodes_w: [N, 2] m.
        to_go_m: [N, rows, columns] of `expert.way_field`, one to each node.
    """
    edges = near_pairs(nodes_w, config.edge_m)
    column, row = space.inner_cells(nodes_w).T
    way = to_go_m[edges[:, 1], row[edges[:, 0]], column[edges[:, 0]]]
    straight = np.linalg.norm(nodes_w[edges[:, 0]] - nodes_w[edges[:, 1]], axis=1)
    return edges[way <= config.detour * straight]


def draw_routes(
    space: FreeSpace, nodes_w: np.ndarray, edges: np.ndarray, config: DriveConfig, rng: np.random.Generator
) -> Routes:
    """Draws the drives of a scene.

    The first edge is uniform over all that are long enough; from its end a drive goes on by an edge that turns less
    than `turn_deg`, if there is one, uniform over those. A share of the nodes is held out: drives that begin there are
    for testing.

    Args:
        nodes_w: [N, 2] m.
        edges: [E, 2] of `drivable`.
    """
    if not len(edges):
        raise SpaceError(f"no two of {len(nodes_w)} nodes are joined by a way to drive; use a larger edge_m or detour")
    heading = angles(nodes_w, edges)
    length = np.linalg.norm(nodes_w[edges[:, 1]] - nodes_w[edges[:, 0]], axis=1)
    begins = np.flatnonzero(length >= min(config.least_edge_m, length.max()))
    out_of = [np.flatnonzero(edges[:, 0] == node) for node in range(len(nodes_w))]
    begun = np.unique(edges[begins, 0])
    tests = rng.permutation(begun)[: round(config.test_share * len(begun))]
    nodes = np.empty((config.drives, config.legs + 1), np.int32)
    legs, yaw = np.empty(config.drives, np.int32), np.empty(config.drives)
    start = np.empty((config.drives, 2))
    for i in range(config.drives):
        way = [int(rng.choice(begins))]
        while len(way) < config.legs:
            onward = out_of[edges[way[-1], 1]]
            turn = np.abs((heading[onward] - heading[way[-1]] + np.pi) % (2 * np.pi) - np.pi)
            passed = {int(edges[way[0], 0]), *(int(edges[w, 1]) for w in way)}
            fresh = np.array([int(edges[e, 1]) not in passed for e in onward], bool)
            onward = onward[(turn < np.radians(config.turn_deg)) & fresh]
            if not len(onward):
                break
            way.append(int(rng.choice(onward)))
        legs[i] = len(way)
        visited = [edges[way[0], 0], *edges[way, 1]]
        nodes[i] = visited + [visited[-1]] * (config.legs - len(way))
        start[i] = _start(space, nodes_w[visited[0]], config, rng)
        off = np.radians(config.start_turn_deg) * rng.uniform(-1.0, 1.0)
        towards = nodes_w[visited[1]] - start[i]
        yaw[i] = np.arctan2(towards[1], towards[0]) + off
    return Routes(nodes, legs, start, (yaw + np.pi) % (2 * np.pi) - np.pi, np.isin(nodes[:, 0], tests))


def _start(space: FreeSpace, node_w: np.ndarray, config: DriveConfig, rng: np.random.Generator) -> np.ndarray:
    """[2] a place near a node: the first of some that is clear, else the clearest."""
    angle, share = rng.uniform(0, 2 * np.pi, CANDIDATES), np.sqrt(rng.uniform(0, 1, CANDIDATES))
    offset = config.start_off_m * share[:, None] * np.stack([np.cos(angle), np.sin(angle)], -1)
    tried = np.concatenate([node_w + offset, node_w[None]])
    room = space.at(tried)
    clear = np.flatnonzero(room >= config.start_clear_m)
    return tried[clear[0] if len(clear) else int(room.argmax())]
