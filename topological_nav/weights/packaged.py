"""Choose networks, policy and maps where none are named: those of the user's runs, else those of the package.

The package's lie in `topological_nav/weights/exported/`, as `export` writes them, laid out like `runs/topological`:

rooms/ passages/ policy/   networks; the policy may be absent
maps/SCENE.npz             may be absent: then a scene's map is built when it is first needed
export.json                where all of it came from
"""

import dataclasses
import importlib.resources
import json
from collections.abc import Sequence
from pathlib import Path

from topological_nav.config import PASSAGE_POLICY, RUNS
from topological_nav.errors import MapError, RunError
from topological_nav.learn.runs import DESCRIPTION, read_description
from topological_nav.maps.graph import load_map

ABOUT = "export.json"


def packaged_weights() -> Path:
    """Return where the weights of the package are, if it has any."""
    return Path(str(importlib.resources.files("topological_nav"))) / "weights" / "exported"


@dataclasses.dataclass(frozen=True)
class Choice:
    """Name the runs and maps that are used."""

    localiser: Path
    detector: Path
    policy: str
    """A run folder, or `PASSAGE_POLICY`."""
    maps: tuple[Path, ...]
    """Folders that may have the scene's map; the first is where a new one is kept."""
    renewed: bool
    """Whether a map there that does not fit may be built again: nobody but this program wrote it."""
    said: str
    """One line on where the networks come from; empty: they were named."""

    @property
    def told(self) -> str:
        """Return the same with the policy."""
        return f"{self.said}; local policy: {self.policy}" if self.said else ""


def choose(
    localiser: Path | None,
    detector: Path | None,
    policy: str | None = None,
    needs: Sequence[str] = ("rooms", "passages"),
) -> Choice:
    """Choose the run folders that are not given.

    Networks that are not given come from one place: `RUNS`, where those needed are finished, else the package. The
    policy of that place is used if neither network is given, else it is `PASSAGE_POLICY`.
    """
    given = {"rooms": localiser, "passages": detector}
    missing = [task for task in needs if given[task] is None]
    if not missing:
        runs = localiser or RUNS / "rooms", detector or RUNS / "passages"
        return Choice(*runs, policy or PASSAGE_POLICY, (RUNS / "maps",), False, "")
    packaged = packaged_weights()
    place = next((p for p in (RUNS, packaged) if all((p / task / DESCRIPTION).is_file() for task in missing)), None)
    if place is None:
        what = " and ".join(missing)
        options = " or ".join({"rooms": "--localiser RUN", "passages": "--detector RUN"}[task] for task in missing)
        raise RunError(
            f"no trained networks of {what}: neither {RUNS} nor the installed package has them; train them (python -m "
            f"topological_nav train {missing[0]}) or name a run folder: {options}"
        )
    chosen = {task: run or place / task for task, run in given.items()}
    if policy is None:
        policy = PASSAGE_POLICY
        if not any(given.values()) and (place / "policy" / DESCRIPTION).is_file():
            policy = str(place / "policy")
    if place == RUNS:
        said = f"networks: {' and '.join(str(chosen[task]) for task in missing)}"
        maps, renewed = (RUNS / "maps",), False
    else:
        said = f"networks: {' and '.join(missing)} of the package, {packaged}{_origin(packaged)}"
        maps, renewed = (RUNS / "maps-packaged", packaged / "maps"), True
    return Choice(chosen["rooms"], chosen["passages"], policy, maps, renewed, said)


def fitting_map(choice: Choice, scene: str, digest: str) -> Path | None:
    """Return the first map of a scene that these networks can use, or None where there is none."""
    networks = [read_description(run, "network", "TASK")["digest"] for run in (choice.localiser, choice.detector)]
    for folder in choice.maps:
        path = folder / f"{scene}.npz"
        if path.is_file():
            try:
                about = load_map(path, digest).about
            except MapError:
                continue
            if [about.get(name) for name in ("localiser", "detector")] == networks:
                return path
    return None


def _origin(folder: Path) -> str:
    try:
        about = json.loads((folder / ABOUT).read_text())["networks"]["rooms"]
        return f" (commit {about['commit'][:12]}, {about['device']})"
    except (OSError, ValueError, KeyError):
        return ""
