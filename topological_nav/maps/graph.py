"""Place a topological map's nodes, join them by edges, plan on it, write and read it.

A node is a position with embeddings of the images around it. Edges join nodes nearer than `edge_m`; their weight is
-log p, where p is the probability that the path is free, so that the shortest path is most likely free as a whole; a
planner may add `metre_cost`. Edges have an absolute angle and a length, so that driving needs no positions.
"""

import dataclasses
import functools
import json
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
from scipy.sparse import csr_array
from scipy.sparse.csgraph import connected_components, dijkstra
from scipy.spatial.distance import cdist

from interactive_nav_common.errors import FileError
from interactive_nav_common.files import write_arrays
from interactive_nav_common.grids import MOVES_4, cell_centres, follow, grid_graph
from interactive_nav_common.untrusted.reading import read_npz
from topological_nav.config import MapConfig
from topological_nav.scenes.space import FreeSpace, Rooms

FORMAT = 1
"""Version of map files; raised when older ones would be misread."""
LEAST_P = 1e-6
"""Distance of probabilities from 0, so that weights are finite, and from 1, so that every edge costs something."""


@dataclasses.dataclass(frozen=True)
class TopologicalMap:
    """Hold N nodes, K images each, and E directed edges."""

    scene: str
    digest: str
    """Of the scene's files, as `interactive_nav.scenes.scene.Scene.digest`."""
    xy_w: np.ndarray
    """[N, 2] f32 m, for drawing, scoring and edge lengths; planning and localisation do not use it."""
    room: np.ndarray
    """[N] i32."""
    embeddings: np.ndarray
    """[N, K, D] f32."""
    edges: np.ndarray
    """[E, 2] i32 from, to."""
    p: np.ndarray
    """[E] f32 probability that the path is free."""
    angle_rad: np.ndarray
    """[E] f32 heading from the first node to the second, world frame."""
    about: dict[str, Any]
    """Settings, and the networks that built it."""
    metre_cost: float = 0.0
    """Added to an edge's weight per metre; set by the planner, not stored in the file."""

    @functools.cached_property
    def length_m(self) -> np.ndarray:
        """Return the lengths of the edges, [E] m."""
        return lengths(self.xy_w, self.edges)

    def plan(self, start: int, goal: int) -> tuple[list[int], float]:
        """Return the nodes and the cost of the cheapest path between two; raise `FileError` if there is none."""
        for node in (start, goal):
            if not 0 <= node < len(self.xy_w):
                raise FileError(f"node {node} is not in the map of '{self.scene}', expected 0 to {len(self.xy_w) - 1}")
        cost, before = dijkstra(self._matrix(self.weight), indices=start, return_predecessors=True)
        if not np.isfinite(cost[goal]):
            raise FileError(f"no way from node {start} to {goal} in the map of '{self.scene}'; make it denser")
        return follow(before, goal, start)[::-1], float(cost[goal])

    @functools.cached_property
    def weight(self) -> np.ndarray:
        """Return the edges' weights [E]: -log p, p at least `LEAST_P` from 0 and 1, plus `metre_cost` per metre."""
        return -np.log(np.clip(self.p.astype(float), LEAST_P, 1.0 - LEAST_P)) + self.metre_cost * self.length_m

    def next_edge(self, start: int, goal: int, penalty: np.ndarray | None = None) -> int:
        """Return the first edge of the cheapest path with weights plus `penalty` [E]; -1 if there is none."""
        changed = penalty is not None and bool(penalty.any())
        weight = self.weight + penalty if changed else self.weight
        left = self._left_to(weight, goal) if changed else self.left[goal]
        out = np.flatnonzero(self.edges[:, 0] == start)
        total = weight[out] + left[self.edges[out, 1]]
        return int(out[total.argmin()]) if len(out) and np.isfinite(total.min()) else -1

    @functools.cached_property
    def left(self) -> np.ndarray:
        """Return the cost [N, N] of the cheapest path to each goal (first axis) from each node; infinite if none."""
        return self._left_to(self.weight, np.arange(len(self.xy_w)))

    def _left_to(self, weight: np.ndarray, goals: np.ndarray | int) -> np.ndarray:
        return np.asarray(dijkstra(self._matrix(weight).T, indices=goals))

    def _matrix(self, weight: np.ndarray) -> csr_array:
        """Return the weights [N, N] of the edges from each node (row) to others."""
        return csr_array((weight, tuple(self.edges.T)), shape=(len(self.xy_w),) * 2)

    def open_parts(self, passable: float) -> list[list[int]]:
        """Return groups of nodes that reach each other by edges of at least this probability, the largest first."""
        return parts_of(self.edges[self.p >= passable], len(self.xy_w), both_ways=True)

    def thinned(self, share: float, seed: int) -> "TopologicalMap":
        """Return the map with a random share of each room's nodes, at least one; it may be disconnected."""
        rng = np.random.default_rng([seed, 11])
        kept = []
        for room in np.unique(self.room):
            mine = np.flatnonzero(self.room == room)
            kept.append(rng.choice(mine, max(1, round(share * len(mine))), replace=False))
        rows = np.sort(np.concatenate(kept))
        number = np.full(len(self.xy_w), -1, np.int32)
        number[rows] = np.arange(len(rows))
        edges = (number[self.edges] >= 0).all(1)
        kept = {name: getattr(self, name)[rows] for name in ("xy_w", "room", "embeddings")}
        kept |= {"edges": number[self.edges[edges]], "p": self.p[edges], "angle_rad": self.angle_rad[edges]}
        return dataclasses.replace(self, **kept, about={**self.about, "thinned": share, "thinned_seed": seed})


def parts_of(edges: np.ndarray, count: int, both_ways: bool = False) -> list[list[int]]:
    """Return groups of `count` nodes that edges [E, 2] join (`both_ways`: that reach each other), the largest first."""
    joined = csr_array((np.ones(len(edges)), tuple(edges.T)), shape=(count, count))
    _, label = connected_components(joined, directed=both_ways, connection="strong")
    parts = [np.flatnonzero(label == k).tolist() for k in np.unique(label)]
    return sorted(parts, key=lambda part: (-len(part), part))


def near_pairs(xy_w: np.ndarray, edge_m: float) -> np.ndarray:
    """Return every ordered pair [E, 2] of different points [N, 2] nearer than `edge_m`, sorted."""
    away = np.linalg.norm(xy_w[:, None] - xy_w[None], axis=-1)
    return np.argwhere((away < edge_m) & ~np.eye(len(xy_w), dtype=bool)).astype(np.int32)


def angles(xy_w: np.ndarray, edges: np.ndarray) -> np.ndarray:
    """Return the headings [E] in (-pi, pi] of edges [E, 2] between points [N, 2]."""
    step = xy_w[edges[:, 1]] - xy_w[edges[:, 0]]
    return np.arctan2(step[:, 1], step[:, 0])


def lengths(xy_w: np.ndarray, edges: np.ndarray) -> np.ndarray:
    """Return the lengths [E] (m) of edges [E, 2] between points [N, 2]."""
    return np.linalg.norm(xy_w[edges[:, 1]] - xy_w[edges[:, 0]], axis=-1).astype(float)


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
    """Build the map of nodes [N, ...]; `probability` maps edges [E, 2] nearer than `edge_m` and headings [E] to [E]."""
    edges = near_pairs(xy_w, edge_m)
    angle = angles(xy_w, edges)
    arrays = {"xy_w": xy_w, "room": room, "embeddings": embeddings}
    arrays |= {"edges": edges, "p": probability(edges, angle), "angle_rad": angle}
    typed: Any = {name: np.asarray(value, _ARRAYS[name]) for name, value in arrays.items()}
    return TopologicalMap(scene, digest, **typed, about=about)


_F32, _I32 = np.float32, np.int32
_ARRAYS = {"xy_w": _F32, "room": _I32, "embeddings": _F32, "edges": _I32, "p": _F32, "angle_rad": _F32}
"""Array of a map's file -> its type."""


def save_map(nav_map: TopologicalMap, path: Path) -> None:
    """Write a map atomically as one npz file."""
    header = {"format": FORMAT, "scene": nav_map.scene, "digest": nav_map.digest, "about": nav_map.about}
    arrays = {name: getattr(nav_map, name) for name in _ARRAYS}
    write_arrays(path, header=np.frombuffer(json.dumps(header).encode(), np.uint8), **arrays)


def load_map(path: Path, digest: str | None = None) -> TopologicalMap:
    """Read a map; raise `FileError` if it is damaged or not of the scene with this digest (None: not checked)."""
    with read_npz(path, FileError, "build the map: python -m topological_nav map SCENE") as stored:
        header = json.loads(stored["header"].tobytes())
        arrays = {name: stored[name] for name in _ARRAYS}
        arrays["embeddings"] = arrays["embeddings"].astype(np.float32)  # exported maps hold them in half precision
        version, scene, built_in, about = (header[k] for k in ("format", "scene", "digest", "about"))
    if version != FORMAT:
        raise FileError(f"{path}: format {version}, expected {FORMAT}; build the map again")
    if digest is not None and built_in != digest:
        raise FileError(
            f"{path}: made in scene '{scene}' with digest {built_in[:12]}, the scene here has {digest[:12]}; "
            "build the map of this scene"
        )
    return TopologicalMap(scene, built_in, **arrays, about=about)


ROOMY_M = 0.5
"""Nodes that join parts of a map keep to the middle of passages narrower than twice this."""
TIGHT_COST = 4.0
"""Most that a metre of the path between parts costs extra, near obstacles."""


def place_nodes(
    space: FreeSpace, rooms: Rooms, config: MapConfig, margin_m: float, points: int
) -> tuple[np.ndarray, list[str]]:
    """Return positions [N, 2] m of a map's nodes, and a description of what was not possible.

    In each room, nodes are added greedily where most places within `spacing_m` have no node yet; a room with fewer than
    `min_per_room` is covered again more densely. With random `nodes`, a room has one per square of the spacing,
    anywhere. `connect` then adds nodes along free paths between parts that no free edge joins, preferring roomy paths.
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
        if config.nodes == "random":
            count = max(config.min_per_room, round(len(mine) * space.resolution_m**2 / config.spacing_m**2))
            nodes.append(mine[np.random.default_rng([config.seed, room]).permutation(len(mine))[:count]])
            continue
        radius, chosen = config.spacing_m, mine[:0]
        while len(chosen) < config.min_per_room:
            chosen = _covering(mine, radius, space.resolution_m)
            radius *= 0.8
        nodes.append(chosen)
    xy = np.concatenate(nodes) if nodes else np.zeros((0, 2))
    if not config.connect:
        return xy, lacking
    joined, apart = _joined(space, xy, config.edge_m, margin_m, points)
    if apart > 1:
        lacking.append(f"{apart} parts of the scene are not joined by any way with {margin_m} m clearance")
    return joined, lacking


def _covering(places: np.ndarray, radius_m: float, step_m: float) -> np.ndarray:
    """Choose places greedily from [n, 2], most uncovered neighbours first, so that one is within the radius of each."""
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
    """Add nodes until free edges join what free paths join; return all nodes, and the number of parts left."""
    free = space.free(margin_m)
    # Cells that share a side: the straight way between their centres is as free as they are.
    cost = 1.0 + TIGHT_COST * np.clip(1.0 - space.clearance_m / ROOMY_M, 0.0, 1.0)
    lattice = grid_graph(free, cost, space.resolution_m, MOVES_4)
    centres = cell_centres(np.ones_like(free), space.resolution_m, space.origin_w)
    while True:
        edges = near_pairs(xy, edge_m)
        parts = parts_of(edges[space.segment_free(*xy[edges.T], points, margin_m)], len(xy))
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
    """Choose places on a path [n, 2] without its ends, each in free reach of the one before: roomy and far along."""
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
