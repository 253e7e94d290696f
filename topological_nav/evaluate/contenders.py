"""Who plays episodes: the navigator through a camera, an expert with the plan, a learned policy told the goal."""

from collections.abc import Callable
from typing import Any, Protocol

import jax
import jax.numpy as jnp
import numpy as np

from topological_nav.config import EvaluationConfig, NavigatorConfig
from topological_nav.evaluate.episodes import DrivenEpisodes
from topological_nav.navigate.navigator import Navigator
from topological_nav.navigate.state import Events, State
from topological_nav.scenes.simulation import Camera, Seen, Simulator
from train.scoring.planners import Planner

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
