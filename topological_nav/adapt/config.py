"""Settings of transfer to another domain: a frozen dataclass checked on construction; docstrings are the help."""

import dataclasses
from typing import Annotated

from interactive_nav_common.config import Count, Seed, Settings, Share
from topological_nav.data.domains import preset


@dataclasses.dataclass(frozen=True)
class AdaptConfig(Settings):
    """How networks are taken to another domain. Batches: the report's."""

    seed: Seed = 0
    """Of weights, order and splits."""
    domain: str = "camera"
    """The camera that target images are seen by: clean, lens, light, noise, blur, or camera, all of them."""
    epochs: Count = 20
    """features: passes over the target images."""
    batch: Count = 50
    """features: images of each domain an update."""
    learning_rate: Annotated[float, (1e-9, 10.0)] = 1e-4
    """features: Adam's, of the extractor."""
    critic_learning_rate: Annotated[float, (1e-9, 10.0)] = 1e-3
    """features: Adam's, of the critic."""
    hidden: Count = 512
    """features: units of each of the critic's two layers."""
    fine_tune: Annotated[int, (2, 10**6)] = 252
    """passages: target images to learn from, at most."""
    test: Annotated[int, (2, 10**6)] = 108
    """passages: target images to test, at most."""
    fine_tune_epochs: Count = 20
    """passages: passes over them."""
    fine_tune_batch: Count = 32
    """passages: images an update."""
    fine_tune_learning_rate: Annotated[float, (1e-9, 10.0)] = 1e-4
    """passages: Adam's."""
    edge_m: Annotated[float, (0.1, 100.0)] = 2.5
    """map: nodes nearer than this are joined, both ways."""
    passable: Share = 0.5
    """map: edges with at least this probability count as open."""

    def __post_init__(self) -> None:
        super().__post_init__()
        preset(self.domain)  # refused where there is none
