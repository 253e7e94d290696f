"""Define `HomeConfig`: what a furnished home is like besides its seed."""

from __future__ import annotations

import dataclasses
from pathlib import Path
from typing import Any, get_type_hints

from converters.generate.design.config import BuildingConfig, GenerationError
from converters.generate.models.cad import HOME_TRAIN_MODELS
from interactive_nav_common.config import nearest
from interactive_nav_common.records import read_packaged

Range = tuple[float, float]
SHARE_TOLERANCE = 0.02
"""`furniture_share` is met to within this."""
SHELL = read_packaged(Path(__file__).with_name("shell.yaml"), BuildingConfig)
"""Rooms, walls, doorways and scan of a home; it counts no furniture."""
COUNTED = (
    *("n_static", "n_chairs", "n_tables", "n_desks", "n_sofas", "n_bottlenecks", "n_blockers", "bottleneck_gap_m"),
    *("blocker_gap_m", "passage_chairs"),
)
"""Settings of `BuildingConfig` that say how much of what stands where: a home's rooms and shares say it instead."""


ARTEFACTS = ("none", "phone")
"""Of a scan."""


@dataclasses.dataclass(frozen=True)
class HomeConfig:
    """Configure what kind of home to build. Pairs are inclusive ranges."""

    shell: BuildingConfig = SHELL
    """Rooms, walls, doors and the scan of them; its counts of furniture are not looked at."""
    tier: str = "furnished"
    """Key of `TIERS`."""
    furniture_share: float = 0.30
    """Footprint of all furniture, built-in and movable, over the floor inside of the walls; met to within 0.02."""
    clutter_per_10_m2: Range = (1.0, 2.0)
    """Boxes, bags, bins, stools and the like, for each ten square metres of floor, before more is added to meet
    `furniture_share`."""
    must_push_turtlebot: Range | None = (0.0, 0.10)
    """Share of the pairs of places between which a disc of the TurtleBot's radius has no path round the movables
    although there is one with them away; None: any."""
    must_push_fetch: Range | None = (0.0, 0.40)
    """The same for Fetch's."""
    artefacts: str = "none"
    """`none`: the exact structure, finely painted, without what moves; `phone`: a fused scan of everything, with the
    holes, noise and wrong labels that a phone's would have."""

    @property
    def floor_area_m2(self) -> Range:
        """Return the inside area of the home."""
        return self.shell.floor_area_m2

    @property
    def must_push(self) -> dict[str, Range]:
        """Return the wanted range by robot, of those that have one."""
        wanted = {"turtlebot": self.must_push_turtlebot, "fetch": self.must_push_fetch}
        return {robot: limits for robot, limits in wanted.items() if limits is not None}

    def validate(self) -> HomeConfig:
        """Return the configuration, or raise."""
        if self.tier not in TIERS:
            raise GenerationError(f"tier is '{self.tier}': expected one of {', '.join(TIERS)}")
        self.shell.validate()
        if self.artefacts not in ARTEFACTS:
            near = nearest(str(self.artefacts), ARTEFACTS)
            raise GenerationError(f"artefacts is {self.artefacts!r}: expected one of {', '.join(ARTEFACTS)}{near}")
        if not 0.0 <= self.furniture_share <= MOST_SHARE:
            raise GenerationError(
                f"furniture_share is {self.furniture_share}: expected 0 to {MOST_SHARE}, which the fullest homes take"
            )
        low, high = self.clutter_per_10_m2
        if not 0 <= low <= high:
            raise GenerationError(f"clutter_per_10_m2 is {self.clutter_per_10_m2}: expected 0 <= lowest <= highest")
        for robot, (low, high) in self.must_push.items():
            if not 0 <= low <= high <= 1:
                raise GenerationError(f"must_push_{robot} is {(low, high)}: expected 0 <= lowest <= highest <= 1")
        return self


MOST_SHARE = 0.42
"""Largest `furniture_share`: of sixteen homes of four and five rooms 13 take 0.37, 7 take 0.40 and 2 take 0.43."""
TIERS = read_packaged(Path(__file__).with_name("tiers.yaml"), dict[str, dict[str, float | Range]])
"""Tier -> how it departs from the defaults; shares that must be pushed leave some to planners that never push."""


def home_fields() -> dict[str, Any]:
    """Return the type of every setting of a home by name, its shell's included, but for the CAD models."""
    every = get_type_hints(BuildingConfig) | get_type_hints(HomeConfig)
    return {name: hint for name, hint in every.items() if name not in ("shell", "tier", "models", *COUNTED)}


def home_config(tier: str, settings: dict[str, Any], models: tuple[str, ...] = HOME_TRAIN_MODELS) -> HomeConfig:
    """Return a tier's home with some settings changed."""
    if tier not in TIERS:
        raise GenerationError(f"tier is '{tier}': expected one of {', '.join(TIERS)}")
    direct = {f.name for f in dataclasses.fields(HomeConfig)}
    shell = {name: value for name, value in settings.items() if name not in direct}
    chosen = TIERS[tier] | {name: value for name, value in settings.items() if name in direct}
    return HomeConfig(dataclasses.replace(SHELL, models=models, **shell), tier, **chosen).validate()
