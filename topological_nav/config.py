"""Define all settings of datasets, training and maps, checked on construction; docstrings are the help."""

import dataclasses
import math
from pathlib import Path
from typing import Annotated, Literal

from interactive_nav_common.config import Bounds, Count, Natural, Seed, Settings, Share
from interactive_nav_common.errors import ConfigError
from topological_nav.gap import GapConfig

PITCHES = ("up", "level", "down")
"""Order of a position's images by pitch."""
RUNS = Path("runs/topological")
"""Where commands write and read by default."""
DATASET, DRIVES, ADAPTED = RUNS / "data", RUNS / "drives", RUNS / "adapted"
PASSAGE_POLICY = "passage"
"""The local policy without weights: straight on while the passage detector agrees, else turn."""


@dataclasses.dataclass(frozen=True)
class CameraConfig(Settings):
    """Set whose eyes draw, and how their images are stored."""

    seed: Seed = 0
    """Of everything that is drawn by chance: positions, splits, passages, drives."""
    robot: str = "ttbot"
    """Whose camera draws."""
    engine: Literal["warp", "gl"] = "warp"
    """Who draws: MJX-Warp's ray tracer (CPU or GPU), or MuJoCo's renderer (needs EGL or OSMesa)."""
    width: Annotated[int, Bounds(16, 2048)] = 128
    """Of a stored image, pixels."""
    height: Annotated[int, Bounds(16, 2048)] = 96
    """Of a stored image, pixels."""
    supersample: Annotated[int, Bounds(1, 16)] = 5
    """Images are drawn this many times larger along each side and averaged: 5 x 128 x 96 is 640 x 480."""
    fov_deg: Annotated[float | None, Bounds(1.0, 170.0)] = None
    """Vertical field of view; auto: the robot's camera's."""
    quality: Annotated[int, Bounds(1, 100)] = 90
    """WebP quality of stored images; 100 stores them without loss."""


@dataclasses.dataclass(frozen=True)
class DataConfig(CameraConfig):
    """Set what is drawn of each scene; `preset=report` has the report's values."""

    room_method: Literal["kmeans", "gmm", "spectral"] = "gmm"
    """How free positions are clustered into rooms."""
    num_rooms: Annotated[int | None, Bounds(1, 10**6)] = None
    """Rooms a scene; auto: as recorded for the scene, else chosen by BIC (gmm) or silhouette."""
    positions: Count = 100
    """Free positions drawn in a scene for room images."""
    clearance_m: Annotated[float, Bounds(0.0, 10.0)] = 0.2
    """Their least distance from obstacles."""
    max_per_room: Count = 10
    """Of them kept in a room."""
    least_per_room: Natural = 0
    """Rooms with fewer positions than this have no images."""
    test_share: Annotated[float, Bounds(0, 1, open=True)] = 0.2
    """Share of a room's positions (and of its passages' sources) that are for testing only."""
    headings: int = 18
    """Images around a position, for each pitch; a multiple of 3, because testing takes every third."""
    pitch_deg: Annotated[float, Bounds(0.0, 80.0)] = 20.0
    """How far up and down the camera looks; the third pitch is level."""
    passage_sources: Count = 10
    """Sources a room of passage images."""
    passage_targets: Count = 10
    """Directions a source, evenly about it from a drawn one on."""
    passage_clearance_m: Annotated[float, Bounds(0.0, 10.0)] = 0.3
    """Least distance of sources from obstacles."""
    passage_length_m: Annotated[float, Bounds(0.05, 100.0)] = 2.0
    """Length of the segment that is navigable or not: passages are balanced on it and detectors scored by it."""
    passage_lengths_m: tuple[float, ...] = (0.5, 1.0, 1.5, 2.0, 2.5)
    """Lengths that passages are labelled for, ascending, `passage_length_m` among them: how far the way is free."""
    passage_points: Annotated[int, Bounds(2, 10**4)] = 50
    """Points of the segment looked up on the map, both ends included."""
    passage_margin_m: Annotated[float, Bounds(0.0, 10.0)] = 0.225
    """Distance from obstacles that each point needs: half of TTbot's width; 0: it may touch them."""
    shard: Count = 10
    """Sheets of images a file: what an interrupted rendering loses at most."""

    def __post_init__(self) -> None:
        super().__post_init__()
        lengths = self.passage_lengths_m
        if not lengths or min(lengths) < 0.05 or list(lengths) != sorted(set(lengths)):
            raise ConfigError(f"passage_lengths_m is {list(lengths)}, expected ascending lengths from 0.05 m on")
        if self.passage_length_m not in lengths:
            raise ConfigError(
                f"passage_length_m is {self.passage_length_m:g}, expected one of passage_lengths_m {list(lengths)}; "
                "add it there"
            )
        if self.headings < 3 or self.headings % 3:
            raise ConfigError(f"headings is {self.headings}, expected a multiple of 3")

    @property
    def passage_column(self) -> int:
        """Return which of `passage_lengths_m` is `passage_length_m`."""
        return self.passage_lengths_m.index(self.passage_length_m)

    @property
    def pitches_rad(self) -> tuple[float, float, float]:
        """Return upward angles in the order of `PITCHES`."""
        up = math.radians(self.pitch_deg)
        return up, 0.0, -up


@dataclasses.dataclass(frozen=True)
class NetworkTrainConfig(Settings):
    """Set a network and how it learns."""

    seed: Seed = 0
    """The one seed of weights, order and augmentation."""
    network: Literal["resnet18", "alexnet"] = "resnet18"
    """Backbone."""
    width: Count = 64
    """Channels of the backbone's first stage; 64 is the original."""
    hidden: Natural = 512
    """Units of each of the two layers behind the backbone; 0: no layers."""
    first_stage: Annotated[int, Bounds(1, 3)] = 2
    """Stage of ResNet-18 whose map joins the fourth's in the embedding. The report's is 1, with width=64: 64 + 512."""
    init: str = "scratch"
    """Where the backbone starts: scratch, or a run folder to take it from."""
    pitch: Literal["all", "up", "level", "down"] = "all"
    """Room images to learn from."""
    test_headings: Literal["thirds", "random"] = "thirds"
    """Images of a room's test positions to test: every third heading, or as many at random."""
    test_scenes: tuple[str, ...] = ()
    """passages: scenes to test by, and to learn nothing from; none: the sources that the dataset holds out."""
    epochs: Count = 15
    """Passes over the training images."""
    batch: Count = 20
    """Images an update."""
    learning_rate: Annotated[float, Bounds(1e-9, 10.0)] = 1e-4
    """Adam's."""
    label_smoothing: Annotated[float, Bounds(0.0, 0.999)] = 0.1
    """Share of a room label's weight that is spread over all rooms."""
    augment: bool = True
    """Vary brightness, contrast and colour, and shift images by up to a sixteenth, anew in every epoch."""


TASKS = {"rooms": NetworkTrainConfig(), "passages": NetworkTrainConfig(batch=32, epochs=20, hidden=0)}
"""Defaults of the room classifier and of the passage detector."""


@dataclasses.dataclass(frozen=True)
class MapConfig(Settings):
    """Set where nodes stand, and which edges join them."""

    seed: Seed = 0
    """Of random nodes."""
    clearance_m: Annotated[float, Bounds(0.0, 10.0)] = 0.4
    """Least distance of nodes from obstacles: robots turn about there; TTbot's corners reach 0.33 m."""
    min_per_room: Annotated[int, Bounds(1, 1000)] = 3
    """Nodes a room, at least."""
    spacing_m: Annotated[float, Bounds(0.1, 100.0)] = 0.9
    """No free place of a room is farther than this from one of its nodes."""
    nodes: Literal["covering", "random"] = "covering"
    """How nodes are chosen: greedily, those that cover most of what is left, or at random."""
    edge_m: Annotated[float, Bounds(0.1, 100.0)] = 2.5
    """Nodes nearer than this are joined, both ways."""
    edge_image: Literal["exact", "nearest"] = "exact"
    """The image that an edge is judged by: drawn along it, or the nearest of the node's images."""
    connect: bool = True
    """Add nodes until every free place that one can drive to is joined by free edges."""
    asked_m: Annotated[float | None, Bounds(0.05, 100.0)] = None
    """Length for which the detector judges an edge; auto: the edge's own."""
    passable: Share = 0.5
    """Edges with at least this probability count as open where connectedness is reported."""
    supersample: Annotated[int | None, Bounds(1, 16)] = None
    """Images are drawn this many times larger along each side; auto: as for the networks, on a CPU at most 2."""
    check: Annotated[int, Bounds(0, 10**6)] = 0
    """Free places, drawn by chance, at which to try how well the finished map localises."""


@dataclasses.dataclass(frozen=True)
class NavigatorConfig(Settings):
    """Set how the navigator localises, turns and drives; `preset=report` has the report's values."""

    images: Annotated[int, Bounds(1, 1000)] = 18
    """Images that one localisation looks at, evenly about; a divisor of the map's images a node."""
    goal_images: Annotated[int | None, Bounds(1, 1000)] = None
    """Images of the goal, evenly from a heading that each episode draws; auto: as `images`, from the world's x axis."""
    match: Literal["aligned", "nearest"] = "aligned"
    """An image is compared with the nodes' images of the same heading, and all are summed (aligned); or with all of
    them, and the nearest of all decides (nearest)."""
    asked_m: Annotated[float | None, Bounds(0.05, 100.0)] = None
    """Length for which the detector is always asked; auto: an edge's own, as `ahead_m`, `slack_m` and `clear_m` say."""
    passable: Share = 0.5
    """The passage detector agrees from this probability on."""
    swing_deg: Annotated[float, Bounds(1.0, 180.0)] = 15.0
    """Step of the swing left and right."""
    swings: Annotated[int, Bounds(1, 1000)] = 4
    """Steps to each side before an edge counts as blocked."""
    ahead_m: Annotated[float, Bounds(0.05, 100.0)] = 2.0
    """The way must be free for an edge's length less `slack_m`, at most this far: a run leads no farther at 0.4 m/s."""
    slack_m: Annotated[float, Bounds(0.0, 100.0)] = 0.3
    """The robot is not exactly at its node; at most half of the edge's length."""
    clear_m: Annotated[float, Bounds(0.05, 100.0)] = 1.0
    """How far the way must be free for the baseline policy to drive on (it takes this to stop and turn) and where the
    map has no way; and of which heading is the most open."""
    tolerance_deg: Annotated[float, Bounds(0.1, 45.0)] = 3.0
    """A heading is reached when it is off by less."""
    runs: Annotated[int, Bounds(1, 1000)] = 12
    """Runs of the local policy between two localisations."""
    run_s: Annotated[float, Bounds(0.1, 1e6)] = 5.0
    """Length of a run."""
    glance: bool = True
    """After each run, judge by the image ahead whether the robot is at its node or at one joined to it; plan anew."""
    watch_s: Annotated[float, Bounds(0.0, 1e6)] = 0.5
    """How often to look, within a run, whether the edge's head is passed (nearest of all, and getting farther), which
    ends the run; 0: never. Needs `glance`."""
    metre_cost: Annotated[float, Bounds(0.0, 1e6)] = 0.3
    """Added to an edge's cost, -log p, for each metre, so that of free ways the shorter wins; 0: the report's."""
    retry_cost: Annotated[float, Bounds(0.0, 1e6)] = 1.0
    """Added to the cost of an edge each time that it was driven and the robot was then not nearer to its head."""
    limit_s: Annotated[float, Bounds(0.1, 1e6)] = 1800.0
    """Time after which an episode has failed."""
    kp: Annotated[float, Bounds(0.0, 100.0)] = 2.0
    """Proportional gain of turning, 1/s."""
    ki: Annotated[float, Bounds(0.0, 100.0)] = 0.2
    """Integral gain, 1/s^2."""
    kd: Annotated[float, Bounds(0.0, 100.0)] = 0.05
    """Derivative gain."""
    max_turn_rad_s: Annotated[float, Bounds(0.01, 10.0)] = 1.0
    """Fastest turn on the spot."""


@dataclasses.dataclass(frozen=True)
class EvaluationConfig(GapConfig, NavigatorConfig):
    """Set the navigator, its robot, its episodes, and how they are scored."""

    seed: Seed = 0
    """Of the episodes."""
    episodes: Annotated[int | None, Bounds(1, 10**6)] = None
    """A scene; auto: one for every 2 square metres of floor, 25 to 60."""
    min_goal_m: Annotated[float, Bounds(0.0, 1000.0)] = 2.5
    """Start and goal are in different rooms and farther apart than this."""
    success_m: Annotated[float, Bounds(0.0, 1000.0)] = 1.5
    """A run that ends nearer to the goal than this has reached it."""
    clearance_m: Annotated[float, Bounds(0.0, 1000.0)] = 0.35
    """Least distance of starts and goals from obstacles; TTbot's corners reach 0.33 m."""
    thinned: Annotated[float, Bounds(0.01, 1.0)] = 0.4
    """Share of each room's nodes that the sparse map of the ablation keeps."""
    batch: Annotated[int | None, Bounds(1, 10**6)] = None
    """Episodes played at a time; auto: all of a scene on an accelerator, 8 on a CPU."""
    backend: Literal["auto", "warp", "jax", "native"] = "auto"
    """Physics: as in `interactive_nav`."""
    objects: Annotated[int, Bounds(0, 100)] = 0
    """Small objects strewn over the floor; images of goals and maps are of the scene without them."""
    blocked: bool = False
    """The widest of them stands where the shortest path is narrowest, so that it blocks a passage of the map."""
    supersample: Annotated[int | None, Bounds(1, 16)] = None
    """Images are drawn this many times larger along each side; auto: as for the networks, on a CPU at most 2."""


@dataclasses.dataclass(frozen=True)
class ExpertConfig(Settings):
    """Set the expert: what it may command, how far it looks ahead, and what it weighs."""

    linear_m_s: Annotated[float, Bounds(0.01, 100.0)] = 0.5
    """Fastest forward; it never reverses."""
    angular_rad_s: Annotated[float, Bounds(0.01, 100.0)] = 0.5
    """Fastest turn, either way."""
    linear_samples: Annotated[int, Bounds(2, 101)] = 5
    """Forward velocities tried, evenly from 0 to the fastest, each as near as a control period can bring it."""
    angular_samples: Annotated[int, Bounds(2, 101)] = 11
    """The same, of turning; an odd number has straight ahead."""
    acceleration_m_s2: Annotated[float, Bounds(0.01, 100.0)] = 1.0
    """What can be reached: change of the forward velocity."""
    angular_acceleration_rad_s2: Annotated[float, Bounds(0.01, 100.0)] = 4.0
    """The same, of turning."""
    horizon_s: Annotated[float, Bounds(0.1, 100.0)] = 1.6
    """Velocities are judged by where they would lead in this time."""
    horizon_steps: Annotated[int, Bounds(1, 1000)] = 8
    """Places on the way there that are looked at."""
    margin_m: Annotated[float, Bounds(0.0, 100.0)] = 0.04
    """Least gap between the footprint and any obstacle."""
    caution_m: Annotated[float, Bounds(0.001, 10.0)] = 0.25
    """A gap less than this costs."""
    weigh_progress: Annotated[float, Bounds(0.0, 100.0)] = 1.0
    """Of the way that is left at the horizon, over the longest that can be driven until then."""
    weigh_heading: Annotated[float, Bounds(0.0, 100.0)] = 1.2
    """Of the angle there to the way on, over a half turn."""
    weigh_gap: Annotated[float, Bounds(0.0, 100.0)] = 0.4
    """Of a gap of 0; at `caution_m` it is nothing."""
    lidar_rays: Annotated[int, Bounds(1, 1000)] = 135
    """Beams of the scan."""
    lidar_fov_deg: Annotated[float, Bounds(1.0, 360.0)] = 270.0
    """Angle that they cover."""
    lidar_range_m: Annotated[float, Bounds(0.1, 100.0)] = 4.0
    """Largest distance that the scanner measures, m."""
    radius_m: Annotated[float, Bounds(0.001, 10.0)] = 0.27
    """The planned way keeps its middle this far from obstacles."""
    near_m: Annotated[float, Bounds(0.001, 10.0)] = 0.3
    """Within this much more a metre of it counts for more, up to `near_cost` more."""
    near_cost: Annotated[float, Bounds(0.0, 100.0)] = 3.0
    """Metres added to a metre along the obstacle."""
    reached_m: Annotated[float, Bounds(0.001, 10.0)] = 0.35
    """A node nearer than this is passed."""


@dataclasses.dataclass(frozen=True)
class DriveConfig(ExpertConfig, CameraConfig):
    """Set the expert's drives along edges of each scene's graph, drawn from the robot."""

    backend: Literal["auto", "warp", "jax", "native"] = "auto"
    """Physics: as in `interactive_nav`."""
    batch: Count = 256
    """Drives at once: what an interrupted simulation loses at most."""
    drives: Count = 400
    """Begun in each scene."""
    driver: str = ""
    """Run folder of a local policy that drives, while the expert labels what it would command (DAgger)."""
    expert_share: Share = 0.0
    """With `driver`: probability that a control step executes the expert's command instead."""
    legs: Count = 3
    """Edges a drive, at most: on from each node by a random edge that turns less than `turn_deg`."""
    turn_deg: Annotated[float, Bounds(0.0, 180.0)] = 30.0
    """Sharpest turn from one edge to the next: nothing but the images shows the policy where to go."""
    edge_m: Annotated[float, Bounds(0.1, 1000.0)] = 2.5
    """Longest edge, as in maps."""
    least_edge_m: Annotated[float, Bounds(0.0, 100.0)] = 1.0
    """Shortest edge that a drive begins with."""
    detour: Annotated[float, Bounds(1.0, 100.0)] = 2.0
    """Edges are driven whose planned way, a metre near obstacles counting more, is at most so many times as long."""
    start_off_m: Annotated[float, Bounds(0.0, 10.0)] = 0.3
    """Drives begin up to this far from their node."""
    start_turn_deg: Annotated[float, Bounds(0.0, 180.0)] = 15.0
    """And up to this much turned away from their edge, as a robot is that was turned along it by its compass."""
    start_clear_m: Annotated[float, Bounds(0.0, 10.0)] = 0.36
    """Least distance of the start from obstacles: the robot's corners swing within 0.34 m."""
    leg_s: Annotated[float, Bounds(0.1, 1000.0)] = 12.0
    """A drive has failed that takes longer for an edge."""
    test_share: Annotated[float, Bounds(0, 1, open=True)] = 0.1
    """Share of the nodes whose drives are for testing only."""
    shard: Count = 10
    """Drives a file of images."""
    IDLE = (("expert_share", "driver=RUN", lambda c: bool(c.driver)),)


@dataclasses.dataclass(frozen=True)
class PolicyConfig(Settings):
    """Set the local policy and how it learns; `preset=report` has the report's values."""

    seed: Seed = 0
    """The one seed of weights, order and thinning."""
    hidden: Count = 500
    """Numbers in the memory of each of the two GRU cells."""
    projection: Annotated[int, Bounds(0, 10**6)] = 0
    """Features are mapped to so many numbers before the cells, which makes these smaller; 0: they are not."""
    forward_hidden: Count = 512
    """Units of each of the forward model's two layers."""
    linear_classes: Annotated[int, Bounds(2, 1000)] = 3
    """Forward velocities, evenly from 0 to the expert's fastest."""
    angular_classes: Annotated[int, Bounds(2, 1000)] = 5
    """Turning velocities, evenly from the fastest right to the fastest left."""
    steps: Annotated[int, Bounds(2, 1000)] = 50
    """Control steps a sequence."""
    overlap_s: Annotated[float, Bounds(0.0, 1e6)] = 4.0
    """Longest overlap of two sequences of a drive."""
    straight_share: Share = 0.2
    """A sequence that turns in less than this share of its steps is nearly straight."""
    straight_kept: Share = 0.3
    """Share of the nearly straight sequences that is learned from."""
    mirror: bool = True
    """Learn from mirrored drives too."""
    alpha: Annotated[float, Bounds(0.0, 1e6)] = 10.0
    """Weight of the commands' cross-entropies."""
    lam: Annotated[float, Bounds(0.0, 1e6)] = 0.5
    """Weight of forward consistency: lambda."""
    lam_alone: bool = False
    """Count forward consistency also while only the forward model learns, as the report's equation 1 does."""
    predicts: Literal["change", "next"] = "change"
    """What the forward model predicts: an embedding's change, in units of its spread, or the next embedding."""
    pairs: Literal["nine", "report"] = "nine"
    """With --grid: all pairs of three alphas and three lambdas, or the report's three."""
    epochs: Count = 50
    """Passes over the sequences."""
    alone: Share = 0.1
    """Share of them, the first, in which only the forward model learns."""
    batch: Count = 50
    """Sequences an update."""
    learning_rate: Annotated[float, Bounds(1e-9, 10.0)] = 1e-4
    """Adam's."""


@dataclasses.dataclass(frozen=True)
class ExportConfig(Settings):
    """Set what an export must keep to."""

    limit_mib: Annotated[float, Bounds(0.001, 1e6)] = 8.0
    """The whole folder is no larger."""
    places: Count = 24
    """Places by whose images exported networks are compared with those of the runs."""
    tolerance: Annotated[float, Bounds(0.0, 10.0)] = 0.02
    """Most by which a passage's probability, or an embedding (of length 1.41), may differ."""
    commit: str | None = None
    """Of runs whose versions.json names none."""
