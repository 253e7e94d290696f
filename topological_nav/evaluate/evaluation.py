"""Draw the fixed episodes of a scene, and let a contender play them: success, SPL, contacts and duration.

Contenders are the navigator on a dense or thinned map, an expert that knows all poses, and a learned policy that
observes the goal. An episode succeeds if a run of 5 s ends within 1.5 m of the goal or the navigator localises at the
goal's node; it fails after `limit_s`.
"""

import dataclasses
from collections.abc import Callable, Sequence
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from interactive_nav.metrics import path_efficiency
from interactive_nav.navigation.ways import PathGrid
from interactive_nav.scenes.scene import Scene
from interactive_nav.task.rollout import HostPolicy, Player, episode_keys
from interactive_nav.types import EpisodeStart
from interactive_nav_common.errors import ConfigError
from interactive_nav_common.grids import label
from interactive_nav_common.rows import Rows, column, fresh
from topological_nav.config import EvaluationConfig
from topological_nav.gap import Gap
from topological_nav.navigate.navigator import Events, Navigator, State
from topological_nav.scenes.rendering import Camera, Snapshot, episode_starts
from topological_nav.scenes.space import FreeSpace, Rooms

CONNECTED_M = 0.25
"""Clearance of a path that joins start and goal: half of TTbot's width and the grid's rounding."""
LEAST, MOST, PER_M2 = 25, 60, 0.5
"""Bounds and density of the number of episodes in a scene."""
APART_M = 1.0


@dataclasses.dataclass(frozen=True)
class DrivenEpisodes(Rows):
    """Hold fixed episodes of one scene."""

    number: np.ndarray
    """[n] i32, in the scene."""
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
    """[n] length of the shortest way round walls and furniture, for half of the robot's width, over a grid of 16
    directions: at most 2.7 % too long."""
    narrow_xy_w: np.ndarray
    """[n, 2] m: narrowest place of the shortest path, at least `APART_M` from both ends if possible."""


def count_of(scene: Scene, config: EvaluationConfig) -> int:
    """Return a scene's number of episodes, as set or by its floor's area."""
    return config.episodes or int(np.clip(round(PER_M2 * scene.manifest.floor_area_m2), LEAST, MOST))


def draw_episodes(digest: str, space: FreeSpace, rooms: Rooms, count: int, config: EvaluationConfig) -> DrivenEpisodes:
    """Draw episodes; number i depends on seed and scene alone.

    Start and goal are uniform over free places in different rooms, more than `min_goal_m` apart, and joined by a path.
    """
    parts, _ = label(space.clearance_m >= CONNECTED_M)
    places = space.centres(config.clearance_m)
    if len(places) < 2:
        raise ConfigError(f"{len(places)} places are {config.clearance_m} m from obstacles; ask for less clearance_m")
    column, row = space.cells(places).T
    part, room = parts[row, column], rooms.of(places)
    rng = np.random.default_rng([config.seed, 17, int(digest[:8], 16)])
    drawn, tries = [], 0
    while len(drawn) < count:
        a, b = rng.integers(len(places), size=2)
        yaw = rng.uniform(-np.pi, np.pi)
        tries += 1
        if tries > 2000 * (len(drawn) + 1):
            raise ConfigError(
                f"after {tries:,} draws {len(drawn)} of {count} episodes have start and goal in different rooms, more "
                f"than {config.min_goal_m} m apart and joined by a way; ask for less clearance_m or min_goal_m"
            )
        if part[a] != part[b] or not part[a] or room[a] == room[b]:
            continue
        if np.linalg.norm(places[a] - places[b]) > config.min_goal_m:
            drawn.append((a, b, yaw))
    a, b, yaws = map(np.array, zip(*drawn, strict=True))
    grid = PathGrid(space.clearance_m >= CONNECTED_M, np.ones(space.clearance_m.shape))
    ends = zip(space.cells(places[a])[:, ::-1], space.cells(places[b])[:, ::-1], strict=True)
    ways = [grid.path(tuple(start), tuple(goal)) for start, goal in ends]
    along = [np.cumsum([0, *np.linalg.norm(np.diff(way, axis=0), axis=1)]) * space.resolution_m for way in ways]
    shortest = np.array([metres[-1] for metres in along])
    narrow = []
    for way, metres in zip(ways, along, strict=True):
        inner = np.minimum(metres, metres[-1] - metres)
        rows, columns = way[inner >= min(APART_M, inner.max())].T
        least = space.clearance_m[rows, columns].argmin()
        narrow.append((columns[least], rows[least]))
    narrow_xy = (np.array(narrow) + 0.5) * space.resolution_m + space.origin_w
    return DrivenEpisodes(np.arange(count), places[a], yaws, places[b], room[a], room[b], shortest, narrow_xy)


def blocking(starts: EpisodeStart, episodes: DrivenEpisodes, radii_m: Sequence[float]) -> EpisodeStart:
    """Return starts with the widest small object at the narrowest place of the shortest path."""
    widest = int(np.argmax(radii_m))
    xy_w = starts.small_xy_w.at[:, widest].set(jnp.asarray(episodes.narrow_xy_w, jnp.float32))
    return starts.replace(small_xy_w=xy_w, small_placed=starts.small_placed.at[:, widest].set(True))


TRACK_S = 0.5
"""Time between two points of a recorded path."""


@dataclasses.dataclass(frozen=True, kw_only=True)
class Played:
    """Hold the outcome of n episodes; arrays are [n]."""

    success: np.ndarray = column(False, bool)
    arrived: np.ndarray = column(False, bool)
    """The episode ended because the navigator localised at the goal's node."""
    goal_m: np.ndarray = column(0.0)
    """Distance to the goal at the end."""
    path_m: np.ndarray = column(0.0)
    duration_s: np.ndarray = column(0.0)
    runs: np.ndarray = column(0, int)
    """Runs driven; the end of an episode cuts short a run, which counts as whole."""
    contact_runs: np.ndarray = column(0, int)
    """Runs with a contact."""
    contact_s: np.ndarray = column(0.0)
    """Seconds of control steps with a contact, turning included."""
    wall_s: np.ndarray = column(0.0)
    """Of these seconds, with a wall."""
    localisations: np.ndarray = column(0, int)
    blocked: np.ndarray = column(0, int)
    lost: np.ndarray = column(0, int)
    """Number of such events of the navigator; 0 for others."""
    broken: np.ndarray = column(False, bool)
    """The physics gave up, which ends an episode as failed."""
    track_w: list[Any]
    """n paths [t, 2], m, a point every `TRACK_S`."""


class Contender(HostPolicy):
    """Play a batch of episodes by the common rule, and record what their scores need."""

    observes = False

    def __init__(self, player: Player, config: EvaluationConfig):
        self.player, self.config = player, config
        self._strew = jax.jit(jax.vmap(player.env.strew))

    def begin(self, episodes: DrivenEpisodes) -> None:
        """Start a batch of episodes."""

    def keep(self, rows: np.ndarray) -> None:
        """Keep only these rows of the batch."""

    def step(self, state: Any, now: Snapshot, running: np.ndarray, step: int) -> tuple[Any, Events]:
        """Return the actions [B, A] of one control step, and the events before it."""
        raise NotImplementedError

    def look(self, state: Any) -> Snapshot:
        return Snapshot.of(state)

    def act(self, state: Any, episode: np.ndarray, running: np.ndarray, step: int) -> tuple[Any, np.ndarray]:
        self._rows = number = np.minimum(episode, len(self._episodes) - 1)  # a batch may be padded
        if step == 0:
            for name, values in fresh(Played, len(number)).items():
                getattr(self._played, name)[number] = values
            self._runs[:, number] = 0
            for i in number:
                self._played.track_w[i] = []
            self.begin(self._episodes.take(number))
        elif len(episode) < len(self._batch):
            self.keep(np.array([np.flatnonzero(self._batch == one)[0] for one in episode]))
        self._batch, now = episode, self.look(state)
        actions, events = self.step(state, now, running, step)
        return actions, self._note(number, now, events, running, step)

    def _note(self, number: np.ndarray, now: Snapshot, events: Events, running: np.ndarray, step: int) -> np.ndarray:
        """Add the moment before a step to the outcomes of running episodes; return which episodes end, [B] bool."""
        dt_s, played, rows = self.player.env.dt, self._played, number[running]
        goal_m = np.linalg.norm(now.xy_w - self._episodes.goal_xy_w[number], axis=-1)
        near = events.run_ended & (goal_m < self.config.success_m)
        last = {"success": (near | events.arrived) & ~now.broken, "arrived": events.arrived & ~near, "goal_m": goal_m}
        last |= {"path_m": now.path_m.astype(np.float32), "broken": now.broken}
        last |= {"duration_s": np.full(len(number), step * dt_s), "runs": self._runs[0, number]}
        for name, values in last.items():
            getattr(played, name)[rows] = values[running]
        sums = {"localisations": events.localised, "blocked": events.blocked, "lost": events.lost}
        if step:  # what the step before touched
            contact, (started, ended, counted) = now.movable | now.wall, self._runs[:, number]
            new = running & contact & (started > ended) & (counted < started)
            self._runs[2, number[new]] = started[new]
            sums |= {"contact_s": dt_s * contact, "wall_s": dt_s * now.wall, "contact_runs": new}
        for name, values in sums.items():
            getattr(played, name)[rows] += values[running]
        self._runs[:2, rows] += np.stack([events.run_started, events.run_ended])[:, running]
        self._last_w[rows] = now.xy_w[running]
        if step % max(1, round(TRACK_S / dt_s)) == 0:
            for i in rows:
                played.track_w[i].append(self._last_w[i].copy())
        return near | events.arrived | now.broken | events.timed_out

    def play(self, episodes: DrivenEpisodes, on_progress: Callable[[int, float], None] = lambda *_: None) -> Played:
        """Play episodes to their ends in one batch; noise and small objects depend on episode numbers and the seed.

        `on_progress` gets the numbers of finished episodes and of simulated seconds; it may raise to stop.
        """
        env, keys = self.player.env, episode_keys(self.config.seed, episodes.number)
        begin = episodes.start_xy_w, episodes.yaw_rad, episodes.goal_xy_w
        starts = episode_starts(*begin, len(env.world.small_objects))
        if self.config.objects:
            starts = self._strew(keys, starts)
        if self.config.blocked:
            starts = blocking(starts, episodes, [one.radius_m for one in env.world.small_objects])
        n, self._episodes = len(episodes), episodes
        self._played = Played(track_w=[[] for _ in range(n)], **fresh(Played, n))
        self._runs, self._last_w = np.zeros((3, n), int), np.zeros((n, 2), np.float32)
        """Runs started, ended, and the last one with a contact; places."""

        def report(over: int, step: int) -> None:
            on_progress(over, step * env.dt)

        self.player.rollout(self, keys, starts, fewest=2, on_progress=report)
        ends = zip(self._played.track_w, self._last_w, strict=True)
        tracks = [np.array([*track, last], float) for track, last in ends]
        return dataclasses.replace(self._played, track_w=tracks)


class NavigatorPlayer(Contender):
    """Play with the navigator through a camera."""

    state: State
    """Of the batch, once it has begun."""

    def __init__(
        self,
        player: Player,
        config: EvaluationConfig,
        navigator: Navigator,
        camera: Camera,
        watch: Callable[[float, Snapshot, State], None] = lambda *_: None,
    ):
        """Store the parts; `watch` is called with time, poses and new state of every step."""
        super().__init__(player, config)
        self._navigator, self._camera, self._watch = navigator, camera, watch

    def begin(self, episodes: DrivenEpisodes) -> None:
        """Render the goals' images of the scene at rest; see `NavigatorConfig.goal_images`."""
        config, n = self._navigator.config, len(episodes)
        count = config.goal_images or config.images
        around = np.tile(2 * np.pi * np.arange(count) / count, (n, 1))
        if config.goal_images:
            drawn = (np.random.default_rng([self.config.seed, 9, number]) for number in episodes.number)
            around += np.array([rng.uniform(0, 2 * np.pi) for rng in drawn])[:, None]
        images = self._camera(np.repeat(episodes.goal_xy_w, count, 0), around.ravel(), None)
        self.goal_images = images = images.reshape(n, count, *images.shape[1:])
        self.state = self._navigator.start(self._navigator.goal_nodes(images, around))
        self._images = images[:, 0].copy()
        half_m = self.player.env.robot.body_width_m / 2
        self._gap = Gap(self.config, self.config.seed, episodes.number, half_m)

    def keep(self, rows: np.ndarray) -> None:
        self.state, self._images = self.state.take(rows), self._images[rows]
        self._shot = tuple(part[rows] for part in self._shot)
        self._gap.keep(rows)

    def step(self, state: Any, now: Snapshot, running: np.ndarray, step: int) -> tuple[Any, Events]:
        time_s, robot = step * self.player.env.dt, self.player.env.robot
        heading = self._gap.heading(now.yaw_rad, time_s)
        if step % self.config.image_steps == 0:
            self._shot = now.xy_w, now.yaw_rad, now.qpos
        mind = self._navigator.stop(self.state, ~running)
        looks = np.flatnonzero(self._navigator.looks(mind, heading, time_s))
        if len(looks):  # the others keep an old image, which nobody looks at
            self._images[looks] = self._camera(*(part[looks] for part in self._shot))
        self.state = self._navigator.step(mind, self._images, heading, time_s)
        self._watch(time_s, now, self.state)
        executed = self._gap.executed(self.state.linear, self.state.angular, step)
        return np.asarray(robot.drive(*executed, np), np.float32), self.state


Act = Callable[[Any, np.ndarray, np.ndarray, int], Any]
"""(state, episode numbers [B], running [B], control steps done) -> actions [B, A]."""


class ActionPlayer(Contender):
    """Play with a policy that acts on the environment's state, with runs one after the other."""

    def __init__(self, player: Player, config: EvaluationConfig, make_act: Callable[[], Act], observes: bool = False):
        super().__init__(player, config)
        self._make_act, self.observes = make_act, observes

    def begin(self, episodes: DrivenEpisodes) -> None:
        self._act = self._make_act()

    def step(self, state: Any, now: Snapshot, running: np.ndarray, step: int) -> tuple[Any, Events]:
        config, dt_s = self.config, self.player.env.dt
        edge = running & (step % max(1, round(config.run_s / dt_s)) == 0)
        late = running & (step * dt_s >= config.limit_s - 1e-3)
        events = {"run_started": edge, "run_ended": edge & (step > 0), "timed_out": late}
        events = Events(**fresh(Events, len(running)) | events)
        return self._act(state, self._episodes.number[self._rows], running, step), events


def learned(player: Player, config: EvaluationConfig, policy: Any) -> ActionPlayer:
    """Return a player for a policy of `train`, which observes the goal's position."""

    @jax.jit
    def chosen(obs: Any, episode: jax.Array, step: jax.Array) -> jax.Array:
        keys = jax.vmap(lambda i: jax.random.fold_in(jax.random.fold_in(jax.random.PRNGKey(config.seed), i), step))
        return jax.vmap(policy)(obs, keys(episode))

    def act(state: Any, episode: np.ndarray, _: np.ndarray, step: int) -> Any:
        return chosen(state.obs, jnp.asarray(episode), jnp.asarray(step))

    return ActionPlayer(player, config, lambda: act, observes=True)


def columns(episodes: DrivenEpisodes, played: Played, config: EvaluationConfig) -> dict[str, np.ndarray]:
    """Return the numbers of the rows, an array per column; SPL, RC and AADC are means of them (see `scores`)."""

    kept = ("contact_s", "wall_s", "duration_s", "path_m", "goal_m", "runs", "contact_runs", "localisations", "blocked")
    ends = {"start": episodes.start_xy_w, "goal": episodes.goal_xy_w}
    return {
        "success": played.success.astype(np.float64),
        "spl": np.asarray(path_efficiency(played.success, episodes.shortest_m, played.path_m), np.float64),
        "within": (played.goal_m < config.success_m).astype(np.float64),
        "contact": (played.contact_s > 0).astype(np.float64),
        "aadc_s": played.contact_runs * config.run_s,
        **{name: getattr(played, name) for name in ("arrived", *kept, "lost", "broken")},
        **{name: getattr(episodes, name) for name in ("shortest_m", "start_room", "goal_room")},
        **{f"{end}_{axis}_w": xy_w[:, k] for end, xy_w in ends.items() for k, axis in enumerate("xy")},
        "start_yaw_rad": episodes.yaw_rad,
    }
