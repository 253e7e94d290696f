"""Build a scene's topological map by two trained networks: place nodes, draw images, judge edges."""

import contextlib
import dataclasses
import functools
import hashlib
import json
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

import jax
import numpy as np

from interactive_nav.robots import RobotSpec, get_robot
from interactive_nav.scenes.objects import SmallObject
from interactive_nav.scenes.scene import Scene, load_scene
from interactive_nav_common.config import overlay, to_dict
from interactive_nav_common.files import whole_file
from topological_nav.config import DataConfig, MapConfig
from topological_nav.data.dataset import headings
from topological_nav.data.folders import lens_of
from topological_nav.errors import Progress, SpaceError
from topological_nav.learn.networks import nearest_turn
from topological_nav.learn.runs import DESCRIPTION
from topological_nav.learn.training import Networks, Trained, load_networks
from topological_nav.maps.graph import TopologicalMap, assemble, lengths, place_nodes
from topological_nav.maps.sight import NetworkSight, Sight, place_distances
from topological_nav.scenes.rendering import SceneRenderer, camera_pose, need_engine
from topological_nav.scenes.space import FreeSpace, Rooms, free_space, scene_rooms

CHUNK = 252
"""Images drawn between two reports: fourteen calls of the renderer."""
CPU_SUPERSAMPLE = 2
"""Beyond it drawing is what a CPU mostly does, and the networks answer nearly the same (docs/topological.md)."""


@dataclasses.dataclass(frozen=True)
class Built:
    """Hold a map, the space it was built in and its scores."""

    map: TopologicalMap
    space: FreeSpace
    free: np.ndarray
    """[E] bool: whether each edge's way is free on the plan."""
    scores: dict[str, Any]
    """Nodes a room, connectedness, and how the edges compare with the plan."""


def build_map(
    scene_folder: Path,
    localiser_run: Path,
    detector_run: Path,
    config: MapConfig,
    progress: Progress = lambda *_: None,
    parts: Path | None = None,
) -> Built:
    """Build a scene's map.

    Args:
        scene_folder: the scene.
        localiser_run: run folder of a network whose embedding localises.
        detector_run: run folder of a passage detector.
        config: of the map.
        progress: called with what is drawn, images done and images in all; may raise to stop.
        parts: folder that drawn images are kept in, so that a map that was stopped goes on; None: they are not.
    """
    networks = load_networks(localiser_run, detector_run)
    data = drawn_for(networks.camera, config.supersample)
    scene, robot = load_scene(scene_folder), get_robot(data.robot)
    space = free_space(scene, robot.height_m)
    rooms = scene_rooms(scene, space, data)
    xy, lacking = place_nodes(space, rooms, config, *judged_by(networks.detector))
    if not len(xy):
        raise SpaceError(f"{scene.path}: no place is {config.clearance_m} m from obstacles; lower clearance_m")
    around = headings(data)
    pictures = Pictures(scene, data, robot, progress, parts)
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
    """Return the margin (m) and the number of points of the labels that a passage detector learned from."""
    config = overlay(DataConfig(), detector.about["data"], DESCRIPTION)
    return config.passage_margin_m, config.passage_points


def judged_map(
    scene: Scene,
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
    """Build the map of nodes with images [N, K, H, W, 3] u8 around each, and compare its edges with the plan.

    `look` takes edges [E, 2] and headings [E] to the images that edges are judged by; None: the node's nearest.
    """
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
    """Say how well a map localises, by all images of a place and by its first alone."""
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
    """Build the map that perfect networks would: ways that are free on the plan have p = 1, others 0.

    It has no embeddings: only `sight.TrueSight` can localise on it.
    """
    margin_m, points = data.passage_margin_m, data.passage_points
    xy, _ = place_nodes(space, rooms, config, margin_m, points)

    def probability(edges: np.ndarray, _: np.ndarray) -> np.ndarray:
        return space.segment_free(xy[edges[:, 0]], xy[edges[:, 1]], points, margin_m).astype(float)

    about = {"settings": to_dict(config), "made": "from the plan"}
    nothing = np.zeros((len(xy), data.headings, 0))
    return assemble(scene.name, scene.digest, xy, rooms.of(xy), nothing, config.edge_m, probability, about)


def drawn_for(data: DataConfig, supersample: int | None) -> DataConfig:
    """Return how a navigator's images are drawn: as networks learned, but larger by `supersample` before averaging.

    Without `supersample` as they learned, on a CPU at most `CPU_SUPERSAMPLE`.
    """
    need_engine(data.engine)
    if supersample is None:
        most = CPU_SUPERSAMPLE if jax.default_backend() == "cpu" else data.supersample
        supersample = min(data.supersample, most)
    return dataclasses.replace(data, supersample=supersample)


def renderer_of(scene: Scene, data: DataConfig, small: Sequence[SmallObject] = ()) -> SceneRenderer:
    """Return what draws a scene, and small objects in it, as a dataset's images were drawn."""
    return SceneRenderer(scene, lens_of(data, get_robot(data.robot)), data.supersample, data.engine, small)


class Pictures:
    """Draw level images of a scene, a chunk at a time, each kept in a file until they are not needed any more."""

    def __init__(self, scene: Scene, data: DataConfig, robot: RobotSpec, progress: Progress, parts: Path | None = None):
        """Draw nothing yet."""
        self._scene, self._data, self._robot, self._progress, self._parts = scene, data, robot, progress, parts
        self._done, self.total = 0, 0
        self._of = json.dumps([scene.digest, to_dict(data)], sort_keys=True).encode()

    @functools.cached_property
    def _renderer(self) -> SceneRenderer:
        return renderer_of(self._scene, self._data)

    def draw_around(self, xy: np.ndarray, around: np.ndarray, what: str) -> np.ndarray:
        """Draw images [N, K, H, W, 3] from places [N, 2], which count to those to draw, along each of K headings."""
        self.total += len(xy) * len(around)
        images = self.draw(np.repeat(xy, len(around), 0), np.tile(around, len(xy)), what)
        return images.reshape(len(xy), len(around), *images.shape[1:])

    def draw(self, xy: np.ndarray, heading: np.ndarray, what: str) -> np.ndarray:
        """Draw images [N, H, W, 3] u8 from places [N, 2] along headings [N]."""
        drawn = []
        for first in range(0, len(xy), CHUNK):
            rows = slice(first, first + CHUNK)
            drawn.append(self._chunk(xy[rows], heading[rows]))
            self._done += len(drawn[-1])
            self._progress(what, self._done, self.total)
        return np.concatenate(drawn)

    def _chunk(self, xy: np.ndarray, heading: np.ndarray) -> np.ndarray:
        kept = None
        if self._parts is not None:
            poses = np.concatenate([xy, heading[:, None]], 1).astype(float)
            kept = self._parts / f"{hashlib.sha256(self._of + poses.tobytes()).hexdigest()[:16]}.npy"
            if kept.is_file():
                with contextlib.suppress(ValueError, EOFError, OSError):  # a damaged or vanished one is drawn again
                    return np.load(kept)
        images = self._renderer.draw(camera_pose(self._robot, xy, heading, np.zeros(len(xy))))
        if kept is not None:
            with whole_file(kept) as partial, open(partial, "wb") as file:
                np.save(file, images)
        return images


def forget(parts: Path) -> None:
    """Remove the images that `build_map` kept, once the map is written."""
    for path in parts.glob("*.npy"):
        path.unlink(missing_ok=True)  # by another process that built the same map
    with contextlib.suppress(OSError):
        parts.rmdir()


def edge_scores(graph: TopologicalMap, free: np.ndarray, passable: float) -> dict[str, Any]:
    """Say how a map's edges compare with the plan, and what open ones join; see `Built`."""
    open_, parts = graph.p >= passable, graph.open_parts(passable)
    return {
        "edges judged open": f"{int(open_.sum())} of {len(open_)}; free on the plan: {int(free.sum())}",
        "edges judged as on the plan": f"{(open_ == free).mean():.3f}",
        "nodes that open edges join": f"{len(parts[0])} of {len(graph.xy_w)}, in {len(parts)} parts",
    }
