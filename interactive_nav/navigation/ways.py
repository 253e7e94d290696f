"""Plan paths in a scene's state on the host by Dijkstra, around movable objects or, at a price, through them.

This is navigation among movable obstacles (Stilman and Kuffner 2005, Interactive Gibson section II-D).
"""

from typing import Any

import mujoco
import numpy as np
import scipy.ndimage
import scipy.sparse.csgraph
import scipy.spatial

from interactive_nav.navigation.tables import friction_share
from interactive_nav_common.grids import (
    MOVES_16,
    follow,
    grid_graph,
    label,
    largest_component,
    nearest_cell,
    sampled_clearance,
)
from scenes_mjcf.look import mesh_of

CELL_M = 0.05
MARGIN_M = 0.02
"""Kept from objects beyond the robot's radius: what episodes begin with."""
NEAR_M = 0.15
"""Within this much more of structure or an object a way costs up to `NEAR_COST` times more: room to steer."""
NEAR_COST = 2.0
START_OFF_M = 0.3
"""The free cell that stands for a start lies this near."""
SHUT_RAD = 0.5
"""A door is shut if it has turned less than this since the start."""
FORCED_COST = 1e3
"""Metres of detour that a metre through an object is worth at weight 1: it is pushed only where no way is free."""


class Footprints:
    """Cells of a grid over which each movable body of a scene stands, below the robot's height."""

    def __init__(self, model: mujoco.MjModel, bodies: np.ndarray, height_m: float, origin_w: Any, shape: Any):
        self._model, self._data = model, mujoco.MjData(model)
        self._bodies, self._height_m = bodies, height_m
        self._origin, self._shape = np.asarray(origin_w, float), shape
        self._geoms = [np.flatnonzero((model.geom_bodyid == b) & (model.geom_rbound > 5e-3)) for b in bodies]
        self._covered_at: dict[Any, np.ndarray] = {}
        self._corners = np.array(np.meshgrid([-1, 1], [-1, 1], [-1, 1], indexing="ij")).reshape(3, -1).T

    def cells(self, qpos: np.ndarray) -> list[np.ndarray]:
        """Return, per body, the flat indices of the cells that it covers."""
        self._data.qpos[:] = qpos
        mujoco.mj_kinematics(self._model, self._data)
        out = []
        for k, geoms in enumerate(self._geoms):
            pose = np.concatenate([self._data.xpos[self._bodies[k]], self._data.xmat[self._bodies[k]]])
            key = (k, *np.round(pose * 200).astype(int).tolist())
            if key not in self._covered_at:
                if len(self._covered_at) > 20_000:
                    self._covered_at.clear()
                self._covered_at[key] = self._covered(geoms)
            out.append(self._covered_at[key])
        return out

    def _covered(self, geoms: np.ndarray) -> np.ndarray:
        model, data = self._model, self._data
        cells = []
        for g in geoms:
            if model.geom_type[g] == mujoco.mjtGeom.mjGEOM_MESH:
                local = mesh_of(model, model.geom_dataid[g])[0]
            else:
                local = self._corners * model.geom_size[g]
            points = data.geom_xpos[g] + local @ data.geom_xmat[g].reshape(3, 3).T
            if points[:, 2].min() > self._height_m:
                continue
            cells.append(self._polygon(points[:, :2]))
        return np.unique(np.concatenate(cells)) if cells else np.zeros(0, np.int64)

    def _polygon(self, points: np.ndarray) -> np.ndarray:
        """Return the cells whose middle lies in the convex hull of points [p, 2], or within half a cell of it."""
        rows, columns = self._shape
        at = (points - self._origin) / CELL_M
        low = np.maximum(np.floor(at.min(0) - 1), 0).astype(int)
        high = np.minimum(np.ceil(at.max(0) + 1), [columns, rows]).astype(int)
        if (high <= low).any():
            return np.zeros(0, np.int64)
        hull = scipy.spatial.ConvexHull(at, qhull_options="QJ").equations
        c, r = np.arange(low[0], high[0]), np.arange(low[1], high[1])
        middle = np.stack(np.meshgrid(c + 0.5, r + 0.5, indexing="xy"), -1)
        inside = (middle @ hull[:, :2].T + hull[:, 2] <= 0.5).all(-1)
        rr, cc = np.nonzero(inside)
        return (rr + low[1]) * columns + cc + low[0]


class _SceneGrid:
    """One scene's static map on the planners' grid, and its objects."""

    def __init__(self, env: Any, index: int):
        world, maps = env.world, env.scenes[index].maps
        self.origin_w = np.asarray(maps.origin_w, float)
        self.room_m = sampled_clearance(maps.traversable, maps.resolution_m, CELL_M)
        self.shape = self.room_m.shape
        self.free = largest_component(self.room_m >= env.robot.footprint_radius_m)
        self.occupied = np.flatnonzero(world.slots.occupied[index])
        bodies = world.layout.slot_body[self.occupied]
        model = world.models[index]
        self.footprints = Footprints(model, bodies, env.robot.height_m, self.origin_w, self.shape)
        self.price = friction_share(world, index)[self.occupied]
        self.stuck = ~world.slots.held[self.occupied] & (self.price > 1.0)  # its friction exceeds the robot's weight
        self.doors = np.array(world.slots.categories[index])[self.occupied] == "door"
        address = world.layout.slot_qpos[self.occupied]
        self.address, self.rest = address, world.rest_qpos[index][address]

    def middles_w(self, cells: np.ndarray) -> np.ndarray:
        """Return [p, 2] m of cells [p, 2] (row, column)."""
        return self.origin_w + (cells[:, ::-1] + 0.5) * CELL_M

    def cell(self, xy_w: np.ndarray) -> tuple[int, int]:
        """Return (row, column) of a place; beyond the map, the nearest."""
        c, r = np.floor((xy_w - self.origin_w) / CELL_M).astype(int)
        return int(np.clip(r, 0, self.shape[0] - 1)), int(np.clip(c, 0, self.shape[1] - 1))


class PathGrid:
    """Plan over one grid by Dijkstra with 16 moves; `free` and `cost` (1 per metre or more) are [rows, columns]."""

    def __init__(self, free: np.ndarray, cost: np.ndarray):
        self._shape = rows, columns = free.shape
        self._any = bool(free.any())
        if not self._any:
            return
        self._nearest = nearest_cell(free)
        self._index = np.arange(rows * columns).reshape(rows, columns)
        self._graph = grid_graph(free, cost, CELL_M, MOVES_16, corners=False)

    def path(self, start: tuple[int, int], goal: tuple[int, int]) -> np.ndarray:
        """Return the cheapest path [p, 2] (row, column) between the free cells nearest to two cells; [0, 2] if none."""
        if not self._any:
            return np.zeros((0, 2), np.int64)
        begin, end = self._nearest[:, start[0], start[1]], self._nearest[:, goal[0], goal[1]]
        source, target = self._index[begin[0], begin[1]], self._index[end[0], end[1]]
        _, previous = scipy.sparse.csgraph.dijkstra(
            self._graph, directed=False, indices=target, return_predecessors=True
        )
        return np.stack(np.unravel_index(np.array(follow(previous, source, target), np.int64), self._shape), -1)


class Ways:
    """Plan paths in every scene of an environment.

    A weight w of 0 gives the shortest path through everything. Between 0 and 1, a metre through an object of mass m and
    friction mu costs w / (1 - w) * mu m / m_0 metres of detour: its friction's work over the robot's weight. With 1, or
    for an object too heavy to push, paths lead through it only if no other exists. None: nothing is touched.
    With `barred`, no path leads through doors of rooms that stand as they did at the start.
    """

    def __init__(self, env: Any, weight: float | None, barred: bool = False):
        self._env, self._weight, self._barred = env, weight, barred
        self._grids = [_SceneGrid(env, i) for i in range(len(env.scenes))]

    def way(self, scene: int, qpos: np.ndarray, start_xy_w: np.ndarray, goal_xy_w: np.ndarray) -> np.ndarray:
        """Return a path [p, 2], m, in the world's frame, for `qpos` [nq] and places (2,), m; [0, 2] where none exists.
        It ends at the goal unless nothing may be touched."""
        grid = self._grids[scene]
        free, cost = self._costs(grid, qpos)
        cells = PathGrid(free, cost).path(grid.cell(start_xy_w), grid.cell(goal_xy_w))
        path = grid.middles_w(cells)
        if not len(path) or not self._near(path[[0, -1]], start_xy_w, goal_xy_w):
            return np.zeros((0, 2))
        return path if self._weight is None else np.concatenate([path, goal_xy_w[None]])

    def exists(self, scene: int, qpos: np.ndarray, start_xy_w: np.ndarray, goal_xy_w: np.ndarray) -> bool:
        """Return whether `way` has a path, in less time."""
        grid = self._grids[scene]
        free, _ = self._costs(grid, qpos)
        if not free.any():
            return False
        nearest = nearest_cell(free)
        ends = np.stack([nearest[:, *grid.cell(xy)] for xy in (start_xy_w, goal_xy_w)])
        # No move cuts a corner, so what the moves join is joined by cells that share sides.
        region, _ = label(free)
        one = region[tuple(ends[0])] == region[tuple(ends[1])]
        return bool(one and self._near(grid.middles_w(ends), start_xy_w, goal_xy_w))

    def _near(self, ends_w: np.ndarray, start_xy_w: np.ndarray, goal_xy_w: np.ndarray) -> bool:
        """Return whether a path's ends, free cells, are near enough to stand for the start and the goal."""
        off = np.linalg.norm(ends_w - np.stack([start_xy_w, goal_xy_w]), axis=-1)
        return bool(off[0] <= START_OFF_M and off[1] <= self._env.success_distance_m)

    def _costs(self, grid: _SceneGrid, qpos: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Return [rows, columns] where the robot's middle may be, and what a metre costs there."""
        radius, cost, free = self._env.robot.footprint_radius_m, np.ones(grid.shape), grid.free
        near = np.clip(1.0 - (grid.room_m - radius) / NEAR_M, 0.0, 1.0)
        if self._weight == 0.0:
            return free, cost + 0.2 * near
        covered = np.zeros(grid.shape)  # metres of detour per metre through what stands here
        blocked = np.zeros(grid.shape, bool)
        share = 1.0 if self._weight is None else self._weight
        for k, cells in enumerate(grid.footprints.cells(qpos)):
            if len(cells):
                forced = grid.stuck[k] or share == 1.0
                price = FORCED_COST if forced else min(share / (1.0 - share) * grid.price[k], FORCED_COST)
                shut = grid.doors[k] and abs(qpos[grid.address[k]] - grid.rest[k]) < SHUT_RAD
                price = np.inf if self._barred and shut else price
                blocked.flat[cells] = True
                covered.flat[cells] = np.maximum(covered.flat[cells], price)
        away, index = scipy.ndimage.distance_transform_edt(~blocked, return_indices=True)  # type: ignore[misc]
        away_m = np.maximum(away - 0.5, 0.0) * CELL_M if blocked.any() else np.full(grid.shape, np.inf)
        hits = away_m < radius + MARGIN_M
        if self._weight is None:
            free = free & ~hits
        else:
            cost = cost + np.where(hits, covered[index[0], index[1]], 0.0)
            free = free & np.isfinite(cost)
        near = np.maximum(near, np.clip(1.0 - (away_m - radius - MARGIN_M) / NEAR_M, 0.0, 1.0) * ~hits)
        return free, cost + NEAR_COST * near
