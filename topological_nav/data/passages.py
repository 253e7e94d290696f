"""Sources and targets in, passage labels out: how far is the straight way ahead free?"""

import dataclasses
from collections.abc import Sequence

import numpy as np

from interactive_nav_common.rows import Rows
from topological_nav.config import DataConfig
from topological_nav.scenes.rooms import Rooms
from topological_nav.scenes.space import FreeSpace


@dataclasses.dataclass(frozen=True)
class Passages(Rows):
    """Looks along straight ways; n of them, grouped by source."""

    xy_w: np.ndarray
    """[n, 2] m, sources."""
    heading_rad: np.ndarray
    """[n] towards the targets."""
    free: np.ndarray
    """[n, L] bool labels for `DataConfig.passage_lengths_m`; never true after false."""
    source: np.ndarray
    """[n] i32 index of the source."""
    room: np.ndarray
    """[n] i32 room of the source."""
    test: np.ndarray
    """[n] bool."""


def draw_passages(space: FreeSpace, rooms: Rooms, config: DataConfig, rng: np.random.Generator) -> Passages:
    """Sources of every room, targets on a circle about each, labels from the map.

    As many are free as blocked for `passage_length_m`.

    A room with fewer eligible places than sources gives them all. Surplus passages of the commoner label are left
    out at random, apart for training and testing, so that guessing scores one half in both.
    """
    places = space.centres(config.passage_clearance_m)
    labels = rooms.of(places)
    xy, room, test = [], [], []
    for k in range(rooms.count):
        mine = np.flatnonzero(labels == k)
        picked = rng.choice(mine, min(config.passage_sources, len(mine)), replace=False)
        xy.append(places[picked])
        room.append(np.full(len(picked), k, np.int32))
        test.append(held_out(len(picked), config.test_share, rng))
    sources, room, test = np.concatenate(xy), np.concatenate(room), np.concatenate(test)
    n, each = len(sources), config.passage_targets
    phase = rng.uniform(0, 2 * np.pi, n)
    heading = (phase[:, None] + 2 * np.pi * np.arange(each) / each).ravel() % (2 * np.pi)
    start = np.repeat(sources, each, 0)
    free = free_lengths(space, start, heading, config)
    every = Passages(
        start,
        heading,
        free,
        np.repeat(np.arange(n, dtype=np.int32), each),
        np.repeat(room, each),
        np.repeat(test, each),
    )
    scored = free[:, config.passage_column]
    kept = [balanced(np.flatnonzero(every.test == held), scored, rng) for held in (False, True)]
    return every.take(np.sort(np.concatenate(kept)))


def free_lengths(space: FreeSpace, xy_w: np.ndarray, heading_rad: np.ndarray, config: DataConfig) -> np.ndarray:
    """[n, L] bool: whether the ways from places [n, 2] along headings [n] are free for `passage_lengths_m`.

    Every length has points of its own, of another spacing, and one may hit a corner that the others miss. So
    `passage_length_m` decides: what is free for it is free for less, what is not is not for more, and so on outwards.
    """
    step = np.stack([np.cos(heading_rad), np.sin(heading_rad)], -1)
    points, margin_m, scored = config.passage_points, config.passage_margin_m, config.passage_column
    ways = [space.segment_free(xy_w, xy_w + length * step, points, margin_m) for length in config.passage_lengths_m]
    free = np.stack(ways, -1)
    free[:, : scored + 1] = np.logical_or.accumulate(free[:, scored::-1], 1)[:, ::-1]
    free[:, scored:] = np.logical_and.accumulate(free[:, scored:], 1)
    return free


def logits_at(logits: np.ndarray, lengths_m: Sequence[float], ahead_m: np.ndarray | float) -> np.ndarray:
    """A detector's logits at any length: between two of its own on the line between them, beyond them the nearest.

    Args:
        logits: [n, L].
        lengths_m: [L] ascending.
        ahead_m: [n], or [n, M] for M lengths of each; a number is for all.

    Returns:
        As `ahead_m`; [n] for a number.
    """
    own = np.asarray(lengths_m, float)
    ahead = np.asarray(ahead_m, float)
    ahead = np.broadcast_to(ahead, (len(logits), *ahead.shape[1:]))
    if len(own) == 1:
        return np.broadcast_to(logits.reshape(-1, *[1] * (ahead.ndim - 1)), ahead.shape).astype(float)
    x = np.clip(ahead, own[0], own[-1])
    right = np.clip(np.searchsorted(own, x), 1, len(own) - 1)
    share = (x - own[right - 1]) / (own[right] - own[right - 1])
    rows = np.arange(len(logits)).reshape(-1, *[1] * (ahead.ndim - 1))
    return (1.0 - share) * logits[rows, right - 1] + share * logits[rows, right]


def balanced(rows: np.ndarray, labels: np.ndarray, rng: np.random.Generator) -> np.ndarray:
    """As many of the given rows with a true label as with a false one, the surplus left out at random."""
    yes, no = rows[labels[rows]], rows[~labels[rows]]
    count = min(len(yes), len(no))
    return np.sort(np.concatenate([rng.permutation(part)[:count] for part in (yes, no)]))


def held_out(count: int, share: float, rng: np.random.Generator) -> np.ndarray:
    """[count] bool, true for testing: the share rounded, of two or more at least one and never all."""
    tests = 0 if count < 2 else int(np.clip(round(count * share), 1, count - 1))
    return np.isin(np.arange(count), rng.permutation(count)[:tests])
