"""Write a run's metrics to TensorBoard, and with `run.wandb=true` also to Weights & Biases (an optional extra).

WANDB_MODE=offline keeps everything in the run folder until `wandb sync`; other WANDB variables work as usual.
"""

import contextlib
import time
import uuid
from pathlib import Path
from typing import Any

from interactive_nav.robots import robot_name
from interactive_nav_common.config import flatten
from interactive_nav_common.errors import ConfigError, missing, optional
from interactive_nav_common.files import write_text, writing
from interactive_nav_common.runs.folder import GOES_ON
from train.config import TrainConfig

ID_FILE = "wandb_id"


def import_wandb() -> Any:
    return optional("wandb", missing("run.wandb=true", "wandb", "wandb", ", or set run.wandb=false"))


class Events:
    """Write TensorBoard files, one a session; each hides older values after its `env_steps`.

    tensorboardX's SummaryWriter is no option: its thread dies if the disk is full, and logging then waits for ever.
    """

    def __init__(self, folder: Path, env_steps: int):
        from tensorboardX import record_writer, summary  # imports PyTorch where there is one, which takes seconds
        from tensorboardX.proto.event_pb2 import Event, SessionLog

        self._folder, self._event, self._scalar = folder, Event, summary.scalar
        with writing(folder, GOES_ON):
            folder.mkdir(parents=True, exist_ok=True)
            self._file = record_writer.RecordWriter(str(folder / f"events.out.tfevents.{time.time():.6f}"))
            self._add(file_version="brain.Event:2")
            self._add(step=env_steps + 1, session_log=SessionLog(status=SessionLog.START))

    def _add(self, **content: Any) -> None:
        self._file.write(self._event(wall_time=time.time(), **content).SerializeToString())

    def log(self, env_steps: int, metrics: dict[str, float]) -> None:
        """Write the means of a log interval, on disk afterwards."""
        with writing(self._folder, GOES_ON):
            for name, value in metrics.items():
                self._add(step=env_steps, summary=self._scalar(name if "/" in name else f"run/{name}", value))
            self._file.flush()

    def close(self) -> None:
        """Close the file, full disk or not."""
        with contextlib.suppress(OSError):
            self._file.close()


class Tracker:
    """One run of Weights & Biases, whose id the run's folder keeps; a continued run goes on with the same one."""

    def __init__(self, folder: Path, config: TrainConfig, versions: dict[str, Any]):
        wandb = import_wandb()
        kept = folder / ID_FILE
        if not kept.is_file():
            write_text(kept, uuid.uuid4().hex[:12] + "\n")
        try:
            self._run = wandb.init(
                project=config.run.wandb_project,
                name=config.run.name,
                id=kept.read_text().strip(),
                resume="allow",
                dir=str(folder),
                group=f"{robot_name(config.env.robot)}-{config.algorithm}-k_int{config.env.k_int:g}",
                config={**flatten(config), "versions": versions},
                settings=wandb.Settings(console="off", silent=True),
            )
        except wandb.Error as error:
            reason = " ".join(str(error).split())
            raise ConfigError(
                f"run.wandb: {reason}; run `wandb login`, set WANDB_MODE=offline, or set run.wandb=false"
            ) from None
        # Steps after the last checkpoint are taken again by a killed run: a separate axis, not W&B's counter.
        self._run.define_metric("env_steps")
        self._run.define_metric("*", step_metric="env_steps")

    def log(self, env_steps: int, metrics: dict[str, float]) -> None:
        self._run.log({"env_steps": env_steps, **metrics})

    def close(self) -> None:
        self._run.finish()


def describe(metrics: dict[str, float]) -> str:
    """Return the speed and scores of a log interval in a few words."""
    words = [f"{metrics['env_steps_per_s']:,.0f} steps/s"]
    for label, name in (("success", "success"), ("INS", "ins_0.5"), ("reward", "sum_reward")):
        value = metrics.get(f"episode/{name}")
        words.append(f"{label} {'-' if value is None else format(value, '.2f')}")
    return "  ".join(words)
