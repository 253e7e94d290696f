"""Expand one YAML file to a list of runs with their complete configs; every mistake is named in one line."""

import dataclasses
import itertools
import re
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Annotated, Any

from interactive_nav_common.config import (
    AtLeastOne,
    Bounds,
    Natural,
    NotNegative,
    Positive,
    Settings,
    flatten,
    nearest,
    nested,
    overlay,
)
from interactive_nav_common.errors import ConfigError
from interactive_nav_common.files import check_name
from scenes_mjcf.sets import scene_folders
from train import config_io
from train.config import TrainConfig, validate

SWEEP_DIR = config_io.PRESET_DIR / "sweeps"
BARE = ("algorithm", "env.robot")
"""Axes whose values name themselves in a run's name."""
PLACEHOLDER = re.compile(r"\{([^{}]*)\}")


@dataclasses.dataclass(frozen=True)
class EvaluateConfig(Settings):
    """The fixed episodes that every trained run plays; see `python -m train.evaluate --help`."""

    scenes: tuple[str, ...] = ()
    """Scene folders to play in; empty: those that the run was trained in."""
    episodes: AtLeastOne = 1000
    """Number of episodes that each run plays."""
    seed: Natural = 1_000_000
    """Random seed of the fixed episodes."""
    balanced: bool = True
    """Let scenes take turns; otherwise each episode draws one."""
    checkpoint: str = "best"
    """Checkpoint to play: best, last or a number of environment steps."""
    stochastic: bool = True
    """Sample actions instead of taking the most likely ones."""
    record: Natural = 8
    """Number of episodes whose paths are recorded."""
    episode_files: tuple[str, ...] = ()
    """Files of fixed episodes to play instead of drawn ones; `{robot}` stands for each run's robot."""
    batch: AtLeastOne | None = None
    """Number of episodes to play in parallel; auto: depends on the backend."""

    def __post_init__(self) -> None:
        super().__post_init__()
        if self.checkpoint not in ("best", "last") and not self.checkpoint.isdecimal():
            raise ConfigError(f"checkpoint is {self.checkpoint!r}, expected best, last or a number of env steps")


@dataclasses.dataclass(frozen=True)
class LaunchConfig(Settings):
    """How runs share a machine."""

    runs_per_gpu: AtLeastOne = 1
    """Number of runs that share a GPU; one that runs out of memory is tried again with twice the share."""
    gpu_memory_gb: Positive | None = None
    """Memory in GB that one run needs: smaller GPUs run fewer than runs_per_gpu; auto: no check."""
    jax_memory_share: Annotated[float, Bounds(0.01, 1.0)] = 0.6
    """Part of a run's share of the GPU that JAX reserves; the rest is for Warp, the renderer and CUDA."""
    slots: AtLeastOne = 1
    """Number of runs at a time on a machine without a GPU; they share the cores."""
    cpus_per_run: AtLeastOne = 1
    """Number of CPU cores that a run reserves on a Ray cluster."""
    retries: Natural = 2
    """Number of times that one command restarts a crashed run, but not a refused config or diverged numbers."""
    grace_s: NotNegative = 300.0
    """Time in s that stopped runs have to write their checkpoints; compilations are not interrupted."""


@dataclasses.dataclass(frozen=True)
class Override(Settings):
    """What differs in some runs."""

    where: Mapping[str, Any] = dataclasses.field(default_factory=dict)
    """Axis -> value, or values, of the runs that it is for."""
    settings: Mapping[str, Any] = dataclasses.field(default_factory=dict)
    launch: Mapping[str, Any] = dataclasses.field(default_factory=dict)


@dataclasses.dataclass(frozen=True)
class SweepConfig(Settings):
    """A sweep as its file says it."""

    name: str = ""
    """Folder of the sweep in out_dir; empty: the file's name."""
    out_dir: str = "sweeps"
    """Folder of all sweeps."""
    preset: str = ""
    """Preset or YAML file of `python -m train` from which every run starts; {algorithm}, {env.robot} and the like stand
    for the run's value."""
    grid: Mapping[str, Sequence[Any]] = dataclasses.field(default_factory=dict)
    """Values of each dotted setting; every combination is a run, and the last setting varies fastest."""
    settings: Mapping[str, Any] = dataclasses.field(default_factory=dict)
    """Settings of every run, which override the preset."""
    overrides: Sequence[Any] = ()
    """Settings of some runs: {where: {setting: value or values}, settings: {...}, launch: {...}}."""
    skip: Sequence[Any] = ()
    """Combinations to leave out: {setting: value or values}."""
    evaluate: EvaluateConfig = dataclasses.field(default_factory=EvaluateConfig)
    """The fixed episodes that every trained run plays."""
    launch: LaunchConfig = dataclasses.field(default_factory=LaunchConfig)
    """How runs share a machine."""


@dataclasses.dataclass(frozen=True)
class RunSpec:
    """One run of a sweep."""

    name: str
    values: Mapping[str, Any]
    """Its value on each axis of the grid."""
    config: TrainConfig
    """Complete; sizes may still be `auto`."""
    launch: LaunchConfig

    @property
    def cell(self) -> tuple[Any, ...]:
        """Return its values without the seed."""
        return tuple(str(value) for axis, value in self.values.items() if axis != "run.seed")


@dataclasses.dataclass(frozen=True)
class Sweep:
    """A sweep, expanded."""

    config: SweepConfig
    root: Path
    runs: tuple[RunSpec, ...]


def load_sweep(name_or_path: str) -> Sweep:
    """Read a sweep by name or path."""
    path, plain = config_io.read_file(name_or_path, SWEEP_DIR, "sweep")
    return expand(plain, path.name, path.stem)


def expand(plain: Any, where: str, default_name: str) -> Sweep:
    """Expand nested plain values to a sweep's runs with their complete configs."""
    config = overlay(SweepConfig(), plain, where)
    name = check_name(config.name or default_name, f"{where}: name", ConfigError)
    if not config.preset:
        raise ConfigError(f"{where}: preset is missing; expected a preset, for example turtlebot_ppo")
    evaluate = dataclasses.replace(config.evaluate, scenes=scene_folders(config.evaluate.scenes))
    config = dataclasses.replace(config, name=name, evaluate=evaluate)
    settings = list(flatten(TrainConfig()))
    for axis, values in config.grid.items():
        if axis not in settings:
            raise ConfigError(f"{where}: grid: unknown key {axis!r}{nearest(str(axis), settings)}")
        if axis in ("run.name", "run.out_dir"):
            raise ConfigError(f"{where}: grid: {axis} is chosen by the sweep")
        if not isinstance(values, list) or not values:
            raise ConfigError(f"{where}: grid: {axis}: got {values!r}, expected a list of values")
    axes = list(config.grid)
    overrides = [overlay(Override(), entry, f"{where}: overrides[{i}]") for i, entry in enumerate(config.overrides)]
    matching = [_where(entry.where, config, f"{where}: overrides[{i}]") for i, entry in enumerate(overrides)]
    skips = [_where(entry, config, f"{where}: skip[{i}]") for i, entry in enumerate(config.skip)]
    root = Path(config.out_dir) / config.name
    runs: dict[str, RunSpec] = {}
    for combination in itertools.product(*config.grid.values()):
        values = dict(zip(axes, combination, strict=True))
        if any(_matches(skip, values) for skip in skips):
            continue
        name = _run_name(config, values) or "run"
        label = f"{where}: {name}"
        train = config_io.load_config(_filled(config.preset, values, where))
        launch = config.launch
        chosen = [each for each, at in zip(overrides, matching, strict=True) if _matches(at, values)]
        for layer in (config.settings, *(each.settings for each in chosen), values):
            train = config_io.from_dict(nested(layer.items(), label), train, label)
        for each in chosen:
            launch = overlay(launch, each.launch, label, "launch.")
        run = dataclasses.replace(train.run, name=name, out_dir=str(root / "runs"))
        train = config_io.with_scenes(dataclasses.replace(train, run=run))
        validate(train)
        if name in runs:
            raise ConfigError(f"{where}: two runs are named {name!r}; give the grid values that can be distinguished")
        runs[name] = RunSpec(name, values, train, launch)
    if not runs:
        raise ConfigError(f"{where}: no run is left of the grid; expected at least one that skip does not name")
    return Sweep(config, root, tuple(runs.values()))


def select(sweep: Sweep, where: Sequence[str]) -> Sweep:
    """Return one machine's part of a sweep: the runs that match all `setting=value[,value]` of `where`."""
    runs = list(sweep.runs)
    for word in where:
        axis, equals, text = word.partition("=")
        if not equals:
            raise ConfigError(f"--where {word!r}: expected setting=value[,value], for example env.robot=fetch")
        chosen = [config_io.parsed(item, f"--where {word!r}") for item in text.split(",")]
        wanted = _where({axis: chosen}, sweep.config, f"--where {word}")
        runs = [run for run in runs if _matches(wanted, run.values)]
    if not runs:
        raise ConfigError("no run of the sweep is left; expected --where to leave some")
    return dataclasses.replace(sweep, runs=tuple(runs))


def _where(entry: Any, config: SweepConfig, where: str) -> dict[str, list[Any]]:
    """Return axis -> the values that match."""
    wanted = {}
    if not isinstance(entry, Mapping):
        raise ConfigError(f"{where}: got {entry!r}, expected a mapping")
    for axis, value in entry.items():
        if axis not in config.grid:
            near = nearest(str(axis), list(config.grid))
            raise ConfigError(f"{where}: {axis!r} is no axis of the grid{near}; axes: {', '.join(config.grid)}")
        values = value if isinstance(value, list) and value not in config.grid[axis] else [value]
        for item in values:
            if item not in config.grid[axis]:
                raise ConfigError(f"{where}: {axis} is {item!r}, expected one of {config.grid[axis]}")
        wanted[axis] = values
    return wanted


def _matches(wanted: Mapping[str, list[Any]], values: Mapping[str, Any]) -> bool:
    return all(values[axis] in chosen for axis, chosen in wanted.items())


def _filled(preset: str, values: Mapping[str, Any], where: str) -> str:
    for axis in PLACEHOLDER.findall(preset):
        if axis not in values:
            near = nearest(axis, list(values))
            raise ConfigError(f"{where}: preset: {{{axis}}} is no axis of the grid{near}")
    return PLACEHOLDER.sub(lambda match: str(values[match[1]]), preset)


def _run_name(config: SweepConfig, values: Mapping[str, Any]) -> str:
    parts = []
    for axis, value in sorted(values.items(), key=lambda item: item[0] == "run.seed"):  # the seed comes last
        tail = "" if axis in BARE else axis.rpartition(".")[2]
        if isinstance(value, (list, dict)):
            value = config.grid[axis].index(value)
        shown = f"{value:g}" if isinstance(value, float) else str(value).lower()
        parts.append(re.sub(r"[^\w.+-]", "_", tail + shown))
    return "-".join(parts)
