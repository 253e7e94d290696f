"""Draw fixed episodes and play them: a navigator through a camera, an expert with the plan, a policy with the goal."""

import dataclasses
from collections.abc import Callable
from typing import Any, Protocol

import jax
import jax.numpy as jnp
import numpy as np

from interactive_nav.navigation.ways import PathGrid
from interactive_nav.scenes.scene import Scene
from interactive_nav_common.grids import label
from interactive_nav_common.rows import Rows
from topological_nav.config import EvaluationConfig, NavigatorConfig
from topological_nav.errors import SpaceError
from topological_nav.navigate.navigator import Navigator
from topological_nav.navigate.state import Events, State
from topological_nav.scenes.rooms import Rooms
from topological_nav.scenes.simulation import Camera, Seen, Simulator
from topological_nav.scenes.space import FreeSpace
from train.scoring.planners import Planner

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


EXPERT_WEIGHT = 1.0
"""Of path against effort: objects are pushed only where no way is free."""


class Contender(Protocol):
    """Plays a batch; everything it remembers can be thinned out."""

    def begin(self, episodes: DrivenEpisodes) -> None:
        """Fresh episodes."""
        ...

    def keep(self, rows: np.ndarray) -> None:
        """Only these episodes go on."""
        ...

    def step(self, state: Any, time_s: float, over: np.ndarray) -> tuple[Any, Events]:
        """The state after one control step, and what the contender says of the step before it."""
        ...


class NavigatorPlayer:
    """The navigator, seeing through a camera."""

    def __init__(
        self,
        navigator: Navigator,
        simulator: Simulator,
        camera: Camera,
        watch: Callable[[float, Seen, State, Events], None] = lambda *_: None,
    ):
        """Takes its parts; `watch` is told time, poses, new state and events of every step."""
        self._navigator, self._simulator, self._camera = navigator, simulator, camera
        self._watch = watch
        self.state: State | None = None

    def begin(self, episodes: DrivenEpisodes) -> None:
        """Takes the goals' images, of the scene at rest, along as many headings as a localisation's."""
        count = self._navigator.config.images
        around = 2 * np.pi * np.arange(count) / count
        n = len(episodes)
        images = self._camera(np.repeat(episodes.goal_xy_w, count, 0), np.tile(around, n), None)
        images = images.reshape(n, count, *images.shape[1:])
        self.state = self._navigator.start(self._navigator.goal_nodes(images, around))
        self._images = images[:, 0].copy()

    def keep(self, rows: np.ndarray) -> None:
        """See `Contender`."""
        assert self.state is not None
        self.state, self._images = self.state.take(rows), self._images[rows]

    def step(self, state: Any, time_s: float, over: np.ndarray) -> tuple[Any, Events]:
        """See `Contender`."""
        assert self.state is not None
        seen = self._simulator.seen(state)
        mind = self._navigator.stop(self.state, over)
        looks = np.flatnonzero(self._navigator.looks(mind, seen.yaw_rad, time_s))
        if len(looks):  # the others keep an old image, which nobody looks at
            self._images[looks] = self._camera(seen.xy_w[looks], seen.yaw_rad[looks], seen.qpos[looks])
        self.state, linear, angular, events = self._navigator.step(mind, self._images, seen.yaw_rad, time_s)
        self._watch(time_s, seen, self.state, events)
        return self._simulator.drive(state, linear, angular), events


Act = Callable[[Any, np.ndarray, np.ndarray, int], Any]
"""State, episode numbers [B], which of them run [B] and control steps done to actions [B, A]."""


class ActionPlayer:
    """Whoever acts on the environment's own state: its runs follow each other without a break."""

    def __init__(self, simulator: Simulator, make_act: Callable[[], Act], config: NavigatorConfig):
        """Takes what acts.

        Args:
            config: of the navigator: runs and time of episodes are everybody's.
        """
        self._simulator, self._make_act, self._config = simulator, make_act, config

    def begin(self, episodes: DrivenEpisodes) -> None:
        """See `Contender`."""
        self._episode, self._act = episodes.number, self._make_act()

    def keep(self, rows: np.ndarray) -> None:
        """See `Contender`."""
        self._episode = self._episode[rows]

    def step(self, state: Any, time_s: float, over: np.ndarray) -> tuple[Any, Events]:
        """See `Contender`."""
        step = round(time_s / self._simulator.dt_s)
        every = max(1, round(self._config.run_s / self._simulator.dt_s))
        edge = np.full(len(over), step % every == 0)
        none = np.zeros(len(over), bool)
        events = Events(
            **dict.fromkeys(("localised", "glanced", "lost", "blocked", "arrived"), none),
            run_started=edge & ~over,
            run_ended=edge & ~over & (step > 0),
            timed_out=~over & (time_s >= self._config.limit_s - 1e-3),
        )
        action = self._act(state, self._episode, ~over, step)
        return self._simulator.act(state, action), events


def expert(simulator: Simulator, config: NavigatorConfig) -> ActionPlayer:
    """The planner of `train.scoring.planners` that has the map and all poses: it goes round everything where it can.

    Where its grid leaves no way between an object and a wall, it takes the one through the least of objects: episodes
    are joined by ways 0.25 m from everything, which is nearer than it goes on its own account.
    """
    return ActionPlayer(simulator, lambda: Planner(simulator.env, EXPERT_WEIGHT).act, config)


def learned(simulator: Simulator, policy: Any, config: EvaluationConfig) -> ActionPlayer:
    """A policy of `train`, told the goal's position as in its own observations."""

    @jax.jit
    def chosen(obs: Any, episode: jax.Array, step: jax.Array) -> jax.Array:
        keys = jax.vmap(lambda i: jax.random.fold_in(jax.random.fold_in(jax.random.PRNGKey(config.seed), i), step))
        return jax.vmap(policy)(obs, keys(episode))

    def act(state: Any, episode: np.ndarray, _: np.ndarray, step: int) -> Any:
        return chosen(state.obs, jnp.asarray(episode), jnp.asarray(step))

    return ActionPlayer(simulator, lambda: act, config.navigator)
