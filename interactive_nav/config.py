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
Task = Literal["reach", "open", "clear", "fetch", "lift"]
"""Names of the tasks; `TaskRules.task` describes them."""
SIGNALS = (*OBSERVATIONS, "localisation", "odometry", "collision", "joints", "lidar", "hand")
"""Parts of the state vector."""
IMAGES = ("depth", "segmentation", "rgb", "normals")
"""Parts that are images."""
VARIANTS = read_packaged(Path(__file__).with_name("variants.yaml"), dict[str, dict[str, Any]])
ORIGINAL_CODE: dict[str, Any] = VARIANTS["code"]
"""Settings by which the original's code differs from its paper (reference benchmark, section 11)."""


@dataclasses.dataclass(frozen=True)
class TaskRules(Settings):
    """What the task is: goals, rewards, objects, what an action commands, and how episodes are scored."""

    task: Task = "reach"
    """Task: reach a place, open (a door by 60 degrees or a drawer by 0.2 m), clear (reach a place behind a door that
    must be pulled), fetch (touch furniture of a given category) or lift (raise an object of at most 6 kg by 0.1 m and
    carry it 0.5 m). Open and clear start with all doors shut."""
    control_mode: str = "native"
    """Control mode of the robot, which decides what an action commands; `native` is the original benchmark's."""
    symmetric_actions: bool = False
    """Let action 0 command nothing; the original's ranges are lopsided (TurtleBot's wheels: -12.5 to 25 rad/s)."""
    hook_force_n: NotNegative = 0.0
    """Largest force in N of a hook at a wheeled robot's front, or at its hand if the control mode moves that (100 pulls
    doors and lifts chairs); 0: no hook. It adds one action: above 0 couples it to an object within 0.1 m, below 0 lets
    go."""
    num_objects: Natural = 10
    """Number of small objects that lie on the floor, at random places in each episode."""
    small_objects: Literal["train", "test"] = "train"
    """Models of the small objects: train, or test (these occur in no training episode)."""
    objects: tuple[str, ...] = ()
    """Folders of small objects that `python -m converters object` wrote, relative to the current folder. They replace
    the built-in ones and take turns until there are num_objects."""
    doors_shut: Annotated[tuple[float, float], Bounds(0, 1)] = (0.0, 0.0)
    """Range of how far doors of rooms are shut at the start: 0 as built, 1 at the farther end of the door's range.
    Doors that are built at an end stay there; the others are spread over the range, the same in every episode."""
    k_int: NotNegative = 0.1
    """Interaction penalty per control step in which the robot touches a movable object."""
    success_reward: float = 10.0
    """Reward for reaching the goal."""
    episode_steps: AtLeastOne = 1000
    """Number of control steps after which an episode ends."""
    success_distance_m: Positive | None = None
    """Distance to the goal in m that counts as success; auto: the original code's, 0.333 m for a TurtleBot."""
    min_goal_distance_m: float = 1.0
    """Least straight distance between start and goal on the floor in m."""
    max_goal_distance_m: float = math.inf
    """Largest length of the shortest path from start to goal in m; inf: any."""
    num_waypoints: AtLeastOne = 10
    """Number of waypoints along the shortest path that the robot observes."""
    waypoint_spacing_m: Positive = 0.2
    """Distance along the path between two waypoints in m."""
    nav_cell_m: Positive = 0.1
    """Side of a cell of the navigation grid in m."""
    success_in_3d: bool = False
    """Measure the distance to the goal in space, as the original code does, instead of on the floor."""
    fail_when_lifted: bool = False
    """End the episode as a failure when the base rises 0.2 m above its standing height; rows count it anyway."""
    interaction_with: Literal["movables", "anything"] = "movables"
    """Contacts that cost k_int: of any part with movable objects, or with anything (walls too, wheels exempt)."""
    kinematic_sum: Literal["all", "touched"] = "all"
    """Objects that count in the kinematic effort: all, or touched ones (each from its first touch on)."""
    force_part: Literal["full", "normal"] = "full"
    """Force in the dynamic effort: the full contact force, or its normal part (no friction, wheels exempt)."""
    force_sum: Literal["vector", "contacts", "last_substep"] = "vector"
    """Force F_t of a control step: the norm of the vector sum (vector) or the sum of the contacts' norms (contacts),
    averaged over substeps, or the vector sum of the last substep."""
    score_gravity_m_s2: Positive = 9.81
    """Gravity g in the dynamic effort, in m/s^2."""
    robot_mass: Literal["total", "links", "base"] = "total"
    """Mass m_0 in the scores: of all links (total), all but the root link (links), or the root link (base)."""
    clip_path_efficiency: bool = True
    """Limit the path efficiency P_eff to 1."""
    effort_on_failure: bool = True
    """Count the effort efficiency E_eff of failures too; otherwise it is 0 there, as in the original's log."""
    waypoint_style: Literal["ahead", "grid"] = "ahead"
    """Place of waypoints: at equal distances ahead, or from the robot's grid cell, as in the original code."""
    potential: Literal["continuous", "quantised"] = "continuous"
    """Start of the shortest path in the reward: the robot's position, or the centre of its cell (quantised)."""
    potential_round: Positive | None = None
    """Let the path in the reward avoid furniture, where it stood at the start, whose friction exceeds this share of the
    robot's weight (1: too heavy to push), if such a path exists; auto: no. Scores ignore it."""
    waypoints_round: bool = False
    """Let waypoints avoid the furniture of potential_round too, as if it stood on the robot's map."""
    scene_choice: Literal["episode", "slot"] = "episode"
    """Draw a scene for each episode, or keep one for each environment of a batch (slot; `AutoResetEnv`)."""
    goal_clear: bool = True
    """Keep goals free of contact with anything; otherwise only with structure."""
    random_object_yaw: bool = True
    """Turn small objects at random; otherwise they all have yaw 0."""
    bootstrap_at_time_limit: bool = True
    """Let learners bootstrap at the time limit; otherwise it looks like any other end."""

    IDLE = (
        ("small_objects objects", "num_objects above 0", lambda c: c.num_objects > 0),
        ("doors_shut", "task reach, fetch or lift", lambda c: c.task in ("reach", "fetch", "lift")),
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
    """Physics: warp (MJX-Warp, NVIDIA GPUs), jax (MJX-JAX), native (C MuJoCo on CPU threads), or auto."""
    control_dt_s: Positive = 0.1
    """Control period in s."""
    sim_dt_s: Positive = 0.02
    """Time step of the physics in s; it must divide the control period."""
    collision: Literal["boxes", "hulls"] = "boxes"
    """Collision shapes of furniture: boxes (any backend, any mix of scenes) or hulls (native, one scene)."""
    solver_iterations: AtLeastOne = 10
    """Number of Newton iterations of the constraint solver in a physics step."""
    contact_time_constant_s: Positive = 0.05
    """Time constant of contacts in s (MuJoCo's solref); MuJoCo raises it to at least two time steps. With 0.05 s, steps
    of 0.02 s stay within 10 % of a fine reference in pushes (docs/fidelity.md)."""
    cone: Literal["pyramidal", "elliptic"] = "pyramidal"
    """Friction cones: pyramidal, or elliptic (native only: MJX-Warp's Newton solver fails on them)."""
    contacts_per_env: Natural = 0
    """Contact slots of each environment in MJX-Warp; 0: measured at the start, with a margin."""
    constraints_per_env: Natural = 0
    """Constraint rows of each environment in MJX-Warp; 0: measured at the start, with a margin."""
    active_furniture: Natural | None = None
    """Most pieces of furniture near the robot that MJX simulates (auto: measured in these scenes; 0: all)."""
    active_small: Natural | None = None
    """Most small objects that MJX simulates at a time (auto: measured in these scenes; 0: all)."""
    active_doors: Natural | None = None
    """Most doors that MJX simulates at a time (auto: measured in these scenes; 0: all)."""
    active_walls: Natural | None = None
    """Most wall boxes that MJX checks for contact at a time (auto: measured in these scenes; 0: all)."""
    active_dofs: Natural | None = None
    """Most degrees of freedom that are awake at a time in MJX-Warp if objects at rest sleep, including the robot's
    (auto: measured in these scenes; 0: all)."""
    sleep: bool = True
    """Let objects at rest sleep until something touches them (native and warp)."""
    threads: Natural = 0
    """Number of threads of the native backend; 0: all cores."""

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
    """Parts of the observation. The vector has this order: waypoints, goal, velocity (the original's), localisation,
    odometry, collision, joints, lidar, hand. With images (depth, segmentation, rgb, normals) it is a dict."""
    renderer: Literal["auto", "warp", "rays"] = "auto"
    """Renderer: warp (MJX-Warp's), rays (plain JAX), or auto: warp with physics on warp, otherwise rays."""
    image_geometry: Literal["boxes", "meshes"] = "boxes"
    """Geometry in images: collision boxes, or visual meshes with textures (drawn by Warp, with any physics)."""
    cameras: Sequence[Mapping[str, Any]] = ()
    """Cameras that replace the robot's, each a mapping of settings of `CameraView`."""
    robot_visible: bool = False
    """Show the robot's body in images, except for the housing of its camera."""
    random_colours: NotNegative = 0.0
    """Standard deviation of the logarithm of the red, green and blue factors of each object class in each episode."""
    random_light: NotNegative = 0.0
    """Standard deviation of the sun's direction (before normalisation) and of the brightness in stops, by episode."""
    image_size: ImageSide = 68
    """Side of the square images in pixels."""
    image_fov_deg: FovDeg = None
    """Field of view in degrees; auto: the robot's camera's (120 degrees)."""
    image_dtype: Literal["float32", "float16", "uint8"] = "float32"
    """Type of images: float32 or float16 from 0 to 1, or uint8 from 0 to 255; normals are in [-1, 1], never uint8."""
    depth_range_m: Positive = 5.0
    """Depth in m at which it is clipped and by which it is divided."""
    segmentation_classes: MaskClasses = 4
    """Furniture classes: 4 as in the original code (desk and table are one), the paper's 5, or all categories."""
    depth_dropout: Share = 0.0
    """Share of depth pixels that read 0, drawn in each step."""
    depth_noise: NotNegative = 0.0
    """Standard deviation of depth, as a share of it."""
    lidar_rays: AtLeastOne = 228
    """Number of beams of the planar scan, evenly over `lidar_fov_deg` from the right (228: the TurtleBot's Hokuyo)."""
    lidar_fov_deg: Annotated[Positive, Bounds(0, 360)] = 240.0
    """Angle of the scan in degrees, centred straight ahead."""
    lidar_range_m: Positive = 5.6
    """Range of the scan in m, by which distances are divided; a beam reads 1 if nothing is nearer."""
    lidar_pos_m: tuple[float, float, float] = (0.0, 0.0, 0.37)
    """Position of the scanner in the frame of the robot's base, in m."""
    lidar_dropout: Share = 0.0
    """Share of beams that read 1, drawn in each step."""
    lidar_noise: NotNegative = 0.0
    """Standard deviation of a beam's distance, as a share of it."""
    odometry_noise: NotNegative = 0.0
    """Standard deviation of the distance and the angle of each step in odometry, as a share of them."""

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
    """Range (low,high) of a factor on the mass of all movable objects, drawn in each episode."""
    random_friction: tuple[Positive, Positive] = (1.0, 1.0)
    """Range of a factor on the friction of all movable objects with the floor, drawn in each episode."""
    random_motor_gain: tuple[NotNegative, NotNegative] = (1.0, 1.0)
    """Range of the share of the commanded base velocity that motors execute, drawn in each episode."""
    random_wheel_slip: tuple[Share, Share] = (0.0, 0.0)
    """Range of the share of their speed that the wheels of a side lose, drawn in each episode for each side."""
    random_motor_delay_steps: tuple[_Steps, _Steps] = (0, 0)
    """Range of the control steps from an action to its execution, drawn in each episode; commands are 0 until then."""
    random_sensor_delay_steps: tuple[_Steps, _Steps] = (0, 0)
    """Range of the age of observations in control steps, drawn in each episode; the first one repeats at the start."""

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
