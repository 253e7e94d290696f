"""Run `python -m topological_nav COMMAND`.

Exit codes: 0 done, 2 on a user's error (one line on stderr), 128 + signal when stopped: the same command resumes.
"""

import importlib
import signal
import sys
from collections.abc import Sequence
from pathlib import Path
from typing import Annotated, Any, ClassVar, Literal

from interactive_nav_common.commands import Command, Flag, Words, option, parse, word
from interactive_nav_common.config import settings_help
from interactive_nav_common.errors import reports_errors
from interactive_nav_common.jobs.progress import Stopped
from topological_nav import config as configs
from topological_nav.config import DATASET, RUNS
from topological_nav.data.domains import AdaptConfig


class Listed(Command):
    """Base of the commands, with settings."""

    LISTED: ClassVar[dict[str, Any]]
    """Name of a group of settings -> their defaults."""
    settings: Words = ()
    """Change settings, listed below; preset=report takes those of the report (topological_nav/presets.yaml) first."""

    @classmethod
    def epilog(cls) -> str:
        listed = cls.LISTED.items()
        return "\n\n".join(f"settings{of or ' (key=default)'}:\n{settings_help(config)}" for of, config in listed)


class UsesNetworks(Listed):
    """Base of the commands that use networks."""

    localiser: Annotated[Path | None, option(metavar="RUN")] = None
    """Network that embeds images (default: a trained one, else the packaged)."""
    detector: Annotated[Path | None, option(metavar="RUN")] = None
    """Network that judges passages (default: as the localiser)."""


class _Driving(UsesNetworks):
    """Base of the commands that drive through scenes."""

    LISTED = {"": configs.EvaluationConfig()}
    maps: Annotated[Path | None, option(metavar="DIR")] = None
    """Folder of SCENE.npz (default: maps beside the networks, built where missing)."""
    policy: Annotated[str | None, option(metavar="RUN")] = None
    """Local policy (default: the networks', if none is named); passage: ahead while the detector agrees, else turn."""
    domain: Annotated[str, option(metavar="NAME")] = "clean"
    """Camera, goals included: clean, lens, light, noise, blur or camera; `adapt map` builds maps of its images."""
    truth: Flag = False
    """Build maps from the plan, and replace both networks by the truth."""


class Data(Listed):
    """Render room and passage images of scenes, or drives of the expert, or import photographs."""

    LISTED = {"": configs.DataConfig(), " of drives": configs.DriveConfig()}
    scenes: Annotated[tuple[str, ...], *word("SCENE")] = ()
    """Scene folders or sets of them; with photographs, the one that they were taken in, if any."""
    photographs: Annotated[Path | None, option(metavar="PATH")] = None
    """Folder of photographs, with where they were taken in photographs.csv; or a ROS 2 bag, which becomes one."""
    drives: Flag = False
    """Drive through the scenes, and render what the robot sees."""
    out: Annotated[Path | None, option("-o", metavar="DIR")] = None
    """The dataset."""


class Train(UsesNetworks):
    """Train the room classifier, the passage detector or the local policy."""

    LISTED = {"": configs.TASKS["rooms"], " of policy": configs.PolicyConfig()}
    task: Annotated[Literal["rooms", "passages", "policy"], *word("TASK")]
    """What to train: rooms, passages (whose defaults differ: batch=32 epochs=20 hidden=0) or policy."""
    data: Annotated[tuple[Path, ...], option(metavar="DIR")] = ()
    """The dataset; policy: one or more folders of drives."""
    grid: Flag = False
    """policy: train with several pairs of alpha and lambda."""
    out: Annotated[Path | None, option("-o", metavar="DIR")] = None
    """Run folder."""


class Map(UsesNetworks):
    """Build a scene's topological map and draw it."""

    LISTED = {"": configs.MapConfig()}
    scene: Annotated[Path, *word("SCENE")]
    """Scene folder."""
    out: Annotated[Path | None, option("-o", metavar="PATH")] = None
    """The map."""
    route: Annotated[tuple[int, int] | None, option(metavar="FROM TO")] = None
    """Draw the route between two nodes."""


class Explore(_Driving):
    """Build a scene's map while the robot explores it, and draw it."""

    scene: Annotated[str, *word("SCENE")]
    """Scene folder."""
    out: Annotated[Path, option("-o", metavar="DIR")] = RUNS / "maps-explored"
    """Folder of the map, for `--maps`; with --truth the map has no images and serves no navigation."""


class Navigate(_Driving):
    """Drive one episode of a scene and draw it."""

    scene: Annotated[str, *word("SCENE")]
    """Scene folder."""
    episode: Annotated[int, option(metavar="N")] = 0
    """Number of the scene's episode."""
    sparse: Flag = False
    """Use the thinned map."""
    out: Annotated[Path | None, option("-o", metavar="PATH")] = None
    """The picture."""
    video: Annotated[Path | None, option(metavar="PATH")] = None
    """Film it as well (.mp4), ten times as fast."""


class Evaluate(_Driving):
    """Play fixed episodes of scenes and score them."""

    scenes: Annotated[tuple[str, ...], *word("SCENE")]
    """Scene folders or sets of them."""
    contenders: Annotated[str | None, option(metavar="NAME,...")] = None
    """dense, sparse (the navigator on its map and on the thinned map), expert, ppo (default: all that can)."""
    ppo: Annotated[Path | None, option(metavar="RUN")] = None
    """Run folder of `python -m train`, whose policy knows where the goal is."""
    out: Annotated[Path, option("-o", metavar="DIR")] = RUNS / "evaluation"
    """Rows and figures."""


class Adapt(UsesNetworks):
    """Adapt networks and maps to another domain."""

    LISTED = {"": AdaptConfig()}
    what: Annotated[Literal["features", "passages", "map"], *word("WHAT")]
    """The embedding, adversarially; the passage detector, in configurations A to D; or a map of the domain's images."""
    scene: Annotated[Path | None, *word("SCENE")] = None
    """map: scene folder; may be left out with photographs."""
    data: Annotated[Path | None, option(metavar="DIR")] = None
    """The source's dataset."""
    target: Annotated[Path | None, option(metavar="DIR")] = None
    """Dataset of the target (default: the source's)."""
    out: Annotated[Path | None, option("-o", metavar="PATH")] = None
    """Folder of the networks, or the map."""


class Export(Listed):
    """Write finished runs as a small folder of weights in half precision, or as ONNX files."""

    LISTED = {"": configs.ExportConfig()}
    localiser: Annotated[Path, option(metavar="RUN")] = RUNS / "rooms"
    """Network that embeds images."""
    detector: Annotated[Path, option(metavar="RUN")] = RUNS / "passages"
    """Network that judges passages."""
    policy: Annotated[Path | None, option(metavar="RUN")] = None
    """Local policy."""
    onnx: Flag = False
    """Write rooms.onnx, passages.onnx and policy.onnx instead."""
    maps: Annotated[Path | None, option(metavar="DIR")] = None
    """Folder of SCENE.npz, all of which are exported."""
    images: Annotated[Path, option(metavar="PATH")] = DATASET
    """Dataset or scene whose images compare the networks."""
    out: Annotated[Path, option("-o", metavar="DIR")] = RUNS / "export"
    """The folder."""
    picture: Annotated[Path | None, option(metavar="PATH")] = None
    """The picture (default: DIR.png)."""


class Tables(Command):
    """Write the report's tables with ours beside them."""

    runs: Annotated[Path, *word("RUNS")]
    """Folder of `make -f benchmarks/topological.mk SIZE=report`, which gets tables.md."""


class Figures(_Driving):
    """Draw the report's figures 8 to 11, 13 to 18 and 22 to 24 of one scene; a line says what is missing for others."""

    runs: Annotated[Path, *word("RUNS")]
    """Folder of `make -f benchmarks/topological.mk`: drives, data-unseen and adapted-passages."""
    scene: Annotated[str, option(metavar="SCENE")] = "scenes_mjcf/alder"
    """Scene folder."""
    out: Annotated[Path | None, option("-o", metavar="DIR")] = None
    """The pictures (default: RUNS/figures)."""


KINDS = (Data, Train, Map, Explore, Navigate, Evaluate, Adapt, Export, Tables, Figures)
COMMANDS = {kind.__name__.lower(): kind for kind in KINDS}


@reports_errors("topological_nav")
def main(argv: Sequence[str] | None = None) -> int:
    """Run a command."""
    arguments = parse(COMMANDS, "python -m topological_nav", argv)
    try:
        # Imported once the command is clear: it is heavy.
        module = "exploration" if isinstance(arguments, Explore) else "commands"
        run = f"run_{type(arguments).__name__.lower()}"
        getattr(importlib.import_module(f"topological_nav.{module}"), run)(arguments)
    except (Stopped, KeyboardInterrupt) as stopped:  # the latter: before the work began, or at a second Ctrl-C
        print("topological_nav: stopped; the same command goes on", file=sys.stderr)
        return 128 + (stopped.args[0] if isinstance(stopped, Stopped) else signal.SIGINT)
    return 0


if __name__ == "__main__":
    sys.exit(main())
