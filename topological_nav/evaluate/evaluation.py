"""DrivenEpisodes of a scene and a contender in, one row an episode out: success, SPL, contacts, duration.

Contenders: the navigator on a map, dense or thinned, with trained networks or with the truth in their place; an expert
that has the map and knows where everything stands; a learned policy that is told the goal's position. All play the
same episodes under the same rule: an episode is won when a run of 5 s ends within 1.5 m of the goal, or when the
navigator finds itself at the goal's node; it is lost after 30 minutes of simulated time.
"""

import dataclasses
from collections.abc import Callable

import jax
import numpy as np

from interactive_nav.metrics import path_efficiency
from interactive_nav_common.rows import column, fresh
from topological_nav.config import EvaluationConfig
from topological_nav.evaluate.contenders import Contender, DrivenEpisodes
from topological_nav.navigate.state import Events
from topological_nav.scenes.simulation import Seen, Simulator

TRACK_S = 0.5
"""Between two points of a recorded path."""
SHRINK = 4
"""On the CPU, once only one episode in so many still runs, those go on in a batch of their own."""


@dataclasses.dataclass(frozen=True, kw_only=True)
class Played:
    """What came of n episodes."""

    success: np.ndarray = column(False, bool)
    """[n] bool."""
    arrived: np.ndarray = column(False, bool)
    """[n] bool: ended because the navigator found itself at the goal's node."""
    goal_m: np.ndarray = column(0.0)
    """[n] distance to the goal at the end."""
    path_m: np.ndarray = column(0.0)
    """[n]."""
    duration_s: np.ndarray = column(0.0)
    """[n]."""
    runs: np.ndarray = column(0, int)
    """[n] i32 runs driven."""
    contact_runs: np.ndarray = column(0, int)
    """[n] i32 of them with a contact."""
    contact_s: np.ndarray = column(0.0)
    """[n] seconds of control steps with a contact, turning included."""
    wall_s: np.ndarray = column(0.0)
    """[n] of them with a wall."""
    localisations: np.ndarray = column(0, int)
    blocked: np.ndarray = column(0, int)
    lost: np.ndarray = column(0, int)
    """[n] i32 such events of the navigator; 0 for others."""
    broken: np.ndarray = column(False, bool)
    """[n] bool: the physics gave up, which ends an episode as failed."""
    track_w: list[np.ndarray]
    """n paths [t, 2], m, a point every `TRACK_S`."""


Tell = Callable[[int, float], None]
"""Told (episodes over, simulated seconds); may raise to stop."""


def play(
    contender: Contender,
    simulator: Simulator,
    episodes: DrivenEpisodes,
    config: EvaluationConfig,
    tell: Tell = lambda *_: None,
) -> Played:
    """Plays episodes to their ends, in one batch."""
    tally = _Tally(episodes, config, simulator.dt_s)
    contender.begin(episodes)
    begin = episodes.start_xy_w, episodes.yaw_rad, episodes.goal_xy_w, episodes.number
    state = simulator.start(*begin, config.seed, strewn=config.objects > 0)
    step, seen = 0, simulator.seen(state)
    while not tally.over.all():
        before, time = seen, step * simulator.dt_s
        state, events = contender.step(state, time, tally.over)
        tally.before(before, events, step)
        step, seen = step + 1, simulator.seen(state)
        tally.after(seen)
        left = np.flatnonzero(~tally.over)
        tell(len(episodes) - len(left), time)
        if simulator.env.backend == "native" and 0 < len(left) <= len(tally.over) // SHRINK:
            state = jax.tree.map(lambda x: x[left], state)  # noqa: B023
            contender.keep(left)
            tally.keep(left)
            seen = simulator.seen(state)
    return tally.played()


class _Tally:
    """What has come of the episodes so far; those over may be left out of the batch."""

    def __init__(self, episodes: DrivenEpisodes, config: EvaluationConfig, dt_s: float):
        n = len(episodes)
        self._episodes, self._config, self._dt_s = episodes, config, dt_s
        self._numbers = fresh(Played, n)
        self._tracks: list[list[np.ndarray]] = [[] for _ in range(n)]
        self._at = np.arange(n)
        """Episode of each row of the batch."""
        self.over = np.zeros(n, bool)
        self._in_run, self._touched = np.zeros(n, bool), np.zeros(n, bool)

    def before(self, seen: Seen, events: Events, step: int) -> None:
        """Counts the moment before a step, which is what the contender speaks of."""
        at, going = self._at, ~self.over
        goal_m = np.linalg.norm(seen.xy_w - self._episodes.goal_xy_w[at], axis=-1)
        if step % max(1, round(TRACK_S / self._dt_s)) == 0:
            self._track(np.flatnonzero(going), seen)
        ended = events.run_ended & going
        self._count_runs(ended)
        self._in_run = (self._in_run & ~ended) | events.run_started
        self._touched = self._touched & ~ended & ~events.run_started
        for name, flag in (("localisations", events.localised), ("blocked", events.blocked), ("lost", events.lost)):
            self._numbers[name][at[flag & going]] += 1
        near = ended & (goal_m < self._config.success_m)
        arrived, broken = events.arrived & going, seen.broken & going
        ends = near | arrived | broken | (events.timed_out & going)
        came = {"success": (near | arrived) & ~broken, "arrived": arrived & ~near, "broken": broken}
        came |= {"goal_m": goal_m, "path_m": seen.path_m, "duration_s": np.full(len(at), step * self._dt_s)}
        for name, value in came.items():
            self._numbers[name][at[ends]] = value[ends]
        # A run that the end of its episode cuts short counts, as the whole run that it is scored as.
        self._count_runs(ends & self._in_run & ~ended & ~events.run_started)
        self._track(np.flatnonzero(ends), seen)
        self.over |= ends

    def _count_runs(self, over: np.ndarray) -> None:
        self._numbers["runs"][self._at[over]] += 1
        self._numbers["contact_runs"][self._at[over & self._touched]] += 1

    def _track(self, rows: np.ndarray, seen: Seen) -> None:
        for row in rows:
            self._tracks[self._at[row]].append(seen.xy_w[row])

    def after(self, seen: Seen) -> None:
        """Counts what was touched in a step."""
        contact = (seen.movable | seen.wall) & ~self.over
        self._numbers["contact_s"][self._at[contact]] += self._dt_s
        self._numbers["wall_s"][self._at[seen.wall & ~self.over]] += self._dt_s
        self._touched |= contact & self._in_run

    def keep(self, rows: np.ndarray) -> None:
        """Only these rows of the batch go on."""
        self._at, self.over = self._at[rows], self.over[rows]
        self._in_run, self._touched = self._in_run[rows], self._touched[rows]

    def played(self) -> Played:
        """All of it."""
        return Played(**self._numbers, track_w=[np.array(track) for track in self._tracks])


def columns(episodes: DrivenEpisodes, played: Played, config: EvaluationConfig) -> dict[str, np.ndarray]:
    """A row's numbers, an array each; SPL, RC and AADC are means of them (see `scores`)."""

    def own(*names: str) -> dict[str, np.ndarray]:
        return {name: getattr(played, name) for name in names}

    return {
        "success": played.success.astype(np.float64),
        "spl": np.asarray(path_efficiency(played.success, episodes.shortest_m, played.path_m), np.float64),
        "within": (played.goal_m < config.success_m).astype(np.float64),
        "arrived": played.arrived,
        "contact": (played.contact_s > 0).astype(np.float64),
        "aadc_s": played.contact_runs * config.navigator.run_s,
        **own("contact_s", "wall_s", "duration_s", "path_m"),
        "shortest_m": episodes.shortest_m,
        **own("goal_m", "runs", "contact_runs", "localisations", "blocked", "lost", "broken"),
        "start_room": episodes.start_room,
        "goal_room": episodes.goal_room,
        "start_x_w": episodes.start_xy_w[:, 0],
        "start_y_w": episodes.start_xy_w[:, 1],
        "start_yaw_rad": episodes.yaw_rad,
        "goal_x_w": episodes.goal_xy_w[:, 0],
        "goal_y_w": episodes.goal_xy_w[:, 1],
    }
