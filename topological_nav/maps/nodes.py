"""A scene's free space and rooms in, the places of a map's nodes out."""

import numpy as np
from scipy.sparse.csgraph import dijkstra
from scipy.spatial.distance import cdist

from interactive_nav_common.grids import MOVES_4, cell_centres, follow, grid_graph
from topological_nav.config import MapConfig
from topological_nav.maps.graph import near_pairs, parts_of
from topological_nav.scenes.rooms import Rooms
from topological_nav.scenes.space import FreeSpace

ROOMY_M = 0.5
"""Nodes added to join parts of a map keep to the middle of what is narrower than twice this."""
TIGHT_COST = 4.0
"""A metre of the way between parts costs up to so many metres more, the nearer to obstacles."""


def place_nodes(
    space: FreeSpace, rooms: Rooms, config: MapConfig, margin_m: float, points: int
) -> tuple[np.ndarray, list[str]]:
    """Where a map's nodes stand.

    In every room one place after the other becomes a node, each time the one that has most places within `spacing_m`
    that no node has yet. A room that needs fewer than `min_per_room`
    is covered again with less spacing. Then, where `connect` is set, nodes are added along the free way
    between parts of the map that no free edge joins which is shortest where room to the sides counts as well.

    Returns:
        [N, 2] m, and what could not be had, in words.
    """
    places = space.centres(config.clearance_m)
    label = rooms.of(places)
    nodes, lacking = [], []
    for room in range(rooms.count):
        mine = places[label == room]
        if len(mine) < config.min_per_room:
            lacking.append(f"room {room} has place for {len(mine)} nodes only, expected {config.min_per_room}")
            nodes.append(mine)
            continue
        radius = config.spacing_m
        chosen = _covering(mine, radius, space.resolution_m)
        while len(chosen) < config.min_per_room:
            radius *= 0.8
            chosen = _covering(mine, radius, space.resolution_m)
        nodes.append(chosen)
    xy = np.concatenate(nodes) if nodes else np.zeros((0, 2))
    if not config.connect:
        return xy, lacking
    joined, apart = _joined(space, xy, config.edge_m, margin_m, points)
    if apart > 1:
        lacking.append(f"{apart} parts of the scene are not joined by any way with {margin_m} m clearance")
    return joined, lacking


def free_edges(space: FreeSpace, xy_w: np.ndarray, edge_m: float, margin_m: float, points: int) -> np.ndarray:
    """[E, 2] i32: the pairs of `near_pairs` whose way is free."""
    edges = near_pairs(xy_w, edge_m)
    return edges[space.segment_free(xy_w[edges[:, 0]], xy_w[edges[:, 1]], points, margin_m)]


def _covering(places: np.ndarray, radius_m: float, step_m: float) -> np.ndarray:
    """Some of the places [n, 2], at least one within the radius of each: greedily those with most of the rest near."""
    # One place in each square of two cells is enough to choose from.
    _, first = np.unique(np.floor(places / (2 * step_m)), axis=0, return_index=True)
    some = places[np.sort(first)]
    near = cdist(some, some) <= radius_m
    chosen, bare = [], np.ones(len(some), bool)
    while bare.any():
        chosen.append(int((near & bare).sum(1).argmax()))
        bare &= ~near[chosen[-1]]
    nodes = some[chosen]
    away = cdist(places, nodes).min(1)
    while away.max() > radius_m:  # the other places of the squares
        nodes = np.concatenate([nodes, places[[away.argmax()]]])
        away = np.minimum(away, np.linalg.norm(places - nodes[-1], axis=1))
    return nodes


def _joined(space: FreeSpace, xy: np.ndarray, edge_m: float, margin_m: float, points: int) -> tuple[np.ndarray, int]:
    """Add nodes until free edges join all that a free way joins; return them all, and the number of parts left."""
    free = space.free(margin_m)
    # Cells that share a side: the straight way between their centres is as free as they are.
    cost = 1.0 + TIGHT_COST * np.clip(1.0 - space.clearance_m / ROOMY_M, 0.0, 1.0)
    lattice, centres = (
        grid_graph(free, cost, space.resolution_m, MOVES_4),
        cell_centres(np.ones_like(free), space.resolution_m, space.origin_w),
    )
    while True:
        parts = parts_of(free_edges(space, xy, edge_m, margin_m, points), len(xy))
        column, row = space.inner_cells(xy).T
        at = np.where(free[row, column], np.ravel_multi_index((row, column), free.shape), -1)
        for part in parts[1:]:
            mine = np.array(part)
            others = np.setdiff1d(np.arange(len(xy)), mine)
            mine, others = mine[at[mine] >= 0], others[at[others] >= 0]
            if not len(mine) or not len(others):
                continue
            how = {"directed": False, "min_only": True, "return_predecessors": True}
            far, before, _ = dijkstra(lattice, indices=at[mine], **how)
            end = int(others[far[at[others]].argmin()])
            if not np.isfinite(far[at[end]]):
                continue
            added = _stations(space, centres[follow(before, at[end])], edge_m, margin_m, points)
            if len(added):
                xy = np.concatenate([xy, added])
                break
        else:
            return xy, len(parts)


def _stations(space: FreeSpace, way: np.ndarray, edge_m: float, margin_m: float, points: int) -> np.ndarray:
    """Places on a way [n, 2], ends left out, each in free reach of the one before.

    Of those in reach, the one with the most room in the farther half; the end as soon as it is in reach.
    """
    chosen, at, room_m = [], 0, np.minimum(space.at(way), ROOMY_M)
    while at < len(way) - 1:
        ahead = way[at + 1 :]
        reach = np.linalg.norm(ahead - way[at], axis=1) < edge_m
        reachable = reach & space.segment_free(np.broadcast_to(way[at], ahead.shape), ahead, points, margin_m)
        last = at + 1 + int(np.flatnonzero(reachable)[-1])
        if last < len(way) - 1:
            steps = at + 1 + np.flatnonzero(reachable)
            steps = steps[steps - at > (last - at) // 2][::-1]  # of equals the farthest
            last = int(steps[room_m[steps].argmax()])
        at = last
        chosen.append(way[at])
    return np.array(chosen[:-1]).reshape(-1, 2)
