"""Nodes, passage probabilities and angles in, a topological map out: planned on, asked where an image is, one file.

A node is a position with the embeddings of the images around it. An edge leads from a node to each one nearer than
`edge_m`; its weight is -log p, p the probability that the way is free, so that the shortest way is the one most likely
to be free as a whole; who plans may add a cost for each metre (`metre_cost`). Edges carry their absolute angle and
length: nothing else about positions is needed to drive along them.
"""

from __future__ import annotations

import dataclasses
import functools
import json
import math
from collections.abc import Callable
from pathlib import Path
from typing import Any

import networkx as nx
import numpy as np
from scipy.sparse import csr_array
from scipy.sparse.csgraph import dijkstra
from scipy.spatial.distance import cdist

from interactive_nav_common.files import whole_file
from topological_nav.config import MapConfig
from topological_nav.errors import MapError, readable
from topological_nav.learn.localise import nearest_node
from topological_nav.scenes.rooms import Rooms
from topological_nav.scenes.space import FreeSpace

FORMAT = 1
"""Of map files; raised whenever older ones would be read wrongly."""
ROOMY_M = 0.5
"""Nodes added to join parts of a map keep to the middle of what is narrower than twice this."""
TIGHT_COST = 4.0
"""A metre of the way between parts costs up to so many metres more, the nearer to obstacles."""
LEAST_P = 1e-6
"""Probabilities stay this far from 0, so that weights are finite, and from 1, so that every edge costs something."""


@dataclasses.dataclass(frozen=True)
class Route:
    """A way through a map."""

    nodes: tuple[int, ...]
    angles_rad: tuple[float, ...]
    """Absolute heading of each leg, one fewer than nodes."""
    cost: float
    """Sum of the legs' weights."""


@dataclasses.dataclass(frozen=True)
class TopologicalMap:
    """N nodes, K images each, E directed edges."""

    scene: str
    digest: str
    """Of the scene's files, as `interactive_nav.scenes.scene.Scene.digest`."""
    xy_w: np.ndarray
    """[N, 2] f32 m: for drawing, scoring and the edges' lengths; nothing else of it is used to plan or to localise."""
    room: np.ndarray
    """[N] i32."""
    embeddings: np.ndarray
    """[N, K, D] f32."""
    edges: np.ndarray
    """[E, 2] i32 from, to."""
    p: np.ndarray
    """[E] f32 probability that the way is free."""
    angle_rad: np.ndarray
    """[E] f32 heading from the first node to the second, world frame."""
    about: dict[str, Any]
    """Settings, and the networks that made it."""
    metre_cost: float = 0.0
    """Added to the weight of an edge for each of its metres; belongs to who plans, not to the file."""

    @functools.cached_property
    def length_m(self) -> np.ndarray:
        """[E] of the edges."""
        return lengths(self.xy_w, self.edges)

    @functools.cached_property
    def graph(self) -> nx.DiGraph:
        """The edges with `weight`, `p` and `angle_rad`."""
        graph = nx.DiGraph()
        graph.add_nodes_from(range(len(self.xy_w)))
        rows = zip(self.edges.tolist(), self.weight.tolist(), self.p.tolist(), self.angle_rad.tolist(), strict=True)
        for (a, b), weight, p, angle in rows:
            graph.add_edge(a, b, weight=weight, p=p, angle_rad=angle)
        return graph

    def plan(self, start: int, goal: int) -> Route:
        """The cheapest way between two nodes, by Dijkstra's algorithm.

        Raises:
            MapError: no such node, or no way.
        """
        for node in (start, goal):
            if not 0 <= node < len(self.xy_w):
                raise MapError(f"node {node} is not in the map of '{self.scene}', expected 0 to {len(self.xy_w) - 1}")
        try:
            found: Any = nx.single_source_dijkstra(self.graph, start, goal)
        except nx.NetworkXNoPath:
            raise MapError(f"no way from node {start} to {goal} in the map of '{self.scene}'; make it denser") from None
        cost, nodes = found
        angles = tuple(self.graph.edges[a, b]["angle_rad"] for a, b in zip(nodes, nodes[1:], strict=False))
        return Route(tuple(nodes), angles, float(cost))

    @functools.cached_property
    def weight(self) -> np.ndarray:
        """[E] -log p of the edges, and `metre_cost` for each metre."""
        return np.array([edge_weight(p) for p in self.p.tolist()]) + self.metre_cost * self.length_m

    def next_edge(self, start: int, goal: int, penalty: np.ndarray | None = None) -> int:
        """The first edge of the cheapest way between two different nodes; -1 where there is none.

        Args:
            start: node.
            goal: node.
            penalty: [E] added to the edges' weights.
        """
        if penalty is None or not penalty.any():
            weight, left = self.weight, self.left[goal]
        else:
            weight = self.weight + penalty
            left = self._left_to(weight, goal)
        out = np.flatnonzero(self.edges[:, 0] == start)
        total = weight[out] + left[self.edges[out, 1]]
        return int(out[total.argmin()]) if len(out) and np.isfinite(total.min()) else -1

    @functools.cached_property
    def left(self) -> np.ndarray:
        """[N, N] cost of the cheapest way to each goal (first axis) from each node; infinite where there is none."""
        return self._left_to(self.weight, np.arange(len(self.xy_w)))

    def _left_to(self, weight: np.ndarray, goals: np.ndarray | int) -> np.ndarray:
        size = len(self.xy_w)
        back = csr_array((weight, (self.edges[:, 1], self.edges[:, 0])), shape=(size, size))
        return np.asarray(dijkstra(back, indices=goals))

    def localise(self, embeddings: np.ndarray) -> np.ndarray:
        """[Q] i32: the node nearest to each embedding [Q, D], over all images of all nodes."""
        return nearest_node(embeddings, self.embeddings)[0]

    def open_parts(self, passable: float) -> list[list[int]]:
        """Nodes that reach each other, both ways, along edges with at least this probability; largest part first."""
        kept = [(a, b) for a, b, p in self.graph.edges(data="p") if p >= passable]
        graph = nx.DiGraph(kept)
        graph.add_nodes_from(self.graph)
        return sorted((sorted(part) for part in nx.strongly_connected_components(graph)), key=lambda p: (-len(p), p))

    def thinned(self, share: float, seed: int) -> TopologicalMap:
        """The map with fewer nodes: a sparse one that may fall apart.

        Args:
            share: of each room's nodes that stay, drawn at random; at least one a room.
            seed: of the draw.
        """
        rng = np.random.default_rng([seed, 11])
        kept = []
        for room in np.unique(self.room):
            mine = np.flatnonzero(self.room == room)
            kept.append(rng.choice(mine, max(1, round(share * len(mine))), replace=False))
        rows = np.sort(np.concatenate(kept))
        number = np.full(len(self.xy_w), -1, np.int32)
        number[rows] = np.arange(len(rows))
        edges = (number[self.edges] >= 0).all(1)
        return dataclasses.replace(
            self,
            xy_w=self.xy_w[rows],
            room=self.room[rows],
            embeddings=self.embeddings[rows],
            edges=number[self.edges[edges]],
            p=self.p[edges],
            angle_rad=self.angle_rad[edges],
            about={**self.about, "thinned": share, "thinned_seed": seed},
        )


def edge_weight(p: float) -> float:
    """-log p, with p kept `LEAST_P` from 0 and 1."""
    return -math.log(min(max(p, LEAST_P), 1.0 - LEAST_P))


def near_pairs(xy_w: np.ndarray, edge_m: float) -> np.ndarray:
    """[E, 2] i32: every ordered pair of different points [N, 2] nearer than `edge_m`, sorted."""
    away = np.linalg.norm(xy_w[:, None] - xy_w[None], axis=-1)
    return np.argwhere((away < edge_m) & ~np.eye(len(xy_w), dtype=bool)).astype(np.int32)


def angles(xy_w: np.ndarray, edges: np.ndarray) -> np.ndarray:
    """[E] rad in (-pi, pi]: headings of edges [E, 2] between points [N, 2]."""
    step = xy_w[edges[:, 1]] - xy_w[edges[:, 0]]
    return np.arctan2(step[:, 1], step[:, 0])


def lengths(xy_w: np.ndarray, edges: np.ndarray) -> np.ndarray:
    """[E] m: lengths of edges [E, 2] between points [N, 2]."""
    return np.linalg.norm(xy_w[edges[:, 1]] - xy_w[edges[:, 0]], axis=-1).astype(float)


def place_nodes(
    space: FreeSpace, rooms: Rooms, config: MapConfig, margin_m: float, points: int
) -> tuple[np.ndarray, list[str]]:
    """Where a map's nodes stand.

    In every room one place after the other becomes a node, each time the one that has most places within `spacing_m`
    that no node has yet. A room that needs fewer than `min_per_room`
    is covered again with less spacing. Then, where `connect` is set, nodes are added along the free way
    between parts of the map that no free edge joins which is shortest where room to the sides counts as well.

    Args:
        space: of the scene.
        rooms: of the scene.
        config: of the map.
        margin_m: clearance that a free way has; nodes added to join parts need only this much.
        points: looked up on a way.

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
    """Nodes added until free edges join all that a free way joins; and the number of parts left."""
    cells = space.centres(margin_m)
    index = {key: i for i, key in enumerate(map(tuple, _cells(space, cells)))}
    room_m = space.at(cells)
    lattice = _lattice(index, space.resolution_m * (1.0 + TIGHT_COST * np.clip(1.0 - room_m / ROOMY_M, 0.0, 1.0)))
    while True:
        graph = nx.Graph()
        graph.add_nodes_from(range(len(xy)))
        graph.add_edges_from(free_edges(space, xy, edge_m, margin_m, points).tolist())
        parts = sorted(nx.connected_components(graph), key=lambda part: (-len(part), min(part)))
        at = np.array([index.get(tuple(c), -1) for c in _cells(space, xy)])
        for part in parts[1:]:
            mine = np.array(sorted(part))
            others = np.setdiff1d(np.arange(len(xy)), mine)
            mine, others = mine[at[mine] >= 0], others[at[others] >= 0]
            if not len(mine) or not len(others):
                continue
            far, before, _ = dijkstra(lattice, indices=at[mine], min_only=True, return_predecessors=True)
            end = int(others[far[at[others]].argmin()])
            if not np.isfinite(far[at[end]]):
                continue
            way = [int(at[end])]
            while before[way[-1]] >= 0:
                way.append(int(before[way[-1]]))
            added = _stations(space, cells[way], edge_m, margin_m, points)
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
        seen = reach & space.segment_free(np.broadcast_to(way[at], ahead.shape), ahead, points, margin_m)
        last = at + 1 + int(np.flatnonzero(seen)[-1])
        if last < len(way) - 1:
            steps = at + 1 + np.flatnonzero(seen)
            steps = steps[steps - at > (last - at) // 2][::-1]  # of equals the farthest
            last = int(steps[room_m[steps].argmax()])
        at = last
        chosen.append(way[at])
    return np.array(chosen[:-1]).reshape(-1, 2)


def _cells(space: FreeSpace, xy: np.ndarray) -> np.ndarray:
    return np.floor((xy - space.origin_w) / space.resolution_m).astype(int)


def _lattice(index: dict[tuple[int, int], int], cost: np.ndarray) -> csr_array:
    """Cells that share a side, so that the straight way between their centres is as free as they are.

    Args:
        index: (column, row) -> number of a cell.
        cost: [cells] of a step within each; a step between two costs their mean.
    """
    pairs = [(i, index.get(side, -1)) for (x, y), i in index.items() for side in ((x + 1, y), (x, y + 1))]
    first, second = np.array([pair for pair in pairs if pair[1] >= 0], int).reshape(-1, 2).T
    between = 0.5 * (cost[first] + cost[second])
    entries = (np.r_[between, between], (np.r_[first, second], np.r_[second, first]))
    return csr_array(entries, shape=(len(index), len(index)))


def assemble(
    scene: str,
    digest: str,
    xy_w: np.ndarray,
    room: np.ndarray,
    embeddings: np.ndarray,
    edge_m: float,
    probability: Callable[[np.ndarray, np.ndarray], np.ndarray],
    about: dict[str, Any],
) -> TopologicalMap:
    """A map of given nodes.

    Args:
        scene: its name.
        digest: of its files.
        xy_w: [N, 2] m.
        room: [N].
        embeddings: [N, K, D].
        edge_m: nodes nearer than this are joined, both ways.
        probability: edges [E, 2] and headings [E] to [E] probabilities.
        about: kept with the map.
    """
    edges = near_pairs(xy_w, edge_m)
    angle = angles(xy_w, edges)
    p = np.asarray(probability(edges, angle), np.float32)
    return TopologicalMap(
        scene,
        digest,
        np.asarray(xy_w, np.float32),
        np.asarray(room, np.int32),
        np.asarray(embeddings, np.float32),
        edges,
        p,
        np.asarray(angle, np.float32),
        about,
    )


_ARRAYS = ("xy_w", "room", "embeddings", "edges", "p", "angle_rad")


def save_map(made: TopologicalMap, path: Path) -> None:
    """Writes a map as one npz file, whole or not at all."""
    header = {"format": FORMAT, "scene": made.scene, "digest": made.digest, "about": made.about}
    with whole_file(path) as partial, open(partial, "wb") as file:
        np.savez_compressed(
            file,
            header=np.frombuffer(json.dumps(header).encode(), np.uint8),
            **{name: getattr(made, name) for name in _ARRAYS},
        )  # type: ignore[arg-type]


def load_map(path: Path, digest: str | None = None) -> TopologicalMap:
    """Reads a map.

    Args:
        path: of the file.
        digest: of the scene that it is to be used in; None: not checked.

    Raises:
        MapError: missing, damaged, of another format, or of another scene.
    """
    with readable(path, MapError, "build the map: python -m topological_nav map SCENE"):
        with np.load(path, allow_pickle=False) as stored:
            header = json.loads(stored["header"].tobytes())
            arrays = {name: stored[name] for name in _ARRAYS}
        version, scene, own, about = (header[k] for k in ("format", "scene", "digest", "about"))
    if version != FORMAT:
        raise MapError(f"{path}: format {version}, expected {FORMAT}; build the map again")
    if digest is not None and own != digest:
        raise MapError(
            f"{path}: made in scene '{scene}' with digest {own[:12]}, the scene here has {digest[:12]}; "
            "build the map of this scene"
        )
    arrays["embeddings"] = arrays["embeddings"].astype(np.float32)  # exported maps hold them in half precision
    return TopologicalMap(scene, own, **arrays, about=about)
