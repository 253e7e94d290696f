"""Define what a generated building (`BuildingConfig`) or furnished home (`HomeConfig`) is like besides its seed."""

from __future__ import annotations

import dataclasses
from pathlib import Path
from typing import Annotated, Any, Literal, get_type_hints

from converters.generate.models.cad import HOME_TRAIN_MODELS, LIBRARY, TRAIN_MODELS
from interactive_nav_common.config import Bounds, Natural, NotNegative, Positive, Settings, Share
from interactive_nav_common.errors import ConfigError
from interactive_nav_common.records import read_packaged
from scenes_mjcf.robot_facts import SMALLEST

Range = Annotated[tuple[float, float], Bounds(0)]
Counts = Annotated[tuple[int, int], Bounds(0)]


class GenerationError(ConfigError):
    """Report a building that cannot be generated: what, where, what was expected and what to do."""


@dataclasses.dataclass(frozen=True)
class BuildingConfig(Settings):
    """Configure what to build. Pairs are inclusive ranges from which each seed draws."""

    floor_area_m2: Range = (31.0, 42.0)
    """Inside area of the building, walls between rooms included."""
    n_rooms: Annotated[tuple[int, int], Bounds(1)] = (3, 4)
    """Rooms, a corridor included."""
    corridor_from_rooms: Natural = 6
    """A building of this many rooms or more gets a corridor that joins them."""
    min_room_side_m: Positive = 2.2
    """Shortest side of a room (a corridor is `corridor_width_m` wide)."""
    corridor_width_m: NotNegative = 1.4
    """Clear width of a corridor."""
    wall_height_m: Range = (2.4, 2.6)
    """Height of the walls above the floor."""
    wall_thickness_m: Range = (0.10, 0.15)
    """Thickness of each wall."""
    doorway_width_m: Range = (0.92, 1.04)
    """Clear width of a doorway; one without a leaf may be `archway_extra_m` wider."""
    archway_extra_m: NotNegative = 0.3
    """How much wider a doorway without a leaf may be."""
    loop_probability: Share = 0.25
    """Chance of each further doorway beyond those that make all rooms reachable."""
    corner_doorways: Share = 0.0
    """Share of doorways put right beside a room's corner, where an open leaf can rest along the side wall."""
    n_static: Counts = (1, 2)
    """Unmovable cupboards and counters: part of the static structure."""
    n_windows: Counts = (2, 4)
    """Windows in the outer walls; their glass returns no depth and so leaves holes in the scan."""
    n_chairs: Counts = (3, 5)
    """Chairs, the ones that narrow a passage included."""
    n_tables: Counts = (1, 1)
    """Tables."""
    n_desks: Counts = (1, 1)
    """Desks."""
    n_sofas: Counts = (1, 1)
    """Sofas."""
    n_doors: Counts = (1, 2)
    """Hinged leaves, standing open."""
    door_open_deg: Range = (85.0, 115.0)
    """How far a leaf stands open, where the wall behind it allows; at 60 it would bar half of its doorway."""
    corner_margin_m: NotNegative = 0.12
    """Wall between such a doorway and the corner."""
    leaf_wall_gap_m: NotNegative = 0.08
    """Least room between an open leaf's edge and the wall beside it. The converter takes walls within 0.04 m of
    a leaf's sweep, annotation errors included, for the leaf."""
    leaf_proud_m: NotNegative = 0.0
    """How far before the wall's face the hinges stand: an open leaf that is annotated 1 cm off clears the wall."""
    leaves_at_walls: bool = False
    """Leaves only where a side wall is close behind the hinge, never into a corridor or before another doorway:
    robots that pass seldom catch them. Needs `corner_doorways`."""
    n_bottlenecks: Natural = 1
    """Chairs put so that they narrow the way through a doorway to `bottleneck_gap_m`."""
    bottleneck_gap_m: Range = (0.42, 0.62)
    """Width of the widest passage left beside such a chair."""
    n_blockers: Natural = 0
    """Further chairs that narrow the way through a doorway to `blocker_gap_m`: less than a robot, who must push
    or go round."""
    blocker_gap_m: Range = (0.05, 0.32)
    """Width of the widest passage left beside such a chair."""
    passage_chairs: tuple[str, ...] = ()
    """Names of the chair models that may narrow a doorway; empty: all chairs of `models`. Light ones can be pushed
    by a small robot."""
    robot_radius_m: Positive = SMALLEST.radius_m
    """A disc of this radius reaches every room with the furniture (but for blockers) where it stands."""
    scale_jitter: NotNegative = 0.08
    """Each instance is scaled per axis by up to this fraction."""
    models: tuple[str, ...] = TRAIN_MODELS
    """Names of the CAD models that may be used (see `converters.generate.models.cad`)."""
    floor_height_m: Range = (0.05, 0.25)
    """The floor's height in the scan's frame."""
    voxel_m: Positive = 0.025
    """Grid of the scanner's volume; thin parts come out about as broken as in a real reconstruction."""
    vertex_noise_m: NotNegative = 0.006
    """Standard deviation of the reconstruction noise along the surface normal."""
    label_noise: NotNegative = 0.04
    """Share of labels that are wrong, all of them near a border between classes."""
    annotation_noise_m: NotNegative = 0.01
    """Standard deviation per axis of where an annotator clicked on the scan."""
    faces_per_m2: Positive = 1350.0
    """Triangles of the scan per square metre of floor."""
    texels_per_m: Positive = 64.0
    """Texture resolution."""

    def __post_init__(self) -> None:
        super().__post_init__()
        if self.n_bottlenecks + self.n_blockers > self.n_chairs[0]:
            raise GenerationError(
                f"n_bottlenecks is {self.n_bottlenecks} and n_blockers {self.n_blockers} but n_chairs may be "
                f"{self.n_chairs[0]}: each bottleneck needs a chair; raise n_chairs"
            )
        unknown = sorted({*self.models, *self.passage_chairs} - set(LIBRARY))
        if unknown:
            raise GenerationError(f"unknown CAD models {unknown}: known are {sorted(LIBRARY)}")
        strange = [m for m in self.passage_chairs if m not in self.models or LIBRARY[m].category != "chair"]
        if strange:
            raise GenerationError(f"passage_chairs names {strange}: expected chairs that `models` has")
        for category in ("chair", "table", "desk", "sofa", "door"):
            wanted = getattr(self, f"n_{category}s")[1]
            if wanted and not any(LIBRARY[m].category == category for m in self.models):
                raise GenerationError(
                    f"n_{category}s is up to {wanted} but `models` names no {category}: "
                    f"add one of {sorted(m for m in LIBRARY if LIBRARY[m].category == category)}"
                )


Shares = Annotated[tuple[float, float], Bounds(0, 1)]
SHARE_TOLERANCE = 0.02
"""`furniture_share` is met to within this."""
SHELL = read_packaged(Path(__file__).with_name("shell.yaml"), BuildingConfig)
"""Rooms, walls, doorways and scan of a home; it counts no furniture."""
COUNTED = (
    *("n_static", "n_chairs", "n_tables", "n_desks", "n_sofas", "n_bottlenecks", "n_blockers", "bottleneck_gap_m"),
    *("blocker_gap_m", "passage_chairs"),
)
"""Settings of `BuildingConfig` that say how much of what stands where: a home's rooms and shares say it instead."""


MOST_SHARE = 0.38
"""Largest `furniture_share`: of eight homes of four and five rooms in 60 m2 all take 0.36 and four take 0.38."""


@dataclasses.dataclass(frozen=True)
class HomeConfig(Settings):
    """Configure what kind of home to build. Pairs are inclusive ranges."""

    shell: BuildingConfig = SHELL
    """Rooms, walls, doors and the scan of them; its counts of furniture are not looked at."""
    tier: str = "furnished"
    """Key of `TIERS`."""
    furniture_share: Annotated[float, Bounds(0.0, MOST_SHARE)] = 0.30
    """Footprint of all furniture, built-in and movable, over the floor inside of the walls; met to within 0.02."""
    clutter_per_10_m2: Range = (1.0, 2.0)
    """Boxes, bags, bins, stools and the like, for each ten square metres of floor, before more is added to meet
    `furniture_share`."""
    must_push_turtlebot: Shares | None = (0.0, 0.10)
    """Share of the pairs of places between which a disc of the TurtleBot's radius has no path round the movables
    although there is one with them away; None: any."""
    must_push_fetch: Shares | None = (0.0, 0.40)
    """The same for Fetch's."""
    opening: Literal["kitchen", "all", "none"] = "kitchen"
    """Which built-in furniture has doors and drawers that open; each is one more body that moves."""
    artefacts: Literal["none", "phone"] = "none"
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

    def __post_init__(self) -> None:
        super().__post_init__()
        if self.tier not in TIERS:
            raise GenerationError(f"tier is {self.tier!r}, expected one of {', '.join(TIERS)}")


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
    return HomeConfig(dataclasses.replace(SHELL, models=models, **shell), tier, **chosen)
