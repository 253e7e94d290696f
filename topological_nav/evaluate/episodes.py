"""A scene's free space in, its fixed episodes out: starts, goals, and the shortest ways between them."""

import dataclasses

import numpy as np

from interactive_nav.navigation.ways import PathGrid
from interactive_nav.scenes.scene import Scene
from interactive_nav_common.grids import label
from interactive_nav_common.rows import Rows
from topological_nav.config import EvaluationConfig
from topological_nav.errors import SpaceError
from topological_nav.scenes.rooms import Rooms
from topological_nav.scenes.space import FreeSpace

CONNECTED_M = 0.25
"""Start and goal are joined by a way with this clearance: half of TTbot's width and the grid's rounding."""
LEAST, MOST, PER_M2 = 25, 60, 0.5
"""Episodes a scene."""


@dataclasses.dataclass(frozen=True)
class DrivenEpisodes(Rows):
    """Fixed episodes of one scene."""

    number: np.ndarray
    """[n] i32, theirs in the scene."""
    start_xy_w: np.ndarray
    """[n, 2] m."""
    yaw_rad: np.ndarray
    """[n] heading at the start."""
    goal_xy_w: np.ndarray
    """[n, 2] m."""
    start_room: np.ndarray
    goal_room: np.ndarray
    """[n] i32."""
    shortest_m: np.ndarray
    """[n] length of the shortest way round walls and furniture, for half of the robot's width."""


def count_of(scene: Scene, config: EvaluationConfig) -> int:
    """Episodes of a scene: as set, or by its floor's area."""
    return config.episodes or int(np.clip(round(PER_M2 * scene.manifest.floor_area_m2), LEAST, MOST))


def draw_episodes(digest: str, space: FreeSpace, rooms: Rooms, count: int, config: EvaluationConfig) -> DrivenEpisodes:
    """Draws episodes: number i depends on seed and scene alone, however many there are.

    Start and goal are uniform over free places, in different rooms, farther apart than `min_goal_m`, joined by a way.
    """
    parts, _ = label(space.clearance_m >= CONNECTED_M)
    places = space.centres(config.clearance_m)
    if len(places) < 2:
        raise SpaceError(f"{len(places)} places are {config.clearance_m} m from obstacles; ask for less clearance_m")
    column, row = space.cells(places).T
    part, room = parts[row, column], rooms.of(places)
    rng = np.random.default_rng([config.seed, 17, int(digest[:8], 16)])
    drawn, tries = [], 0
    while len(drawn) < count:
        a, b = rng.integers(len(places), size=2)
        yaw = rng.uniform(-np.pi, np.pi)
        tries += 1
        if tries > 2000 * (len(drawn) + 1):
            raise SpaceError(
                f"after {tries:,} draws {len(drawn)} of {count} episodes have start and goal in different rooms, more "
                f"than {config.min_goal_m} m apart and joined by a way; ask for less clearance_m or min_goal_m"
            )
        if part[a] != part[b] or not part[a] or room[a] == room[b]:
            continue
        if np.linalg.norm(places[a] - places[b]) > config.min_goal_m:
            drawn.append((a, b, yaw))
    a, b, yaws = map(np.array, zip(*drawn, strict=True))
    shortest = _shortest_m(space, places[a], places[b])
    return DrivenEpisodes(np.arange(count), places[a], yaws, places[b], room[a], room[b], shortest)


def _shortest_m(space: FreeSpace, starts: np.ndarray, goals: np.ndarray) -> np.ndarray:
    """[n] m: shortest ways between places [n, 2] over a grid of 16 directions, at most 2.7 % too long."""
    free = space.clearance_m >= CONNECTED_M
    grid = PathGrid(free, np.ones(free.shape))
    ends = zip(space.cells(starts)[:, ::-1], space.cells(goals)[:, ::-1], strict=True)
    ways = [grid.path(tuple(start), tuple(goal)) for start, goal in ends]
    return np.array([np.linalg.norm(np.diff(way, axis=0), axis=1).sum() for way in ways]) * space.resolution_m
