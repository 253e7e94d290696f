"""Free positions in, rooms by three kinds of clustering out.

Positions are clustered by their coordinates alone. Where a scene's plan is recorded (plans.json: the generated scenes,
drawn by `converters.generate.design_building`), rooms are compared with it by the adjusted Rand index.
"""

import dataclasses
import json
from pathlib import Path

import numpy as np
from scipy.spatial import cKDTree
from sklearn.cluster import KMeans, SpectralClustering
from sklearn.metrics import adjusted_rand_score, silhouette_score
from sklearn.mixture import GaussianMixture
from threadpoolctl import threadpool_limits

from interactive_nav.scenes.scene import Scene
from interactive_nav_common.errors import ConfigError
from topological_nav.config import DataConfig
from topological_nav.errors import SpaceError
from topological_nav.scenes.space import FreeSpace

METHODS = ("kmeans", "gmm", "spectral")
MAX_ROOMS = 15
"""Most rooms that a choice by BIC or silhouette considers."""
CLUSTERED = 1000
"""Free positions that are clustered: enough that a doorway holds several."""
_PLANS = json.loads(Path(__file__).with_name("plans.json").read_text(encoding="utf-8"))
RECORDED: dict[str, tuple[tuple[float, ...], ...]] = {
    plan["digest"]: tuple(map(tuple, plan["rooms"])) for plan in _PLANS.values()
}
"""Digest of a scene -> x0, y0, x1, y1 (m, world) of the clear inside of each room that its building was drawn with."""


@dataclasses.dataclass(frozen=True)
class Rooms:
    """Rooms of a scene, given by the nearest of many labelled positions."""

    points_w: np.ndarray
    """[n, 2] m."""
    labels: np.ndarray
    """[n] i32, 0 to count - 1, in the order of the rooms' means by x, then y."""
    method: str
    chosen_by: str
    """What decided their number: config, recorded, bic or silhouette."""

    @property
    def count(self) -> int:
        """Number of rooms."""
        return int(self.labels.max()) + 1

    def of(self, xy_w: np.ndarray) -> np.ndarray:
        """[...] i32 room of each point [..., 2]."""
        _, nearest = cKDTree(self.points_w).query(np.asarray(xy_w, float))
        return self.labels[nearest]


def cluster(points: np.ndarray, method: str, count: int, seed: int) -> np.ndarray:
    """Return labels [n] i32 of points [n, 2] (m), numbered by the clusters' means along x, then y."""
    if method not in METHODS:
        raise ConfigError(f"method is '{method}', expected one of {', '.join(METHODS)}")
    if not 1 <= count <= len(points):
        raise ConfigError(f"count is {count}, expected between 1 and the {len(points)} points")
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
    return _ordered(points, np.asarray(labels))


def choose_count(points: np.ndarray, method: str, seed: int, most: int = MAX_ROOMS) -> tuple[int, str]:
    """Number of clusters where nobody knows it, and the criterion's name.

    The Gaussian mixture takes the least Bayesian information criterion, the others the greatest silhouette, which
    needs at least two clusters.
    """
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
    """Clusters a scene's free positions."""
    centres = space.centres(clearance_m)
    rng = np.random.default_rng([seed, 1])
    points = centres[np.sort(rng.choice(len(centres), min(CLUSTERED, len(centres)), replace=False))]
    if num_rooms is not None:
        count, by = num_rooms, "config"
    elif recorded is not None:
        count, by = len(recorded), "recorded"
    else:
        count, by = choose_count(points, method, seed)
    if count > len(points):
        raise SpaceError(f"{count} rooms in {len(points)} free cells; expected fewer rooms or a finer map")
    return Rooms(points, cluster(points, method, count, seed), method, by)


def scene_rooms(scene: Scene, space: FreeSpace, config: DataConfig) -> Rooms:
    """A scene's rooms as a dataset of these settings has them; see `find_rooms`."""
    recorded = recorded_rooms(scene.digest)
    return find_rooms(space, config.room_method, config.num_rooms, recorded, config.seed, config.clearance_m)


def recorded_rooms(digest: str) -> np.ndarray | None:
    """[k, 4] x0, y0, x1, y1 (m, world) of a scene's rooms, by its digest; None where its plan is not recorded."""
    return np.array(RECORDED[digest]) if digest in RECORDED else None


def room_of(recorded: np.ndarray, xy_w: np.ndarray) -> np.ndarray:
    """[n] i32: the recorded room that holds each point [n, 2], or in a doorway the nearest one."""
    low, high = recorded[None, :, :2], recorded[None, :, 2:]
    outside = np.maximum(np.maximum(low - xy_w[:, None], xy_w[:, None] - high), 0.0)
    return np.linalg.norm(outside, axis=-1).argmin(1).astype(np.int32)


def agreement(rooms: Rooms, recorded: np.ndarray) -> float:
    """Return the adjusted Rand index of the rooms with the recorded ones: 1 the same, 0 as good as chance."""
    return float(adjusted_rand_score(room_of(recorded, rooms.points_w), rooms.labels))


def _mixture(points: np.ndarray, count: int, seed: int) -> GaussianMixture:
    return GaussianMixture(count, covariance_type="full", n_init=5, reg_covar=1e-4, random_state=seed).fit(points)


def _ordered(points: np.ndarray, labels: np.ndarray) -> np.ndarray:
    used = np.unique(labels)
    means = np.array([points[labels == k].mean(0) for k in used])
    place = np.empty(len(used), np.int32)
    place[np.lexsort((means[:, 1], means[:, 0]))] = np.arange(len(used))
    return place[np.searchsorted(used, labels)]
