"""Define what a batch of navigators remembers, and what happened to it in its last step."""

from __future__ import annotations

import dataclasses
from typing import Any

import jax
import numpy as np

from interactive_nav_common.rows import column

LOCALISE, FACE, SWING, LEAN, DRIVE, ARRIVED, STOPPED, TIMED_OUT = range(8)
PHASES = ("localise", "face", "swing", "lean", "drive", "arrived", "stopped", "timed out")
TURNING, OVER = (LOCALISE, FACE, SWING, LEAN), (ARRIVED, STOPPED, TIMED_OUT)


@dataclasses.dataclass(frozen=True, kw_only=True)
class Events:
    """Hold what happened in a step, [B] bool each; a caller may stop an episode whose run ended."""

    localised: np.ndarray = column(False, bool)
    """Turned about, and `State.node` is new."""
    glanced: np.ndarray = column(False, bool)
    """Saw a neighbour of the last node after a run, and `State.node` is new."""
    lost: np.ndarray = column(False, bool)
    """The map has no way from there."""
    blocked: np.ndarray = column(False, bool)
    """No heading near the edge's is open."""
    run_started: np.ndarray = column(False, bool)
    run_ended: np.ndarray = column(False, bool)
    arrived: np.ndarray = column(False, bool)
    timed_out: np.ndarray = column(False, bool)


@dataclasses.dataclass(frozen=True, kw_only=True)
class State(Events):
    """Hold what a batch of B navigators remembers, and its last step; N nodes, E edges. Every leaf has B rows."""

    phase: np.ndarray = column(LOCALISE, np.int8)
    """i8, one of `PHASES`."""
    goal: np.ndarray
    """i32 node."""
    node: np.ndarray = column(-1, np.int32)
    """i32 node of the last localisation, -1 before the first."""
    edge: np.ndarray = column(-1, np.int32)
    """i32 edge that is followed; -1 where the map has no way, or none is planned yet."""
    began_s: np.ndarray = column(np.nan)
    """When the episode began; NaN before its first step."""
    looks: np.ndarray = column(0, np.int32)
    """i32 images taken in this localisation."""
    evidence: np.ndarray
    """[B, N] what they say: sums, or least, of distances."""
    base_rad: np.ndarray = column(0.0)
    """The edge's angle; in a localisation, the first heading."""
    target_rad: np.ndarray = column(np.nan)
    """Heading to reach."""
    swing: np.ndarray = column(0, np.int32)
    """i32 headings tried since the edge was planned."""
    best_p: np.ndarray = column(-1.0)
    best_rad: np.ndarray = column(0.0)
    """The most open of them, for `NavigatorConfig.clear_m`."""
    penalty: np.ndarray
    """[B, E] added to the edges' weights."""
    driven: np.ndarray = column(-1, np.int32)
    """i32 edge that was driven since the robot last localised, -1: none."""
    times_lost: np.ndarray = column(0, np.int32)
    """i32 times that the map had no way."""
    integral: np.ndarray = column(0.0)
    """PID: integral term, rad/s."""
    error_rad: np.ndarray = column(np.nan)
    """PID: error of the step before; NaN where it starts."""
    clock_s: np.ndarray = column(np.nan)
    """Time of the step before."""
    run: np.ndarray = column(0, np.int32)
    """i32 runs done since the robot last looked about."""
    run_end_s: np.ndarray = column(0.0)
    watch_s: np.ndarray = column(0.0)
    """Next time to look, within a run, whether the edge's head is passed."""
    least: np.ndarray = column(np.inf)
    """Least distance to the head in this run, by `Sight.distances`."""
    acts: np.ndarray = column(0, np.int32)
    """i32 control steps of this run."""
    linear: np.ndarray = column(0.0)
    """m/s, the last command."""
    angular: np.ndarray = column(0.0)
    """rad/s."""
    hidden: Any
    """The local policy's."""

    def take(self, rows: np.ndarray) -> State:
        """Return those rows of the batch."""
        return jax.tree.map(lambda x: np.asarray(x)[rows], self)

    @property
    def over(self) -> np.ndarray:
        """Return which have arrived, stopped or run out of time, [B] bool."""
        return self.phase >= ARRIVED

    def restart_pid(self, rows: np.ndarray) -> None:
        """Start turning to a new target: errors of before say nothing."""
        self.integral[rows], self.error_rad[rows] = 0.0, np.nan

    def put_hidden(self, rows: np.ndarray, new: Any) -> None:
        """Set rows of the local policy's state."""
        for old, value in zip(jax.tree.leaves(self.hidden), jax.tree.leaves(new), strict=True):
            old[rows] = np.asarray(value)


jax.tree_util.register_dataclass(State, [f.name for f in dataclasses.fields(State)], [])
