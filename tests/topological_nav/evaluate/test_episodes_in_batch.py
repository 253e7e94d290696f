"""The benchmark's parts add up to its whole, and compiling is told apart."""

import time
from pathlib import Path

import jax
import jax.numpy as jnp
import numpy as np

from docs.studies.episodes_in_batch import REST, Clock, Spent, measure, table
from tests.topological_nav.conftest import Made
from topological_nav.config import PASSAGE_POLICY, EvaluationConfig
from topological_nav.evaluate.contest import Contest


def test_seconds_are_those_of_the_part_itself(monkeypatch):
    now = [100.0]
    monkeypatch.setattr(time, "perf_counter", lambda: now[0])

    def passes(seconds):
        now[0] += seconds

    clock = Clock()
    inner = clock.timed("inner", passes)
    clock.timed("outer", lambda: (inner(2.0), passes(1.0), inner(3.0)))()
    assert clock.parts == {"inner": Spent(2, 5.0, 0.0, 3.0), "outer": Spent(1, 1.0, 0.0, 1.0)}


def test_compiling_belongs_to_the_part_that_asked_for_it():
    clock = Clock()
    call = clock.timed("compiled", jax.jit(lambda x: jnp.sin(x) * 3.0))
    call(np.zeros(7))
    once = clock.parts["compiled"].compiling
    call(np.zeros(7))
    assert 0.0 < once == clock.parts["compiled"].compiling <= clock.parts["compiled"].seconds
    call(np.zeros(9))
    assert clock.parts["compiled"].compiling > once


def test_a_batch_is_played_and_its_parts_add_up(made: Made):
    config = EvaluationConfig.of(episodes=3, limit_s=12.0, images=2, backend="native", supersample=1)
    contest = Contest(
        scenes=(made.scene,),
        contenders=("dense",),
        out=Path(),
        config=config,
        map_files={"painted": made.map},
        localiser=made.rooms,
        detector=made.passages,
        policy=PASSAGE_POLICY,
    )
    parts, played, images, seconds = measure(contest)
    assert len(played.success) == 3 and (played.duration_s <= 12.0 + 1e-3).all()
    assert set(parts) == {"networks", "local policy", "physics", "drawing", "episodes drawn", REST}
    assert parts["drawing"].calls <= images and parts["local policy"].calls <= images
    steps = round(played.duration_s.max() / 0.1) + 1
    # A start, and every step.
    assert steps <= parts["physics"].calls <= steps + 2
    assert all(part.seconds >= part.longest > 0 for part in parts.values())
    assert sum(part.seconds for part in parts.values()) <= seconds
    lines = table(parts).splitlines()
    assert len(lines) == 2 + len(parts) and lines[0].count("|") == lines[-1].count("|") == 6
