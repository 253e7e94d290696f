"""Episodes of a scene and a contender in, one row an episode out: success, SPL, contacts, duration.

Contenders: the navigator on a map, dense or thinned, with trained networks or with the truth in their place; an expert
that has the map and knows where everything stands; a learned policy that is told the goal's position. All play the
same episodes under the same rule: an episode is won when a run of 5 s ends within 1.5 m of the goal, or when the
navigator finds itself at the goal's node; it is lost after 30 minutes of simulated time.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Callable
from typing import Any, Protocol

import jax
import jax.numpy as jnp
import numpy as np
from scipy.ndimage import label as components

from interactive_nav.metrics import path_efficiency
from interactive_nav.scenes.scene import Scene
from topological_nav.config import EvaluationConfig
from topological_nav.errors import SpaceError
from topological_nav.navigate.navigator import Events, Navigator, State
from topological_nav.scenes.rooms import Rooms
from topological_nav.scenes.simulation import Camera, Seen, Simulator
from topological_nav.scenes.space import FreeSpace
from train.scoring.planners import PathGrid, Planner

CONNECTED_M = 0.25
"""Start and goal are joined by a way with this clearance: half of TTbot's width and the grid's rounding."""
EXPERT_WEIGHT = 1.0
"""Of path against effort: objects are pushed only where no way is free."""
LEAST, MOST, PER_M2 = 25, 60, 0.5
"""Episodes a scene."""
TRACK_S = 0.5
"""Between two points of a recorded path."""
SHRINK = 4
"""On the CPU, once only one episode in so many still runs, those go on in a batch of their own."""


@dataclasses.dataclass(frozen=True)
class Journeys:
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

    def take(self, rows: Any) -> Journeys:
        """Some of them."""
        return Journeys(**{f.name: getattr(self, f.name)[rows] for f in dataclasses.fields(self)})

    def __len__(self) -> int:
        return len(self.yaw_rad)


@dataclasses.dataclass(frozen=True)
class Played:
    """What came of n episodes."""

    success: np.ndarray
    """[n] bool."""
    arrived: np.ndarray
    """[n] bool: ended because the navigator found itself at the goal's node."""
    goal_m: np.ndarray
    """[n] distance to the goal at the end."""
    path_m: np.ndarray
    """[n]."""
    duration_s: np.ndarray
    """[n]."""
    runs: np.ndarray
    """[n] i32 runs driven."""
    contact_runs: np.ndarray
    """[n] i32 of them with a contact."""
    contact_s: np.ndarray
    """[n] seconds of control steps with a contact, turning included."""
    wall_s: np.ndarray
    """[n] of them with a wall."""
    localisations: np.ndarray
    blocked: np.ndarray
    lost: np.ndarray
    """[n] i32 such events of the navigator; 0 for others."""
    broken: np.ndarray
    """[n] bool: the physics gave up, which ends an episode as failed."""
    track_w: list[np.ndarray]
    """n paths [t, 2], m, a point every `TRACK_S`."""


Tell = Callable[[int, float], None]
"""Told (episodes over, simulated seconds); may raise to stop."""


def count_of(scene: Scene, config: EvaluationConfig) -> int:
    """Episodes of a scene: as set, or by its floor's area."""
    return config.episodes or int(np.clip(round(PER_M2 * scene.manifest.floor_area_m2), LEAST, MOST))


def draw_journeys(digest: str, space: FreeSpace, rooms: Rooms, count: int, config: EvaluationConfig) -> Journeys:
    """Draws episodes: number i depends on seed and scene alone, however many there are.

    Start and goal are uniform over free places, in different rooms, farther apart than `min_goal_m`, joined by a way.

    Raises:
        SpaceError: the scene has no such pair.
    """
    parts, _ = components(space.clearance_m >= CONNECTED_M)  # type: ignore[misc]
    places = space.centres(config.clearance_m)
    if len(places) < 2:
        raise SpaceError(f"{len(places)} places are {config.clearance_m} m from obstacles; ask for less clearance_m")
    cell = _cells(space, places)
    part, room = parts[cell[:, 0], cell[:, 1]], rooms.of(places)
    rng = np.random.default_rng([config.seed, 17, int(digest[:8], 16)])
    pairs, yaws, tries = [], [], 0
    while len(pairs) < count:
        a, b = rng.integers(len(places), size=2)
        yaw = rng.uniform(-np.pi, np.pi)
        tries += 1
        if tries > 2000 * (len(pairs) + 1):
            raise SpaceError(
                f"after {tries:,} draws {len(pairs)} of {count} episodes have start and goal in different rooms, more "
                f"than {config.min_goal_m} m apart and joined by a way; ask for less clearance_m or min_goal_m"
            )
        if part[a] != part[b] or not part[a] or room[a] == room[b]:
            continue
        if np.linalg.norm(places[a] - places[b]) > config.min_goal_m:
            pairs.append((a, b))
            yaws.append(yaw)
    a, b = np.array(pairs).T
    ways = _Ways(space)
    shortest = np.array([ways.shortest_m(places[i], places[j]) for i, j in pairs])
    return Journeys(np.arange(count), places[a], np.array(yaws), places[b], room[a], room[b], shortest)


def _cells(space: FreeSpace, xy: np.ndarray) -> np.ndarray:
    """[n, 2] row and column."""
    return np.floor((np.asarray(xy) - space.origin_w) / space.resolution_m).astype(int)[..., ::-1]


class _Ways:
    """Shortest ways over a grid of 16 directions: at most 2.7 % too long."""

    def __init__(self, space: FreeSpace):
        self._space, free = space, space.clearance_m >= CONNECTED_M
        self._grid = PathGrid(free, np.ones(free.shape))

    def shortest_m(self, start: np.ndarray, goal: np.ndarray) -> float:
        """Between two places [2], m."""
        a, b = _cells(self._space, start), _cells(self._space, goal)
        way = self._grid.path((a[0], a[1]), (b[0], b[1]))
        return float(np.linalg.norm(np.diff(way, axis=0), axis=1).sum() * self._space.resolution_m)


class Contender(Protocol):
    """Plays a batch; everything it remembers can be thinned out."""

    def begin(self, journeys: Journeys) -> None:
        """Fresh episodes."""
        ...

    def keep(self, rows: np.ndarray) -> None:
        """Only these episodes go on."""
        ...

    def step(self, state: Any, time_s: float, over: np.ndarray) -> tuple[Any, Marks]:
        """The state after one control step, and what the contender says of the step before it."""
        ...


@dataclasses.dataclass(frozen=True)
class Marks:
    """[B] bool each."""

    run_started: np.ndarray
    run_ended: np.ndarray
    arrived: np.ndarray
    timed_out: np.ndarray
    localised: np.ndarray
    blocked: np.ndarray
    lost: np.ndarray


class NavigatorPlayer:
    """The navigator, seeing through a camera."""

    def __init__(
        self,
        navigator: Navigator,
        simulator: Simulator,
        camera: Camera,
        config: EvaluationConfig,
        watch: Callable[[float, Seen, State, Events], None] = lambda *_: None,
    ):
        """Takes its parts.

        Args:
            navigator: of the scene.
            simulator: of the scene.
            camera: what the navigator's sight understands.
            config: of the evaluation.
            watch: told time, poses, new state and events of every step.
        """
        self._navigator, self._simulator, self._camera, self._config = navigator, simulator, camera, config
        self._watch = watch
        self.state: State | None = None

    def begin(self, journeys: Journeys) -> None:
        """Takes the goals' images, along as many headings as a localisation's."""
        count = self._config.images
        around = 2 * np.pi * np.arange(count) / count
        n = len(journeys)
        images = self._camera(np.repeat(journeys.goal_xy_w, count, 0), np.tile(around, n))
        images = images.reshape(n, count, *images.shape[1:])
        self.state = self._navigator.start(self._navigator.goal_nodes(images, around))
        self._images = images[:, 0].copy()

    def keep(self, rows: np.ndarray) -> None:
        """See `Contender`."""
        assert self.state is not None
        self.state, self._images = self.state.take(rows), self._images[rows]

    def step(self, state: Any, time_s: float, over: np.ndarray) -> tuple[Any, Marks]:
        """See `Contender`."""
        assert self.state is not None
        seen = self._simulator.seen(state)
        mind = self._navigator.stop(self.state, over)
        looks = np.flatnonzero(self._navigator.looks(mind, seen.yaw_rad, time_s))
        if len(looks):  # the others keep an old image, which nobody looks at
            self._images[looks] = self._camera(seen.xy_w[looks], seen.yaw_rad[looks])
        self.state, linear, angular, events = self._navigator.step(mind, self._images, seen.yaw_rad, time_s)
        self._watch(time_s, seen, self.state, events)
        marks = Marks(
            events.run_started,
            events.run_ended,
            events.arrived,
            events.timed_out,
            events.localised,
            events.blocked,
            events.lost,
        )
        return self._simulator.drive(state, linear, angular), marks


Act = Callable[[Any, np.ndarray, np.ndarray, int], Any]
"""State, episode numbers [B], which of them run [B] and control steps done to actions [B, A]."""


class ActionPlayer:
    """Whoever acts on the environment's own state: its runs follow each other without a break."""

    def __init__(self, simulator: Simulator, make_act: Callable[[], Act], config: EvaluationConfig):
        """Takes what acts.

        Args:
            simulator: of the environment.
            make_act: called for every batch of episodes.
            config: of the evaluation.
        """
        self._simulator, self._make_act, self._config = simulator, make_act, config

    def begin(self, journeys: Journeys) -> None:
        """See `Contender`."""
        self._episode, self._act = journeys.number, self._make_act()

    def keep(self, rows: np.ndarray) -> None:
        """See `Contender`."""
        self._episode = self._episode[rows]

    def step(self, state: Any, time_s: float, over: np.ndarray) -> tuple[Any, Marks]:
        """See `Contender`."""
        step = round(time_s / self._simulator.dt_s)
        every = max(1, round(self._config.run_s / self._simulator.dt_s))
        edge = np.full(len(over), step % every == 0)
        none = np.zeros(len(over), bool)
        late = ~over & (time_s >= self._config.limit_s - 1e-3)
        marks = Marks(edge & ~over, edge & ~over & (step > 0), none, late, none, none, none)
        action = self._act(state, self._episode, ~over, step)
        return self._simulator.act(state, action), marks


def expert(simulator: Simulator, config: EvaluationConfig) -> ActionPlayer:
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

    return ActionPlayer(simulator, lambda: act, config)


def play(
    contender: Contender,
    simulator: Simulator,
    journeys: Journeys,
    config: EvaluationConfig,
    tell: Tell = lambda *_: None,
) -> Played:
    """Plays episodes to their ends, in one batch."""
    n = len(journeys)
    whole = {name: np.zeros(n, bool) for name in ("success", "arrived", "broken")}
    numbers = {name: np.zeros(n) for name in ("goal_m", "path_m", "duration_s", "contact_s", "wall_s")}
    counts = {name: np.zeros(n, int) for name in ("runs", "contact_runs", "localisations", "blocked", "lost")}
    tracks: list[list[np.ndarray]] = [[] for _ in range(n)]
    at = np.arange(n)
    """Episode of each row of the batch."""
    over = np.zeros(n, bool)
    in_run, touched = np.zeros(n, bool), np.zeros(n, bool)
    contender.begin(journeys)
    state = simulator.start(journeys.start_xy_w, journeys.yaw_rad, journeys.goal_xy_w, journeys.number, config.seed)
    every, step, dt = max(1, round(TRACK_S / simulator.dt_s)), 0, simulator.dt_s
    seen = simulator.seen(state)
    while not over.all():
        before, time = seen, step * dt
        stepped, marks = contender.step(state, time, over)
        goal_m = np.linalg.norm(before.xy_w - journeys.goal_xy_w[at], axis=-1)
        if step % every == 0:
            for row in np.flatnonzero(~over):
                tracks[at[row]].append(before.xy_w[row])
        # What the contender says is of the moment before its step.
        ended = marks.run_ended & ~over
        counts["runs"][at[ended]] += 1
        counts["contact_runs"][at[ended & touched]] += 1
        in_run = (in_run & ~ended) | marks.run_started
        touched = touched & ~ended & ~marks.run_started
        for name in ("localisations", "blocked", "lost"):
            flag = getattr(marks, "localised" if name == "localisations" else name)
            counts[name][at[flag & ~over]] += 1
        near = ended & (goal_m < config.success_m)
        arrived, broken = marks.arrived & ~over, before.broken & ~over
        ends = near | arrived | broken | (marks.timed_out & ~over)
        rows = np.flatnonzero(ends)
        whole["success"][at[rows]] = (near | arrived)[rows] & ~broken[rows]
        whole["arrived"][at[rows]], whole["broken"][at[rows]] = (arrived & ~near)[rows], broken[rows]
        numbers["goal_m"][at[rows]], numbers["path_m"][at[rows]] = goal_m[rows], before.path_m[rows]
        numbers["duration_s"][at[rows]] = time
        # A run that the end of its episode cuts short counts, as the whole run that it is scored as.
        cut = rows[in_run[rows] & ~ended[rows] & ~marks.run_started[rows]]
        counts["runs"][at[cut]] += 1
        counts["contact_runs"][at[cut[touched[cut]]]] += 1
        for row in rows:
            tracks[at[row]].append(before.xy_w[row])
        over |= ends
        state, step = stepped, step + 1
        seen = simulator.seen(state)
        contact = (seen.movable | seen.wall) & ~over
        numbers["contact_s"][at[contact]] += dt
        numbers["wall_s"][at[seen.wall & ~over]] += dt
        touched |= contact & in_run
        tell(n - int((~over).sum()), time)
        left = np.flatnonzero(~over)
        if simulator.env.backend == "native" and 0 < len(left) <= len(over) // SHRINK:
            state = jax.tree.map(lambda x: x[left], state)  # noqa: B023
            contender.keep(left)
            at, over, in_run, touched = at[left], over[left], in_run[left], touched[left]
            seen = simulator.seen(state)
    return Played(**whole, **numbers, **counts, track_w=[np.array(t) for t in tracks])


def columns(journeys: Journeys, played: Played, config: EvaluationConfig) -> dict[str, np.ndarray]:
    """A row's numbers, an array each; SPL, RC and AADC are means of them (see `scores`)."""
    contact = played.contact_s > 0
    return {
        "success": played.success.astype(np.float64),
        "spl": np.asarray(path_efficiency(played.success, journeys.shortest_m, played.path_m), np.float64),
        "within": (played.goal_m < config.success_m).astype(np.float64),
        "arrived": played.arrived,
        "contact": contact.astype(np.float64),
        "aadc_s": played.contact_runs * config.run_s,
        "contact_s": played.contact_s,
        "wall_s": played.wall_s,
        "duration_s": played.duration_s,
        "path_m": played.path_m,
        "shortest_m": journeys.shortest_m,
        "goal_m": played.goal_m,
        "runs": played.runs,
        "contact_runs": played.contact_runs,
        "localisations": played.localisations,
        "blocked": played.blocked,
        "lost": played.lost,
        "broken": played.broken,
        "start_room": journeys.start_room,
        "goal_room": journeys.goal_room,
        "start_x_w": journeys.start_xy_w[:, 0],
        "start_y_w": journeys.start_xy_w[:, 1],
        "start_yaw_rad": journeys.yaw_rad,
        "goal_x_w": journeys.goal_xy_w[:, 0],
        "goal_y_w": journeys.goal_xy_w[:, 1],
    }
