"""Commands of `python -m converters` that label scans, and what they print; their words are in words.yaml."""

from __future__ import annotations

import argparse
import json
from pathlib import Path

from rich.console import Console

from converters.records.errors import SceneRejected
from interactive_nav_common.files import write_arrays, write_text
from interactive_nav_common.progress import stage_progress


def _labels_of(source: Path) -> Path:
    """Where the readers look for a source's labels."""
    from converters.read.gibson import LABELS
    from converters.read.meshes import labels_beside

    if source.is_file():
        return labels_beside(source)
    from converters.read.source import detect_format

    layout = detect_format(source)
    if layout != "gibson":
        raise SceneRejected(f"{source}: is of layout {layout}, expected a mesh file or a folder of layout gibson")
    return source / LABELS


def _segment(arguments: argparse.Namespace, console: Console) -> int:
    target = _labels_of(arguments.source)
    if target.exists() and not arguments.overwrite:
        raise SceneRejected(f"{target}: the scan has labels; give --overwrite to replace them")
    arguments.output = target
    _label(arguments, target, arguments.weights, console)
    return 0


def label_unlabelled(arguments: argparse.Namespace, console: Console) -> None:
    """The step of `convert --segment`: labels the source beside it, unless it has labels, perhaps edited ones."""
    target = _labels_of(arguments.source)
    if target.exists():
        console.print(f"{target}: is there, kept", soft_wrap=True)
    else:
        _label(arguments, target, None, console)


def propose_unproposed(arguments: argparse.Namespace, console: Console) -> Path | None:
    """The next step of it: beside a mesh file, the models that fit, unless they are there; None for a folder."""
    from converters.propose.proposals import as_scan2cad
    from converters.propose.report import retrieve_sure
    from converters.read.source import read_source

    source = arguments.source
    if not source.is_file():
        return None
    target = source.with_name(f"{source.stem}.proposals.json")
    if target.exists():
        console.print(f"{target}: is there, kept", soft_wrap=True)
        return target
    about = (getattr(arguments, word) for word in ("format", "strict", "up", "unit", "root", "mirror"))
    with stage_progress(console) as report:
        found, models = retrieve_sure(read_source(source, *about), arguments.library, lambda x: report("propose", x))
    text = json.dumps(as_scan2cad(source.stem, found, dict(enumerate(models))), indent=1, allow_nan=False)
    write_text(target, text + "\n")
    console.print(f"{target}: {len(models)} models", soft_wrap=True)
    return target


def _label(arguments: argparse.Namespace, target: Path, weights: Path | None, console: Console) -> None:
    import numpy as np

    from converters.read.source import read_source
    from converters.segment.labelling import label_scan, load_scores
    from converters.segment.network import WEIGHTS

    scores = load_scores(weights or WEIGHTS)
    with stage_progress(console) as report:
        labels = label_scan(read_source(arguments.source, up=arguments.up, unit=arguments.unit), scores, report)
    write_arrays(target, label=labels.astype(np.uint8))
    console.print(f"{target}: labels of {len(labels)} vertices", soft_wrap=True)


def _train(arguments: argparse.Namespace, console: Console) -> int:
    from converters.segment.train import SegmentConfig, train
    from interactive_nav_common.config import overridden

    config = overridden(SegmentConfig(), arguments.settings)
    with stage_progress(console) as report:
        scores = train(arguments.out, config, report, lambda line: console.print(line, soft_wrap=True))
    _table(console, "held-out crops", scores)
    return 0


def _score(arguments: argparse.Namespace, console: Console) -> int:
    from converters.read.source import read_source
    from converters.segment.labelling import load_scores, score_homes, score_source
    from converters.segment.network import WEIGHTS
    from converters.segment.train import HELD_OUT_SEED

    scores = load_scores(arguments.weights or WEIGHTS)
    with stage_progress(console) as report:
        for source in arguments.sources:
            found = score_source(read_source(source), scores, report)
            _table(console, str(source), found["iou"])
            console.print(
                f"{source}: of {found['objects']} annotated objects {found['found']} found, "
                f"{found['found_true']} with its own labels",
                soft_wrap=True,
            )
        if arguments.homes:
            # Whole buildings of other seeds than those whose crops the training was watched by.
            found = score_homes(HELD_OUT_SEED + 50_000, arguments.homes, scores, report)
            _table(console, f"{arguments.homes} held-out buildings", found)
    return 0


def _table(console: Console, what: str, iou: dict[str, float]) -> None:
    mean = iou.get("mean", sum(iou.values()) / max(len(iou), 1))
    row = ", ".join(f"{name} {value:.3f}" for name, value in iou.items() if name != "mean")
    console.print(f"{what}: mIoU {mean:.3f}; {row}", soft_wrap=True, highlight=False)


SEGMENTING = {"segment": _segment, "segment-train": _train, "segment-score": _score}
"""Command -> what runs it."""
