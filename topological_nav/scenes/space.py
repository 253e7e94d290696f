"""Compute a scene's rooms and free space: where a robot may stand and which straight paths are free.

Obstacles are walls, doors and movable objects at rest, up to the robot's height. Rooms are clusters of free positions
by their coordinates alone; the adjusted Rand index compares them with recorded plans (plans.json: generated scenes).
"""

import dataclasses
import itertools
import json
from pathlib import Path
from typing import Any

import numpy as np
import shapely
from scipy.spatial import cKDTree
from sklearn.cluster import KMeans, SpectralClustering
from sklearn.metrics import adjusted_rand_score, silhouette_score
from sklearn.mixture import GaussianMixture
from threadpoolctl import threadpool_limits

from interactive_nav.scenes.scene import Scene
from interactive_nav_common.errors import ConfigError
from interactive_nav_common.grids import cell_centres, clearance
from interactive_nav_common.rotations import matrix_from_quat
from topological_nav.config import DataConfig

_FREE_M = 1e-6
"""Least clearance of a free cell."""


def shadow(boxes: np.ndarray, pos_w: np.ndarray, quat_w: np.ndarray) -> Any:
    """Return what the boxes [n, 10] of a body at (3,) with quaternion (4,) cover of the floor, in world m."""
    corners = np.array(list(itertools.product((-1, 1), repeat=3))) * boxes[:, None, 7:10]
    points_b = boxes[:, None, :3] + corners @ matrix_from_quat(boxes[:, 3:7]).swapaxes(1, 2)
    points_w = points_b @ matrix_from_quat(quat_w).T + pos_w
    return shapely.union_all([shapely.MultiPoint(points[:, :2]).convex_hull for points in points_w])


@dataclasses.dataclass(frozen=True)
class FreeSpace:
    """Hold a grid of distances to the nearest obstacle."""

    clearance_m: np.ndarray
    """[rows along y, columns along x] from a cell's centre; 0 where blocked."""
    resolution_m: float
    origin_w: tuple[float, float]
    """World x, y of the outer corner of cell [0, 0]."""

    def free(self, least_m: float) -> np.ndarray:
        """Return which cells have at least this clearance, [rows, columns] bool."""
        return self.clearance_m >= max(least_m, _FREE_M)

    def centres(self, least_m: float) -> np.ndarray:
        """Return the centres of the cells with at least this clearance, row by row: [n, 2] m, world."""
        return cell_centres(self.free(least_m), self.resolution_m, self.origin_w)

    def cells(self, xy_w: np.ndarray) -> np.ndarray:
        """Return the column and row [..., 2] of the cells that hold points [..., 2], inside the map or not."""
        return np.floor((np.asarray(xy_w, float) - self.origin_w) / self.resolution_m).astype(int)

    def inner_cells(self, xy_w: np.ndarray) -> np.ndarray:
        """Return the map's cells nearest to points, as `cells` does."""
        rows, columns = self.clearance_m.shape
        return np.clip(self.cells(xy_w), 0, (columns - 1, rows - 1))

    def at(self, xy_w: np.ndarray) -> np.ndarray:
        """Return the clearance [...] (m) of the cells that hold points [..., 2]; 0 outside the map."""
        cell = self.inner_cells(xy_w)
        inside = (cell == self.cells(xy_w)).all(-1)
        return np.where(inside, self.clearance_m[cell[..., 1], cell[..., 0]], 0.0)

    def segment_free(self, start_w: np.ndarray, end_w: np.ndarray, points: int, margin_m: float) -> np.ndarray:
        """Return whether straight paths between points [..., 2] keep the margin at `points` places; 0: free cells."""
        share = np.linspace(0.0, 1.0, points)[:, None]
        start_w, end_w = np.asarray(start_w, float), np.asarray(end_w, float)
        along = start_w[..., None, :] + share * (end_w - start_w)[..., None, :]
        # A point on the border of two cells belongs to either: a hair of slack keeps the answer the same both ways.
        return np.asarray((self.at(along) >= max(margin_m, _FREE_M) - 1e-9).all(-1))

    def sample(self, rng: np.random.Generator, count: int, least_m: float) -> np.ndarray:
        """Draw distinct cell centres [count, 2] with at least this clearance, uniformly."""
        centres = self.centres(least_m)
        if len(centres) < count:
            raise ConfigError(
                f"{len(centres)} cells are at least {least_m} m from obstacles, expected {count}; "
                "ask for fewer positions or less clearance"
            )
        return centres[np.sort(rng.choice(len(centres), count, replace=False))]


def free_space(scene: Scene, height_m: float) -> FreeSpace:
    """Return the free space of a scene."""
    maps = scene.maps
    free = maps.traversable.copy()
    x, y = cell_centres(np.ones_like(free), maps.resolution_m, maps.origin_w).T
    for body in scene.movables:
        # A box's lowest point is at least its centre less its half diagonal.
        low = body.pos_w[2] + body.boxes[:, 2] - np.linalg.norm(body.boxes[:, 7:10], axis=1)
        boxes = body.boxes[low < height_m]
        if len(boxes):
            free &= ~shapely.contains_xy(shadow(boxes, body.pos_w, body.quat_w), x, y).reshape(free.shape)
    return FreeSpace(clearance(free, maps.resolution_m), maps.resolution_m, maps.origin_w)


def spread(points: np.ndarray, count: int, rng: np.random.Generator) -> np.ndarray:
    """Return the indices of up to `count` points of [n, 2]; each next one is the farthest from the others."""
    if count <= 0 or not len(points):
        return np.zeros(0, int)
    picked = [int(rng.integers(len(points)))]
    away = np.linalg.norm(points - points[picked[0]], axis=1)
    while len(picked) < min(count, len(points)):
        nearest = int(np.argmax(away))
        picked.append(nearest)
        away = np.minimum(away, np.linalg.norm(points - points[nearest], axis=1))
    return np.asarray(picked)


METHODS = ("kmeans", "gmm", "spectral")
MAX_ROOMS = 15
"""Most rooms considered when BIC or silhouette choose."""
CLUSTERED = 1000
"""Free positions to cluster: enough that a doorway contains several."""
_PLANS = json.loads(Path(__file__).with_name("plans.json").read_text(encoding="utf-8"))
RECORDED: dict[str, tuple[tuple[float, ...], ...]] = {
    plan["digest"]: tuple(map(tuple, plan["rooms"])) for plan in _PLANS.values()
}
"""Digest of a scene -> x0, y0, x1, y1 (m, world) of the clear inside of each room that its building was drawn with."""


@dataclasses.dataclass(frozen=True)
class Rooms:
    """Hold the rooms of a scene; each point belongs to the room of the nearest labelled position."""

    points_w: np.ndarray
    """[n, 2] m."""
    labels: np.ndarray
    """[n] i32, 0 to count - 1, in the order of the rooms' means by x, then y."""
    method: str
    chosen_by: str
    """What determined their number: config, recorded, bic or silhouette."""

    @property
    def count(self) -> int:
        return int(self.labels.max()) + 1

    def of(self, xy_w: np.ndarray) -> np.ndarray:
        """Return the room [...] of each point [..., 2]."""
        _, nearest = cKDTree(self.points_w).query(np.asarray(xy_w, float))
        return self.labels[nearest]


def cluster(points: np.ndarray, method: str, count: int, seed: int) -> np.ndarray:
    """Return labels [n] i32 of points [n, 2] (m), numbered by the clusters' means along x, then y."""
    if not 1 <= count <= len(points):
        raise ConfigError(f"count is {count}, expected between 1 and the {len(points)} points in free cells")
    if count == 1:
        return np.zeros(len(points), np.int32)
    with threadpool_limits(1):  # on problems this small, threads cost more than they give
        if method == "kmeans":
            labels = KMeans(count, n_init=10, random_state=seed).fit_predict(points)  # type: ignore[arg-type]
        elif method == "gmm":
            labels = _mixture(points, count, seed).predict(points)
        else:
            near = min(10, len(points) - 1)
            labels = SpectralClustering(
                count, affinity="nearest_neighbors", n_neighbors=near, assign_labels="cluster_qr", random_state=seed
            ).fit_predict(points)
    used, labels = np.unique(labels, return_inverse=True)
    means = np.array([points[labels == k].mean(0) for k in range(len(used))])
    place = np.empty(len(used), np.int32)
    place[np.lexsort((means[:, 1], means[:, 0]))] = np.arange(len(used))
    return place[labels]


def choose_count(points: np.ndarray, method: str, seed: int, most: int = MAX_ROOMS) -> tuple[int, str]:
    """Return the number of clusters of least BIC (gmm) or greatest silhouette (others, 2 or more) and its criterion."""
    most = min(most, len(points) - 1)
    if method == "gmm":
        with threadpool_limits(1):
            scores = [_mixture(points, k, seed).bic(points) for k in range(1, most + 1)]
        return 1 + int(np.argmin(scores)), "bic"
    scores = [silhouette_score(points, cluster(points, method, k, seed)) for k in range(2, most + 1)]
    return 2 + int(np.argmax(scores)), "silhouette"


def find_rooms(
    space: FreeSpace, method: str, num_rooms: int | None, recorded: np.ndarray | None, seed: int, clearance_m: float
) -> Rooms:
    """Cluster a scene's free positions."""
    centres = space.centres(clearance_m)
    rng = np.random.default_rng([seed, 1])
    points = centres[np.sort(rng.choice(len(centres), min(CLUSTERED, len(centres)), replace=False))]
    if num_rooms is not None:
        count, by = num_rooms, "config"
    elif recorded is not None:
        count, by = len(recorded), "recorded"
    else:
        count, by = choose_count(points, method, seed)
    return Rooms(points, cluster(points, method, count, seed), method, by)


def scene_rooms(scene: Scene, space: FreeSpace, config: DataConfig) -> Rooms:
    """Return a scene's rooms with a dataset's settings; see `find_rooms`."""
    recorded = recorded_rooms(scene.digest)
    return find_rooms(space, config.room_method, config.num_rooms, recorded, config.seed, config.clearance_m)


def recorded_rooms(digest: str) -> np.ndarray | None:
    """Return x0, y0, x1, y1 (m, world) of a scene's rooms [k, 4] by its digest; None without a recorded plan."""
    return np.array(RECORDED[digest]) if digest in RECORDED else None


def room_of(recorded: np.ndarray, xy_w: np.ndarray) -> np.ndarray:
    """Return the recorded room [n] that contains each point [n, 2], or the nearest one."""
    low, high = recorded[None, :, :2], recorded[None, :, 2:]
    outside = np.maximum(np.maximum(low - xy_w[:, None], xy_w[:, None] - high), 0.0)
    return np.linalg.norm(outside, axis=-1).argmin(1).astype(np.int32)


def agreement(rooms: Rooms, recorded: np.ndarray) -> float:
    """Return the adjusted Rand index of the rooms with the recorded ones: 1 identical, 0 chance."""
    return float(adjusted_rand_score(room_of(recorded, rooms.points_w), rooms.labels))


def _mixture(points: np.ndarray, count: int, seed: int) -> GaussianMixture:
    return GaussianMixture(count, covariance_type="full", n_init=5, reg_covar=1e-4, random_state=seed).fit(points)
