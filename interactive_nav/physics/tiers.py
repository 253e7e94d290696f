"""Sort a batch by what its environments need near them, and step each part in the smallest window that holds it.

A step costs as the degrees of freedom of its model do, and most environments need few. Parts have fixed sizes, since
shapes are static.
"""

from collections.abc import Callable, Mapping, Sequence

import jax
import jax.numpy as jnp
import numpy as np

from interactive_nav.config import NavConfig, WindowTier, parse_window_tiers
from interactive_nav.physics.base import Physics
from interactive_nav.physics.mjx_batch import MjxPhysics
from interactive_nav.scenes.world import World

KINDS: tuple[str, ...] = ("free", "small", "hinge", "walls")
"""Of what a `WindowTier` has room for, in its order."""
AUTO_SHARES = (0.7, 0.2)
"""Of a batch, in measured tiers."""
HEAD_ROOM = 2.0
"""Measured tiers let this many times as many environments need more as were counted."""
LEAST_ENVS = 64
"""In smaller batches all environments have the whole window: launching kernels is what costs there."""


def tier_sizes(count: int, shares: Sequence[float] | np.ndarray) -> tuple[int, ...]:
    """Return the environments in each tier, smallest window first: `count` in all, the last has the rest, one or more.

    `count` is N, at least 1; `shares` are of all tiers but the last.
    """
    ends = [min(round(count * end), count - 1) for end in np.cumsum(shares)]
    return tuple(int(size) for size in np.diff([0, *ends, count]))


def assign(needed: jax.Array, sizes: Sequence[int]) -> tuple[jax.Array, ...]:
    """Return the environments [size] i32 of each tier, in order of what they need, equal ones in the batch's order.

    `needed` is [N] i32, the first tier that holds what the environment needs. Spare places of larger tiers go to those
    that need less; where too many need a large one, the first of them get less than they need. `sizes` are N in all.
    """
    return tuple(jnp.split(jnp.argsort(needed, stable=True), np.cumsum(sizes)[:-1]))


def propose_tiers(counts: Mapping[str, np.ndarray], shares: Sequence[float] = AUTO_SHARES) -> tuple[WindowTier, ...]:
    """Return tiers of these shares that fit the counts: each the least quantile of all kinds alike that suffices.

    `counts` are [P] of each kind of slot, and of walls; `shares` of the batch, of all tiers but the last.
    """
    kinds = np.stack([counts[kind] for kind in KINDS])
    tiers = []
    for share, below in zip(shares, np.cumsum(shares), strict=True):
        least, widths = 1 - (1 - below) / HEAD_ROOM, kinds.max(1)
        for quantile in np.linspace(least, 1, 101):
            widths = np.quantile(kinds, quantile, axis=1, method="higher")
            if (kinds <= widths[:, None]).all(0).mean() >= least:
                break
        tiers.append(WindowTier(share, *map(int, widths)))
    return tuple(tiers)


class TieredPhysics(Physics):
    """Several engines of one backend, each with its window and its share of the batch."""

    def __init__(self, make: Callable[..., MjxPhysics], world: World, config: NavConfig):
        """Build the engines; `make` takes a world, settings and a window."""
        whole = make(world, config)
        self.name, self.nv, self.window = whole.name, whole.nv, whole.window
        self.tells_convergence = whole.tells_convergence
        words = config.windows
        proposed = propose_tiers(whole.window.needs_at_rest) if words is None else parse_window_tiers(words)
        self.shares = tuple(tier.share for tier in proposed)
        wanted = (dict(zip(KINDS, tier[1:], strict=True)) for tier in proposed)
        self.tiers = (*(make(world, config, whole.window.narrower(widths, config)) for widths in wanted), whole)

    def needed(self, counts: Mapping[str, jax.Array]) -> jax.Array:
        """Return [N] i32, the first tier that holds what each environment needs, or the last: `counts` are [N] each."""
        rooms = [tier.window.room for tier in self.tiers[:-1]]
        small = [jnp.stack([counts[kind] > width for kind, width in room.items()]).any(0) for room in rooms]
        return jnp.stack(small).sum(0)

    def step_batch(self, scene, state, command, time_s):
        if scene.shape[0] < LEAST_ENVS:
            return self.tiers[-1].step_batch(scene, state, command, time_s)
        measured = jax.vmap(self.window.measure)(scene, state)
        needed = self.needed(jax.vmap(self.window.needs)(measured))
        places = assign(needed, tier_sizes(scene.shape[0], self.shares))
        whole = (measured, scene, state, command, time_s)
        parts = [
            tier.step_measured(*jax.tree.map(lambda x, rows=rows: x[rows], whole))
            for tier, rows in zip(self.tiers, places, strict=True)
            if len(rows)
        ]
        back = jnp.argsort(jnp.concatenate(places))
        return jax.tree.map(lambda *x: jnp.concatenate(x)[back], *parts)
