"""Drives in, sequences to learn from out: windows of control steps, commands as classes, straight ones thinned."""

import dataclasses

import numpy as np

from interactive_nav_common.rows import Rows
from topological_nav.config import PolicyConfig
from topological_nav.drives.dataset import Drives
from topological_nav.drives.expert import CONTROL_S


@dataclasses.dataclass(frozen=True)
class Sequences(Rows):
    """W windows of T control steps."""

    rows: np.ndarray
    """[W, T + 1] i32 indices of the steps' frames; behind a drive's end its last one."""
    valid: np.ndarray
    """[W, T] bool: the step is of the drive."""
    followed: np.ndarray
    """[W, T] bool: the frame after it is of the drive too."""
    linear: np.ndarray
    """[W, T] i32 class of the commanded velocity."""
    angular: np.ndarray
    """[W, T] i32."""


def class_values(config: PolicyConfig, linear_m_s: float, angular_rad_s: float) -> tuple[np.ndarray, np.ndarray]:
    """The velocity that each class stands for: linear [L] m/s and angular [A] rad/s, in rising order."""
    return (
        np.linspace(0.0, linear_m_s, config.linear_classes),
        np.linspace(-angular_rad_s, angular_rad_s, config.angular_classes),
    )


def classes(values: np.ndarray, of: np.ndarray) -> np.ndarray:
    """i32 index of the nearest of rising values [C]; half way between two, the lower."""
    return np.searchsorted((of[1:] + of[:-1]) / 2, values - 1e-6).astype(np.int32)


def window_starts(steps: int, window: int, overlap: int) -> np.ndarray:
    """Where windows begin in a drive: from its first step on, each sharing at most `overlap` steps with the next.

    A drive that is shorter than a window has one, which its end cuts short; at the end of a longer one, what is left
    over is left out.
    """
    stride = max(window - overlap, 1)
    return np.arange(0, max(steps - window, 0) + 1, stride)


def make_sequences(
    drives: Drives, which: np.ndarray, config: PolicyConfig, values: tuple[np.ndarray, np.ndarray], overlap_s: float
) -> Sequences:
    """All windows of some drives.

    Args:
        which: [k] indices of drives.
    """
    window, overlap = config.steps, int(np.floor(overlap_s / CONTROL_S + 1e-9))
    rows, ends = [], []
    for k in which:
        begin, steps = int(drives.first[k]), int(drives.steps[k])
        for start in window_starts(steps, window, min(overlap, window - 1)):
            rows.append(begin + start + np.arange(window + 1))
            ends.append(begin + steps)
    at, end = np.array(rows, int).reshape(-1, window + 1), np.array(ends, int)[:, None]
    capped = np.minimum(at, end - 1).astype(np.int32)
    asked = drives.command[capped[:, :-1]]
    return Sequences(
        capped, at[:, :-1] < end, at[:, 1:] < end, classes(asked[..., 0], values[0]), classes(asked[..., 1], values[1])
    )


def turning_share(sequences: Sequences, config: PolicyConfig) -> np.ndarray:
    """[W] share of a window's steps whose angular class is not straight ahead."""
    turns = (sequences.angular != config.angular_classes // 2) & sequences.valid
    return turns.sum(1) / np.maximum(sequences.valid.sum(1), 1)


def thinned(sequences: Sequences, config: PolicyConfig) -> Sequences:
    """The windows without some of the nearly straight ones, which stay with probability `straight_kept`."""
    straight = turning_share(sequences, config) < config.straight_share
    rng = np.random.default_rng([config.seed, 7])
    return sequences.take(np.flatnonzero(~straight | (rng.random(len(sequences)) < config.straight_kept)))


def mirrored(sequences: Sequences, frames: int, config: PolicyConfig) -> Sequences:
    """The same windows in a mirror: its frames follow `frames` others, and left is right."""
    return dataclasses.replace(
        sequences, rows=sequences.rows + frames, angular=config.angular_classes - 1 - sequences.angular
    )
