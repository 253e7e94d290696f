"""Define the environment's settings in three parts (task, physics, sensors), checked on construction."""

import dataclasses
import math
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import Annotated, Any, Literal

from interactive_nav.camera_config import CameraNoise, CameraView, FovDeg, ImageSide
from interactive_nav_common.config import AtLeastOne, Bounds, Natural, NotNegative, Positive, Settings, Share, overlay
from interactive_nav_common.errors import ConfigError
from interactive_nav_common.records import read_packaged
from scenes_mjcf.categories import MaskClasses

OBSERVATIONS = ("goal", "velocity", "waypoints")
"""Parts of the observation by default."""
SIGNALS = (*OBSERVATIONS, "localisation", "odometry", "collision", "joints", "lidar", "trail")
"""Parts of the state vector."""
IMAGES = ("depth", "segmentation", "rgb", "normals")
"""Parts that are images."""
VARIANTS = read_packaged(Path(__file__).with_name("variants.yaml"), dict[str, dict[str, Any]])
ORIGINAL_CODE: dict[str, Any] = VARIANTS["code"]
"""Settings by which the original's code differs from its paper (reference benchmark, section 11)."""


@dataclasses.dataclass(frozen=True)
class TaskRules(Settings):
    """What the task is: goals, rewards, objects, what an action commands, and how episodes are scored."""

    control_mode: str = "native"
    """What an action commands: a control mode of the robot; `native` is the original benchmark's."""
    symmetric_actions: bool = False
    """Action 0 commands nothing; the original's ranges are lopsided (TurtleBot's wheels: -12.5 to 25 rad/s)."""
    hook_force_n: NotNegative = 0.0
    """Largest force, N, of a hook at a wheeled robot's front (100 pulls doors and chairs): one more action, above 0 to
    couple to what stands within 0.1 m, below 0 to let go. 0: no hook."""
    num_objects: Natural = 10
    """Small objects strewn about at random each episode."""
    small_objects: Literal["train", "test"] = "train"
    """Set of the small objects' models: train, or test (in no training episode)."""
    objects: tuple[str, ...] = ()
    """Folders of `python -m converters object`, relative to the current folder: they are the small objects in place of
    the built-in ones, in turn until there are num_objects."""
    doors_shut: Annotated[tuple[float, float], Bounds(0, 1)] = (0.0, 0.0)
    """How far the doors of rooms are shut at first: 0 as built, 1 at the end of their range that is farther away. Doors
    that are built at an end stay there; the others are spread over this range, each the same in every episode."""
    k_int: NotNegative = 0.1
    """Interaction penalty per control step in which the robot touches a movable object."""
    success_reward: float = 10.0
    """Reward of reaching the goal."""
    episode_steps: AtLeastOne = 1000
    """Control steps before an episode is cut."""
    success_distance_m: Positive | None = None
    """Planar distance to the goal that counts as success; none: the original code's, 0.333 m for a TurtleBot."""
    min_goal_distance_m: float = 1.0
    """Least planar distance between start and goal."""
    max_goal_distance_m: float = math.inf
    """Largest geodesic distance between start and goal; infinite: any."""
    num_waypoints: AtLeastOne = 10
    """Waypoints along the shortest path in the observation."""
    waypoint_spacing_m: Positive = 0.2
    """Arc length between waypoints."""
    nav_cell_m: Positive = 0.1
    """Cell side of the navigation grid."""
    success_in_3d: bool = False
    """Success by the distance in space to the goal on the floor, as the original's code; else in the plane."""
    fail_when_lifted: bool = False
    """End the episode as a failure when the base rises 0.2 m above its standing height; it is counted anyway."""
    interaction_with: Literal["movables", "anything"] = "movables"
    """Touches that cost k_int: movables (any part of the robot) or anything (walls too, but wheels exempt)."""
    kinematic_sum: Literal["all", "touched"] = "all"
    """Objects in the kinematic effort: all, or touched (each from the step of its first touch on)."""
    force_part: Literal["full", "normal"] = "full"
    """Force in the dynamic effort: full contact force, or normal (without friction, wheels exempt)."""
    force_sum: Literal["vector", "contacts", "last_substep"] = "vector"
    """F_t: norm of the vector sum (vector) or sum of the contacts' norms (contacts), mean over the substeps; or the
    vector sum of the last_substep only."""
    score_gravity_m_s2: Positive = 9.81
    """g in the dynamic effort."""
    robot_mass: Literal["total", "links", "base"] = "total"
    """m_0 in the scores: total, links (all but the root link) or base (the root link alone)."""
    clip_path_efficiency: bool = True
    """P_eff at most 1."""
    effort_on_failure: bool = True
    """E_eff counts on failures; else it is 0 there, as the original's log had it."""
    waypoint_style: Literal["ahead", "grid"] = "ahead"
    """ahead: at equal arc length ahead; grid: from the robot's cell, as the original's code."""
    potential: Literal["continuous", "quantised"] = "continuous"
    """Geodesic distance from the robot's position, or quantised: from the centre of its cell."""
    potential_round: Positive | None = None
    """For training: the potential's path also avoids furniture, where it stood at the start, whose friction exceeds
    this share of the robot's weight (1: too heavy to push), if such a path exists. Scores do not use this path;
    waypoints do with waypoints_round."""
    waypoints_round: bool = False
    """Waypoints also avoid the furniture of potential_round, as if it stood on the robot's map."""
    scene_choice: Literal["episode", "slot"] = "episode"
    """Each episode draws a scene, or each environment of a batch keeps one (slot; `AutoResetEnv`)."""
    goal_clear: bool = True
    """Goals are free of contact for the robot; else only of structure."""
    random_object_yaw: bool = True
    """Small objects are turned at random; else they all have yaw 0."""
    bootstrap_at_time_limit: bool = True
    """The time limit is a truncation, at which learners bootstrap; else it looks like any other end."""

    IDLE = (
        ("small_objects objects", "num_objects above 0", lambda c: c.num_objects > 0),
        ("waypoints_round", "potential_round", lambda c: c.potential_round is not None),
    )

    def __post_init__(self) -> None:
        if isinstance(self.objects, (str, Path)):
            raise ConfigError(
                f"objects is {self.objects!r}, expected a list of object folders; write ['{self.objects}']"
            )
        object.__setattr__(self, "objects", tuple(str(folder) for folder in self.objects))
        super().__post_init__()
        if self.objects and self.small_objects != "train":
            raise ConfigError(
                f"small_objects is {self.small_objects!r}, expected train, its default: with objects there are no "
                "built-in models to choose from"
            )
        if self.hook_force_n and self.needs_contacts:
            got = f"hook_force_n is {self.hook_force_n}, expected 0 with options that look at single contacts"
            raise ConfigError(f"{got} (interaction_with, force_part, force_sum); leave these at their defaults")
        if not 0 <= self.min_goal_distance_m < self.max_goal_distance_m:
            raise ConfigError(
                f"min_goal_distance_m is {self.min_goal_distance_m!r}, expected 0 or more and less than "
                f"max_goal_distance_m ({self.max_goal_distance_m})"
            )

    @property
    def needs_contacts(self) -> bool:
        """Return whether an option looks at single contacts, not just at each body's net force."""
        return self.interaction_with == "anything" or self.force_part == "normal" or self.force_sum == "contacts"


WINDOW = ("active_furniture", "active_small", "active_doors", "active_walls")
"""Settings that size what MJX simulates at a time."""


@dataclasses.dataclass(frozen=True)
class PhysicsConfig(Settings):
    """How the world is simulated. With backend auto, settings of all backends may stand side by side."""

    backend: Literal["auto", "warp", "jax", "native"] = "auto"
    """Physics: warp (MJX-Warp, NVIDIA), jax (MJX-JAX), native (C MuJoCo on CPU threads), or auto."""
    control_dt_s: Positive = 0.1
    """Control period."""
    sim_dt_s: Positive = 0.02
    """Physics timestep; must divide the control period."""
    collision: Literal["boxes", "hulls"] = "boxes"
    """Furniture collides as boxes (any backend, any mix of scenes) or hulls (native, one scene)."""
    solver_iterations: AtLeastOne = 10
    """Newton iterations of the constraint solver per physics step."""
    contact_time_constant_s: Positive = 0.05
    """Time constant of contacts (MuJoCo's solref); MuJoCo raises it to twice the timestep where it is less. This one
    lets 0.02 s stay within 10 % of a fine reference in pushes (docs/fidelity.md)."""
    cone: Literal["pyramidal", "elliptic"] = "pyramidal"
    """Friction cones: pyramidal, or elliptic (native only: MJX-Warp's Newton solver fails on them)."""
    contacts_per_env: Natural = 0
    """MJX-Warp contact slots per env; 0: measured when the environment is built, with head room."""
    constraints_per_env: Natural = 0
    """MJX-Warp constraint rows per env; 0: measured likewise."""
    active_furniture: Natural | None = None
    """MJX backends: pieces of furniture near the robot that are simulated (auto: measured in these scenes; 0: all)."""
    active_small: Natural | None = None
    """MJX backends: small objects simulated at a time (auto: likewise; 0: all)."""
    active_doors: Natural | None = None
    """MJX backends: doors simulated at a time (auto: likewise; 0: all)."""
    active_walls: Natural | None = None
    """MJX backends: wall boxes that can be met at a time (auto: likewise; 0: all)."""
    active_dofs: Natural | None = None
    """MJX-Warp: degrees of freedom that are awake at a time, the robot's among them, if objects at rest sleep (auto:
    measured in these scenes; 0: all)."""
    sleep: bool = True
    """Native and warp: objects at rest sleep until touched."""
    threads: Natural = 0
    """Native backend: threads; 0: all cores."""

    IDLE = (
        (" ".join(WINDOW), "backend auto, jax or warp, or 0 (all)", lambda c: c.backend != "native"),
        (
            "contacts_per_env constraints_per_env active_dofs",
            "backend auto or warp",
            lambda c: c.backend in ("auto", "warp"),
        ),
        ("threads", "backend auto or native", lambda c: c.backend in ("auto", "native")),
    )

    def __post_init__(self) -> None:
        super().__post_init__()
        control, sim = self.control_dt_s, self.sim_dt_s
        if abs(control / sim - round(control / sim)) > 1e-6:
            raise ConfigError(f"sim_dt_s is {sim}, expected a divisor of control_dt_s ({control} s)")

    @property
    def substeps(self) -> int:
        """Return the number of physics steps per control step."""
        return round(self.control_dt_s / self.sim_dt_s)


_OF_DEPTH, _OF_RGB = (
    " ".join(field.name for field in dataclasses.fields(CameraNoise) if field.name.startswith(part))
    for part in ("depth", "rgb")
)
_OF_IMAGES = "cameras robot_visible image_size image_fov_deg image_dtype image_geometry renderer frame_dropout"


def _only_with(settings: str, *parts: str) -> tuple[str, str, Callable[[Any], bool]]:
    """Return an entry of `IDLE`: settings without effect unless one of these parts is observed."""
    which = parts[0] if len(parts) == 1 else f"one of {', '.join(parts)}"
    return settings, f"{which} among observations", lambda c: any(part in c.observations for part in parts)


@dataclasses.dataclass(frozen=True)
class SensorConfig(CameraNoise):
    """Set what the robot perceives, and how noisily."""

    observations: tuple[str, ...] = OBSERVATIONS
    """Parts of the observation; the vector keeps the original's order: waypoints, goal, velocity, then localisation,
    odometry, collision, joints, lidar, trail. With images (depth, segmentation, rgb, normals) it is a dict."""
    renderer: Literal["auto", "warp", "rays"] = "auto"
    """Renderer: warp (MJX-Warp's), rays (plain JAX), or auto: warp beside physics on warp, rays elsewhere."""
    image_geometry: Literal["boxes", "meshes"] = "boxes"
    """Images show collision boxes, or visual meshes with textures (rendered by Warp, with any physics)."""
    cameras: Sequence[Mapping[str, Any]] = ()
    """Cameras that replace the robot's, each a mapping of settings of `CameraView`."""
    robot_visible: bool = False
    """Show the robot's body in images, except for the housing of its camera."""
    random_colours: NotNegative = 0.0
    """Standard deviation of the logarithm of the red, green and blue factors of each object class in each episode."""
    random_light: NotNegative = 0.0
    """Standard deviation of the sun's direction (before normalisation) and of the brightness, in stops, by episode."""
    image_size: ImageSide = 68
    """Side of the square images, pixels."""
    image_fov_deg: FovDeg = None
    """Field of view; none: the robot's camera's (120 degrees)."""
    image_dtype: Literal["float32", "float16", "uint8"] = "float32"
    """Type of images: float32 or float16 in [0, 1], or uint8, 255 times that; normals are in [-1, 1], never uint8."""
    depth_range_m: Positive = 5.0
    """Depth is clipped at this value and divided by it."""
    segmentation_classes: MaskClasses = 4
    """Furniture classes: 4 as in the original's code (desk and table are one), the paper's 5, or all categories."""
    depth_dropout: Share = 0.0
    """Share of depth pixels that read 0, drawn in each step."""
    depth_noise: NotNegative = 0.0
    """Standard deviation of depth, as a share of it."""
    lidar_rays: AtLeastOne = 228
    """Beams of the planar scan, evenly over `lidar_fov_deg` from the right; by default the TurtleBot's Hokuyo."""
    lidar_fov_deg: Annotated[Positive, Bounds(0, 360)] = 240.0
    """Angle of the scan, centred straight ahead."""
    lidar_range_m: Positive = 5.6
    """Distances are divided by it; 1 if nothing is nearer."""
    lidar_pos_m: tuple[float, float, float] = (0.0, 0.0, 0.37)
    """Scanner in the robot's base frame."""
    lidar_dropout: Share = 0.0
    """Share of beams that read 1, drawn in each step."""
    lidar_noise: NotNegative = 0.0
    """Standard deviation of a beam's distance, as a share of it."""
    odometry_noise: NotNegative = 0.0
    """Standard deviation of each step's distance and angle in odometry, as a share of them."""

    IDLE = (
        _only_with(_OF_IMAGES, *IMAGES),
        _only_with(f"depth_range_m depth_dropout depth_noise {_OF_DEPTH}", "depth"),
        _only_with(f"random_colours random_light {_OF_RGB}", "rgb"),
        _only_with("lidar_rays lidar_fov_deg lidar_range_m lidar_pos_m lidar_dropout lidar_noise", "lidar"),
        _only_with("odometry_noise", "odometry"),
    )

    def __post_init__(self) -> None:
        allowed = (*SIGNALS, *IMAGES)
        if not self.observations or len(set(self.observations) & set(allowed)) != len(self.observations):
            raise ConfigError(f"observations is {self.observations!r}, expected a choice from {', '.join(allowed)}")
        if self.image_geometry == "meshes" and self.renderer == "rays":
            raise ConfigError("renderer is 'rays', expected auto or warp with image_geometry=meshes")
        super().__post_init__()
        names = [view.name for view in self.views]
        if self.cameras and (len(set(names)) < len(names) or not all(name.isidentifier() for name in names)):
            raise ConfigError(f"cameras have the names {names}, expected a different one for each, a word as front")

    @property
    def views(self) -> tuple[CameraView, ...]:
        """Return the cameras; where none are listed, the robot's, without a name."""
        return tuple(overlay(CameraView(), view, "cameras") for view in self.cameras) or (CameraView(),)


_Steps = Annotated[int, Bounds(0, 100)]


@dataclasses.dataclass(frozen=True)
class RandomDynamics(Settings):
    """Set ranges (low, high) from which each episode draws its dynamics uniformly; the defaults change nothing."""

    random_mass: tuple[Positive, Positive] = (1.0, 1.0)
    """Factor of the mass of all movable objects, drawn by episode: low,high."""
    random_friction: tuple[Positive, Positive] = (1.0, 1.0)
    """Factor of the friction of all movable objects, which holds on the floor, by episode: low,high."""
    random_motor_gain: tuple[NotNegative, NotNegative] = (1.0, 1.0)
    """Velocity of the base that the motors execute, as a share of the commanded one, by episode: low,high."""
    random_wheel_slip: tuple[Share, Share] = (0.0, 0.0)
    """Share of their speed that the wheels of a side lose, by episode and side: low,high."""
    random_motor_delay_steps: tuple[_Steps, _Steps] = (0, 0)
    """Control steps from an action to its execution, by episode: low,high. Before that, commands are 0."""
    random_sensor_delay_steps: tuple[_Steps, _Steps] = (0, 0)
    """Age of observations in control steps, by episode: low,high. The first one repeats at the start."""

    def __post_init__(self) -> None:
        super().__post_init__()
        for name in (field.name for field in dataclasses.fields(RandomDynamics)):
            low, high = getattr(self, name)
            if low > high:
                raise ConfigError(f"{name} is {(low, high)}, expected the smaller number first; write {(high, low)}")


@dataclasses.dataclass(frozen=True)
class NavConfig(SensorConfig, PhysicsConfig, RandomDynamics, TaskRules):
    """Settings of an environment (defaults: reference benchmark, section 11); impossible ones raise `ConfigError`."""


def make_config(variant: str = "paper", **settings: Any) -> NavConfig:
    """Build a `NavConfig` from settings by name, which take precedence over those of the variant: `paper`, the
    defaults, or `code`: where the original's code differs from its paper, the code."""
    if variant not in VARIANTS:
        raise ConfigError(f"variant is {variant!r}, expected one of {', '.join(VARIANTS)}")
    return NavConfig.of(**{**VARIANTS[variant], **settings})
