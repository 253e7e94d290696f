"""Weights of rooms in, the shares in which a rectangle is cut for them out."""

from __future__ import annotations

import dataclasses


@dataclasses.dataclass(frozen=True)
class Parts:
    """How a rectangle is shared among rooms."""

    weights: tuple[float, ...]
    """Area of each room against the others', in the order in which they lie."""
    spread: float = 0.1
    """A cut is up to this share of the side away from where the weights have it."""

    @classmethod
    def even(cls, n: int) -> Parts:
        """n rooms of one size."""
        return cls((1.0,) * n)

    def share(self, n_low: int) -> float:
        """Of the first `n_low` rooms."""
        return sum(self.weights[:n_low]) / sum(self.weights)

    def cut(self, n_low: int) -> tuple[Parts, Parts]:
        """The first `n_low` rooms and the others."""
        return Parts(self.weights[:n_low], self.spread), Parts(self.weights[n_low:], self.spread)
