"""Sources and targets in, passage labels out: is the straight way ahead free?"""

from __future__ import annotations

import dataclasses

import numpy as np

from topological_nav.config import DataConfig
from topological_nav.rooms import Rooms
from topological_nav.space import FreeSpace


@dataclasses.dataclass(frozen=True)
class Passages:
    """Looks along straight ways; n of them, grouped by source."""

    xy_w: np.ndarray
    """[n, 2] m, sources."""
    heading_rad: np.ndarray
    """[n] towards the targets."""
    free: np.ndarray
    """[n] bool labels."""
    source: np.ndarray
    """[n] i32 index of the source."""
    room: np.ndarray
    """[n] i32 room of the source."""
    test: np.ndarray
    """[n] bool."""

    def __len__(self) -> int:
        return len(self.xy_w)

    def take(self, rows: np.ndarray) -> Passages:
        """The passages at some indices."""
        return Passages(*(getattr(self, f.name)[rows] for f in dataclasses.fields(self)))


def draw_passages(space: FreeSpace, rooms: Rooms, config: DataConfig, rng: np.random.Generator) -> Passages:
    """Sources of every room, targets on a circle about each, labels from the map; as many free as blocked.

    A room with fewer eligible places than sources gives them all. Surplus passages of the commoner label are left
    out at random, apart for training and testing, so that guessing scores one half in both.

    Args:
        space: of the scene.
        rooms: of the scene.
        config: counts, circle, margin and test share.
        rng: draws all of it.
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
    end = start + config.passage_length_m * np.stack([np.cos(heading), np.sin(heading)], -1)
    free = space.segment_free(start, end, config.passage_points, config.passage_margin_m)
    every = Passages(
        start,
        heading,
        free,
        np.repeat(np.arange(n, dtype=np.int32), each),
        np.repeat(room, each),
        np.repeat(test, each),
    )
    kept = [balanced(np.flatnonzero(every.test == held), free, rng) for held in (False, True)]
    return every.take(np.sort(np.concatenate(kept)))


def balanced(rows: np.ndarray, labels: np.ndarray, rng: np.random.Generator) -> np.ndarray:
    """As many of the given rows with a true label as with a false one, the surplus left out at random."""
    yes, no = rows[labels[rows]], rows[~labels[rows]]
    count = min(len(yes), len(no))
    return np.sort(np.concatenate([rng.permutation(part)[:count] for part in (yes, no)]))


def held_out(count: int, share: float, rng: np.random.Generator) -> np.ndarray:
    """[count] bool, true for testing: the share rounded, of two or more at least one and never all."""
    tests = 0 if count < 2 else int(np.clip(round(count * share), 1, count - 1))
    return np.isin(np.arange(count), rng.permutation(count)[:tests])
