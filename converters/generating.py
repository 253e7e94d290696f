"""Run the commands of `python -m converters` that generate scenes and prepare furniture."""

import functools
import os
from pathlib import Path
from typing import Annotated, ClassVar, Literal

from rich.console import Console

from interactive_nav_common.commands import Command as AnyCommand
from interactive_nav_common.commands import Flag, OnCluster, Words, option, word
from interactive_nav_common.config import AtLeastOne, Positive, read_words, refuse_unused
from interactive_nav_common.errors import typed
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


class Decomposing(Command):
    """Base of the commands that decompose models into hulls."""

    seed: int = 0
    """Random seed of the convex decomposition."""
    overwrite: Flag = False
    """Replace OUT if it exists."""
    strict: Flag = False
    """Stop with an error where the converter would otherwise repair the input and print a warning."""
    timeout_s: Annotated[Positive, option(name="timeout", metavar="S")] = 240.0
    """Time limit in seconds to decompose one model. If it is exceeded, the model's convex hull is used."""


class ObjectConfig(Decomposing):
    """Choices of one object."""

    category: Annotated[str | None, option(metavar="NAME")] = None
    """Category, a row of scenes_mjcf/categories.yaml (default: guessed from the file name, otherwise other)."""
    mass_kg: Annotated[Positive | None, option(name="mass", metavar="KG")] = None
    """Mass in kg (default: from the URDF, otherwise density times volume)."""
    friction: Annotated[Positive | None, option(metavar="MU")] = None
    """Friction coefficient (default: from the URDF, otherwise from the category)."""
    scale: Positive = 1.0
    """Factor that converts the mesh's unit to metres, for example 0.01 for centimetres."""
    up: Literal["z", "y"] = "z"
    """Axis of the mesh that points up. DAE files name their own axis, which takes precedence."""
    within: Annotated[Path | None, option(metavar="DIR")] = None
    """Folder that textures may be read from (default: the model's folder)."""


class Generate(Command):
    """Generate a synthetic home as a raw scan in the Gibson layout, which `convert` reads."""

    out: Annotated[Path, *word("OUT")]
    """Folder to create."""
    settings: Words = ()
    """Override settings of the tier's homes, for example floor_area_m2=80."""
    seed: Annotated[int, option(metavar="N")]
    """Random seed. The same seed gives the same home. If it gives none, another seed is used and printed."""
    tier: str = "sparse"
    """How full the home is: sparse, furnished or cluttered."""
    split: Literal["train", "test"] = "train"
    """Split whose CAD models furnish the home: the test models never occur in training homes."""

    def run(self, console: Console) -> None:
        """Run the command."""
        from converters.generate import generate_building
        from converters.recipes import building_of, with_seeds

        settings = read_words(self.settings, "floor_area_m2=80")
        config = building_of(self.tier, settings, self.split, "settings")
        with stage_progress(console) as report:
            _, seed = with_seeds(self.seed, lambda seed: generate_building(self.out, seed, report, config))
        again = f"python -m converters convert {typed(self.out)} SCENE_DIR"
        console.print(f"{self.out}: building of {seed}; convert it with: {again}")


class GenerateScenes(OnCluster, Command):
    """Generate, convert and draw the homes of a recipe file or of a tier. The same command continues after a stop."""

    WRITES = ("{}/*",)
    out: Annotated[Path, *word("OUT")]
    """Folder that contains the scene folders. Scenes that exist are kept."""
    recipes: Annotated[Path | None, option(metavar="YAML")] = None
    """Recipe file to read (default: OUT/recipes.yaml)."""
    tier: Annotated[str | None, option(metavar="TIER")] = None
    """Write OUT/recipes.yaml for homes of this tier: sparse, furnished or cluttered."""
    count: Annotated[AtLeastOne | None, option(metavar="N")] = None
    """Number of homes to generate, with --tier (default: 10)."""
    seed: Annotated[int | None, option(metavar="N")] = None
    """Random seed of the first home, with --tier; each further home adds 1 (default: 100000)."""
    only: Annotated[tuple[str, ...], option(metavar="NAME")] = ()
    """Names of the scenes to generate (default: all)."""
    overwrite: Flag = False
    """Also generate scenes that exist, and replace them."""
    jobs: Annotated[AtLeastOne, option(metavar="N")] = CORES
    """Number of scenes to generate in parallel."""

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
    """Generate named homes in the cache folder, where every program finds them, and check their digests."""

    names: Annotated[tuple[str, ...], *word("NAME")]
    """Scenes (alder, cluttered_003), sets (cluttered) or splits of sets (furnished/test) to generate."""
    jobs: Annotated[AtLeastOne, option(metavar="N")] = CORES
    """Number of scenes to generate in parallel."""

    def run(self, console: Console) -> int:
        """Run the command."""
        from converters.many import make_packaged

        with stage_progress(console) as report:
            failed = make_packaged(self.names, functools.partial(GenerateScenes, jobs=self.jobs), report, console.print)
        return 1 if failed else 0


class ListScenes(Command):
    """List the set, split, name and folder of every home that is installed or can be generated."""

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
