"""Judge images for a navigator: how far each node of its map is from where they were taken, and what lies ahead.

The navigator itself never looks into an image. `NetworkSight` asks trained networks; `TrueSight` stands in for perfect
ones in tests and measurements: its "images" are poses.
"""

from typing import Any, Protocol

import numpy as np

from topological_nav.errors import MapError
from topological_nav.learn.networks import nearest_turn, squares_between
from topological_nav.learn.training import Networks
from topological_nav.maps.graph import TopologicalMap
from topological_nav.scenes.space import FreeSpace

OUT_OF_SIGHT_M = 100.0
"""Added to the distance of a node behind a wall, for `TrueSight`."""
LINE_POINTS = 50
"""Looked up on a line of sight."""


class Sight(Protocol):
    """Judge images, in batches; an image is one row of an array, of any shape that the judge understands."""

    summed: bool
    """Whether distances of several images are summed; else the least counts."""

    def distances(self, images: np.ndarray, heading_rad: np.ndarray) -> np.ndarray:
        """Return how far each node is, [n, N], by images [n, ...] taken along headings [n]."""
        ...

    def passage(self, images: np.ndarray, ahead_m: np.ndarray | float) -> np.ndarray:
        """Return the probability that the way ahead is free for lengths [n], or for M lengths of each [n, M].

        A number is a length for all images, and gives [n].
        """
        ...


def place_distances(sight: Sight, images: np.ndarray, heading_rad: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return how far each node is from places, by each image [P, K, N] and by all [P, N]; images [P, K, ...]."""
    count, around = images.shape[:2]
    each = sight.distances(images.reshape(count * around, *images.shape[2:]), np.tile(heading_rad, count))
    each = each.reshape(count, around, -1)
    return each, each.sum(1) if sight.summed else each.min(1)


class NetworkSight:
    """Judge by a map, a network that embeds and one that judges passages."""

    def __init__(self, graph: TopologicalMap, networks: Networks, match: str = "aligned"):
        """Check that the map is of these networks."""
        for name, digest in networks.digests.items():
            used = graph.about.get(name, "")
            if used != digest:
                raise MapError(
                    f"the map of '{graph.scene}' was built with {name} {used[:12] or 'unknown'}, "
                    f"this one is {digest[:12]}; "
                    "build the map again with it, or name the runs it was built with"
                )
        self._nodes = graph.embeddings.astype(float)
        self._networks, self.summed = networks, match == "aligned"

    def distances(self, images: np.ndarray, heading_rad: np.ndarray) -> np.ndarray:
        """Return Euclidean distances [n, N] of embeddings: to the node's image of that heading, or to its nearest."""
        queries = self._networks.localiser.embed(images).astype(float)
        nodes, around = self._nodes, self._nodes.shape[1]
        if self.summed:
            turn = nearest_turn(np.asarray(heading_rad), around)
            out = np.empty((len(queries), len(nodes)))
            for k in np.unique(turn):
                rows = turn == k
                out[rows] = _apart(queries[rows], nodes[:, k])
            return out
        return _apart(queries, nodes.reshape(-1, nodes.shape[-1])).reshape(len(queries), -1, around).min(-1)

    def passage(self, images: np.ndarray, ahead_m: np.ndarray | float) -> np.ndarray:
        """Return the detector's probability; see `Sight.passage`."""
        return self._networks.detector.passage(images, ahead_m)


class TrueSight:
    """Judge by the truth in the place of networks: images are poses [n, 3], x and y (m) and yaw (rad), world frame."""

    summed = True

    def __init__(self, graph: TopologicalMap, space: FreeSpace, margin_m: float = 0.225):
        """Take the plan."""
        self._xy, self._space, self._margin_m = graph.xy_w.astype(float), space, margin_m

    def distances(self, images: np.ndarray, heading_rad: np.ndarray) -> np.ndarray:
        """Return the distances [n, N] (m) to nodes in sight; `OUT_OF_SIGHT_M` more to those that are not."""
        del heading_rad
        here = np.broadcast_to(images[:, None, :2], (len(images), len(self._xy), 2))
        visible = self._space.segment_free(here, np.broadcast_to(self._xy, here.shape), LINE_POINTS, 0.0)
        return np.linalg.norm(here - self._xy, axis=-1) + OUT_OF_SIGHT_M * ~visible

    def passage(self, images: np.ndarray, ahead_m: np.ndarray | float) -> np.ndarray:
        """Return 1 where the way ahead is free, else 0; see `Sight.passage`.

        Who stands nearer to an obstacle than the margin may leave it: the way may begin as near, but come no nearer.
        """
        ahead = np.asarray(ahead_m, float)
        ahead = np.broadcast_to(ahead, (len(images), *ahead.shape[1:]))
        poses = images.reshape(len(images), *[1] * ahead.ndim, -1)
        xy, yaw = poses[..., :2], poses[..., 2]
        along = (ahead[..., None] * np.linspace(0.0, 1.0, LINE_POINTS))[..., None]
        room = self._space.at(xy + along * np.stack([np.cos(yaw), np.sin(yaw)], -1))
        least = np.minimum(self._margin_m, room[..., :1])
        free = ((room >= least - 1e-9) & (room > 0.0)).all(-1) & (room[..., -1] >= self._margin_m - 1e-9)
        return free.astype(float)


def _apart(a: np.ndarray, b: np.ndarray) -> np.ndarray:
    """Return the Euclidean distances [n, m] of rows [n, D] and [m, D] in double precision."""
    return np.sqrt(np.maximum(squares_between(a, b), 0.0))


class PassagePolicy:
    """Drive by the passage detector alone, as a baseline: straight on while it agrees, else it swings about.

    It turns left by `SWEEP_RAD`, then right by twice as much, and so on wider, until the detector agrees.
    """

    period = 3
    """Control steps between two looks; in between the last command holds."""
    CRUISE_M_S = 0.4
    TURN_RAD_S = 0.5
    SWEEP = 4
    """Looks (of 0.15 rad) that the first turn to the left lasts."""

    def __init__(self, sight: Sight, passable: float = 0.5, ahead_m: float = 1.0):
        """Take whose judgement to trust."""
        self._sight, self._passable, self._ahead_m = sight, passable, ahead_m

    def start(self, batch: int) -> Any:
        """Return the looks since the way was last free, [batch] i32."""
        return np.zeros(batch, np.int32)

    def act(self, state: Any, images: np.ndarray) -> tuple[Any, np.ndarray, np.ndarray]:
        """See `driving.LocalPolicy`."""
        free = self._sight.passage(images, self._ahead_m) >= self._passable
        # Turns end after 1, 3, 5, ... times SWEEP looks: sides change after SWEEP * k^2.
        side = np.where(np.floor(np.sqrt(state / self.SWEEP)).astype(int) % 2 == 0, 1.0, -1.0)
        linear = np.where(free, self.CRUISE_M_S, 0.0)
        angular = np.where(free, 0.0, side * self.TURN_RAD_S)
        return np.where(free, 0, state + 1).astype(np.int32), linear, angular
