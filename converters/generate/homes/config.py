"""Define what a generated home is like besides its seed (`HomeConfig`), and the tiers of homes."""

import dataclasses
from pathlib import Path
from typing import Annotated, Any, Literal, get_type_hints

from converters.generate.models.cad import HOME_TRAIN_MODELS, LIBRARY
from interactive_nav_common.config import Bounds, Natural, NotNegative, Positive, Settings, Share
from interactive_nav_common.errors import ConfigError
from interactive_nav_common.records import read_packaged
from scenes_mjcf.robot_facts import SMALLEST

Range = Annotated[tuple[float, float], Bounds(0)]
Counts = Annotated[tuple[int, int], Bounds(0)]
Shares = Annotated[tuple[float, float], Bounds(0, 1)]
SHARE_TOLERANCE = 0.02
"""`furniture_share` is met to within this."""
MOST_SHARE = 0.38
"""Largest `furniture_share`: of eight homes of four and five rooms in 60 m2 all take 0.36 and four take 0.38."""


class GenerationError(ConfigError):
    """Report a home that cannot be generated: what, where, what was expected and what to do."""


@dataclasses.dataclass(frozen=True)
class HomeConfig(Settings):
    """Configure what kind of home to build. Pairs are inclusive ranges from which each seed draws."""

    tier: str = "furnished"
    """Name of its tier."""
    models: tuple[str, ...] = HOME_TRAIN_MODELS
    """Names of the CAD models that may be used (see `converters.generate.models.cad`)."""
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
    floor_area_m2: Range = (60.0, 110.0)
    """Inside area of the home, walls between rooms included."""
    n_rooms: Annotated[tuple[int, int], Bounds(1)] = (5, 7)
    """Rooms, a corridor included."""
    corridor_from_rooms: Natural = 6
    """A home of this many rooms or more gets a corridor that joins them."""
    min_room_side_m: Positive = 1.5
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
    corner_doorways: Share = 1.0
    """Share of doorways put right beside a room's corner, where an open leaf can rest along the side wall."""
    corner_margin_m: NotNegative = 0.28
    """Wall between such a doorway and the corner."""
    n_windows: Counts = (5, 9)
    """Windows in the outer walls; their glass returns no depth and so leaves holes in a scan."""
    n_doors: Counts = (1, 12)
    """Hinged leaves, standing open."""
    door_open_deg: Range = (85.0, 115.0)
    """How far a leaf stands open, where the wall behind it allows; at 60 it would bar half of its doorway."""
    leaf_wall_gap_m: NotNegative = 0.16
    """Least room between an open leaf's edge and the wall beside it. The converter takes walls within 0.04 m of
    a leaf's sweep, annotation errors included, for the leaf."""
    leaf_proud_m: NotNegative = 0.02
    """How far before the wall's face the hinges stand: an open leaf that is annotated 1 cm off clears the wall."""
    leaves_at_walls: bool = True
    """Leaves only where a side wall is close behind the hinge, never into a corridor or before another doorway:
    robots that pass seldom catch them. Needs `corner_doorways`."""
    robot_radius_m: Positive = SMALLEST.radius_m
    """A disc of this radius reaches every room with the furniture where it stands."""
    scale_jitter: NotNegative = 0.08
    """Each instance is scaled per axis by up to this fraction."""
    floor_height_m: Range = (0.05, 0.25)
    """The floor's height in the scan's frame."""
    voxel_m: Positive = 0.03
    """Grid of the scanner's volume; thin parts come out about as broken as in a real reconstruction."""
    vertex_noise_m: NotNegative = 0.006
    """Standard deviation of the reconstruction noise along the surface normal."""
    label_noise: NotNegative = 0.04
    """Share of labels that are wrong, all of them near a border between classes."""
    annotation_noise_m: NotNegative = 0.01
    """Standard deviation per axis of where an annotator clicked on the scan."""
    faces_per_m2: Positive = 600.0
    """Triangles of a scan per square metre of floor."""
    texels_per_m: Positive = 40.0
    """Texture resolution of a scan."""

    @property
    def must_push(self) -> dict[str, Range]:
        """Return the wanted range by robot, of those that have one."""
        wanted = {"turtlebot": self.must_push_turtlebot, "fetch": self.must_push_fetch}
        return {robot: limits for robot, limits in wanted.items() if limits is not None}

    def __post_init__(self) -> None:
        super().__post_init__()
        unknown = sorted(set(self.models) - set(LIBRARY))
        if unknown:
            raise GenerationError(f"unknown CAD models {unknown}: known are {sorted(LIBRARY)}")
        if self.n_doors[1] and not any(LIBRARY[m].category == "door" for m in self.models):
            raise GenerationError(f"n_doors is up to {self.n_doors[1]} but `models` names no door")


TIERS = read_packaged(Path(__file__).with_name("tiers.yaml"), dict[str, HomeConfig])
"""Tier -> its homes; shares that must be pushed leave some to planners that never push."""
SPARSE = "sparse"
"""The tier where none is named: little furniture, in a scan that takes little time."""


def home_fields() -> dict[str, Any]:
    """Return the type of every setting of a home by name, but for the CAD models."""
    return {name: hint for name, hint in get_type_hints(HomeConfig).items() if name not in ("tier", "models")}


def home_config(tier: str, settings: dict[str, Any], models: tuple[str, ...] = HOME_TRAIN_MODELS) -> HomeConfig:
    """Return a tier's home with some settings changed."""
    if tier not in TIERS:
        raise GenerationError(f"tier is '{tier}': expected one of {', '.join(TIERS)}")
    return dataclasses.replace(TIERS[tier], tier=tier, models=models, **settings)
