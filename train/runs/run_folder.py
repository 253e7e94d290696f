"""Keep one run's folder: config, versions, metrics, TensorBoard events, summary; name the files of its rows.

<out_dir>/<name>/config.yaml       what was run, every value resolved
                 versions.json     packages, device, commit
                 metrics.jsonl     one line a log interval
                 tensorboard/      the same as events
                 checkpoints/      see `checkpoint`
                 summary.json      how it ended
                 robot/            the file of the user's robot
                 lock              held by the process that trains it
"""

import dataclasses
import re
import shutil
import tempfile
from pathlib import Path
from typing import Any

from interactive_nav_common.config import Natural, NotNegative, flatten, replace
from interactive_nav_common.errors import FileError, readable
from interactive_nav_common.files import write_json, write_text, writing
from interactive_nav_common.records import METRICS, RUNS, read_metrics
from interactive_nav_common.rows import digest_of
from interactive_nav_common.runs.folder import CONFIG, VERSIONS, refuse_changes
from interactive_nav_common.versions import versions
from train.config import TrainConfig
from train.config_io import from_yaml, to_yaml

MAY_CHANGE = (
    *("run.name", "run.out_dir", "run.num_timesteps", "run.keep_checkpoints", "run.tensorboard"),
    *("run.wandb", "run.wandb_project", "run.devices"),
    *("run.env_state_limit_mb", "env.threads"),
)
"""Settings that a run may be continued with at other values: they change nothing of an update but, with
`run.devices`, the groups that minibatches are shuffled in."""
HEADROOM_MB = 64.0


@dataclasses.dataclass(frozen=True)
class _Origin:
    """The fields of summary.json and versions.json that are read."""

    completed: bool = False
    env_steps: Natural | None = None
    wall_s: NotNegative | None = None
    device: dict[str, Any] | None = None
    commit: str | None = None


class RunFolder:
    """Paths of a run, and the small files in it."""

    def __init__(self, path: Path):
        self.path = path
        self.config = path / CONFIG
        self.metrics = path / METRICS
        self.checkpoints = path / "checkpoints"
        self.tensorboard = path / "tensorboard"
        self.summary = path / "summary.json"
        self.lock = path / "lock"
        self.robot = path / "robot"

    def read_config(self) -> TrainConfig:
        """Return the resolved config of the run."""
        if not self.config.is_file():
            raise FileError(f"{self.path}: is no run folder (no config.yaml); expected <out_dir>/<name> of a run")
        with readable(self.config, FileError, "fetch the run again", " as the config of a run"):
            text = self.config.read_text(encoding="utf-8")
        if not text.strip():
            raise FileError(f"{self.config}: is empty, expected the config of a run; fetch the run again")
        config, robot = from_yaml(text, where=str(self.config)), self._kept_robot()
        return dataclasses.replace(config, env=replace(config.env, robot=robot[0])) if robot else config

    def _kept_robot(self) -> tuple[str, str] | None:
        """Return the reference and identity of the user's robot."""
        if not self.robot.is_dir():
            return None
        from interactive_nav.robots.reference import recorded_robot  # heavy, and most runs need none

        return recorded_robot(self.robot)

    def open(self, config: TrainConfig) -> bool:
        """Write config and versions of a new run, or check that one that exists (True) is continued as it began."""
        from interactive_nav.robots.reference import identity, record_robot

        exists = self.config.is_file()
        if exists:
            old, new, robot = flatten(self.read_config()), flatten(config), self._kept_robot()
            old["env.robot"] = robot[1] if robot else old["env.robot"]
            new["env.robot"] = identity(config.env.robot)
            fixed = {name: value for name, value in new.items() if name not in MAY_CHANGE}
            refuse_changes(self.path, old, fixed, "set run.name to begin another run, or remove the folder")
        write_text(self.config, to_yaml(config))
        record_robot(config.env.robot, self.robot)
        write_json(self.path / VERSIONS, versions())
        return exists

    def origin(self) -> dict[str, Any]:
        """Return the numbers' origin: env_steps and wall_s so far, device and commit; None where not recorded."""
        origin = _Origin()
        for path in (self.summary, self.path / VERSIONS):
            given = RUNS.json(path, {})
            read = RUNS.record(given, _Origin, str(path), others=True)
            origin = dataclasses.replace(origin, **{k: v for k, v in vars(read).items() if k in given})
        return {**vars(origin), "device": (origin.device or {}).get("kind")}

    def read_metrics(self) -> list[dict[str, Any]]:
        """Return the lines of metrics.jsonl; none where nothing was logged."""
        return read_metrics(self.metrics) if self.metrics.is_file() else []


def claim(path: Path, needed_mb: float = 0.0) -> None:
    """Create a folder and make sure that it can be written to."""
    needed_mb += HEADROOM_MB
    with writing(path, "expected a writable folder (run.out_dir)"):
        path.mkdir(parents=True, exist_ok=True)
        with tempfile.TemporaryFile(dir=path) as probe:  # of no fixed name: many may claim one folder at once
            probe.write(bytes(1 << 16))
        free_mb = shutil.disk_usage(path).free / 1e6
    if free_mb < needed_mb:
        raise FileError(
            f"{path}: {free_mb:.0f} MB free on its disk, expected {needed_mb:.0f} MB for checkpoints; "
            "make room, or set run.out_dir or run.env_state_limit_mb"
        )


@dataclasses.dataclass(frozen=True)
class EvaluationRequest:
    """The episodes and policies of an evaluation; together with the run it names a file of rows."""

    scenes: tuple[str, ...]
    policies: tuple[str, ...]
    episodes: int
    seed: int
    balanced: bool
    """Scenes take turns."""
    checkpoint: str
    deterministic: bool
    settings: tuple[str, ...] = ()
    """env.key=value words."""
    episode_file: str = ""
    """Digest of a file of episodes."""

    def file_name(self, run: str) -> str:
        """Return `<run>-<8 hex>.parquet`: the same request for a run replaces its file, another one adds one."""
        return f"{run}-{digest_of(dataclasses.asdict(self))}.parquet"


PATHS = "_paths"
"""Folder of recorded paths in a dataset; readers of a dataset pass over it."""


def files_of_run(dataset: Path, run: str, ending: str = ".parquet") -> list[Path]:
    """Return the files of rows in a dataset folder that are of one run."""
    name = re.compile(re.escape(run) + r"-[0-9a-f]{8}" + re.escape(ending))
    return sorted(path for path in dataset.glob(f"*{ending}") if name.fullmatch(path.name))


def paths_beside(rows: Path) -> Path:
    """Return where the recorded paths of a file of rows lie: in a dataset's `PATHS`."""
    in_dataset = re.search(r"-[0-9a-f]{8}\.parquet$", rows.name)
    folder = rows.parent / PATHS if in_dataset else rows.parent
    return folder / f"{rows.stem}.npz"
