"""Scan a plan and its furniture into a labelled mesh, as a depth camera would.

Solids are fused on a voxel grid and contoured. Glass and surfaces that no camera position sees are dropped, and the
rest is simplified. Vertices get noise along the normals, and some labels near borders are wrong. There is no ceiling.
Frame: scan x, y, height above the floor; metres.
"""

import dataclasses

import fast_simplification
import numpy as np
from scipy import ndimage

from converters.generate.homes.building import Plan
from converters.generate.homes.config import HomeConfig
from converters.generate.homes.space import GRID_M, cell_centres, free_grid, room_mask
from converters.generate.models.cad import Instance
from converters.geometry.faces import compacted, face_vectors, loose_parts, vertex_normals
from converters.records.raw import FLOOR, WALL
from interactive_nav_common.grids import clearance
from scenes_mjcf.categories import TABLE


@dataclasses.dataclass(frozen=True)
class Solid:
    """Describe a convex solid as half-spaces `normals @ x <= offsets`."""

    normals: np.ndarray
    """(k, 3) unit outward normals."""
    offsets: np.ndarray
    """(k,)"""
    low: np.ndarray
    """(3,) corner of its bounding box."""
    high: np.ndarray
    """(3,)"""
    label: int
    """NYU40 id."""
    material: str
    """Key of the palette."""
    owner: int
    """Index of the movable it belongs to; -1: static structure."""
    item: Instance | None = None
    """What stands there, of which it is a part; None: floor or wall."""

    def distance(self, points: np.ndarray) -> np.ndarray:
        """Return the signed distance, (n, 3) -> (n,): exact inside and beside faces, a lower bound off edges."""
        out = points @ self.normals[0] - self.offsets[0]
        for normal, offset in zip(self.normals[1:], self.offsets[1:], strict=True):
            np.maximum(out, points @ normal - offset, out=out)
        return out


def solid_from_mesh(vertices: np.ndarray, faces: np.ndarray, label: int, material: str, owner: int) -> Solid:
    """Return a convex mesh as half-spaces, equal planes merged."""
    normals = face_vectors(vertices, faces)
    area = np.linalg.norm(normals, axis=1)
    keep = area > 1e-10
    normals = normals[keep] / area[keep, None]
    offsets = np.einsum("ij,ij->i", normals, vertices[faces[keep, 0]])
    _, first = np.unique(np.round(np.column_stack([normals, offsets]), 4), axis=0, return_index=True)
    return Solid(normals[first], offsets[first], vertices.min(axis=0), vertices.max(axis=0), label, material, owner)


def solid_from_box(low, high, label: int, material: str) -> Solid:
    """Return an axis-aligned box of the static structure."""
    low, high = np.asarray(low, float), np.asarray(high, float)
    return Solid(np.concatenate([np.eye(3), -np.eye(3)]), np.concatenate([high, -low]), low, high, label, material, -1)


@dataclasses.dataclass(frozen=True)
class Volume:
    """Hold truncated signed distances."""

    sdf: np.ndarray
    """(nx, ny, nz) float32, metres, negative inside; at `origin + voxel_m * index`."""
    origin: np.ndarray
    """(3,)"""
    voxel_m: float

    def sample(self, points: np.ndarray) -> np.ndarray:
        """Return the value at the nearest voxel, (n, 3) -> (n,); outside the grid that of its border."""
        index = (points - self.origin) / self.voxel_m + 0.5
        i, j, k = (np.clip(index[:, d].astype(np.int32), 0, size - 1) for d, size in enumerate(self.sdf.shape))
        return self.sdf.ravel().take((i * self.sdf.shape[1] + j) * self.sdf.shape[2] + k)


def fuse(solids: list[Solid], low: np.ndarray, high: np.ndarray, voxel_m: float) -> Volume:
    """Write the union of the solids into a grid that spans `low`..`high`, truncated at three voxels."""
    shape = np.ceil((high - low) / voxel_m).astype(int) + 1
    trunc = 3 * voxel_m
    sdf = np.full(tuple(shape), trunc, np.float32)
    for s in solids:
        i0 = np.clip(np.floor((s.low - trunc - low) / voxel_m).astype(int), 0, shape)
        i1 = np.clip(np.ceil((s.high + trunc - low) / voxel_m).astype(int) + 1, 0, shape)
        if (i1 <= i0).any():
            continue
        axes = [(low[k] + voxel_m * np.arange(i0[k], i1[k])).astype(np.float32) for k in range(3)]
        value = np.full(tuple(i1 - i0), -np.inf, np.float32)
        for normal, offset in zip(s.normals.astype(np.float32), s.offsets, strict=True):
            plane = (normal[0] * axes[0] - np.float32(offset))[:, None, None]
            plane = plane + (normal[1] * axes[1])[None, :, None] + (normal[2] * axes[2])[None, None, :]
            np.maximum(value, plane, out=value)
        part = sdf[tuple(slice(a, b) for a, b in zip(i0, i1, strict=True))]
        np.minimum(part, value, out=part)
    np.maximum(sdf, -trunc, out=sdf)
    return Volume(sdf, np.asarray(low, float), voxel_m)


def surface_nets(volume: Volume) -> tuple[np.ndarray, np.ndarray]:
    """Return the zero surface by surface nets: vertices (n, 3), and faces (m, 3) counter-clockwise from outside."""
    sdf = volume.sdf
    shape = np.array(sdf.shape)
    strides = np.array([shape[1] * shape[2], shape[2], 1])
    points, cells, flips = [], [], []
    for axis in range(3):
        first, second = [slice(None)] * 3, [slice(None)] * 3
        first[axis], second[axis] = slice(None, -1), slice(1, None)
        # Only edges with all four neighbouring cells inside the grid make a quad.
        for other in {0, 1, 2} - {axis}:
            first[other] = second[other] = slice(1, -1)
        a, b = sdf[tuple(first)], sdf[tuple(second)]
        index = np.argwhere((a < 0) != (b < 0))
        index_a = index + [0 if k == axis else 1 for k in range(3)]
        va, vb = a[tuple(index.T)], b[tuple(index.T)]
        at = index_a.astype(float)
        at[:, axis] += va / (va - vb)
        u, v = (axis + 1) % 3, (axis + 2) % 3
        corner = np.zeros((4, 3), int)
        corner[1, u], corner[2, [u, v]], corner[3, v] = -1, -1, -1
        points.append(at)
        cells.append(((index_a[:, None] + corner) * strides).sum(axis=2))
        flips.append(va >= 0)
    at, cell, flip = np.concatenate(points), np.concatenate(cells), np.concatenate(flips)
    ids, vertex = np.unique(cell, return_inverse=True)
    vertex = vertex.reshape(cell.shape)
    weight = np.bincount(vertex.ravel(), minlength=len(ids))
    flat = np.repeat(at, 4, axis=0)
    mean = np.stack([np.bincount(vertex.ravel(), flat[:, k], len(ids)) / weight for k in range(3)], axis=1)
    quads = np.where(flip[:, None], vertex[:, ::-1], vertex)
    faces = np.concatenate([quads[:, [0, 1, 2]], quads[:, [0, 2, 3]]])
    return volume.origin + volume.voxel_m * mean, faces


NYU40 = {"wall": WALL, "floor": FLOOR, "cabinet": 3} | {c.name: c.labels[0] for c in TABLE if c.labels}
"""Class name -> NYU40 id."""

RANGE_M = 5.0
"""A depth camera's reach."""
GRAZING = 0.12
"""Cosine between ray and normal below which depth is lost."""


@dataclasses.dataclass(frozen=True)
class Scan:
    """Hold a reconstruction."""

    vertices: np.ndarray
    """(n, 3) float64."""
    faces: np.ndarray
    """(m, 3) int64."""
    labels: np.ndarray
    """(n,) uint8 NYU40 ids, with label noise."""
    solid: np.ndarray = dataclasses.field(default_factory=lambda: np.zeros(0, np.int64))
    """(n,) int64: index of the nearest solid, without noise; empty where `solids` is."""
    solids: tuple[Solid, ...] = ()
    """None: it shows nothing that moves."""

    @property
    def owner(self) -> np.ndarray:
        """Return (n,) the index of the piece of furniture that each vertex shows, -1 where it shows none."""
        return np.array([s.owner for s in self.solids])[self.solid] if self.solids else np.full(len(self.labels), -1)


def building_solids(plan: Plan, items: list[Instance]) -> list[Solid]:
    """Return everything that a camera can hit, with labels and materials."""
    o = plan.outer
    solids = [solid_from_box((o.x0, o.y0, -0.3), (o.x1, o.y1, 0.0), NYU40["floor"], "floor")]
    solids += [solid_from_box(w.low, w.high, NYU40["wall"], "paint") for w in plan.walls]
    for owner, item in [(-1, i) for i in plan.built_in] + list(enumerate(items)):
        label = NYU40[item.model.category]
        for part in item.model.parts:
            solid = solid_from_mesh(item.to_floor(part.vertices), part.faces, label, part.material, owner)
            solids.append(dataclasses.replace(solid, item=item))
    return solids


def camera_positions(plan: Plan, items: list[Instance], rng: np.random.Generator) -> np.ndarray:
    """Draw (n, 3) places of the camera: two to four a room, at eye height, and one in each doorway."""
    free = clearance(free_grid(plan, items), GRID_M)
    centres = cell_centres(free)
    out = []
    for room in plan.rooms:
        score = np.where(room_mask(free, room), free, 0.0)
        cells = np.argwhere(score > min(0.35, 0.7 * score.max()))
        for _ in range(2 + int(room.area_m2 > 8) + int(room.area_m2 > 14)):
            # The next place is the one of thirty random ones that is farthest from the earlier ones.
            pick = cells[rng.integers(len(cells), size=30)]
            xy = np.stack([centres[pick[:, 1]], centres[pick[:, 0]]], axis=1)
            if out:
                gap = np.linalg.norm(xy[:, None] - np.array(out)[None, :, :2], axis=2).min(axis=1)
                xy = xy[np.argmax(gap)][None]
            out.append(np.array([*xy[0], rng.uniform(1.35, 1.6)]))
    out += [np.array([*d.rect.centre, rng.uniform(1.35, 1.6)]) for d in plan.doorways]
    return np.array(out)


def visible_from(points: np.ndarray, normals: np.ndarray, cameras: np.ndarray, volume: Volume) -> np.ndarray:
    """Return (n,) bool: some camera sees the point, within reach, not grazing, nothing between."""
    visible = np.zeros(len(points), bool)
    start = points + normals * 1.6 * volume.voxel_m
    step = 1.5 * volume.voxel_m
    free = dataclasses.replace(volume, sdf=volume.sdf > 0)
    for camera in cameras:
        ray = camera - start
        length = np.linalg.norm(ray, axis=1)
        facing = np.einsum("ij,ij->i", ray, normals) > GRAZING * length
        index = np.flatnonzero(~visible & facing & (length < RANGE_M))
        at, left = start[index], length[index]
        stride = ray[index] / left[:, None] * step
        while len(index):
            keep = free.sample(at)
            visible[index[keep & (left <= 0)]] = True
            on = np.flatnonzero(keep & (left > 0))
            index, left, stride = index[on], left[on] - step, stride.take(on, axis=0)
            at = at.take(on, axis=0) + stride
    return visible


def smooth_noise(points: np.ndarray, wave_m: float, rng: np.random.Generator) -> np.ndarray:
    """Draw spatially correlated noise, (n, 3) -> (n,), of about unit deviation and correlation length `wave_m`."""
    low = points.min(axis=0) - wave_m
    shape = np.ceil((points.max(axis=0) - low) / wave_m).astype(int) + 2
    grid = rng.standard_normal(tuple(shape))
    return 1.5 * ndimage.map_coordinates(grid, ((points - low) / wave_m).T, order=1)


def compact(vertices: np.ndarray, faces: np.ndarray, min_faces: int) -> tuple[np.ndarray, np.ndarray]:
    """Drop connected pieces of fewer than `min_faces` faces, degenerate faces, and unused vertices."""
    degenerate = (faces[:, 0] == faces[:, 1]) | (faces[:, 1] == faces[:, 2]) | (faces[:, 2] == faces[:, 0])
    faces = faces[~degenerate]
    part = loose_parts(vertices, faces)
    return compacted(vertices, faces[np.bincount(part)[part] >= min_faces])


def nearest_solids(points: np.ndarray, solids: list[Solid], reach_m: float = 0.12) -> tuple[np.ndarray, np.ndarray]:
    """Return for points (n, 3) the nearest solid's index, and the nearest other class within 0.05 m, or 0."""
    best = np.full(len(points), np.inf)
    index = np.zeros(len(points), np.int64)
    by_label = {s.label: np.full(len(points), np.inf) for s in solids}
    order = np.argsort(points[:, 0])
    x, yz = points[order, 0], points[:, 1:].T.copy()
    for k, s in enumerate(solids):
        near = order[np.searchsorted(x, s.low[0] - reach_m, "right") : np.searchsorted(x, s.high[0] + reach_m)]
        for column, low, high in zip(yz, s.low[1:] - reach_m, s.high[1:] + reach_m, strict=True):
            near = near[(column[near] > low) & (column[near] < high)]
        near.sort()
        # Signed, so that a point inside two solids belongs to the one it is deepest in.
        distance = s.distance(points[near])
        labelled = by_label[s.label]
        labelled[near] = np.minimum(labelled[near], np.abs(distance))
        better = distance < best[near]
        best[near[better]] = distance[better]
        index[near[better]] = k
    nearest = np.array([s.label for s in solids])[index]
    labels = np.array(sorted(by_label))
    table = np.stack([np.where(nearest == lab, np.inf, by_label[int(lab)]) for lab in labels], axis=1)
    return index, np.where(table.min(axis=1) < 0.05, labels[table.argmin(axis=1)], 0)


def scan_building(plan: Plan, items: list[Instance], cfg: HomeConfig, rng: np.random.Generator) -> Scan:
    """Reconstruct the building: a mesh with a label for each vertex."""
    solids = building_solids(plan, items)
    o = plan.outer
    pad = 4 * cfg.voxel_m
    # An offset that is not a whole voxel keeps walls from falling exactly onto voxel centres.
    low = np.array([o.x0, o.y0, 0.0]) - pad - rng.uniform(0.2, 0.8, 3) * cfg.voxel_m
    volume = fuse(solids, low, np.array([o.x1, o.y1, plan.wall_height_m]) + pad, cfg.voxel_m)
    vertices, faces = surface_nets(volume)
    normals = vertex_normals(vertices, faces)
    visible = visible_from(vertices, normals, camera_positions(plan, items, rng), volume)
    for w in plan.windows:
        inside = (vertices > np.array(w.low) - 0.06) & (vertices < np.array(w.high) + 0.06)
        visible &= ~inside.all(axis=1)
    # Glossy spots return no depth either.
    spots = vertices[rng.integers(len(vertices), size=max(3, int(0.15 * o.area_m2)))]
    for spot in spots:
        visible &= ((vertices - spot) ** 2).sum(axis=1) > rng.uniform(0.04, 0.11) ** 2
    vertices, faces = compact(vertices, faces[visible[faces].all(axis=1)], 60)
    index, _ = nearest_solids(vertices, solids)
    movable = np.array([s.owner for s in solids])[index] >= 0
    # Flat walls and floors thin out more readily than furniture if they are smoother before thinning.
    noise = 0.5 * rng.standard_normal(len(vertices)) + smooth_noise(vertices, 0.12, rng)
    noise *= np.where(movable, 0.8, 0.3) * cfg.vertex_noise_m
    vertices = vertices + vertex_normals(vertices, faces) * noise[:, None]
    budget = int(cfg.faces_per_m2 * sum(r.area_m2 for r in plan.rooms))
    if len(faces) > budget:
        points, triangles = fast_simplification.simplify(vertices, faces, target_count=budget, agg=5)[:2]
        vertices, faces = compact(np.asarray(points, float), np.asarray(triangles, np.int64), 12)
    index, _ = nearest_solids(vertices, solids)
    movable = np.array([s.owner for s in solids])[index] >= 0
    noise = rng.standard_normal(len(vertices)) * np.where(movable, 0.6, 0.95) * cfg.vertex_noise_m
    vertices = vertices + vertex_normals(vertices, faces) * noise[:, None]
    index, other = nearest_solids(vertices, solids)
    labels = np.array([s.label for s in solids])[index]
    border = np.flatnonzero((other > 0) & (other != labels))
    wrong = rng.permutation(border)[: int(cfg.label_noise * len(vertices) * 0.5)]
    labels[wrong] = other[wrong]
    return Scan(vertices, faces, labels.astype(np.uint8), index, tuple(solids))
