"""Build a scene's topological map by two trained networks, and judge images for a navigator.

Building places nodes, renders images and judges edges. A `Sight` tells the navigator how far each node is from an
image, and how far the path ahead is free: `NetworkSight` by networks, `TrueSight` by the truth, where images are poses,
for tests and measurements.
"""

import dataclasses
from collections.abc import Callable
from pathlib import Path
from typing import Any, Protocol

import jax
import numpy as np
from sklearn.metrics.pairwise import euclidean_distances

from interactive_nav import get_robot, load_scene
from interactive_nav.robots import RobotSpec
from interactive_nav.scenes.scene import Scene
from interactive_nav_common.config import overlay, to_dict
from interactive_nav_common.errors import ConfigError, FileError
from interactive_nav_common.jobs.progress import Progress
from topological_nav.config import DataConfig, MapConfig
from topological_nav.data.dataset import headings
from topological_nav.data.folders import renderer_of
from topological_nav.learn.learning import DESCRIPTION
from topological_nav.learn.networks import nearest_turn
from topological_nav.learn.training import Networks, Trained, load_networks
from topological_nav.maps.graph import TopologicalMap, assemble, lengths, place_nodes
from topological_nav.scenes.rendering import camera_pose, need_engine
from topological_nav.scenes.space import FreeSpace, Rooms, free_space, scene_rooms

OUT_OF_SIGHT_M = 100.0
"""`TrueSight` adds this to the distance of a node behind a wall."""
LINE_POINTS = 50
"""Points to check on a line of sight."""


class Sight(Protocol):
    """Judge images in batches; an image is a row of an array, of any shape that the judge understands."""

    summed: bool
    """Whether distances of several images are summed; otherwise the least counts."""

    def distances(self, images: np.ndarray, heading_rad: np.ndarray) -> np.ndarray:
        """Return the distance of each node [n, N] by images [n, ...] along headings [n]."""
        ...

    def passage(self, images: np.ndarray, ahead_m: np.ndarray | float) -> np.ndarray:
        """Return the probability that the path ahead is free for lengths [n] or [n, M] (m), or one for all ([n])."""
        ...


def place_distances(sight: Sight, images: np.ndarray, heading_rad: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return nodes' distances by image [P, K, N] and by place [P, N]; images [P, K, ...], headings [K] or [P, K]."""
    count, around = images.shape[:2]
    headings_rad = np.broadcast_to(heading_rad, (count, around)).ravel()
    each = sight.distances(images.reshape(count * around, *images.shape[2:]), headings_rad)
    each = each.reshape(count, around, -1)
    return each, each.sum(1) if sight.summed else each.min(1)


class NetworkSight:
    """Judge by a map, an embedding network and a passage detector."""

    def __init__(self, graph: TopologicalMap, networks: Networks, match: str = "aligned"):
        """Check that the map was built with these networks."""
        for name, digest in networks.digests.items():
            used = graph.about.get(name, "")
            if used != digest:
                raise FileError(
                    f"the map of '{graph.scene}' was built with {name} {used[:12] or 'unknown'}, "
                    f"this one is {digest[:12]}; "
                    "build the map again with it, or name the runs it was built with"
                )
        self._nodes = graph.embeddings.astype(float)
        self._networks, self.summed = networks, match == "aligned"

    def distances(self, images: np.ndarray, heading_rad: np.ndarray) -> np.ndarray:
        """Return Euclidean distances [n, N] of embeddings to the node's image of that heading, or its nearest."""
        queries = self._networks.localiser.embed(images).astype(float)
        nodes, around = self._nodes, self._nodes.shape[1]
        if self.summed:
            turn = nearest_turn(np.asarray(heading_rad), around)
            out = np.empty((len(queries), len(nodes)))
            for k in np.unique(turn):
                rows = turn == k
                out[rows] = euclidean_distances(queries[rows], nodes[:, k])
            return out
        away = euclidean_distances(queries, nodes.reshape(-1, nodes.shape[-1]))
        return away.reshape(len(queries), -1, around).min(-1)

    def passage(self, images: np.ndarray, ahead_m: np.ndarray | float) -> np.ndarray:
        return self._networks.detector.passage(images, ahead_m)


class TrueSight:
    """Judge by the truth instead of networks; images are poses [n, 3]: x, y (m) and yaw (rad), world frame."""

    summed = True

    def __init__(self, graph: TopologicalMap, space: FreeSpace, margin_m: float = 0.225):
        self._xy, self._space, self._margin_m = graph.xy_w.astype(float), space, margin_m

    def distances(self, images: np.ndarray, heading_rad: np.ndarray) -> np.ndarray:
        """Return the distances [n, N] (m) to nodes, plus `OUT_OF_SIGHT_M` for those out of sight."""
        here = np.broadcast_to(images[:, None, :2], (len(images), len(self._xy), 2))
        visible = self._space.segment_free(here, np.broadcast_to(self._xy, here.shape), LINE_POINTS, 0.0)
        return np.linalg.norm(here - self._xy, axis=-1) + OUT_OF_SIGHT_M * ~visible

    def passage(self, images: np.ndarray, ahead_m: np.ndarray | float) -> np.ndarray:
        """Return 1 where the path ahead is free, else 0; see `Sight.passage`.

        A path that starts nearer to an obstacle than the margin may come no nearer.
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


class PassagePolicy:
    """Drive straight while the passage detector agrees, else swing about, left first and ever wider: a baseline."""

    period = 3
    """Control steps per image; the last command holds in between."""
    CRUISE_M_S = 0.4
    TURN_RAD_S = 0.5
    SWEEP = 4
    """Images (0.15 rad each) during the first turn to the left."""

    def __init__(self, sight: Sight, passable: float = 0.5, ahead_m: float = 1.0):
        self._sight, self._passable, self._ahead_m = sight, passable, ahead_m

    def start(self, batch: int) -> Any:
        """Return the number of images since the path was last free, [batch] i32."""
        return np.zeros(batch, np.int32)

    def act(self, state: Any, images: np.ndarray) -> tuple[Any, np.ndarray, np.ndarray]:
        free = self._sight.passage(images, self._ahead_m) >= self._passable
        # Turns end after 1, 3, 5, ... times SWEEP looks: sides change after SWEEP * k^2.
        side = np.where(np.floor(np.sqrt(state / self.SWEEP)).astype(int) % 2 == 0, 1.0, -1.0)
        linear = np.where(free, self.CRUISE_M_S, 0.0)
        angular = np.where(free, 0.0, side * self.TURN_RAD_S)
        return np.where(free, 0, state + 1).astype(np.int32), linear, angular


CHUNK = 252
"""Images rendered between two reports: fourteen calls of the renderer."""
CPU_SUPERSAMPLE = 2
"""Limit on a CPU, where rendering dominates; the networks answer nearly the same (docs/topological-transfer.md)."""


@dataclasses.dataclass(frozen=True)
class Built:
    """Hold a map, its free space and its scores."""

    map: TopologicalMap
    space: FreeSpace
    free: np.ndarray
    """[E] bool: whether each edge is free on the plan."""
    scores: dict[str, Any]
    """Nodes per room, connectedness, and how edges compare with the plan."""


def build_map(
    scene_folder: Path,
    localiser_run: Path,
    detector_run: Path,
    config: MapConfig,
    progress: Progress = lambda *_: None,
) -> Built:
    """Build a scene's map by the runs of an embedding and a passage detector."""
    networks = load_networks(localiser_run, detector_run).asking(config.asked_m)
    data = drawn_for(networks.camera, config.supersample)
    scene, robot = load_scene(scene_folder), get_robot(data.robot)
    space = free_space(scene, robot.height_m)
    rooms = scene_rooms(scene, space, data)
    xy, lacking = place_nodes(space, rooms, config, *judged_by(networks.detector))
    if not len(xy):
        raise ConfigError(f"{scene.path}: no place is {config.clearance_m} m from obstacles; lower clearance_m")
    around = headings(data)
    pictures = Pictures(scene, data, robot, progress)
    images = pictures.draw_around(xy, around, "nodes")

    def along(edges: np.ndarray, angle: np.ndarray) -> np.ndarray:
        pictures.total += len(edges)
        return pictures.draw(xy[edges[:, 0]], angle, "edges")

    about = {"settings": to_dict(config), "data": to_dict(data)}
    look = along if config.edge_image == "exact" else None
    built = judged_map(scene, space, xy, rooms.of(xy), images, networks, config.edge_m, config.passable, about, look)
    graph = built.map
    scores = {"nodes a room": " ".join(map(str, np.bincount(graph.room))), **built.scores}
    scores |= {"lacking": "; ".join(lacking)} if lacking else {}
    if config.check:
        places = space.sample(np.random.default_rng([data.seed, 13]), config.check, config.clearance_m)
        looked = pictures.draw_around(places, around, "check")
        for match in ("aligned", "nearest"):
            sight = NetworkSight(graph, networks, match)
            scores |= localisation_check(sight, graph, looked, around, places)
    return dataclasses.replace(built, scores=scores)


def judged_by(detector: Trained) -> tuple[float, int]:
    """Return the margin (m) and number of points of the labels that a passage detector was trained on."""
    config = overlay(DataConfig(), detector.about["data"], DESCRIPTION)
    return config.passage_margin_m, config.passage_points


def judged_map(
    scene: Any,
    space: FreeSpace,
    xy_w: np.ndarray,
    room: np.ndarray,
    images: np.ndarray,
    networks: Networks,
    edge_m: float,
    passable: float,
    about: dict[str, Any],
    look: Callable[[np.ndarray, np.ndarray], np.ndarray] | None = None,
) -> Built:
    """Build a map of nodes with images [N, K, ...]; `look(edges, headings)` returns images (None: the nearest)."""
    margin_m, points = judged_by(networks.detector)

    def probability(edges: np.ndarray, angle: np.ndarray) -> np.ndarray:
        ahead = look(edges, angle) if look else images[edges[:, 0], nearest_turn(angle, images.shape[1])]
        return networks.detector.passage(ahead, lengths(xy_w, edges))

    about = {**about, **networks.digests, "margin_m": margin_m, "points": points}
    embeddings = networks.localiser.embed(images)
    graph = assemble(scene.name, scene.digest, xy_w, room, embeddings, edge_m, probability, about)
    free = space.segment_free(xy_w[graph.edges[:, 0]], xy_w[graph.edges[:, 1]], points, margin_m)
    return Built(graph, space, free, edge_scores(graph, free, passable))


def localisation_check(
    sight: Sight, graph: TopologicalMap, images: np.ndarray, heading_rad: np.ndarray, xy_w: np.ndarray
) -> dict[str, str]:
    """Describe how well a map localises by all images of a place, and by the first one."""
    each, summed = place_distances(sight, images, heading_rad)
    away, said = np.linalg.norm(xy_w[:, None] - graph.xy_w, axis=-1), {}
    for what, evidence in ((f"{len(heading_rad)} images", summed), ("1 image", each[:, 0])):
        node = evidence.argmin(-1)
        error = away[np.arange(len(node)), node]
        said[f"localised by {what}, {'aligned' if sight.summed else 'nearest'}"] = (
            f"nearest node {(node == away.argmin(-1)).mean():.3f}, within 1.5 m {(error < 1.5).mean():.3f}, "
            f"median error {np.median(error):.2f} m (least possible {np.median(away.min(-1)):.2f} m)"
        )
    return said


def true_map(scene: Scene, space: FreeSpace, rooms: Rooms, config: MapConfig, data: DataConfig) -> TopologicalMap:
    """Build the map of perfect networks for `TrueSight`: free edges have p = 1, others 0; without embeddings."""
    margin_m, points = data.passage_margin_m, data.passage_points
    xy, _ = place_nodes(space, rooms, config, margin_m, points)

    def probability(edges: np.ndarray, _: np.ndarray) -> np.ndarray:
        return space.segment_free(xy[edges[:, 0]], xy[edges[:, 1]], points, margin_m).astype(float)

    about = {"settings": to_dict(config), "made": "from the plan"}
    nothing = np.zeros((len(xy), data.headings, 0))
    return assemble(scene.name, scene.digest, xy, rooms.of(xy), nothing, config.edge_m, probability, about)


def drawn_for(data: DataConfig, supersample: int | None) -> DataConfig:
    """Return a navigator's image settings: as in training, with `supersample` or at most `CPU_SUPERSAMPLE` on a CPU."""
    need_engine(data.engine)
    if supersample is None:
        most = CPU_SUPERSAMPLE if jax.default_backend() == "cpu" else data.supersample
        supersample = min(data.supersample, most)
    return dataclasses.replace(data, supersample=supersample)


class Pictures:
    """Render level images of a scene in chunks."""

    def __init__(self, scene: Scene, data: DataConfig, robot: RobotSpec, progress: Progress):
        self._renderer, self._robot, self._progress = renderer_of(scene, data), robot, progress
        self._done, self.total = 0, 0

    def draw_around(self, xy: np.ndarray, around: np.ndarray, what: str) -> np.ndarray:
        """Render images [N, K, H, W, 3] of places [N, 2] along each of K headings, and add them to the total."""
        self.total += len(xy) * len(around)
        images = self.draw(np.repeat(xy, len(around), 0), np.tile(around, len(xy)), what)
        return images.reshape(len(xy), len(around), *images.shape[1:])

    def draw(self, xy: np.ndarray, heading: np.ndarray, what: str) -> np.ndarray:
        """Render images [N, H, W, 3] u8 of places [N, 2] along headings [N]."""
        drawn = []
        for first in range(0, len(xy), CHUNK):
            rows = slice(first, first + CHUNK)
            level = np.zeros(len(xy[rows]))
            drawn.append(self._renderer.draw(camera_pose(self._robot, xy[rows], heading[rows], level)))
            self._done += len(drawn[-1])
            self._progress(what, self._done, self.total)
        return np.concatenate(drawn)


def edge_scores(graph: TopologicalMap, free: np.ndarray, passable: float) -> dict[str, Any]:
    """Compare a map's edges with the plan, and count the parts that open ones join; see `Built`."""
    open_, parts = graph.p >= passable, graph.open_parts(passable)
    return {
        "edges judged open": f"{int(open_.sum())} of {len(open_)}; free on the plan: {int(free.sum())}",
        "edges judged as on the plan": f"{(open_ == free).mean():.3f}",
        "nodes that open edges join": f"{len(parts[0])} of {len(graph.xy_w)}, in {len(parts)} parts",
    }
