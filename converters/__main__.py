"""Parse, run and print the commands of `python -m converters`.

Exit codes: 0 done, 1 a gate failed (`convert` has written the scene anyway), 2 unusable input (one line on stderr),
130 or 143 interrupted.
"""

import contextlib
import dataclasses
import glob
import os
import signal
import sys
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, Literal

from rich.console import Console
from rich.table import Table
from rich.text import Text

from converters import generating, segmenting
from converters.records.errors import StageFailed
from interactive_nav_common.commands import Flag, OnCluster, Words, option, parse, word
from interactive_nav_common.config import AtLeastOne, read_words, refuse_unused
from interactive_nav_common.errors import ConfigError, UserError, printable, readable, reports_errors
from interactive_nav_common.jobs.progress import SafeConsole, stage_progress, warn_once
from interactive_nav_common.signals import STOPS, interrupts_heard, number_of
from scenes_mjcf.sets import existing

if TYPE_CHECKING:
    from converters.records.errors import Gate


def bounds(gate: "Gate") -> str:
    """Return a gate's limits in words."""
    pairs = ((">=", gate.limit.least), ("<=", gate.limit.most))
    return " ".join(f"{word} {value:g}" for word, value in pairs if value is not None)


def gate_table(gates: "tuple[Gate, ...]") -> Table:
    """Return a table of one row a gate."""
    table = Table("gate", "value", "limit", "", title="Gates")
    for gate in gates:
        verdict = Text("PASS", "green") if gate.passed else Text("FAIL", "red")
        table.add_row(gate.name, f"{gate.value:.5g} {gate.limit.unit}", bounds(gate), verdict)
    return table


class Convert(OnCluster, segmenting.MeshFile, segmenting.WithLibrary, generating.Decomposing):
    """Convert a scan, drawing or home into a scene folder (SRC OUT), or several into one folder (SRC... --into DIR)."""

    places: Annotated[tuple[str, ...], *word("SRC OUT")] = ()
    """Raw folder or file, then the scene folder to write (OUT_0, ... for floors). @LIST is a file of one SRC a line."""
    settings: Words = ()
    """Override sizes: structure_faces, object_faces (triangles), structure_texture, object_texture (pixels)."""
    into: Annotated[Path | None, option(metavar="DIR")] = None
    """Convert each SRC into a folder of DIR and add a row to conversions.parquet. Up-to-date scenes are kept."""
    mirror: Flag = False
    """Mirror a mesh file: replace x by -x."""
    root: Annotated[Path | None, option(metavar="DIR")] = None
    """Folder that may be read if an MJCF or Gazebo home names files outside its own folder."""
    split: Literal["train", "test"] = "train"
    """Split to record in scene.json."""
    jobs: Annotated[AtLeastOne, option(metavar="N")] = generating.CORES
    """Number of models to decompose in parallel; with --into, number of sources."""
    auto_align: Flag = False
    """Also fit CAD models to labelled furniture that has no annotation."""
    segment: Flag = False
    """First label an unlabelled mesh file or Gibson folder with the segmentation network; implies --auto-align."""
    annotations: Annotated[Path | None, option(metavar="JSON")] = None
    """Alignments that `annotate` wrote, instead of those in SRC. --library contains their CAD models."""

    @property
    def source(self) -> Path:
        """The only source."""
        return Path(self.places[0])

    @property
    def out(self) -> Path | None:
        """Where scenes go."""
        return self.into or (Path(self.places[1]) if len(self.places) == 2 else None)

    def writes(self) -> tuple[str, ...]:
        """Return the patterns of the files that it may write."""
        return ("{}/[!.]*",) if self.into else ("{}", "{}_[0-9]*")

    def run(self, console: Console) -> int:
        """Run the command."""
        from converters.pipeline import ConvertConfig, convert_building
        from converters.recipes import check_conversion

        places = [line for place in self.places for line in _lines(place) if line.strip()]
        check_conversion(settings := read_words(self.settings, "object_faces=3000"), "settings")
        words = {f.name: getattr(self, f.name) for f in dataclasses.fields(ConvertConfig) if hasattr(self, f.name)}
        words["auto_align"] |= self.segment or bool(self.library and not self.annotations)
        config = ConvertConfig(**words | settings)
        if self.into:
            from converters.many import convert_many, make_launcher

            refuse_unused(self, "--annotations", "with --into: a file is of one scan")
            jobs = min(self.jobs, len(places))
            launcher, side_by_side = make_launcher(self.launcher, self.ray_address, jobs, len(places))
            sources = [Path(place) for place in places]
            with stage_progress(console) as report:
                failed = convert_many(sources, self.into, config, launcher, side_by_side, report, console.print)
            if failed:
                console.print(f"not converted, or with gates that fail: {', '.join(failed)}")
            return 1 if failed else 0
        if len(places) != 2:
            raise ConfigError(f"convert: got {len(places)} folders, expected SRC OUT, or SRC... --into DIR")
        assert self.out is not None
        if self.segment:
            segmenting.label_unlabelled(self, console)
            self.annotations = self.annotations or segmenting.propose_unproposed(self, console)
            config = dataclasses.replace(config, auto_align=self.annotations is None)
        warn = warn_once(console)
        with stage_progress(console) as report:
            results = convert_building(self.source, self.out, config, report, warn=warn, annotations=self.annotations)
        for result in results:
            console.print(gate_table(result.gates))
            for warning in result.manifest.warnings:
                warn(warning)
        times = ", ".join(f"{k} {v:.1f}" for k, v in results[0].stage_s.items())
        console.print(f"Seconds: {times}")
        for result in results:
            for row in result.manifest.alignment:
                if "note" in row:
                    console.print(f"{row['name']}: {row['note']}")
            failed = [g.name for g in result.gates if not g.passed]
            console.print(
                f"{result.folder}: {len(result.manifest.objects)} movable objects, {result.n_walls} wall boxes, "
                f"{result.manifest.floor_area_m2:.1f} m² traversable; "
                + (f"gates that fail: {', '.join(failed)}" if failed else "every gate passes"),
            )
        layout, moves = results[0].manifest.source["format"], any(result.manifest.objects for result in results)
        if not moves and (word := segmenting.next_step(self, layout)):
            console.print(word)
        return 0 if all(g.passed for result in results for g in result.gates) else 1


class Object(generating.ObjectConfig):
    """Convert one mesh or URDF into a folder with a MuJoCo body."""

    source: Annotated[Path, *word("MESH_OR_URDF")]
    """Mesh (OBJ, PLY, STL, GLB, ...; in metres unless --scale is given) or URDF."""
    out: Annotated[Path, *word("OUT")]
    """Folder to write. Its name becomes the body's name."""

    def run(self, console: Console) -> None:
        """Run the command."""
        from converters.single_object import convert_object

        warn = warn_once(console)
        about = convert_object(self.source, self.out, self, warn=warn)
        for warning in about["warnings"]:
            warn(warning)
        size = " x ".join(f"{100 * v:.1f}" for v in about["size_m"])
        console.print(
            f"{self.out}: {about['category']}, {about['mass_kg']:.3f} kg ({about['mass_source']}), {size} cm, "
            f"{about['n_hulls']} hulls ({about['hull_source']}); at rest it drifts "
            f"{1000 * about['rest']['drift_hulls_m']:.2f} mm with hulls, "
            f"{1000 * about['rest']['drift_boxes_m']:.2f} mm with boxes",
        )


class Check(generating.Command):
    """Run the acceptance gates on a scene folder; the exit code is 1 if a gate fails."""

    scene: Annotated[Path, *word("SCENE_DIR")]
    """Scene folder to check."""

    def run(self, console: Console) -> int:
        """Run the command."""
        from converters.check.gates import check_folder

        manifest, gates = check_folder(existing(self.scene))
        for gate in gates:
            verdict = "PASS" if gate.passed else "FAIL"
            print(
                f"{verdict}  {gate.name:<18} {gate.value:>10.5g} {gate.limit.unit:<6} limit {bounds(gate):<8} "
                f"({gate.limit.meaning})"
            )
        for warning in (w for gate in gates for w in gate.warnings):
            print(f"warning: {printable(warning)}")
        failed = sum(not g.passed for g in gates)
        print(f"{manifest.name}: {len(gates) - failed} of {len(gates)} gates pass")
        return 1 if failed else 0


class Preview(generating.Command):
    """Draw a scene: two views of the home, and its objects and collision shapes from above."""

    scene: Annotated[Path, *word("SCENE_DIR")]
    """Scene folder to draw."""
    output: Annotated[Path, option("-o", metavar="PNG")]
    """PNG file to write."""

    def run(self, console: Console) -> None:
        """Run the command."""
        from converters.check.preview import preview

        preview(existing(self.scene), self.output)
        console.print(f"{self.output}: picture of {self.scene}")


class Export(generating.Command):
    """Export a scene as a Sweet Home 3D file, to edit it there and convert it again."""

    scene: Annotated[Path, *word("SCENE_DIR")]
    """Scene folder to export."""
    output: Annotated[Path, *word("HOME.sh3d")]
    """Sweet Home 3D file to write."""

    def run(self, console: Console) -> None:
        """Run the command."""
        from converters.write.sh3d import export_sh3d

        for line in export_sh3d(existing(self.scene), self.output):
            console.print(f"{self.output}: {line}")


def _lines(place: str) -> list[str]:
    """Return the places that `@LIST` lists; another place as it is."""
    if not place.startswith("@"):
        return [place]
    with readable(place[1:], ConfigError, "expected a file of one SRC a line"):
        return Path(place[1:]).read_text().splitlines()


COMMANDS: dict[str, Any] = {
    "convert": Convert,
    "segment": segmenting.Segment,
    "segment-score": segmenting.SegmentScore,
    "propose": segmenting.Propose,
    "annotate": segmenting.Annotate,
    "object": Object,
    "check": Check,
    "generate": generating.Generate,
    "generate-scenes": generating.GenerateScenes,
    "scenes": {"list": generating.ListScenes, "make": generating.MakeScenes},
    "preview": Preview,
    "export": Export,
}


def _standing(command: generating.Command) -> dict[str, int]:
    """Return the inode by path where the command writes: it changes once something else is put there."""
    target = glob.escape(str(getattr(command, "out", None) or getattr(command, "output", None) or ""))
    inodes = {}
    for path in (p for pattern in command.writes() for p in glob.glob(pattern.format(target))):
        with contextlib.suppress(OSError):
            inodes[path] = os.stat(path).st_ino
    return inodes


@reports_errors("error")
@interrupts_heard(*STOPS)
def main(argv: list[str] | None = None) -> int:
    """Run one command and return its exit code."""
    command = parse(COMMANDS, "python -m converters", argv)
    console = SafeConsole()
    before = _standing(command)

    def written() -> str:
        new = sorted(path for path, inode in _standing(command).items() if before.get(path) != inode)
        return f"written before: {', '.join(new)}" if new else "nothing was written"

    try:
        return command.run(console) or 0
    except KeyboardInterrupt as stop:
        number = number_of(stop)
        print(f"{'interrupted' if number == signal.SIGINT else 'terminated'}; {written()}", file=sys.stderr)
        return 128 + number
    except OSError as error:
        if isinstance(error, BrokenPipeError):
            raise
        where = error.filename or getattr(command, "out", None) or "file system"
        print(f"error: {where}: {error.strerror or error}; {written()}", file=sys.stderr)
        return 2
    except (UserError, StageFailed) as error:
        print("error: " + " ".join(str(error).split()), file=sys.stderr)
        return 2


if __name__ == "__main__":
    sys.exit(main())
