"""Define all settings of datasets, training and maps, checked on construction; docstrings are the help."""

import dataclasses
from pathlib import Path
from typing import Annotated, Literal

from interactive_nav_common.config import Bounds, Count, Natural, Seed, Settings, Share
from interactive_nav_common.errors import ConfigError
from topological_nav.gap import GapConfig

PITCHES = ("up", "level", "down")
"""Order of a position's images by pitch."""
RUNS = Path("runs/topological")
"""Default folder of the commands."""
DATASET, DRIVES, ADAPTED = RUNS / "data", RUNS / "drives", RUNS / "adapted"
PASSAGE_POLICY = "passage"
"""The local policy without weights: straight on while the passage detector agrees, else turn."""


@dataclasses.dataclass(frozen=True)
class CameraConfig(Settings):
    """Set the camera, and how its images are stored."""

    seed: Seed = 0
    """Random seed of positions, splits, passages and drives."""
    robot: str = "ttbot"
    """Robot whose camera is used."""
    engine: Literal["warp", "gl"] = "warp"
    """Renderer: MJX-Warp's ray tracer (CPU or GPU), or MuJoCo's (needs EGL or OSMesa)."""
    width: Annotated[int, Bounds(16, 2048)] = 128
    """Width of a stored image in pixels."""
    height: Annotated[int, Bounds(16, 2048)] = 96
    """Height of a stored image in pixels."""
    supersample: Annotated[int, Bounds(1, 16)] = 5
    """Images are rendered this many times larger along each side and averaged: 5 x 128 x 96 is 640 x 480."""
    fov_deg: Annotated[float | None, Bounds(1.0, 170.0)] = None
    """Vertical field of view in degrees; auto: the robot's camera's."""
    quality: Annotated[int, Bounds(1, 100)] = 90
    """WebP quality of stored images; 100 is lossless."""


@dataclasses.dataclass(frozen=True)
class DataConfig(CameraConfig):
    """Set the images of each scene; `preset=report` has the report's values."""

    room_method: Literal["kmeans", "gmm", "spectral"] = "gmm"
    """Method that clusters free positions into rooms."""
    num_rooms: Annotated[int | None, Bounds(1, 10**6)] = None
    """Number of rooms per scene; auto: as recorded for it, otherwise by BIC (gmm) or silhouette."""
    positions: Count = 100
    """Number of free positions to draw in a scene for room images."""
    clearance_m: Annotated[float, Bounds(0.0, 10.0)] = 0.2
    """Least distance of positions from obstacles in m."""
    max_per_room: Count = 10
    """Most positions to keep in a room."""
    least_per_room: Natural = 0
    """Least number of positions of a room that gets images."""
    test_share: Annotated[float, Bounds(0, 1, open=True)] = 0.2
    """Share of a room's positions (and of its passages' sources) for testing only."""
    headings: int = 18
    """Number of images around a position for each pitch, a multiple of 3: testing takes every third."""
    pitch_deg: Annotated[float, Bounds(0.0, 80.0)] = 20.0
    """Angle in degrees by which the camera looks up and down; the third pitch is level."""
    passage_sources: Count = 10
    """Number of sources of passage images per room."""
    passage_targets: Count = 10
    """Number of directions per source, evenly spaced from a random one."""
    passage_clearance_m: Annotated[float, Bounds(0.0, 10.0)] = 0.3
    """Least distance of sources from obstacles in m."""
    passage_length_m: Annotated[float, Bounds(0.05, 100.0)] = 2.0
    """Length in m of the segment to classify, by which passages are balanced and detectors scored."""
    passage_lengths_m: tuple[float, ...] = (0.5, 1.0, 1.5, 2.0, 2.5)
    """Lengths in m that passages are labelled for, ascending, including `passage_length_m`."""
    passage_points: Annotated[int, Bounds(2, 10**4)] = 50
    """Number of points of the segment to check on the map, including both ends."""
    passage_margin_m: Annotated[float, Bounds(0.0, 10.0)] = 0.225
    """Least distance of each point from obstacles in m: half of TTbot's width; 0: it may touch them."""
    objects: Annotated[int, Bounds(0, 100)] = 0
    """Most small objects on the floor in passage images; each source has a layout of its own."""
    shard: Count = 10
    """Number of sheets of images per file: the most that an interrupted rendering loses."""

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


@dataclasses.dataclass(frozen=True)
class NetworkTrainConfig(Settings):
    """Set a network and its training."""

    seed: Seed = 0
    """Random seed of weights, order and augmentation."""
    network: Literal["resnet18", "alexnet"] = "resnet18"
    """Backbone of the network."""
    width: Count = 64
    """Channels of the backbone's first stage; 64 is the original."""
    hidden: Natural = 512
    """Units of each of the two layers after the backbone; 0: no layers."""
    first_stage: Annotated[int, Bounds(1, 3)] = 2
    """Stage of ResNet-18 whose map joins the fourth's in the embedding. The report's is 1, with width=64: 64 + 512."""
    init: str = "scratch"
    """Initial backbone: scratch, or a run folder."""
    pitch: Literal["all", "up", "level", "down"] = "all"
    """Room images to train on."""
    test_headings: Literal["thirds", "random"] = "thirds"
    """Images of a room's test positions to test: every third heading, or as many at random."""
    test_scenes: tuple[str, ...] = ()
    """passages: scenes for testing only; none: the sources that the dataset holds out."""
    epochs: Count = 15
    """Passes over the training images."""
    batch: Count = 20
    """Images per update."""
    learning_rate: Annotated[float, Bounds(1e-9, 10.0)] = 1e-4
    """Adam's step size."""
    label_smoothing: Annotated[float, Bounds(0.0, 0.999)] = 0.1
    """Share of a room label's weight that is spread over all rooms."""
    augment: bool = True
    """Vary brightness, contrast and colour, and shift images by up to a sixteenth, in every epoch."""


TASKS = {"rooms": NetworkTrainConfig(), "passages": NetworkTrainConfig(batch=32, epochs=20, hidden=0)}
"""Defaults of the room classifier and of the passage detector."""


@dataclasses.dataclass(frozen=True)
class MapConfig(Settings):
    """Set the positions of nodes, and the edges that join them."""

    seed: Seed = 0
    """Random seed of random nodes."""
    clearance_m: Annotated[float, Bounds(0.0, 10.0)] = 0.4
    """Least distance of nodes from obstacles in m, for turning: TTbot's corners reach 0.33 m."""
    min_per_room: Annotated[int, Bounds(1, 1000)] = 3
    """Least nodes per room."""
    spacing_m: Annotated[float, Bounds(0.1, 100.0)] = 0.9
    """Largest distance of a room's free places from their nearest node in m."""
    nodes: Literal["covering", "random"] = "covering"
    """Choice of nodes: greedily, by the uncovered places that they cover, or at random."""
    edge_m: Annotated[float, Bounds(0.1, 100.0)] = 2.5
    """Largest distance in m between two nodes that are joined, in both directions."""
    edge_image: Literal["exact", "nearest"] = "exact"
    """Image that judges an edge: rendered along it, or the nearest of the node's images."""
    connect: bool = True
    """Add nodes until free edges join every free place that the robot can reach."""
    asked_m: Annotated[float | None, Bounds(0.05, 100.0)] = None
    """Length in m for which the detector judges an edge; auto: the edge's length."""
    passable: Share = 0.5
    """Least probability of an edge that counts as open in reports of connectedness."""
    supersample: Annotated[int | None, Bounds(1, 16)] = None
    """Images are drawn this many times larger along each side; auto: as for the networks, on a CPU at most 2."""
    check: Annotated[int, Bounds(0, 10**6)] = 0
    """Number of random free places to test localisation on the finished map."""


@dataclasses.dataclass(frozen=True)
class NavigatorConfig(Settings):
    """Set how the navigator localises, turns and drives; `preset=report` has the report's values."""

    images: Annotated[int, Bounds(1, 1000)] = 18
    """Number of images per localisation, evenly spaced; a divisor of the map's images per node."""
    goal_images: Annotated[int | None, Bounds(1, 1000)] = None
    """Number of images of the goal, evenly spaced from a random heading; auto: `images`, from the world's x axis."""
    match: Literal["aligned", "nearest"] = "aligned"
    """An image is compared with the nodes' images of the same heading, and all are summed (aligned); or with all of
    them, and the nearest of all decides (nearest)."""
    asked_m: Annotated[float | None, Bounds(0.05, 100.0)] = None
    """Length in m for which the detector always answers; auto: an edge's, by `ahead_m`, `slack_m` and `clear_m`."""
    passable: Share = 0.5
    """Least probability at which the passage detector agrees."""
    swing_deg: Annotated[float, Bounds(1.0, 180.0)] = 15.0
    """Step of the swing left and right in degrees."""
    swings: Annotated[int, Bounds(1, 1000)] = 4
    """Number of steps to each side before an edge counts as blocked."""
    ahead_m: Annotated[float, Bounds(0.05, 100.0)] = 2.0
    """Distance in m that must be free, at most an edge's length less `slack_m`: a run at 0.4 m/s leads as far."""
    slack_m: Annotated[float, Bounds(0.0, 100.0)] = 0.3
    """Allowance in m for the robot's distance from its node; at most half of the edge's length."""
    clear_m: Annotated[float, Bounds(0.05, 100.0)] = 1.0
    """Free distance in m that the baseline policy needs to drive on (it takes this to stop and turn), also where the
    map has no path, and by which it finds the most open heading."""
    tolerance_deg: Annotated[float, Bounds(0.1, 45.0)] = 3.0
    """Error in degrees below which a heading is reached."""
    runs: Annotated[int, Bounds(1, 1000)] = 12
    """Number of runs of the local policy between two localisations."""
    run_s: Annotated[float, Bounds(0.1, 1e6)] = 5.0
    """Length of a run in s."""
    glance: bool = True
    """After each run, check by the image ahead whether the robot is at its node or a neighbour, and replan."""
    watch_s: Annotated[float, Bounds(0.0, 1e6)] = 0.5
    """Time in s between two checks within a run whether the robot has passed the edge's head (nearest of all, and
    getting farther), which ends the run; 0: no checks. It needs `glance`."""
    metre_cost: Annotated[float, Bounds(0.0, 1e6)] = 0.3
    """Added to an edge's cost, -log p, per metre, so that the shorter of free paths wins; 0: the report's."""
    retry_cost: Annotated[float, Bounds(0.0, 1e6)] = 1.0
    """Added to the cost of an edge each time that driving it did not bring the robot nearer to its head."""
    limit_s: Annotated[float, Bounds(0.1, 1e6)] = 1800.0
    """Time in s after which an episode fails."""
    kp: Annotated[float, Bounds(0.0, 100.0)] = 2.0
    """Proportional gain of turning, 1/s."""
    ki: Annotated[float, Bounds(0.0, 100.0)] = 0.2
    """Integral gain of turning, 1/s^2."""
    kd: Annotated[float, Bounds(0.0, 100.0)] = 0.05
    """Derivative gain of turning, without unit."""
    max_turn_rad_s: Annotated[float, Bounds(0.01, 10.0)] = 1.0
    """Fastest turn on the spot in rad/s."""


@dataclasses.dataclass(frozen=True)
class EvaluationConfig(GapConfig, NavigatorConfig):
    """Set the navigator, its robot, its episodes and their scoring."""

    seed: Seed = 0
    """Random seed of the episodes."""
    episodes: Annotated[int | None, Bounds(1, 10**6)] = None
    """Number of episodes per scene; auto: one for every 2 square metres of floor, 25 to 60."""
    min_goal_m: Annotated[float, Bounds(0.0, 1000.0)] = 2.5
    """Least distance in m between start and goal, which are in different rooms."""
    success_m: Annotated[float, Bounds(0.0, 1000.0)] = 1.5
    """Distance to the goal in m below which the end of an episode is a success."""
    clearance_m: Annotated[float, Bounds(0.0, 1000.0)] = 0.35
    """Least distance of starts and goals from obstacles in m; TTbot's corners reach 0.33 m."""
    thinned: Annotated[float, Bounds(0.01, 1.0)] = 0.4
    """Share of each room's nodes that the sparse map of the ablation keeps."""
    batch: Annotated[int | None, Bounds(1, 10**6)] = None
    """Number of episodes to play at a time; auto: all of a scene on an accelerator, 8 on a CPU."""
    backend: Literal["auto", "warp", "jax", "native"] = "auto"
    """Physics: as in `interactive_nav`."""
    objects: Annotated[int, Bounds(0, 100)] = 0
    """Number of small objects on the floor; images of goals and maps do not show them."""
    blocked: bool = False
    """Put the widest small object at the narrowest place of the shortest path, to block a passage."""
    supersample: Annotated[int | None, Bounds(1, 16)] = None
    """Images are drawn this many times larger along each side; auto: as for the networks, on a CPU at most 2."""


@dataclasses.dataclass(frozen=True)
class ExpertConfig(Settings):
    """Set the expert: its velocities, its horizon and its weights."""

    linear_m_s: Annotated[float, Bounds(0.01, 100.0)] = 0.5
    """Fastest forward velocity in m/s; it never reverses."""
    angular_rad_s: Annotated[float, Bounds(0.01, 100.0)] = 0.5
    """Fastest turn in rad/s, either way."""
    linear_samples: Annotated[int, Bounds(2, 101)] = 5
    """Number of forward velocities to try, from 0 to the fastest, clipped to those within reach of a control period."""
    angular_samples: Annotated[int, Bounds(2, 101)] = 11
    """Number of turning velocities to try, likewise; an odd number includes straight ahead."""
    acceleration_m_s2: Annotated[float, Bounds(0.01, 100.0)] = 1.0
    """Largest acceleration in m/s^2."""
    angular_acceleration_rad_s2: Annotated[float, Bounds(0.01, 100.0)] = 4.0
    """Largest angular acceleration in rad/s^2."""
    horizon_s: Annotated[float, Bounds(0.1, 100.0)] = 1.6
    """Time in s to look ahead for each pair of velocities."""
    horizon_steps: Annotated[int, Bounds(1, 1000)] = 8
    """Number of poses to check within the horizon."""
    margin_m: Annotated[float, Bounds(0.0, 100.0)] = 0.04
    """Least gap between the footprint and any obstacle in m."""
    caution_m: Annotated[float, Bounds(0.001, 10.0)] = 0.25
    """Gap in m below which an obstacle has a cost."""
    weigh_progress: Annotated[float, Bounds(0.0, 100.0)] = 1.0
    """Weight of the distance to go at the horizon, relative to the longest drive until then."""
    weigh_heading: Annotated[float, Bounds(0.0, 100.0)] = 1.2
    """Weight of the angle between the heading there and the field, relative to a half turn."""
    weigh_gap: Annotated[float, Bounds(0.0, 100.0)] = 0.4
    """Weight of a gap of 0, falling to nothing at `caution_m`."""
    lidar_rays: Annotated[int, Bounds(1, 1000)] = 135
    """Number of beams of the scan."""
    lidar_fov_deg: Annotated[float, Bounds(1.0, 360.0)] = 270.0
    """Angle of the scan in degrees."""
    lidar_range_m: Annotated[float, Bounds(0.1, 100.0)] = 4.0
    """Range of the scanner in m."""
    radius_m: Annotated[float, Bounds(0.001, 10.0)] = 0.27
    """Least distance of the planned path from obstacles in m."""
    near_m: Annotated[float, Bounds(0.001, 10.0)] = 0.3
    """Range in m beyond `radius_m` in which obstacles raise the cost of a metre, by up to `near_cost`."""
    near_cost: Annotated[float, Bounds(0.0, 100.0)] = 3.0
    """Most metres that a metre beside an obstacle counts in addition."""
    reached_m: Annotated[float, Bounds(0.001, 10.0)] = 0.35
    """Distance in m within which a node is passed."""


@dataclasses.dataclass(frozen=True)
class DriveConfig(ExpertConfig, CameraConfig):
    """Set the expert's drives along edges of each scene's graph, drawn from the robot."""

    backend: Literal["auto", "warp", "jax", "native"] = "auto"
    """Physics: as in `interactive_nav`."""
    batch: Count = 256
    """Number of drives at once: the most that an interrupted simulation loses."""
    drives: Count = 400
    """Number of drives to start in each scene."""
    legs: Count = 3
    """Most edges of a drive; each next one is random among those that turn less than `turn_deg`."""
    turn_deg: Annotated[float, Bounds(0.0, 180.0)] = 30.0
    """Sharpest turn between edges in degrees, because only the images show the policy where to go."""
    edge_m: Annotated[float, Bounds(0.1, 1000.0)] = 2.5
    """Longest edge in m, as in maps."""
    least_edge_m: Annotated[float, Bounds(0.0, 100.0)] = 1.0
    """Shortest first edge of a drive in m."""
    detour: Annotated[float, Bounds(1.0, 100.0)] = 2.0
    """Largest ratio of an edge's planned path, where a metre near obstacles counts more, to its length."""
    start_off_m: Annotated[float, Bounds(0.0, 10.0)] = 0.3
    """Largest distance of a drive's start from its node in m."""
    start_turn_deg: Annotated[float, Bounds(0.0, 180.0)] = 15.0
    """Largest initial angle from the edge in degrees, as after turning by the compass."""
    start_clear_m: Annotated[float, Bounds(0.0, 10.0)] = 0.36
    """Least distance of the start from obstacles in m: the robot's corners swing within 0.34 m."""
    leg_s: Annotated[float, Bounds(0.1, 1000.0)] = 12.0
    """Time in s per edge after which a drive fails."""
    test_share: Annotated[float, Bounds(0, 1, open=True)] = 0.1
    """Share of the nodes whose drives are for testing only."""
    shard: Count = 10
    """Number of drives per file of images."""


@dataclasses.dataclass(frozen=True)
class PolicyConfig(Settings):
    """Set the local policy and its training; `preset=report` has the report's values."""

    seed: Seed = 0
    """Random seed of weights, order and thinning."""
    hidden: Count = 500
    """Size of the memory of each of the two GRU cells."""
    projection: Annotated[int, Bounds(0, 10**6)] = 0
    """Width of a projection of the features before the cells, which makes these smaller; 0: none."""
    forward_hidden: Count = 512
    """Units of each of the forward model's two layers."""
    linear_classes: Annotated[int, Bounds(2, 1000)] = 3
    """Number of forward velocities, evenly from 0 to the expert's fastest."""
    angular_classes: Annotated[int, Bounds(2, 1000)] = 5
    """Number of turning velocities, evenly from the fastest right to the fastest left."""
    steps: Annotated[int, Bounds(2, 1000)] = 50
    """Number of control steps per sequence."""
    overlap_s: Annotated[float, Bounds(0.0, 1e6)] = 4.0
    """Longest overlap of two sequences of a drive in s."""
    straight_share: Share = 0.2
    """Share of steps with a turn below which a sequence is nearly straight."""
    straight_kept: Share = 0.3
    """Share of the nearly straight sequences to keep."""
    mirror: bool = True
    """Train on mirrored drives too."""
    alpha: Annotated[float, Bounds(0.0, 1e6)] = 10.0
    """Weight of the commands' cross-entropies."""
    lam: Annotated[float, Bounds(0.0, 1e6)] = 0.5
    """Weight of forward consistency, lambda."""
    lam_alone: bool = False
    """Include forward consistency also while only the forward model is trained, as in the report's equation 1."""
    predicts: Literal["change", "next"] = "change"
    """Output of the forward model: an embedding's change, in units of its spread, or the next embedding."""
    pairs: Literal["nine", "report"] = "nine"
    """With --grid: all pairs of three alphas and three lambdas, or the report's three."""
    epochs: Count = 50
    """Passes over the sequences."""
    alone: Share = 0.1
    """Share of the epochs, the first, that train only the forward model."""
    batch: Count = 50
    """Sequences per update."""
    learning_rate: Annotated[float, Bounds(1e-9, 10.0)] = 1e-4
    """Adam's step size."""


@dataclasses.dataclass(frozen=True)
class ExportConfig(Settings):
    """Set the limits of an export."""

    places: Count = 24
    """Number of places whose images compare exported networks with the runs'."""
    tolerance: Annotated[float, Bounds(0.0, 10.0)] = 0.02
    """Largest difference of a passage's probability, or of an embedding (of length 1.41)."""
    commit: str | None = None
    """Commit of runs whose versions.json has none."""
