"""Run the commands of `python -m converters` that label scans; words.yaml has their words."""

import argparse
import json
import shlex
from pathlib import Path
from typing import Any

import numpy as np
from rich.console import Console

from converters.records.errors import SceneRejected
from interactive_nav_common.files import write_arrays, write_text
from interactive_nav_common.jobs.progress import stage_progress

UNFIT = ("bed", "cabinet", "lamp")
"""Classes of furniture that `propose` does not look for."""


def _beside(source: Path, ending: str) -> Path:
    """Return the place of labels, where the readers look for them, or of proposals beside a source's mesh."""
    from converters.read.gibson import MESH
    from converters.read.meshes import beside
    from converters.read.source import detect_format

    if not source.is_file() and (layout := detect_format(source)) != "gibson":
        raise SceneRejected(f"{source}: is of layout {layout}, expected a mesh file or a folder of layout gibson")
    return beside(source, ending) if source.is_file() else (source / MESH).with_suffix(f".{ending}")


def _read(arguments: argparse.Namespace) -> Any:
    from converters.read.source import read_source

    words = {"layout": "format", "strict": "strict", "up": "up", "unit": "unit", "within": "root", "mirror": "mirror"}
    return read_source(arguments.source, **{k: getattr(arguments, w) for k, w in words.items() if w in arguments})


def _segment(arguments: argparse.Namespace, console: Console) -> None:
    arguments.output = target = _beside(arguments.source, "labels.npz")
    if target.exists() and not arguments.overwrite:
        raise SceneRejected(f"{target}: the scan has labels; give --overwrite to replace them")
    _label(arguments, target, arguments.weights, console)


def label_unlabelled(arguments: argparse.Namespace, console: Console) -> None:
    """Label the source of `convert --segment` beside it, unless it has labels, perhaps edited ones."""
    target = _beside(arguments.source, "labels.npz")
    if not target.exists():
        return _label(arguments, target, None, console)
    console.print(f"{target}: is there, kept", soft_wrap=True)


def propose_unproposed(arguments: argparse.Namespace, console: Console) -> Path | None:
    """Write the models that fit beside the mesh, unless there are some; return their file, None if alignments exist."""
    from converters.propose.pieces import MIN_VOXELS
    from converters.propose.proposals import as_scan2cad
    from converters.propose.report import given_up, retrieve_sure
    from converters.read.gibson import ALIGNMENTS
    from converters.read.surfaces import split_storeys
    from converters.segment.voxels import NAMES, classes_of

    source, target = arguments.source, _beside(arguments.source, "proposals.json")
    if (source / ALIGNMENTS).exists():
        return None
    if target.exists():
        console.print(f"{target}: is there, kept", soft_wrap=True)
        return target
    library = arguments.library or (source if (source / "cad").is_dir() else None)
    with stage_progress(console) as report:
        floors = split_storeys(_read(arguments))
        fitted = [retrieve_sure(floor, library, lambda share: report("propose", share)) for floor in floors]
    pairs = [(p, sure.get(k)) for new, sure in fitted for k, p in enumerate(new)]
    placed, models = [p for p, model in pairs if model], [model for _, model in pairs if model]
    text = json.dumps(as_scan2cad(source.stem, tuple(placed), dict(enumerate(models))), indent=1, allow_nan=False)
    write_text(target, text + "\n")
    console.print(f"{target}: {len(models)} models", soft_wrap=True)
    counts = np.bincount(np.concatenate([classes_of(floor.scan.labels) for floor in floors]), minlength=len(NAMES))
    unfit = [name for name in UNFIT if counts[NAMES.index(name)] >= MIN_VOXELS]
    lines = given_up([p for p, model in pairs if model is None], ())
    lines += (f"labelled, and never given a model: {', '.join(unfit)}",) if unfit else ()
    for line in (*lines, *((f"{_annotate(source)} places models by hand",) if lines else ())):
        console.print(f"{source}: {line}", soft_wrap=True, highlight=False)
    return target


def _annotate(source: Path) -> str:
    return f"'python -m converters annotate {shlex.quote(str(source))} -o DIR'"


def next_step(arguments: argparse.Namespace, layout: str) -> str:
    """Return what else makes furniture of a scan move, or "" for homes and for scans that people annotated."""
    from converters.read.gibson import ALIGNMENTS

    people = (arguments.source / ALIGNMENTS).exists() or (arguments.annotations and not arguments.segment)
    if layout not in ("mesh", "gibson") or people:
        return ""
    first = "" if arguments.segment else "add --segment to recognise furniture in the scan, or "
    return f"no movable object: {first}place models by hand with {_annotate(arguments.source)}"


def _label(arguments: argparse.Namespace, target: Path, weights: Path | None, console: Console) -> None:
    from converters.segment.labelling import label_scan, load_scores

    scores = load_scores(weights)
    with stage_progress(console) as report:
        labels = label_scan(_read(arguments), scores, report)
    write_arrays(target, label=labels.astype("uint8"))
    console.print(f"{target}: labels of {len(labels)} vertices", soft_wrap=True)


def _train(arguments: argparse.Namespace, console: Console) -> None:
    from converters.segment.train import SegmentConfig, train
    from interactive_nav_common.config import overridden

    config = overridden(SegmentConfig(), arguments.settings)
    with stage_progress(console) as report:
        scores = train(arguments.out, config, report, lambda line: console.print(line, soft_wrap=True))
    _table(console, "held-out crops", scores)


def _score(arguments: argparse.Namespace, console: Console) -> None:
    from converters.read.source import read_source
    from converters.segment.labelling import load_scores, score_homes, score_source
    from converters.segment.train import HELD_OUT_SEED

    scores = load_scores(arguments.weights)
    with stage_progress(console) as report:
        for source in arguments.sources:
            score = score_source(read_source(source), scores, report)
            _table(console, str(source), score["iou"])
            console.print(
                f"{source}: {score['matched']} of {score['objects']} annotated objects are recognised, "
                f"{score['matched_true']} with the scan's labels",
                soft_wrap=True,
            )
        if arguments.homes:
            # Whole buildings of other seeds than those whose crops the training was watched by.
            iou = score_homes(HELD_OUT_SEED + 50_000, arguments.homes, scores, report)
            _table(console, f"{arguments.homes} held-out buildings", iou)


def _table(console: Console, what: str, iou: dict[str, float]) -> None:
    mean = iou.get("mean", sum(iou.values()) / max(len(iou), 1))
    row = ", ".join(f"{name} {value:.3f}" for name, value in iou.items() if name != "mean")
    console.print(f"{what}: mIoU {mean:.3f}; {row}", soft_wrap=True, highlight=False)


SEGMENTING = {"segment": _segment, "segment-train": _train, "segment-score": _score}
"""Command -> what runs it."""
