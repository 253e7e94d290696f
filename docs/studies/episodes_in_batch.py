"""Where the seconds go when many episodes of the topological navigator are one batch.

    python -m docs.studies.episodes_in_batch scenes_mjcf/cedar --maps R/maps episodes=1000 supersample=2

Plays the first episodes of a scene at once, as `topological_nav evaluate` does with batch=episodes, and adds up what
draws, looks, drives and simulates; what XLA compiles stands apart, the longest call shows what Warp compiles. Without
run folders: the package's networks and policy. Settings are those of `evaluate`.
"""

from __future__ import annotations

import argparse
import collections
import dataclasses
import re
import sys
import time
from collections.abc import Callable, Sequence
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import jax

from interactive_nav_common.config import overridden
from interactive_nav_common.rows import markdown
from topological_nav.config import EvaluationConfig
from topological_nav.drives.driving import local_policy
from topological_nav.evaluate.contest import Contest, ContestScene
from topological_nav.evaluate.evaluation import NavigatorPlayer, Played
from topological_nav.learn.training import load_networks
from topological_nav.navigate.navigator import Navigator
from topological_nav.weights.export import packaged_weights

COMPILED = "/jax/core/compile/backend_compile_duration"
"""JAX's event of a program that XLA has compiled; tracing and lowering have others, of which one may hold another."""
REST = "navigator, scores"


@dataclasses.dataclass
class Spent:
    """By one part of the work; times in seconds."""

    calls: int = 0
    seconds: float = 0.0
    """Without the parts that it called."""
    compiling: float = 0.0
    """Of these, by XLA."""
    longest: float = 0.0
    """Of one call, likewise without the parts that it called."""


class Clock:
    """Adds up the seconds of functions that may call each other."""

    def __init__(self) -> None:
        self.parts: dict[str, Spent] = collections.defaultdict(Spent)
        self._open: list[tuple[str, float]] = []
        """Part, and the seconds that other parts have taken within it so far."""
        jax.monitoring.register_event_duration_secs_listener(self._compiled)

    def timed(self, part: str, function: Callable[..., Any]) -> Callable[..., Any]:
        """The function, its seconds added to the part's."""

        def call(*args: Any, **kwargs: Any) -> Any:
            began = time.perf_counter()
            self._open.append((part, 0.0))
            try:
                return function(*args, **kwargs)
            finally:
                took = time.perf_counter() - began
                _, inner = self._open.pop()
                spent = self.parts[part]
                spent.calls, spent.seconds = spent.calls + 1, spent.seconds + took - inner
                spent.longest = max(spent.longest, took - inner)
                if self._open:
                    outer, before = self._open[-1]
                    self._open[-1] = outer, before + took

        return call

    def _compiled(self, event: str, duration_secs: float, **_: Any) -> None:
        if self._open and event == COMPILED:
            self.parts[self._open[-1][0]].compiling += duration_secs


def measure(
    contest: Contest, tell: Callable[[int, float], None] = lambda *_: None
) -> tuple[dict[str, Spent], Played, int, float]:
    """Plays the episodes of the contest's only scene in one batch.

    Args:
        contest: with networks; its contenders and folder are not looked at.
        tell: see `Contender.play`.

    Returns:
        What each part spent, what came of the episodes, images drawn, and seconds in all.

    Raises:
        TopologicalError, SceneError: something cannot be used.
    """
    clock, images = Clock(), 0
    began = time.perf_counter()
    venue = ContestScene(contest.scenes[0], contest, load_networks(contest.localiser, contest.detector))
    made = venue.map_of("dense")
    real = venue.sight(made)
    distances, passage = clock.timed("networks", real.distances), clock.timed("networks", real.passage)
    sight: Any = SimpleNamespace(summed=real.summed, distances=distances, passage=passage)
    policy: Any = local_policy(contest.policy, sight, contest.config, venue.networks or ())
    policy.act = clock.timed("local policy", policy.act)
    for name in ("_reset_to", "_step"):
        setattr(venue.player, name, clock.timed("physics", getattr(venue.player, name)))
    draw = clock.timed("drawing", venue.camera)

    def camera(xy_w, yaw_rad, qpos):
        nonlocal images
        images += len(xy_w)
        return draw(xy_w, yaw_rad, qpos)

    journeys = clock.timed("episodes drawn", lambda: venue.episodes)()
    navigator = Navigator(made, sight, policy, contest.config)
    player = NavigatorPlayer(venue.player, contest.config, navigator, camera)
    played = clock.timed(REST, player.play)(journeys, tell)
    return dict(clock.parts), played, images, time.perf_counter() - began


def table(parts: dict[str, Spent]) -> str:
    """Markdown, the dearest part first."""
    lines = [
        (name, f"{spent.calls:,}", f"{spent.seconds:.1f}", f"{spent.compiling:.1f}", f"{spent.longest:.2f}")
        for name, spent in sorted(parts.items(), key=lambda item: -item[1].seconds)
    ]
    return markdown(("Part", "Calls", "Seconds", "XLA compiling", "Longest call"), lines)


def main(argv: Sequence[str] | None = None) -> None:
    """Prints the table, and what was played."""
    words = list(sys.argv[1:] if argv is None else argv)
    settings = [word for word in words if re.match(r"\w+=", word)]
    weights = packaged_weights()
    made = argparse.ArgumentParser(description=(__doc__ or "").splitlines()[0])
    made.add_argument("scene", type=Path, metavar="SCENE", help="scene folder")
    made.add_argument("--maps", type=Path, required=True, metavar="DIR", help="of SCENE.npz, as `map` writes it")
    made.add_argument("--localiser", type=Path, default=weights / "rooms", metavar="RUN")
    made.add_argument("--detector", type=Path, default=weights / "passages", metavar="RUN")
    made.add_argument("--policy", default=str(weights / "policy"), metavar="RUN", help="or passage")
    arguments = made.parse_args([word for word in words if word not in settings])
    contest = Contest(
        scenes=(arguments.scene,),
        contenders=("dense",),
        out=Path(),
        config=overridden(EvaluationConfig(), settings),
        maps=arguments.maps,
        localiser=arguments.localiser,
        detector=arguments.detector,
        policy=arguments.policy,
    )
    told = time.monotonic()

    def tell(over: int, simulated_s: float) -> None:
        nonlocal told
        if time.monotonic() - told > 5.0:
            told = time.monotonic()
            most = contest.config.limit_s
            print(f"{over} over, simulated {simulated_s:.0f} s of {most:.0f} s at most", file=sys.stderr, flush=True)

    parts, played, images, seconds = measure(contest, tell)
    print(table(parts), end="")
    simulated_h, device = played.duration_s.sum() / 3600, jax.devices()[0].device_kind
    print(
        f"{len(played.success)} episodes, {simulated_h:.2f} h simulated in {seconds:.0f} s on {device}; "
        f"{images:,} images; success {played.success.mean():.3f}"
    )


if __name__ == "__main__":
    main()
