"""Name the file of rows that answers a request for an evaluation."""

import dataclasses
import hashlib
import json
import re
from pathlib import Path
from typing import Any


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

    def plain(self) -> dict[str, Any]:
        """Return the request as JSON holds it."""
        return json.loads(json.dumps(dataclasses.asdict(self)))

    def file_name(self, run: str) -> str:
        """Return `<run>-<8 hex>.parquet`: the same request for a run replaces its file, another one adds one."""
        digest = hashlib.sha256(json.dumps(self.plain(), sort_keys=True).encode()).hexdigest()
        return f"{run}-{digest[:8]}.parquet"


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


def lonely_paths(dataset: Path, run: str) -> list[Path]:
    """Return recorded paths of one run without their rows, which are written after them."""
    every = files_of_run(dataset / PATHS, run, ".npz")
    return [path for path in every if not (dataset / f"{path.stem}.parquet").is_file()]
