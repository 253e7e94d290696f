"""Run `python -m topological_nav COMMAND`.

Exit codes: 0 done, 2 on a user's error (one line on stderr), 128 + signal when stopped.
"""

import sys
from collections.abc import Sequence
from pathlib import Path
from typing import Annotated, Any, ClassVar, Literal

from interactive_nav_common.commands import Command, Flag, Words, option, parse, word
from interactive_nav_common.config import settings_help
from interactive_nav_common.errors import reports_errors
from interactive_nav_common.jobs.progress import Stopped
from interactive_nav_common.signals import STOPS, interrupts_heard, number_of
from topological_nav import config as configs
from topological_nav.config import DATASET, RUNS
from topological_nav.data.domains import PRESETS, AdaptConfig


class Listed(Command):
    """Base of the commands, with settings."""

    LISTED: ClassVar[dict[str, Any]]
    """Name of a group of settings -> their defaults."""
    settings: Words = ()
    """Override settings, listed below. preset=report first applies the report's (topological_nav/presets.yaml)."""

    @classmethod
    def epilog(cls) -> str:
        listed = cls.LISTED.items()
        return "\n\n".join(f"settings{of or ' (key=default)'}:\n{settings_help(config)}" for of, config in listed)


class UsesNetworks(Listed):
    """Base of the commands that use networks."""

    localiser: Annotated[Path | None, option(metavar="RUN")] = None
    """Run folder of the network that embeds images (default: a trained one, otherwise the packaged one)."""
    detector: Annotated[Path | None, option(metavar="RUN")] = None
    """Run folder of the network that detects passages (default: chosen like the localiser)."""


class _Driving(UsesNetworks):
    """Base of the commands that drive through scenes."""

    LISTED = {"": configs.EvaluationConfig()}
    maps: Annotated[Path | None, option(metavar="DIR")] = None
    """Folder of maps, SCENE.npz (default: maps beside the networks; missing maps are built)."""
    policy: Annotated[str | None, option(metavar="RUN")] = None
    """Local policy: a run folder, or passage, a rule without learning (default: the networks', if you name none)."""
    domain: Annotated[Literal[tuple(PRESETS)], option(metavar="NAME")] = "clean"  # type: ignore[valid-type]
    """Camera of all images: clean, lens, light, noise, blur or camera. `adapt map` builds maps for a domain."""
    truth: Flag = False
    """Build maps from the floor plan, and replace both networks by the ground truth."""


class Data(Listed):
    """Render images of rooms and passages, record drives of the expert, or import photographs."""

    LISTED = {"": configs.DataConfig(), " of drives": configs.DriveConfig()}
    scenes: Annotated[tuple[str, ...], *word("SCENE")] = ()
    """Scene folders or sets; with --photographs, the scene that they were taken in, if it exists."""
    photographs: Annotated[Path | None, option(metavar="PATH")] = None
    """Folder of photographs, with their poses in photographs.csv, or a ROS 2 bag to make one from."""
    drives: Flag = False
    """Let the expert drive through the scenes, and render what the robot sees."""
    out: Annotated[Path | None, option("-o", metavar="DIR")] = None
    """Dataset folder to write (default: runs/topological/data, or .../drives with --drives)."""


class Train(UsesNetworks):
    """Train the room classifier, the passage detector or the local policy."""

    LISTED = {"": configs.TASKS["rooms"], " of policy": configs.PolicyConfig()}
    task: Annotated[Literal["rooms", "passages", "policy"], *word("TASK")]
    """What to train: rooms, passages (with defaults batch=32 epochs=20 hidden=0) or policy."""
    data: Annotated[tuple[Path, ...], option(metavar="DIR")] = ()
    """Dataset folder; for policy, one or more folders of drives."""
    grid: Flag = False
    """For policy: train with several pairs of alpha and lambda."""
    out: Annotated[Path | None, option("-o", metavar="DIR")] = None
    """Run folder to write (default: runs/topological/TASK)."""


class Map(UsesNetworks):
    """Build a scene's topological map and draw it."""

    LISTED = {"": configs.MapConfig()}
    scene: Annotated[Path, *word("SCENE")]
    """Scene folder."""
    out: Annotated[Path | None, option("-o", metavar="PATH")] = None
    """Map file to write, .npz (default: SCENE.npz beside the networks)."""
    route: Annotated[tuple[int, int] | None, option(metavar="FROM TO")] = None
    """Numbers of two nodes to draw the route between."""


class Navigate(_Driving):
    """Drive one episode of a scene and draw it."""

    scene: Annotated[str, *word("SCENE")]
    """Scene folder."""
    episode: Annotated[int, option(metavar="N")] = 0
    """Number of the scene's episode, starting at 0."""
    sparse: Flag = False
    """Use the thinned map, which has fewer nodes."""
    out: Annotated[Path | None, option("-o", metavar="PATH")] = None
    """Picture to write (default: in runs/topological/navigate)."""
    video: Annotated[Path | None, option(metavar="PATH")] = None
    """Also write a film to this .mp4 file, at ten times the real speed."""


class Evaluate(_Driving):
    """Play fixed episodes of scenes and score them."""

    scenes: Annotated[tuple[str, ...], *word("SCENE")]
    """Scene folders or sets."""
    contenders: Annotated[str | None, option(metavar="NAME,...")] = None
    """Navigator on its map (dense) or on the thinned map (sparse), expert, ppo (default: all that are available)."""
    ppo: Annotated[Path | None, option(metavar="RUN")] = None
    """Run folder of `python -m train`. Its policy knows where the goal is."""
    out: Annotated[Path, option("-o", metavar="DIR")] = RUNS / "evaluation"
    """Folder to write rows and figures to."""


class Adapt(UsesNetworks):
    """Adapt networks and maps to another domain."""

    LISTED = {"": AdaptConfig()}
    what: Annotated[Literal["features", "passages", "map"], *word("WHAT")]
    """What to adapt: features (by adversarial training), passages (in configurations A to D), or map."""
    scene: Annotated[Path | None, *word("SCENE")] = None
    """For map: scene folder. You can omit it with photographs."""
    data: Annotated[Path | None, option(metavar="DIR")] = None
    """Dataset of the source domain."""
    target: Annotated[Path | None, option(metavar="DIR")] = None
    """Dataset of the target domain (default: that of the source)."""
    out: Annotated[Path | None, option("-o", metavar="PATH")] = None
    """Folder to write the networks to, or map file to write (default: in runs/topological/adapted)."""


class Export(Listed):
    """Export finished runs as a small folder of weights in half precision, or as ONNX files."""

    LISTED = {"": configs.ExportConfig()}
    localiser: Annotated[Path, option(metavar="RUN")] = RUNS / "rooms"
    """Run folder of the network that embeds images."""
    detector: Annotated[Path, option(metavar="RUN")] = RUNS / "passages"
    """Run folder of the network that detects passages."""
    policy: Annotated[Path | None, option(metavar="RUN")] = None
    """Run folder of the local policy."""
    onnx: Flag = False
    """Write rooms.onnx, passages.onnx and policy.onnx instead."""
    maps: Annotated[Path | None, option(metavar="DIR")] = None
    """Folder of maps, SCENE.npz, all of which are exported."""
    images: Annotated[Path, option(metavar="PATH")] = DATASET
    """Dataset or scene on whose images the runs and their exports are compared."""
    out: Annotated[Path, option("-o", metavar="DIR")] = RUNS / "export"
    """Folder to write."""


class Tables(Command):
    """Write the report's tables beside our results."""

    runs: Annotated[Path, *word("RUNS")]
    """Folder that `make -f benchmarks/topological.mk SIZE=report` wrote; tables.md is added to it."""


class Figures(_Driving):
    """Draw the report's figures 8 to 11, 13 to 18 and 22 to 24 for one scene; print what other figures still need."""

    runs: Annotated[Path, *word("RUNS")]
    """Folder that `make -f benchmarks/topological.mk` wrote: drives, data-unseen and adapted-passages."""
    scene: Annotated[str, option(metavar="SCENE")] = "scenes_mjcf/alder"
    """Scene folder."""
    out: Annotated[Path | None, option("-o", metavar="DIR")] = None
    """Folder to write the pictures to (default: RUNS/figures)."""


KINDS = (Data, Train, Map, Navigate, Evaluate, Adapt, Export, Tables, Figures)
COMMANDS = {kind.__name__.lower(): kind for kind in KINDS}


@reports_errors("topological_nav")
@interrupts_heard(*STOPS)
def main(argv: Sequence[str] | None = None) -> int:
    """Run a command."""
    arguments = parse(COMMANDS, "python -m topological_nav", argv)
    try:
        # Imported once the command is clear: it is heavy.
        from topological_nav import commands

        getattr(commands, f"run_{type(arguments).__name__.lower()}")(arguments)
    except (Stopped, KeyboardInterrupt) as stopped:  # the latter: outside of loops that stop between two steps
        print("topological_nav: stopped; give the same command again", file=sys.stderr)
        return 128 + number_of(stopped)
    return 0


if __name__ == "__main__":
    sys.exit(main())
