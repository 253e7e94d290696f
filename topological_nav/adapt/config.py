"""Settings of transfer to another domain: a frozen dataclass checked on construction; docstrings are the help."""

from __future__ import annotations

import dataclasses

from interactive_nav_common.errors import ConfigError
from topological_nav.data.domains import PRESETS
from topological_nav.settings import require


@dataclasses.dataclass(frozen=True)
class AdaptConfig:
    """How networks are taken to another domain. Batches: the report's."""

    seed: int = 0
    """Of weights, order and splits."""
    domain: str = "camera"
    """The camera that target images are seen by: clean, lens, light, noise, blur, or camera, all of them."""
    epochs: int = 20
    """features: passes over the target images."""
    batch: int = 50
    """features: images of each domain an update."""
    learning_rate: float = 1e-4
    """features: Adam's, of the extractor."""
    critic_learning_rate: float = 1e-3
    """features: Adam's, of the critic."""
    hidden: int = 512
    """features: units of each of the critic's two layers."""
    fine_tune: int = 252
    """passages: target images to learn from, at most."""
    test: int = 108
    """passages: target images to test, at most."""
    fine_tune_epochs: int = 20
    """passages: passes over them."""
    fine_tune_batch: int = 32
    """passages: images an update."""
    fine_tune_learning_rate: float = 1e-4
    """passages: Adam's."""
    edge_m: float = 2.5
    """map: nodes nearer than this are joined, both ways."""
    passable: float = 0.5
    """map: edges with at least this probability count as open."""

    def __post_init__(self) -> None:
        require(self, "seed", 0, 2**32 - 1)
        require(self, "epochs batch hidden fine_tune_epochs fine_tune_batch", 1, 10**6)
        require(self, "fine_tune test", 2, 10**6)
        require(self, "learning_rate critic_learning_rate fine_tune_learning_rate", 1e-9, 10.0)
        require(self, "edge_m", 0.1, 100.0)
        require(self, "passable", 0.0, 1.0)
        if self.domain not in PRESETS:
            raise ConfigError(f"domain is '{self.domain}', expected one of {', '.join(PRESETS)}")
