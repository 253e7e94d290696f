"""Settings and a random stream in, a furnished home out, with what was measured of it."""

import dataclasses

import numpy as np

from converters.generate.design.config import GenerationError
from converters.generate.design.instance import Instance
from converters.generate.design.plan import Plan
from converters.generate.design.space import rooms_joined, static_grid
from converters.generate.homes.config import HomeConfig
from converters.generate.homes.furnish import WIDE_M, Full, furnish_home
from converters.generate.homes.passages import adjust
from converters.generate.homes.rooms import home_plan

MOST_PLANS = 8
"""Plans furnished before giving up."""
MOST_FULL, LARGE_M2 = 2, 150.0
"""Of these, plans into which less fits than asked for: one is enough where it is so large, for each takes its time."""


@dataclasses.dataclass(frozen=True)
class Furnished:
    """A furnished home."""

    plan: Plan
    """Its built-in furniture is in it."""
    uses: tuple[str, ...]
    """Of the plan's rooms: keys of `converters.generate.homes.rooms.USES`."""
    items: tuple[Instance, ...]
    """What can be moved, door leaves first."""
    furniture_share: float
    """Share of the floor inside of the walls that furniture covers, seen from above."""
    must_push_share: dict[str, float]
    """Robot -> share of the pairs of places between which it finds no way round the movables."""


def design_home(cfg: HomeConfig, rng: np.random.Generator) -> Furnished:
    """Draws and furnishes a home, its shares as asked for."""
    cfg.validate()
    refused: GenerationError | None = None
    full = 0
    for _ in range(MOST_PLANS):
        plan, uses = home_plan(cfg.shell, rng)
        try:
            home = furnish_home(plan, uses, cfg, rng)
            shares = adjust(home)
        except GenerationError as error:
            refused = error
            full += isinstance(error, Full)
            if full == (1 if sum(r.area_m2 for r in plan.rooms) > LARGE_M2 else MOST_FULL):
                break
            continue
        standing = home.floor.standing
        plan = dataclasses.replace(plan, built_in=tuple(s.item for s in standing if s.built_in))
        if not rooms_joined(static_grid(plan), plan, WIDE_M - 0.02):
            refused = GenerationError("built-in furniture bars a room: ask for more area or fewer rooms")
            continue
        movable = tuple(s.item for s in standing if not s.built_in)
        return Furnished(plan, tuple(uses), movable, home.floor.share, shares)
    assert refused is not None
    raise refused
