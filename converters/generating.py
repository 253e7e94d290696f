"""Run the commands of `python -m converters` that generate scenes and prepare furniture."""

import functools
import os
import shlex
from pathlib import Path
from typing import Annotated, ClassVar, Literal

from rich.console import Console

from interactive_nav_common.commands import Command as AnyCommand
from interactive_nav_common.commands import Flag, Words, option, word
from interactive_nav_common.config import AtLeastOne, Positive, read_words, refuse_unused
from interactive_nav_common.jobs.progress import stage_progress
from scenes_mjcf import sets

CORES = os.cpu_count() or 1


class Command(AnyCommand):
    """Base of the converters' commands."""

    WRITES: ClassVar[tuple[str, ...]] = ("{}",)
    """What `writes` returns."""

    def writes(self) -> tuple[str, ...]:
        """Return the patterns of the files that it may write; {} stands for its field `out` or `output`."""
        return self.WRITES

    def run(self, console: Console) -> int | None:
        """Run the command; return its exit code, None for 0."""
        raise NotImplementedError


class OnCluster(Command):
    """Base of the commands that can run on a cluster."""

    launcher: Literal["local", "ray"] = "local"
    """This machine, or a Ray cluster."""
    ray_address: Annotated[str | None, option(metavar="HOST:PORT")] = None
    """Of the cluster's head (default: auto)."""

    def __post_init__(self) -> None:
        super().__post_init__()
        if self.launcher != "ray":
            refuse_unused(self, "--ray-address", "without --launcher ray")


class Decomposing(Command):
    """Base of the commands that decompose models into hulls."""

    seed: int = 0
    """Of the decomposition's search."""
    overwrite: Flag = False
    """Replace OUT if it exists."""
    strict: Flag = False
    """Refuse what would be repaired with a warning."""
    timeout_s: Annotated[Positive, option(name="timeout", metavar="S")] = 240.0
    """Seconds for the decomposition of one model before its convex hull is taken."""


class ObjectConfig(Decomposing):
    """Choices of one object."""

    category: Annotated[str | None, option(metavar="NAME")] = None
    """Category, a row of scenes_mjcf/categories.yaml (default: by the file's name, else other)."""
    mass_kg: Annotated[Positive | None, option(name="mass", metavar="KG")] = None
    """Mass (default: the URDF's, else density x volume)."""
    friction: Annotated[Positive | None, option(metavar="MU")] = None
    """Friction (default: the URDF's, else the category's)."""
    scale: Positive = 1.0
    """Of a mesh that is not in metres."""
    up: Literal["z", "y"] = "z"
    """Axis of the mesh that points up; DAE files say it themselves."""
    within: Annotated[Path | None, option(metavar="DIR")] = None
    """Folder that textures are read from (default: the model's folder)."""


class Generate(Command):
    """Write a synthetic home in the raw Gibson layout."""

    out: Annotated[Path, *word("OUT")]
    """Folder to create."""
    settings: Words = ()
    """Settings of the tier's homes, such as floor_area_m2=80."""
    seed: Annotated[int, option(metavar="N")]
    """Same seed, same home. One that cannot be furnished takes another seed, which is printed."""
    tier: str = "sparse"
    """sparse, furnished or cluttered."""
    split: Literal["train", "test"] = "train"
    """Whose CAD models."""

    def run(self, console: Console) -> None:
        """Run the command."""
        from converters.generate import generate_building
        from converters.recipes import building_of, with_seeds

        settings = read_words(self.settings, "floor_area_m2=80")
        config = building_of(self.tier, settings, self.split, "settings")
        with stage_progress(console) as report:
            _, seed = with_seeds(self.seed, lambda seed: generate_building(self.out, seed, report, config))
        console.print(
            f"{self.out}: building of {seed}; convert it with "
            f"'python -m converters convert {shlex.quote(str(self.out))} SCENE_DIR'"
        )


class GenerateScenes(OnCluster):
    """Generate, convert and draw the scenes of a recipe file, or homes of a tier; continue where it stopped."""

    WRITES = ("{}/*",)
    out: Annotated[Path, *word("OUT")]
    """Folder of scene folders; those that exist are kept."""
    recipes: Annotated[Path | None, option(metavar="YAML")] = None
    """The recipe file (default: OUT/recipes.yaml)."""
    tier: Annotated[str | None, option(metavar="TIER")] = None
    """Write OUT/recipes.yaml: sparse, furnished or cluttered homes."""
    count: Annotated[AtLeastOne | None, option(metavar="N")] = None
    """How many of a tier (default: 10)."""
    seed: Annotated[int | None, option(metavar="N")] = None
    """Of a tier's first home (default: 100000)."""
    only: Annotated[tuple[str, ...], option(metavar="NAME")] = ()
    """Scenes to generate (default: all)."""
    overwrite: Flag = False
    """Generate those again that exist."""
    jobs: Annotated[AtLeastOne, option(metavar="N")] = CORES
    """Scenes side by side."""

    def run(self, console: Console) -> int:
        """Run the command."""
        from converters.many import SEEDS, generate_scenes

        if self.tier:
            refuse_unused(self, "--recipes", "with --tier, which writes them")
            self.count, self.seed = self.count or 10, SEEDS if self.seed is None else self.seed
        else:
            refuse_unused(self, "--count --seed", "without --tier")
        with stage_progress(console) as report:
            failed = generate_scenes(self, report, console.print)
        return 1 if failed else 0


class MakeScenes(Command):
    """Generate them in the cache folder, where every program looks for them, and compare their digests."""

    names: Annotated[tuple[str, ...], *word("NAME")]
    """Scenes (alder, cluttered_003), sets (cluttered) or splits of them (furnished/test)."""
    jobs: Annotated[AtLeastOne, option(metavar="N")] = CORES
    """Scenes side by side."""

    def run(self, console: Console) -> int:
        """Run the command."""
        from converters.many import make_packaged

        with stage_progress(console) as report:
            failed = make_packaged(self.names, functools.partial(GenerateScenes, jobs=self.jobs), report, console.print)
        return 1 if failed else 0


class ListScenes(Command):
    """List the scenes that are here, and those that can be generated: set, split, name, place."""

    def run(self, console: Console) -> None:
        """Run the command."""
        listed = {
            f / scene: (name, m)
            for name, f in sets.PACKAGED.items()
            for scene, m in sets.packaged_set(name).scenes.items()
        }
        for scene, (name, member) in listed.items():
            place = next((p for p in (scene, sets.in_cache(scene)) if p.exists()), None)
            other = place and place == sets.in_cache(scene) and not sets.is_listed(place, member)
            what = "in the cache is another scene of this name: make it again" if other else place or "not made"
            print(f"{name:<10} {member.split:<6} {scene.name:<15} {what}")
        for scene in sorted({path.parent for path in sets.HERE.rglob("scene.json")} - set(listed)):
            print(f"{'-':<10} {'-':<6} {scene.relative_to(sets.HERE).as_posix():<15} {scene}")


class Models(Command):
    """Draw the CAD models that generated buildings are furnished with."""

    names: Annotated[tuple[str, ...], *word("NAME")] = ()
    """Models or categories (default: all models)."""
    output: Annotated[Path, option("-o", metavar="PNG")]
    """The picture."""

    def run(self, console: Console) -> None:
        """Run the command."""
        from converters.check.pictures import model_sheet

        count = model_sheet(self.output, self.names)
        console.print(f"{self.output}: picture of {count} models")


class Get(Command):
    """Fetch the furniture libraries of Sweet Home 3D."""

    name: Annotated[Literal["sweethome3d"], *word("NAME")]
    """Which libraries."""
    given: Annotated[Path | None, option(name="from", metavar="FILE.deb|DIR")] = None
    """Read them from here (default: apt-get downloads them)."""
    out: Annotated[Path | None, option("-o", metavar="DIR")] = None
    """Folder for them (default: the cache folder)."""
    overwrite: Flag = False
    """Replace what was fetched before."""

    def run(self, console: Console) -> None:
        """Run the command."""
        from converters.library.build import fetch, library_folder

        target = self.out or library_folder()
        files = fetch(self.given, target, self.overwrite)
        console.print(f"{target}: {len(files)} furniture libraries, checked by digest")


class Build(Command):
    """Rebuild the packaged selection: models.zip and ATTRIBUTION.md."""

    WRITES = ("{}/*",)
    out: Annotated[Path, *word("OUT")]
    """Folder for both files."""
    given: Annotated[Path | None, option(name="from", metavar="DIR")] = None
    """Folder of the .sh3f files (default: as fetched)."""
    jobs: Annotated[AtLeastOne, option(metavar="N")] = CORES
    """Models side by side."""

    def run(self, console: Console) -> None:
        """Run the command."""
        from converters.library.build import FILES, build, checked, library_folder

        given = self.given or library_folder()
        files = [given / f"{name}.sh3f" for name in FILES]
        for path in files:
            checked(given, path.stem, path.read_bytes() if path.is_file() else None)
        with stage_progress(console) as report:
            count = build(files, self.out, self.jobs, report)
        console.print(f"{self.out}: {count} models with their hulls, and ATTRIBUTION.md")


class ListModels(Command):
    """List the packaged models, with size and credit."""

    def run(self, console: Console) -> None:
        """Run the command."""
        from converters.library.store import read_index

        for model in read_index().values():
            width, height, depth = model.size_m
            print(
                f"{model.name:<40} {model.category:<15} {model.split:<6} {width:.2f} x {depth:.2f} x {height:.2f} m "
                f"{model.faces:>5} faces {model.hulls:>3} hulls  "
                + "; ".join(f"{c.creator}, {c.licence}" for c in model.credits)
            )
