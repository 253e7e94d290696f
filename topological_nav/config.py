"""Every setting of datasets, training and maps: frozen dataclasses checked on construction; docstrings are the help."""

from __future__ import annotations

import dataclasses
import math
from pathlib import Path
from typing import Literal

from interactive_nav_common.errors import ConfigError
from topological_nav.settings import require

PITCHES = ("up", "level", "down")
"""Order of a position's images by pitch."""
RUNS = Path("runs/topological")
"""Where commands write and read when they are told no other place."""
PASSAGE_POLICY = "passage"
"""The local policy without weights of its own: straight on while the passage detector agrees, else turn."""


@dataclasses.dataclass(frozen=True)
class CameraConfig:
    """Whose eyes draw, and how their images are stored."""

    seed: int = 0
    """Of everything that is drawn by chance: positions, splits, passages, drives."""
    robot: str = "ttbot"
    """Whose camera draws."""
    engine: Literal["warp", "gl"] = "warp"
    """Who draws: MJX-Warp's ray tracer (CPU or GPU), or MuJoCo's own renderer (needs EGL or OSMesa)."""
    width: int = 128
    """Of a stored image, pixels."""
    height: int = 96
    """Of a stored image, pixels."""
    supersample: int = 5
    """Images are drawn this many times larger along each side and averaged: 5 x 128 x 96 is 640 x 480."""
    fov_deg: float | None = None
    """Vertical field of view; auto: the robot's camera's."""
    quality: int = 90
    """WebP quality of stored images; 100 stores them without loss."""

    def __post_init__(self) -> None:
        require(self, "seed", 0, 2**32 - 1)
        require(self, "width height", 16, 2048)
        require(self, "supersample", 1, 16)
        require(self, "fov_deg", 1.0, 170.0)
        require(self, "quality", 1, 100)


@dataclasses.dataclass(frozen=True)
class DataConfig(CameraConfig):
    """What is drawn of each scene. Defaults: the report's, at a stored size of 128 x 96."""

    room_method: Literal["kmeans", "gmm", "spectral"] = "gmm"
    """How free positions are clustered into rooms."""
    num_rooms: int | None = None
    """Rooms a scene; auto: as recorded for the scene, else chosen by BIC (gmm) or silhouette."""
    positions: int = 100
    """Free positions drawn in a scene for room images."""
    clearance_m: float = 0.2
    """Their least distance from obstacles."""
    max_per_room: int = 10
    """Of them kept in a room."""
    test_share: float = 0.2
    """Share of a room's positions (and of its passages' sources) that are for testing only."""
    headings: int = 18
    """Images around a position, for each pitch; a multiple of 3, because testing takes every third."""
    pitch_deg: float = 20.0
    """How far up and down the camera looks; the third pitch is level."""
    passage_sources: int = 10
    """Sources a room of passage images."""
    passage_targets: int = 10
    """Directions a source, evenly about it from a drawn one on."""
    passage_clearance_m: float = 0.3
    """Least distance of sources from obstacles."""
    passage_length_m: float = 2.0
    """Length of the segment that is navigable or not: passages are balanced on it and detectors scored by it."""
    passage_lengths_m: tuple[float, ...] = (0.5, 1.0, 1.5, 2.0, 2.5)
    """Lengths that passages are labelled for, ascending, `passage_length_m` among them: how far the way is free."""
    passage_points: int = 50
    """Points of the segment looked up on the map, both ends included."""
    passage_margin_m: float = 0.225
    """Distance from obstacles that each point needs: half of TTbot's width; 0: it may touch them."""
    shard: int = 10
    """Sheets of images a file: what an interrupted rendering loses at most."""

    def __post_init__(self) -> None:
        super().__post_init__()
        require(self, "num_rooms max_per_room positions passage_sources passage_targets shard", 1, 10**6)
        require(self, "clearance_m passage_clearance_m passage_margin_m", 0.0, 10.0)
        require(self, "passage_length_m", 0.05, 100.0)
        require(self, "passage_points", 2, 10**4)
        lengths = self.passage_lengths_m
        if not lengths or min(lengths) < 0.05 or list(lengths) != sorted(set(lengths)):
            raise ConfigError(f"passage_lengths_m is {list(lengths)}, expected ascending lengths from 0.05 m on")
        if self.passage_length_m not in lengths:
            raise ConfigError(
                f"passage_length_m is {self.passage_length_m:g}, expected one of passage_lengths_m {list(lengths)}; "
                "add it there"
            )
        require(self, "pitch_deg", 0.0, 80.0)
        if not 0.0 < self.test_share < 1.0:
            raise ConfigError(f"test_share is {self.test_share}, expected between 0 and 1, both excluded")
        if self.headings < 3 or self.headings % 3:
            raise ConfigError(f"headings is {self.headings}, expected a multiple of 3")

    @property
    def passage_column(self) -> int:
        """Which of `passage_lengths_m` is `passage_length_m`."""
        return self.passage_lengths_m.index(self.passage_length_m)

    @property
    def pitches_rad(self) -> tuple[float, float, float]:
        """Upward angles in the order of `PITCHES`."""
        up = math.radians(self.pitch_deg)
        return up, 0.0, -up


@dataclasses.dataclass(frozen=True)
class TrainConfig:
    """A network and how it learns. Defaults: the report's room classifier, from scratch."""

    seed: int = 0
    """The one seed of weights, order and augmentation."""
    network: Literal["resnet18", "alexnet"] = "resnet18"
    """Backbone."""
    width: int = 64
    """Channels of the backbone's first stage; 64 is the original."""
    hidden: int = 512
    """Units of each of the room classifier's two layers."""
    init: str = "scratch"
    """Where the backbone starts: scratch, selfsup (first learns without labels), or a run folder to take it from."""
    pitch: Literal["all", "up", "level", "down"] = "all"
    """Room images to learn from."""
    epochs: int = 15
    """Passes over the training images."""
    batch: int = 20
    """Images an update."""
    learning_rate: float = 1e-4
    """Adam's."""
    label_smoothing: float = 0.1
    """Share of a room label's weight that is spread over all rooms."""
    augment: bool = True
    """Vary brightness, contrast and colour, and shift images by up to a sixteenth, anew in every epoch."""
    selfsup_epochs: int = 30
    """Passes without labels, where init is selfsup."""
    selfsup_batch: int = 128
    """Pairs of images an update of them."""
    selfsup_learning_rate: float = 1e-3
    """Adam's, of them."""

    def __post_init__(self) -> None:
        require(self, "seed", 0, 2**32 - 1)
        require(self, "width hidden epochs batch selfsup_epochs", 1, 10**6)
        require(self, "selfsup_batch", 2, 10**6)
        require(self, "learning_rate selfsup_learning_rate", 1e-9, 10.0)
        require(self, "label_smoothing", 0.0, 0.999)


def room_config() -> TrainConfig:
    """The report's room classifier."""
    return TrainConfig()


def passage_config() -> TrainConfig:
    """The report's passage detector."""
    return TrainConfig(batch=32, epochs=20)


@dataclasses.dataclass(frozen=True)
class MapConfig:
    """Where nodes stand, and which edges join them."""

    clearance_m: float = 0.4
    """Least distance of nodes from obstacles: robots turn about there; TTbot's corners reach 0.33 m."""
    min_per_room: int = 3
    """Nodes a room, at least."""
    spacing_m: float = 0.9
    """No free place of a room is farther than this from one of its nodes."""
    edge_m: float = 2.5
    """Nodes nearer than this are joined, both ways."""
    edge_image: Literal["exact", "nearest"] = "exact"
    """The image that an edge is judged by: drawn along it, or the nearest of the node's own."""
    connect: bool = True
    """Add nodes until every free place that one can drive to is joined by free edges."""
    passable: float = 0.5
    """Edges with at least this probability count as open where connectedness is told."""
    supersample: int | None = None
    """Images are drawn this many times larger along each side and averaged; auto: as the networks' were, on a CPU at
    most 2 (docs/topological.md says what that changes)."""
    check: int = 0
    """Free places, drawn by chance, at which to try how well the finished map localises."""

    def __post_init__(self) -> None:
        require(self, "clearance_m", 0.0, 10.0)
        require(self, "min_per_room", 1, 1000)
        require(self, "supersample", 1, 16)
        require(self, "check", 0, 10**6)
        require(self, "spacing_m edge_m", 0.1, 100.0)
        require(self, "passable", 0.0, 1.0)


@dataclasses.dataclass(frozen=True)
class NavigatorConfig:
    """How the navigator localises, turns and drives. Defaults: the report's where it gives a value."""

    images: int = 18
    """Images that one localisation looks at, evenly about; a divisor of the map's images a node."""
    match: Literal["aligned", "nearest"] = "aligned"
    """An image is compared with the nodes' images of its own heading, and all are summed (aligned); or with all of
    them, and the nearest of all decides (nearest)."""
    passable: float = 0.5
    """The passage detector agrees from this probability on."""
    swing_deg: float = 15.0
    """Step of the swing left and right."""
    swings: int = 4
    """Steps to each side before an edge counts as blocked."""
    ahead_m: float = 2.0
    """Facing an edge, the way must be free for the edge's length less `slack_m`, at most this far: a run leads no
    farther at 0.4 m/s."""
    slack_m: float = 0.3
    """The robot is not exactly at its node; at most half of the edge's length."""
    clear_m: float = 1.0
    """How far the way must be free for the baseline policy to drive on (it takes this to stop and turn) and where the
    map has no way; and of which heading is the most open."""
    tolerance_deg: float = 3.0
    """A heading is reached when it is off by less."""
    runs: int = 12
    """Runs of the local policy between two localisations."""
    run_s: float = 5.0
    """Length of a run."""
    glance: bool = True
    """After every run, tell by the image ahead whether the robot is still at its node or at one joined to it, and plan
    anew from there."""
    watch_s: float = 0.5
    """How often to look, within a run, whether the edge's head is passed (nearest of all, and getting farther), which
    ends the run; 0: never. Needs `glance`."""
    metre_cost: float = 0.3
    """Added to the cost of an edge, -log p, for each of its metres: of ways that are all but surely free the shorter is
    taken; 0: the report's."""
    retry_cost: float = 1.0
    """Added to the cost of an edge each time that it was driven and the robot was then not found nearer to its head."""
    limit_s: float = 1800.0
    """Time after which an episode has failed."""
    kp: float = 2.0
    """Proportional gain of turning, 1/s."""
    ki: float = 0.2
    """Integral gain, 1/s^2."""
    kd: float = 0.05
    """Derivative gain."""
    max_turn_rad_s: float = 1.0
    """Fastest turn on the spot."""

    def __post_init__(self) -> None:
        require(self, "images swings runs", 1, 1000)
        require(self, "passable", 0.0, 1.0)
        require(self, "swing_deg", 1.0, 180.0)
        require(self, "ahead_m clear_m", 0.05, 100.0)
        require(self, "slack_m", 0.0, 100.0)
        require(self, "tolerance_deg", 0.1, 45.0)
        require(self, "run_s limit_s", 0.1, 1e6)
        require(self, "watch_s", 0.0, 1e6)
        require(self, "retry_cost metre_cost", 0.0, 1e6)
        require(self, "kp ki kd", 0.0, 100.0)
        require(self, "max_turn_rad_s", 0.01, 10.0)


@dataclasses.dataclass(frozen=True)
class EvaluationConfig(NavigatorConfig):
    """Episodes, and how they are scored."""

    seed: int = 0
    """Of the episodes."""
    episodes: int | None = None
    """A scene; auto: one for every 2 square metres of floor, 25 to 60."""
    min_goal_m: float = 2.5
    """Start and goal are in different rooms and farther apart than this."""
    success_m: float = 1.5
    """A run that ends nearer to the goal than this has reached it."""
    clearance_m: float = 0.35
    """Least distance of starts and goals from obstacles; TTbot's corners reach 0.33 m."""
    thinned: float = 0.4
    """Share of each room's nodes that the sparse map of the ablation keeps."""
    batch: int | None = None
    """Episodes played at a time; auto: all of a scene on an accelerator, 8 on a CPU."""
    backend: Literal["auto", "warp", "jax", "native"] = "auto"
    """Physics: as in `interactive_nav`."""
    supersample: int | None = None
    """Images are drawn this many times larger along each side and averaged; auto: as the networks' were, on a CPU at
    most 2."""

    def __post_init__(self) -> None:
        super().__post_init__()
        require(self, "seed", 0, 2**32 - 1)
        require(self, "supersample", 1, 16)
        require(self, "episodes batch", 1, 10**6)
        require(self, "min_goal_m success_m clearance_m", 0.0, 1000.0)
        require(self, "thinned", 0.01, 1.0)


@dataclasses.dataclass(frozen=True)
class ExpertConfig:
    """The expert: what it may command, how far it looks ahead, and what it weighs."""

    linear_m_s: float = 0.5
    """Fastest forward; it never reverses."""
    angular_rad_s: float = 0.5
    """Fastest turn, either way."""
    linear_samples: int = 5
    """Forward velocities tried, evenly from 0 to the fastest, each as near as a control period can bring it."""
    angular_samples: int = 11
    """The same, of turning; an odd number has straight ahead."""
    acceleration_m_s2: float = 1.0
    """What can be reached: change of the forward velocity."""
    angular_acceleration_rad_s2: float = 4.0
    """The same, of turning."""
    horizon_s: float = 1.6
    """Velocities are judged by where they would lead in this time."""
    horizon_steps: int = 8
    """Places on the way there that are looked at."""
    margin_m: float = 0.04
    """Least gap between the footprint and any obstacle."""
    caution_m: float = 0.25
    """A gap less than this costs."""
    weigh_progress: float = 1.0
    """Of the way that is left at the horizon, over the longest that can be driven until then."""
    weigh_heading: float = 1.2
    """Of the angle there to the way on, over a half turn."""
    weigh_gap: float = 0.4
    """Of a gap of 0; at `caution_m` it is nothing."""
    lidar_rays: int = 135
    """Beams of the scan."""
    lidar_fov_deg: float = 270.0
    """Angle that they cover."""
    lidar_range_m: float = 4.0
    """What is farther is not seen."""
    radius_m: float = 0.27
    """The planned way keeps its middle this far from obstacles."""
    near_m: float = 0.3
    """Within this much more a metre of it counts for more, up to `near_cost` more."""
    near_cost: float = 3.0
    """Metres added to a metre along the obstacle."""
    reached_m: float = 0.35
    """A node nearer than this is passed."""

    def __post_init__(self) -> None:
        require(self, "linear_m_s angular_rad_s acceleration_m_s2 angular_acceleration_rad_s2", 0.01, 100.0)
        require(self, "linear_samples angular_samples", 2, 101)
        require(self, "horizon_steps lidar_rays", 1, 1000)
        require(self, "horizon_s lidar_range_m", 0.1, 100.0)
        require(self, "lidar_fov_deg", 1.0, 360.0)
        require(self, "margin_m weigh_progress weigh_heading weigh_gap near_cost", 0.0, 100.0)
        require(self, "caution_m radius_m near_m reached_m", 0.001, 10.0)


@dataclasses.dataclass(frozen=True)
class DriveConfig(ExpertConfig, CameraConfig):
    """Drives of the expert along edges of each scene's graph, seen from the robot."""

    backend: Literal["auto", "warp", "jax", "native"] = "auto"
    """Physics: as in `interactive_nav`."""
    batch: int = 256
    """Drives at once: what an interrupted simulation loses at most."""
    drives: int = 400
    """Begun in each scene."""
    legs: int = 3
    """Edges a drive, at most: on from each node by a random edge that turns less than `turn_deg`."""
    turn_deg: float = 30.0
    """Sharpest turn from one edge to the next: nothing but the images tells the policy where to go."""
    edge_m: float = 2.5
    """Longest edge, as in maps."""
    least_edge_m: float = 1.0
    """Shortest edge that a drive begins with."""
    detour: float = 2.0
    """Edges are driven whose planned way, a metre near obstacles counting more, is at most so many times as long."""
    start_off_m: float = 0.3
    """Drives begin up to this far from their node."""
    start_turn_deg: float = 15.0
    """And up to this much turned away from their edge, as a robot is that was turned along it by its compass."""
    start_clear_m: float = 0.36
    """Least distance of the start from obstacles: the robot's corners swing within 0.34 m."""
    leg_s: float = 12.0
    """A drive has failed that takes longer for an edge."""
    test_share: float = 0.1
    """Share of the nodes whose drives are for testing only."""
    shard: int = 10
    """Drives a file of images."""

    def __post_init__(self) -> None:
        CameraConfig.__post_init__(self)
        ExpertConfig.__post_init__(self)
        require(self, "batch drives legs shard", 1, 10**6)
        require(self, "turn_deg start_turn_deg", 0.0, 180.0)
        require(self, "edge_m leg_s", 0.1, 1000.0)
        require(self, "least_edge_m", 0.0, 100.0)
        require(self, "detour", 1.0, 100.0)
        require(self, "start_off_m start_clear_m", 0.0, 10.0)
        if not 0.0 < self.test_share < 1.0:
            raise ConfigError(f"test_share is {self.test_share}, expected between 0 and 1, both excluded")


@dataclasses.dataclass(frozen=True)
class PolicyConfig:
    """The local policy and how it learns. Defaults: the report's."""

    seed: int = 0
    """The one seed of weights, order and thinning."""
    hidden: int = 500
    """Numbers in the memory of each of the two GRU cells."""
    projection: int = 0
    """Features are mapped to so many numbers before the cells, which makes these smaller; 0: they are not."""
    forward_hidden: int = 512
    """Units of each of the forward model's two layers."""
    linear_classes: int = 3
    """Forward velocities, evenly from 0 to the expert's fastest."""
    angular_classes: int = 5
    """Turning velocities, evenly from the fastest right to the fastest left."""
    steps: int = 50
    """Control steps a sequence."""
    overlap_s: float = 4.0
    """Longest overlap of two sequences of a drive."""
    straight_share: float = 0.2
    """A sequence that turns in less than this share of its steps is nearly straight."""
    straight_kept: float = 0.3
    """Share of the nearly straight sequences that is learned from."""
    mirror: bool = True
    """Learn from mirrored drives too."""
    alpha: float = 10.0
    """Weight of the commands' cross-entropies."""
    lam: float = 0.5
    """Weight of forward consistency: lambda."""
    epochs: int = 50
    """Passes over the sequences."""
    alone: float = 0.1
    """Share of them, the first, in which only the forward model learns."""
    batch: int = 50
    """Sequences an update."""
    learning_rate: float = 1e-4
    """Adam's."""

    def __post_init__(self) -> None:
        require(self, "seed", 0, 2**32 - 1)
        require(self, "hidden forward_hidden epochs batch", 1, 10**6)
        require(self, "projection", 0, 10**6)
        require(self, "linear_classes angular_classes steps", 2, 1000)
        require(self, "overlap_s alpha lam", 0.0, 1e6)
        require(self, "straight_share straight_kept alone", 0.0, 1.0)
        require(self, "learning_rate", 1e-9, 10.0)


@dataclasses.dataclass(frozen=True)
class ExportConfig:
    """What an export must keep to."""

    limit_mib: float = 8.0
    """The whole folder is no larger."""
    places: int = 24
    """Places by whose images exported networks are compared with those of the runs."""
    tolerance: float = 0.02
    """Most by which a passage's probability, or an embedding (of length 1.41), may differ."""
    commit: str | None = None
    """Of runs whose versions.json names none."""

    def __post_init__(self) -> None:
        require(self, "limit_mib", 0.001, 1e6)
        require(self, "places", 1, 10**6)
        require(self, "tolerance", 0.0, 10.0)
