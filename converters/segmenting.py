"""Run the commands of `python -m converters` that label and annotate scans."""

import json
import signal
import threading
from pathlib import Path
from typing import Annotated, Any, Literal

import numpy as np
from rich.console import Console
from rich.table import Table
from tyro.conf import Suppress

from converters.generating import Command
from converters.records.errors import SceneRejected
from interactive_nav_common.commands import Flag, option, word
from interactive_nav_common.errors import typed
from interactive_nav_common.files import write_arrays, write_text
from interactive_nav_common.jobs.progress import stage_progress
from interactive_nav_common.signals import number_of

Up = Literal["auto", "x", "y", "z", "-x", "-y", "-z"]
Unit = Literal["auto", "m", "cm", "mm", "ft", "in"]
Format = Literal[
    "auto", "gibson", "interactive-gibson", "scan2cad", "sdf", "habitat", "mjcf", "sh3d",
    "scannet", "scannetpp", "arkitscenes", "3rscan", "multiscan", "matterport3d",
]  # fmt: skip
"""`READERS` of `converters.read.source`, which need not be imported to say so."""


UNFIT = ("bed", "cabinet", "lamp")
"""Classes of furniture that `propose` does not look for."""


class MeshFile(Command):
    """Base of the commands that read mesh files."""

    up: Up = "auto"
    """Axis of the mesh file that points up; auto determines it from the mesh."""
    unit: Unit = "auto"
    """Length unit of the mesh file; auto determines it from the height of a storey."""


class WithLibrary(Command):
    """Base of the commands that fit library models."""

    format: Format = "auto"
    """Layout of SRC; auto detects it from the files."""
    library: Annotated[Path | None, option(metavar="DIR")] = None
    """Folder whose cad/ contains CAD models (default: SRC if it has a cad/, otherwise the packaged furniture)."""


def _beside(source: Path, ending: str) -> Path:
    """Return the place of labels, where the readers look for them, or of proposals beside a source's mesh."""
    from converters.read.gibson import MESH
    from converters.read.meshes import beside
    from converters.read.source import detect_format

    if not source.is_file() and (layout := detect_format(source)) != "gibson":
        raise SceneRejected(f"{source}: is of layout {layout}, expected a mesh file or a folder of layout gibson")
    return beside(source, ending) if source.is_file() else (source / MESH).with_suffix(f".{ending}")


def _read(command: Any) -> Any:
    from converters.read.source import read_source

    words = {"layout": "format", "strict": "strict", "up": "up", "unit": "unit", "within": "root", "mirror": "mirror"}
    return read_source(command.source, **{k: getattr(command, w) for k, w in words.items() if hasattr(command, w)})


class Segment(MeshFile):
    """Label an unlabelled scan with the segmentation network, as input for `propose` and `convert`."""

    source: Annotated[Path, *word("SRC")]
    """Mesh file, or folder in the Gibson layout."""
    overwrite: Flag = False
    """Replace labels that exist."""
    output: Annotated[Path | None, Suppress] = None
    """Where the labels go, once that is clear."""

    def run(self, console: Console) -> None:
        """Run the command."""
        self.output = target = _beside(self.source, "labels.npz")
        if target.exists() and not self.overwrite:
            raise SceneRejected(f"{target}: the scan has labels; give --overwrite to replace them")
        _label(self, target, console)


def label_unlabelled(arguments: Any, console: Console) -> None:
    """Label the source of `convert --segment` beside it, unless it has labels, perhaps edited ones."""
    target = _beside(arguments.source, "labels.npz")
    if not target.exists():
        return _label(arguments, target, console)
    console.print(f"{target}: is there, kept")


def propose_unproposed(arguments: Any, console: Console) -> Path | None:
    """Write the models that fit beside the mesh, unless there are some; return their file, None if alignments exist."""
    from converters.propose.pieces import MIN_VOXELS
    from converters.propose.proposals import as_scan2cad, given_up, retrieve_sure
    from converters.read.gibson import ALIGNMENTS
    from converters.read.surfaces import split_storeys
    from converters.segment.voxels import NAMES, classes_of

    source, target = arguments.source, _beside(arguments.source, "proposals.json")
    if (source / ALIGNMENTS).exists():
        return None
    if target.exists():
        console.print(f"{target}: is there, kept")
        return target
    library = arguments.library or (source if (source / "cad").is_dir() else None)
    with stage_progress(console) as report:
        floors = split_storeys(_read(arguments))
        fitted = [retrieve_sure(floor, library, lambda share: report("propose", share)) for floor in floors]
    pairs = [(p, sure.get(k)) for new, sure in fitted for k, p in enumerate(new)]
    placed, models = [p for p, model in pairs if model], [model for _, model in pairs if model]
    text = json.dumps(as_scan2cad(source.stem, tuple(placed), dict(enumerate(models))), indent=1, allow_nan=False)
    write_text(target, text + "\n")
    console.print(f"{target}: {len(models)} models")
    counts = np.bincount(np.concatenate([classes_of(floor.scan.labels) for floor in floors]), minlength=len(NAMES))
    unfit = [name for name in UNFIT if counts[NAMES.index(name)] >= MIN_VOXELS]
    lines = given_up([p for p, model in pairs if model is None], ())
    lines += (f"labelled, and never given a model: {', '.join(unfit)}",) if unfit else ()
    for line in (*lines, *((f"place models by hand with: {_annotate(source)}",) if lines else ())):
        console.print(f"{source}: {line}")
    return target


def _annotate(source: Path) -> str:
    return f"python -m converters annotate {typed(source)} -o DIR"


def next_step(arguments: Any, layout: str) -> str:
    """Return what else makes furniture of a scan move, or "" for homes and for scans that people annotated."""
    from converters.read.gibson import ALIGNMENTS

    people = (arguments.source / ALIGNMENTS).exists() or (arguments.annotations and not arguments.segment)
    if layout not in ("mesh", "gibson") or people:
        return ""
    first = "" if arguments.segment else "add --segment to recognise furniture in the scan, or "
    return f"no movable object: {first}place models by hand with: {_annotate(arguments.source)}"


def _label(arguments: Any, target: Path, console: Console) -> None:
    from converters.segment.labelling import label_scan, load_scores

    scores = load_scores()
    with stage_progress(console) as report:
        labels = label_scan(_read(arguments), scores, report)
    write_arrays(target, label=labels.astype("uint8"))
    console.print(f"{target}: labels of {len(labels)} vertices")


class SegmentScore(Command):
    """Score the segmentation network on labelled scans."""

    sources: Annotated[tuple[Path, ...], *word("SRC")]
    """Labelled scans to score."""

    def run(self, console: Console) -> None:
        """Run the command."""
        from converters.read.source import read_source
        from converters.segment.labelling import load_scores, score_source

        scores = load_scores()
        with stage_progress(console) as report:
            for source in self.sources:
                score = score_source(read_source(source), scores, report)
                mean = sum(score["iou"].values()) / max(len(score["iou"]), 1)
                row = ", ".join(f"{name} {value:.3f}" for name, value in score["iou"].items())
                console.print(f"{source}: mIoU {mean:.3f}; {row}")
                console.print(
                    f"{source}: {score['matched']} of {score['objects']} annotated objects are recognised, "
                    f"{score['matched_true']} with the scan's labels"
                )


class Propose(WithLibrary):
    """Find furniture in a labelled scan; write proposals.json in the format of Scan2CAD."""

    WRITES = ("{}/proposals.json",)
    source: Annotated[Path, *word("SRC")]
    """Folder of the raw scan, or mesh file."""
    output: Annotated[Path, option("-o", metavar="DIR")]
    """Folder to write proposals.json to."""
    auto_align: Flag = False
    """Also select a CAD model and its pose for each proposal."""

    def run(self, console: Console) -> None:
        """Run the command."""
        from converters.propose.proposals import propose
        from converters.propose.retrieval import read_library
        from converters.read.source import read_source

        with stage_progress(console) as report:
            raw, library = read_source(self.source, self.format), None
            if self.auto_align or self.library:
                library = read_library(self.library, self.source)
            proposals, retrieved = propose(raw, self.output, library, report)
        table = Table("class", "confidence", "x y z, m", "size, m", "model", "sure", title="Proposals")
        for k, proposal in enumerate(proposals):
            model, sizes = retrieved.get(k), (proposal.centre, proposal.extent_m)
            fitted = (model.cad.cad_id[:8], f"{model.confidence:.2f}") if model else ("-", "-")
            metres = (" ".join(f"{v:.2f}" for v in values) for values in sizes)
            table.add_row(proposal.category, f"{proposal.confidence:.2f}", *metres, *fitted)
        console.print(table)
        console.print(f"{self.output}: proposals.json")


class Annotate(MeshFile, WithLibrary):
    """Place CAD models in a scan by hand, in the browser: accept proposals, choose models, match pairs of points."""

    WRITES = ("{}/*.json",)
    source: Annotated[Path, *word("SRC")]
    """Folder of the raw scan, or mesh file."""
    output: Annotated[Path, option("-o", metavar="DIR")]
    """Folder for one person's annotations. Work in a folder that exists is continued."""
    host: Annotated[str, option(metavar="ADDRESS")] = "127.0.0.1"
    """Address to listen on. Addresses that other machines reach need a token, which is printed."""
    port: int = 8080
    """TCP port to listen on; 0 selects a free one."""

    def run(self, console: Console) -> int:
        """Run the command."""
        from converters.annotate.browser import Page
        from converters.annotate.session import Store, start
        from converters.propose.proposals import propose_instances
        from converters.propose.retrieval import read_library
        from converters.read.source import read_source
        from interactive_nav_common.files import alone_in
        from interactive_nav_common.untrusted.guard import guarded_server

        with alone_in(self.output):
            raw = read_source(self.source, self.format, up=self.up, unit=self.unit)
            store = Store(self.output, read_library(self.library, self.source))
            proposals = propose_instances(raw.scan)
            session = store.save(store.open(raw, lambda: start(raw, proposals)))
            server, address = guarded_server(self.host, self.port, raw.name, "annotate")
            page = Page(server, store, session, raw, proposals)
            console.print(f"{address} (Ctrl-C ends it; every action is saved)")
            try:
                threading.Event().wait()
            except KeyboardInterrupt as stop:
                number = number_of(stop)  # Ctrl-C is how it ends
            server.stop()
        states = [item.state for item in page.session.items]
        counts = ", ".join(f"{states.count(word)} {word}" for word in ("accepted", "skipped", "open"))
        console.print(f"{self.output}: {counts}")
        return 0 if number == signal.SIGINT else 128 + number
