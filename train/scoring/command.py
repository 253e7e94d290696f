"""Describe the command line of `train.evaluate`, without what takes long to import."""

from pathlib import Path
from typing import Annotated

from interactive_nav_common.commands import Command, Flag, Repeated, Words, option, word
from interactive_nav_common.config import AtLeastOne, Bounds, Natural
from train.scoring import AUTO_BATCH, PLANNERS, POLICIES, SEED


class Evaluate(Command):
    """Play fixed episodes and score them."""

    runs: Annotated[tuple[str, ...], *word("RUN_DIR")] = ()
    """Run folders to evaluate. Without one, --scenes, --policies and --out determine what to play."""
    settings: Words = ()
    """Override environment settings: env.NAME=VALUE."""
    robot: Annotated[str | None, option(metavar="NAME|FILE")] = None
    """Set env.robot: a name, a URDF or MJCF file, or path.py:function."""
    episodes: Annotated[AtLeastOne | None, option(metavar="N")] = None
    """Number of episodes for each policy (default: 200, or all of --episode-file)."""
    episode_file: Annotated[Repeated, option(metavar="FILE")] = ()
    """Episode file to play, made by `python -m interactive_nav.episodes make`."""
    balanced: Flag = False
    """Let scenes take turns. Otherwise each episode draws its scene at random."""
    policies: Annotated[str | None, option(metavar="NAME,...")] = None
    """Policies and planners; keyboard: you drive; ros: a node drives (default: all policies, or none with --policy)."""
    policy: Annotated[Repeated, option(metavar="[NAME=]MODULE:FACTORY")] = ()
    """Also play the policy that this function of your module, or of path/to/file.py, returns."""
    scenes: Annotated[tuple[str, ...], option(metavar="SCENE_DIR")] = ()
    """Scenes to play in (default: those that the policy was trained in)."""
    seed: Annotated[int | None, Bounds(-(2**63), 2**63 - 1), option()] = None
    """Random seed of the fixed episodes (default: see below)."""
    checkpoint: Annotated[str, option(metavar="best|last|STEPS")] = "best"
    """Checkpoint to play."""
    stochastic: bool = True
    """Sample the learned policy's actions, as the original code did, or take the most likely ones."""
    record: Natural = 8
    """Number of episodes whose paths are recorded."""
    batch: Annotated[AtLeastOne | None, option(metavar="N")] = None
    """Number of episodes to play in parallel (default: depends on the backend, see below)."""
    out: Annotated[Path | None, option(metavar="PATH")] = None
    """Parquet file to write rows to (default: RUN_DIR/evaluation/episodes.parquet)."""
    dataset: Annotated[Path | None, option(metavar="DIR")] = None
    """Folder to add one file of rows to for each run and evaluation, instead of --out."""
    demonstrations: Annotated[Path | None, option(metavar="FILE")] = None
    """Also write every control step to this Parquet file, as training data of algorithm=clone."""

    @classmethod
    def epilog(cls) -> str:
        batches = ", ".join(f"{backend} {size}" for backend, size in AUTO_BATCH.items())
        return f"policies: {', '.join(POLICIES)}\nplanners: {', '.join(PLANNERS)}\nseed: {SEED}\nbatch: {batches}"
