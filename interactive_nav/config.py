"""The environment's settings: one frozen dataclass, checked on construction."""

from __future__ import annotations

import dataclasses
import difflib
import math
from collections.abc import Callable
from pathlib import Path
from typing import Any

from interactive_nav_common.errors import ConfigError
from scenes_mjcf.categories import MaskClasses

OBSERVATIONS = ("goal", "velocity", "waypoints")
"""Parts of the observation by default."""
SIGNALS = (*OBSERVATIONS, "localisation", "odometry", "collision", "joints", "lidar")
"""Parts of the state vector."""
IMAGES = ("depth", "segmentation")
CHOICES: dict[str, tuple[Any, ...]] = {
    "backend": ("auto", "warp", "jax", "native"),
    "collision": ("boxes", "hulls"),
    "cone": ("pyramidal", "elliptic"),
    "small_objects": ("train", "test"),
    "interaction_with": ("movables", "anything"),
    "kinematic_sum": ("all", "touched"),
    "force_part": ("full", "normal"),
    "force_sum": ("vector", "contacts", "last_substep"),
    "robot_mass": ("total", "links", "base"),
    "waypoint_style": ("ahead", "grid"),
    "potential": ("continuous", "quantised"),
    "scene_choice": ("episode", "slot"),
    "renderer": ("auto", "warp", "rays"),
    "image_dtype": ("float32", "float16", "uint8"),
    "segmentation_classes": (4, 5, "all"),
}
"""Settings that are one of a few values."""
_BOUNDS: tuple[tuple[str, str, Callable[[Any], bool]], ...] = (
    ("num_objects contacts_per_env constraints_per_env threads k_int active_furniture active_small active_doors "
     "active_walls depth_noise lidar_noise odometry_noise", "0 or more", lambda x: x >= 0),
    ("episode_steps num_waypoints solver_iterations image_size lidar_rays", "at least 1", lambda x: x >= 1),
    ("control_dt_s sim_dt_s waypoint_spacing_m nav_cell_m max_goal_distance_m contact_time_constant_s "
     "score_gravity_m_s2 depth_range_m lidar_range_m", "a positive number", lambda x: x > 0),
    ("depth_dropout lidar_dropout", "between 0 and 1", lambda x: 0 <= x <= 1),
    ("success_distance_m", "a positive number or none", lambda x: x is None or x > 0),
    ("image_fov_deg", "between 0 and 180, or none", lambda x: x is None or 0 < x < 180),
    ("lidar_fov_deg", "between 0 and 360", lambda x: 0 < x <= 360),
    ("lidar_pos_m", "three numbers", lambda x: len(x) == 3),
)  # fmt: skip
"""Settings with bounds: their names, what is expected, and the test of it."""
_IDLE: tuple[tuple[str, str, Callable[[Any], bool]], ...] = (
    ("active_furniture active_small active_doors active_walls", "backend auto, jax or warp, or 0 (all)",
     lambda c: c.backend != "native"),
    ("contacts_per_env constraints_per_env", "backend auto or warp", lambda c: c.backend in ("auto", "warp")),
    ("threads", "backend auto or native", lambda c: c.backend in ("auto", "native")),
    ("image_size image_dtype renderer", "depth or segmentation among observations",
     lambda c: any(name in c.observations for name in IMAGES)),
    ("depth_range_m depth_dropout depth_noise", "depth among observations", lambda c: "depth" in c.observations),
    ("lidar_rays lidar_fov_deg lidar_range_m lidar_pos_m lidar_dropout lidar_noise", "lidar among observations",
     lambda c: "lidar" in c.observations),
    ("odometry_noise", "odometry among observations", lambda c: "odometry" in c.observations),
    ("small_objects", "num_objects above 0", lambda c: c.num_objects > 0),
)  # fmt: skip
"""Settings that change nothing but where something holds: their names, what, and the test of it. With backend auto,
settings of all backends may stand side by side."""
ORIGINAL_CODE: dict[str, Any] = {
    "episode_steps": 500,
    "success_in_3d": True,
    "fail_when_lifted": True,
    "interaction_with": "anything",
    "kinematic_sum": "touched",
    "force_part": "normal",
    "score_gravity_m_s2": 9.8,
    "robot_mass": "links",
    "effort_on_failure": False,
    "waypoint_style": "grid",
    "potential": "quantised",
    "scene_choice": "slot",
    "goal_clear": False,
    "random_object_yaw": False,
    "bootstrap_at_time_limit": False,
}
"""What the original's code did where it differs from its paper (reference benchmark, section 11)."""
VARIANTS: dict[str, dict[str, Any]] = {"paper": {}, "code": ORIGINAL_CODE}


@dataclasses.dataclass(frozen=True)
class NavConfig:
    """Settings of an interactive navigation environment (defaults: reference benchmark, section 11)."""

    backend: str = "auto"
    """Physics: warp (MJX-Warp, NVIDIA), jax (MJX-JAX), native (C MuJoCo on CPU threads), or auto."""
    control_mode: str = "native"
    """What an action commands: a control mode of the robot; `native` is the original benchmark's."""
    symmetric_actions: bool = False
    """Action 0 commands nothing; the original's ranges are lopsided (TurtleBot's wheels: -12.5 to 25 rad/s)."""
    num_objects: int = 10
    """Small objects strewn about at random each episode."""
    small_objects: str = "train"
    """Whose models the small objects are: train, or test, which no training episode shows."""
    objects: tuple[str, ...] = ()
    """Folders of `python -m converters object`, relative to the current folder: they are the small objects in place of
    the built-in ones, in turn until there are num_objects."""
    observations: tuple[str, ...] = OBSERVATIONS
    """Parts of the observation; the vector keeps the original's order: waypoints, goal, velocity, then localisation,
    odometry, collision, joints, lidar. With images (depth, segmentation) the observation is a dict."""
    k_int: float = 0.1
    """Interaction penalty per control step in which the robot touches a movable object."""
    success_reward: float = 10.0
    """Reward of reaching the goal."""
    episode_steps: int = 1000
    """Control steps before an episode is cut."""
    control_dt_s: float = 0.1
    """Control period."""
    sim_dt_s: float = 0.02
    """Physics timestep; must divide the control period."""
    collision: str = "boxes"
    """Furniture collides as boxes (any backend, any mix of scenes) or hulls (native, one scene)."""
    success_distance_m: float | None = None
    """Planar distance to the goal that counts as success; none: the robot's body width."""
    min_goal_distance_m: float = 1.0
    """Least planar distance between start and goal."""
    max_goal_distance_m: float = math.inf
    """Largest geodesic distance between start and goal; infinite: any."""
    num_waypoints: int = 10
    """Waypoints along the shortest path in the observation."""
    waypoint_spacing_m: float = 0.2
    """Arc length between waypoints."""
    nav_cell_m: float = 0.1
    """Cell side of the navigation grid."""
    success_in_3d: bool = False
    """Success by the distance in space to the goal on the floor, as the original's code; else in the plane."""
    fail_when_lifted: bool = False
    """End the episode as a failure when the base rises 0.2 m above its standing height; it is counted anyway."""
    interaction_with: str = "movables"
    """Touches that cost k_int: movables (any part of the robot) or anything (walls too, but wheels exempt)."""
    kinematic_sum: str = "all"
    """Objects in the kinematic effort: all, or touched (each from the step of its first touch on)."""
    force_part: str = "full"
    """Force in the dynamic effort: full contact force, or normal (without friction, wheels exempt)."""
    force_sum: str = "vector"
    """F_t: norm of the vector sum (vector) or sum of the contacts' norms (contacts), mean over the substeps; or the
    vector sum of the last_substep only."""
    score_gravity_m_s2: float = 9.81
    """g in the dynamic effort."""
    robot_mass: str = "total"
    """m_0 in the scores: total, links (all but the root link) or base (the root link alone)."""
    clip_path_efficiency: bool = True
    """P_eff at most 1."""
    effort_on_failure: bool = True
    """E_eff counts on failures; else it is 0 there, as the original's log had it."""
    waypoint_style: str = "ahead"
    """ahead: at equal arc length ahead; grid: from the robot's own cell, as the original's code."""
    potential: str = "continuous"
    """Geodesic distance from the robot's position, or quantised: from the centre of its cell."""
    scene_choice: str = "episode"
    """Each episode draws a scene, or each environment of a batch keeps one (slot; `AutoResetEnv`)."""
    goal_clear: bool = True
    """Goals are free of contact for the robot; else only of structure."""
    random_object_yaw: bool = True
    """Small objects are turned at random; else they all have yaw 0."""
    bootstrap_at_time_limit: bool = True
    """The time limit is a truncation, at which learners bootstrap; else it looks like any other end."""
    solver_iterations: int = 10
    """Newton iterations of the constraint solver per physics step."""
    contact_time_constant_s: float = 0.05
    """Time constant of contacts (MuJoCo's solref); MuJoCo raises it to twice the timestep where it is less. This one
    lets 0.02 s stay within 10 % of a fine reference in pushes (docs/fidelity.md)."""
    cone: str = "pyramidal"
    """Friction cones: pyramidal, or elliptic (native only: MJX-Warp's Newton solver fails on them)."""
    contacts_per_env: int = 0
    """MJX-Warp contact slots per env; 0: measured when the environment is built, with head room."""
    constraints_per_env: int = 0
    """MJX-Warp constraint rows per env; 0: measured likewise."""
    active_furniture: int = 5
    """MJX backends: pieces of furniture simulated at a time, the nearest to the robot; 0: all."""
    active_small: int = 4
    """MJX backends: small objects simulated at a time; 0: all."""
    active_doors: int = 2
    """MJX backends: doors simulated at a time; 0: all."""
    active_walls: int = 32
    """MJX backends: wall boxes that can be met at a time; 0: all."""
    sleep: bool = True
    """Native backend: objects at rest sleep until touched."""
    threads: int = 0
    """Native backend: threads; 0: all cores."""
    renderer: str = "auto"
    """Who draws: warp (MJX-Warp's), rays (plain JAX), or auto: warp beside physics on warp, rays elsewhere."""
    image_size: int = 68
    """Side of the square images, pixels."""
    image_fov_deg: float | None = None
    """Field of view; none: the robot's camera's (120 degrees)."""
    image_dtype: str = "float32"
    """Of images: float32 or float16 in [0, 1], or uint8, 255 times that."""
    depth_range_m: float = 5.0
    """Depth is cut off here and divided by it."""
    segmentation_classes: MaskClasses = 4
    """Furniture classes: 4 as in the original's code (desk and table are one), the paper's 5, or all: every category
    has an id of its own."""
    depth_dropout: float = 0.0
    """Share of depth pixels that read 0, drawn anew each step."""
    depth_noise: float = 0.0
    """Standard deviation of depth, as a share of it."""
    lidar_rays: int = 228
    """Beams of the planar scan, evenly over `lidar_fov_deg` from the right; by default the TurtleBot's Hokuyo."""
    lidar_fov_deg: float = 240.0
    """Angle that the scan covers, ahead in its middle."""
    lidar_range_m: float = 5.6
    """Distances are divided by it; 1 where nothing is nearer."""
    lidar_pos_m: tuple[float, float, float] = (0.0, 0.0, 0.37)
    """Scanner in the robot's base frame."""
    lidar_dropout: float = 0.0
    """Share of beams that read 1, drawn anew each step."""
    lidar_noise: float = 0.0
    """Standard deviation of a beam's distance, as a share of it."""
    odometry_noise: float = 0.0
    """Standard deviation of each step's distance and angle in odometry, as a share of them."""

    def __post_init__(self) -> None:
        def refuse(field: str, expected: str) -> None:
            raise ValueError(f"{field} is {getattr(self, field)!r}, expected {expected}")

        object.__setattr__(self, "observations", tuple(self.observations))
        if isinstance(self.objects, (str, Path)):
            refuse("objects", f"a list of object folders; write ['{self.objects}']")
        object.__setattr__(self, "objects", tuple(str(folder) for folder in self.objects))
        object.__setattr__(self, "lidar_pos_m", tuple(self.lidar_pos_m))
        for field, choices in CHOICES.items():
            if getattr(self, field) not in choices:
                refuse(field, f"one of {', '.join(map(str, choices))}")
        if self.objects and self.small_objects != "train":
            refuse("small_objects", "train, its default: with objects there are no built-in models to choose from")
        known = (*SIGNALS, *IMAGES)
        unknown = [o for o in self.observations if o not in known]
        if unknown or not self.observations or len(set(self.observations)) != len(self.observations):
            refuse("observations", f"a choice from {', '.join(known)}")
        for names, expected, within in _BOUNDS:
            for field in names.split():
                if not within(getattr(self, field)):
                    refuse(field, expected)
        if not 0 <= self.min_goal_distance_m < self.max_goal_distance_m:
            bound = f"0 or more and less than max_goal_distance_m ({self.max_goal_distance_m})"
            refuse("min_goal_distance_m", bound)
        _refuse_idle(self)
        ratio = self.control_dt_s / self.sim_dt_s
        if abs(ratio - round(ratio)) > 1e-6:
            refuse("sim_dt_s", f"a divisor of control_dt_s ({self.control_dt_s} s)")

    @property
    def substeps(self) -> int:
        """Physics steps per control step."""
        return round(self.control_dt_s / self.sim_dt_s)

    @property
    def needs_contacts(self) -> bool:
        """Whether an option looks at single contacts, not just at each body's net force."""
        return self.interaction_with == "anything" or self.force_part == "normal" or self.force_sum == "contacts"


def _refuse_idle(config: NavConfig) -> None:
    """Raises `ConfigError` for a setting that is not its default and has no effect beside the others."""
    default = {field.name: field.default for field in dataclasses.fields(NavConfig)}
    for names, needs, used in _IDLE:
        for name in names.split():
            value = getattr(config, name)
            all_of_them = name.startswith("active_") and value == 0
            if value != default[name] and not all_of_them and not used(config):
                raise ConfigError(f"{name} is {value!r}, which changes nothing here: expected {needs}; or leave it out")


def original_code(**settings: Any) -> NavConfig:
    """All values of the original's code at once (`ORIGINAL_CODE`), and settings by name over them."""
    return make_config(variant="code", **settings)


def make_config(variant: str = "paper", **settings: Any) -> NavConfig:
    """A `NavConfig` from settings by name.

    Args:
        variant: `paper`, the defaults, or `code`: where the original's code differs from its paper, the code.
        **settings: fields of `NavConfig`; they go before the variant's.

    Raises:
        ValueError: unknown variant or setting (the message names the nearest valid one) or impossible value.
    """
    if variant not in VARIANTS:
        raise ValueError(f"variant is {variant!r}, expected one of {', '.join(VARIANTS)}")
    fields = {f.name for f in dataclasses.fields(NavConfig)}
    for key in settings:
        if key not in fields:
            near = difflib.get_close_matches(key, fields, 1)
            hint = f"did you mean '{near[0]}'? " if near else ""
            raise ValueError(f"unknown setting '{key}'; {hint}known settings: {', '.join(sorted(fields))}")
    return NavConfig(**{**VARIANTS[variant], **settings})
