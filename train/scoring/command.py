"""Describe the command line of `train.evaluate`, without what takes long to import."""

from pathlib import Path
from typing import Annotated

from interactive_nav_common.commands import Command, Flag, Repeated, Words, option, word
from interactive_nav_common.config import AtLeastOne, Bounds, Natural
from train.scoring import AUTO_BATCH, PLANNERS, POLICIES, SEED


class Evaluate(Command):
    """Play fixed episodes."""

    runs: Annotated[tuple[str, ...], *word("RUN_DIR")] = ()
    """Folders that `python -m train` wrote; several share what is compiled. Without one, --scenes, --out and --policies
    say what to play."""
    settings: Words = ()
    """Environment settings to change: env.NAME=VALUE."""
    robot: Annotated[str | None, option(metavar="NAME|FILE")] = None
    """Sets env.robot: a name, a URDF or MJCF file, or path.py:function."""
    episodes: Annotated[AtLeastOne | None, option(metavar="N")] = None
    """Episodes of each policy (default: 200; of files, all)."""
    episode_file: Annotated[Repeated, option(metavar="FILE")] = ()
    """Play these (python -m interactive_nav.episodes make)."""
    balanced: Flag = False
    """Scenes take turns; otherwise each episode draws one."""
    policies: Annotated[str | None, option(metavar="NAME,...")] = None
    """Policies and planners to play, keyboard: you drive, or ros: a ROS 2 node (default: all policies; with --policy
    none)."""
    policy: Annotated[Repeated, option(metavar="[NAME=]MODULE:FACTORY")] = ()
    """Also play what this function of your module, or of path/to/file.py, returns."""
    scenes: Annotated[tuple[str, ...], option(metavar="SCENE_DIR")] = ()
    """Where to play (default: the scenes that the policy was trained on)."""
    seed: Annotated[int | None, Bounds(-(2**63), 2**63 - 1), option()] = None
    """Of the fixed episodes."""
    checkpoint: Annotated[str, option(metavar="best|last|STEPS")] = "best"
    """Which checkpoint plays."""
    stochastic: bool = True
    """Sample the learned policy's actions, as the original did, or take their mode."""
    record: Natural = 8
    """Episodes to record paths of."""
    batch: Annotated[AtLeastOne | None, option(metavar="N")] = None
    """Episodes played at a time (default: by the backend)."""
    out: Annotated[Path | None, option(metavar="PATH")] = None
    """Parquet file of rows (default: RUN_DIR/evaluation/episodes.parquet)."""
    dataset: Annotated[Path | None, option(metavar="DIR")] = None
    """Add a file for each run and evaluation to this folder instead."""
    demonstrations: Annotated[Path | None, option(metavar="FILE")] = None
    """Also write every control step to this Parquet file, for algorithm=clone."""

    @classmethod
    def epilog(cls) -> str:
        batches = ", ".join(f"{backend} {size}" for backend, size in AUTO_BATCH.items())
        return f"policies: {', '.join(POLICIES)}\nplanners: {', '.join(PLANNERS)}\nseed: {SEED}\nbatch: {batches}"
