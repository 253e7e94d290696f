"""How well the filled patches of a scan join it.

    python -m benchmarks.cracks ../shared/data/scan2cad_scene0470_00

Converts up to the fill, and prints for each plane (0 the floor, then the walls) the length of its patches' border, how
much of it no other face joins, and how much of that runs within 2 cm and 10 cm of other open border: a crack. The
rest is the rim of a patch where nothing was scanned. Hulls come from the converter's cache where they are there.
"""

from __future__ import annotations

import dataclasses
import math
from pathlib import Path

import numpy as np
from scipy.sparse import coo_matrix
from scipy.sparse.csgraph import connected_components, dijkstra
from scipy.spatial import KDTree

from benchmarks.measurement import command_line
from converters.bodies.decompose import DOOR_OVERRIDES, DecomposeConfig, cache_folder, decompose_all
from converters.bodies.objects import name_objects, place_object
from converters.fill.holes import hidden_surfaces
from converters.fill.join import FACING, REACH_M, border_edges, edge_pieces, edges_of, points_on
from converters.fill.patches import Filled, fill_planes, wall_planes
from converters.geometry.boxes import Hull
from converters.pipeline import align_objects
from converters.propose.report import floor_of
from converters.read.source import read_source
from converters.structure.cut import cut_furniture
from converters.structure.floor import level_floor
from converters.structure.maps import main_direction, make_floor_plan

NARROW_M, WIDE_M = 0.02, 0.10


SPOT_M = 0.005
"""Spacing of the places on the border that are looked at."""


@dataclasses.dataclass(frozen=True)
class OpenBorder:
    """How much of a patch's border no other face joins."""

    border_m: float
    """Length of the patches' whole border."""
    open_m: float
    """Of it, edges that only one face has."""
    crack_m: float
    """Of it, what other open border faces within `REACH_M`: a gap, and not the rim of what was scanned."""


def open_border(
    vertices: np.ndarray, faces: np.ndarray, patch_plane: np.ndarray, reach_m: float = REACH_M
) -> dict[int, OpenBorder]:
    """What stays open of the patches' borders, by plane.

    A crack is open border that other open border faces within the reach: border that is at least `FACING` times as far
    away along the border as it is straight across; and a hole that is no wider than the reach, whatever its shape. What
    is near without that is the border's own continuation, as where the outline of the scan goes on beside the end of a
    patch; and what a narrow patch itself lies between is no gap.

    Args:
        vertices: (n, 3) m.
        faces: (m, 3) scan and patches, one mesh.
        patch_plane: (m,) plane of each patch face, -1 for scan faces.
        reach_m: open border this near to other border is a crack.
    """
    edges, owner = border_edges(faces)
    plane = patch_plane[owner]
    spots, of = points_on(vertices, edges, SPOT_M)
    whole = np.linalg.norm(vertices[edges[:, 0]] - vertices[edges[:, 1]], axis=1)
    length = (whole / np.bincount(of, minlength=len(edges)))[of]
    a, b, tip = vertices[edges[:, 0]], vertices[edges[:, 1]], vertices[faces[owner].sum(axis=1) - edges.sum(axis=1)]
    along = (b - a) / np.maximum(whole, 1e-12)[:, None]
    inward = (tip - a) - ((tip - a) * along).sum(axis=1, keepdims=True) * along
    piece = edge_pieces(edges_of(faces))
    floating = ~np.isin(piece, piece[patch_plane < 0])[owner]
    surface = np.where(floating, plane.max(initial=0) + 1 + piece[owner], plane)
    faced = _faced(vertices, edges, spots, of, surface, inward, reach_m)
    result = {}
    for k in np.unique(patch_plane[patch_plane >= 0]):
        own = plane[of] == k
        rim = border_edges(faces[patch_plane == k])[0]
        total = float(np.linalg.norm(vertices[rim[:, 0]] - vertices[rim[:, 1]], axis=1).sum())
        result[int(k)] = OpenBorder(total, float(length[own].sum()), float(length[own & faced].sum()))
    return result


def _faced(
    vertices: np.ndarray,
    edges: np.ndarray,
    spots: np.ndarray,
    of: np.ndarray,
    surface: np.ndarray,
    inward: np.ndarray,
    reach_m: float,
) -> np.ndarray:
    """(n,) bool: which spots on patches' border other border faces over a gap.

    The way along the border goes from spot to spot on an edge and over the vertices that edges share.

    Args:
        vertices: (v, 3) m.
        edges: (k, 2) of the border.
        spots: (n, 3) on them.
        of: (n,) edge of each spot.
        surface: (k,) plane of each edge's face, or number of its piece where that joins no scan; -1 for the scan's.
        inward: (k, 3) from the edge into its face.
        reach_m: how near.
    """
    asked = surface[of] >= 0
    border = coo_matrix((np.ones(len(edges), np.int8), edges.T), shape=(len(vertices),) * 2)
    hole = connected_components(border, directed=False)[1][edges[:, 0]][of]
    low, high = np.full((hole.max(initial=0) + 1, 3), np.inf), np.full((hole.max(initial=0) + 1, 3), -np.inf)
    np.minimum.at(low, hole, spots)
    np.maximum.at(high, hole, spots)
    result = asked & (np.linalg.norm(high - low, axis=1)[hole] < reach_m)
    asked_at = np.flatnonzero(asked & ~result)
    if len(asked_at) == 0:
        return result
    near = np.asarray(KDTree(spots[asked_at]).query(spots, distance_upper_bound=2 * FACING * reach_m)[0]) < np.inf
    n = len(spots)
    along = np.flatnonzero(of[:-1] == of[1:])
    start, end = (np.flatnonzero(np.r_[True, of[1:] != of[:-1]]), np.flatnonzero(np.r_[of[1:] != of[:-1], True]))
    a = np.concatenate([along, start, end])
    b = np.concatenate([along + 1, n + edges[of[start], 0], n + edges[of[end], 1]])
    places = np.vstack([spots, vertices])
    way = np.linalg.norm(places[a] - places[b], axis=1)
    graph = coo_matrix((np.maximum(way, 1e-9), (a, b)), shape=(len(places),) * 2).tocsr()
    used = np.concatenate([near, np.zeros(len(vertices), bool)])
    used[n + np.unique(edges[of[near]])] = True
    number = np.cumsum(used) - 1
    graph = graph[used][:, used]
    tree, here = KDTree(spots[near]), np.flatnonzero(near)
    for block in np.array_split(asked_at, math.ceil(len(asked_at) / 200)):
        along_m = dijkstra(graph, directed=False, indices=number[block], limit=FACING * reach_m)
        for row, i in enumerate(block):
            there = here[tree.query_ball_point(spots[i], reach_m)]
            straight = np.linalg.norm(spots[there] - spots[i], axis=1)
            # The other side of the same patch, with the patch between.
            own = (surface[of[there]] == surface[of[i]]) & ((spots[there] - spots[i]) @ inward[of[i]] > 0)
            # To the spots' spacing: what is nearer than that along the border is the spot's own neighbourhood.
            result[i] = (along_m[row, number[there]] > FACING * straight + 2 * SPOT_M)[~own].any()
    return result


def fill(source: Path, cache: Path | None = None) -> Filled:
    """A raw folder of one floor, converted up to the filled structure.

    Args:
        source: the folder.
        cache: of hulls; None: the converter's own.
    """
    raw = read_source(source)
    placements, _ = align_objects(raw)
    height = floor_of(raw)
    vertices = raw.scan.vertices - [0.0, 0.0, height]
    yaw = main_direction(vertices, raw.scan.faces, raw.scan.labels)
    todo = {k: c for k, c in sorted(raw.cads.items()) if c.pieces is None}
    doors = {k: DOOR_OVERRIDES for k, c in todo.items() if c.category == "door"}
    meshes = {k: (c.vertices, c.faces) for k, c in todo.items()}
    hulls = decompose_all(meshes, DecomposeConfig(), 2, cache or cache_folder(), lambda share: None, doors, False).hulls
    hulls |= {k: tuple(Hull(*p) for p in c.pieces) for k, c in raw.cads.items() if c.pieces is not None}
    objects = tuple(
        place_object(name, a, raw.cads[a.cad_id], hulls[a.cad_id], pose, height, yaw)
        for name, a, pose in zip(name_objects(raw.annotations), raw.annotations, placements, strict=True)
    )
    faces = raw.scan.faces[cut_furniture(vertices, raw.scan.faces, raw.scan.labels, objects).keep]
    plan = make_floor_plan(vertices, faces, raw.scan.labels, objects, raw.given_map, yaw)
    level = level_floor(vertices, raw.scan.faces, raw.scan.labels)
    planes = wall_planes(level, faces, raw.scan.labels)
    return fill_planes(level, faces, hidden_surfaces(plan, planes, level, faces, objects))


def measure(filled: Filled) -> tuple[dict[int, OpenBorder], dict[int, OpenBorder]]:
    """Open border by plane, cracks counted to `NARROW_M` and to `WIDE_M`."""
    narrow, wide = (open_border(filled.vertices, filled.faces, filled.patch_plane, r) for r in (NARROW_M, WIDE_M))
    return narrow, wide


def main() -> None:
    """Prints the table."""
    parser = command_line(__doc__)
    parser.add_argument("source", type=Path)
    narrow, wide = measure(fill(parser.parse_args().source))
    rows = [[narrow[k].border_m, narrow[k].open_m, narrow[k].crack_m, wide[k].crack_m] for k in narrow]
    print("plane  border m   open m  crack 2 cm  crack 10 cm")
    for name, row in [*zip(narrow, rows, strict=True), ("sum", np.sum(rows, axis=0))]:
        print(f"{name!s:<5} {row[0]:>9.2f} {row[1]:>8.2f} {row[2]:>11.2f} {row[3]:>12.2f}")


if __name__ == "__main__":
    main()
