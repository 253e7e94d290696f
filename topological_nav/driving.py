"""What drives along an edge of the map: images in, velocities out, ten times a second."""

from __future__ import annotations

from typing import Any, Protocol

import numpy as np


class LocalPolicy(Protocol):
    """Drives by images alone; what it remembers travels in a state that belongs to the caller."""

    def start(self, batch: int) -> Any:
        """Hidden state of `batch` fresh runs."""
        ...

    def act(self, state: Any, images: np.ndarray) -> tuple[Any, np.ndarray, np.ndarray]:
        """images (B, H, W, 3) uint8 level, straight ahead -> new state, linear (B,) m/s, angular (B,) rad/s."""
        ...
