"""Label the vertices of an unlabelled scan with NYU40 ids; score how well they fit those of a labelled one."""

import dataclasses
from pathlib import Path
from typing import Any

import numpy as np

from converters.clock import Report
from converters.generate import GenerationError
from converters.propose.proposals import bounds, box_iou, propose_instances
from converters.propose.retrieval import annotated_vertices
from converters.read.surfaces import floor_level, storey_of
from converters.records.raw import UNLABELLED, RawScene
from converters.segment.network import WEIGHTS, Scores, load_network, make_scores, score_voxels
from converters.segment.samples import TIERS, building_surface
from converters.segment.voxels import (
    NAMES,
    NYU40,
    Surface,
    at_vertices,
    classes_of,
    intersection_over_union,
    sample_surface,
    voxelise,
)

MATCH_IOU = 0.5
"""Of boxes, from which on a proposal is an annotated object."""


def load_scores(weights: Path | None = None) -> Scores:
    """Load the network for `label_scan`; None: with the packaged weights."""
    return make_scores(*load_network(weights or WEIGHTS))


def score_points(surface: Surface, floors_m: tuple[float, ...], scores: Scores, report: Report) -> np.ndarray:
    """Return (n, classes) scores of a surface's points, storey by storey; zeros too high above a floor."""
    out, of = np.zeros((len(surface.points), len(NAMES)), np.float32), storey_of(surface.points[:, 2], floors_m)
    for k, floor_m in enumerate(floors_m):
        mine = np.flatnonzero(of == k)
        colours = None if surface.colours is None else surface.colours[mine]
        part = Surface(surface.points[mine], surface.normals[mine], colours, surface.face[mine])
        voxels = voxelise(part, floor_m)
        scored = score_voxels(voxels, scores, lambda share, k=k: report("segment", (k + share) / len(floors_m)))
        inside = voxels.of_point >= 0
        out[mine[inside]] = scored[voxels.of_point[inside]]
    return out


def label_scan(raw: RawScene, scores: Scores, report: Report = lambda stage, share: None) -> np.ndarray:
    """Return (n,) int64 NYU40 ids of the scan's vertices; its labels are not read. `report` takes stage, share."""
    scan = raw.scan
    floors = tuple(s.height_m for s in raw.storeys)
    if not floors:
        given = raw.floor_height_m
        floors = (floor_level(scan.vertices, scan.faces, raw.name) if given is None else given,)
    surface = sample_surface(scan)
    scored = at_vertices(score_points(surface, floors, scores, report), surface, scan.faces, len(scan.vertices))
    return np.where(scored.any(axis=1), NYU40[scored.argmax(axis=1)], UNLABELLED)


def score_source(raw: RawScene, scores: Scores, report: Report) -> dict[str, Any]:
    """Return IoU by class at the vertices of a labelled source, and how many annotated objects `propose` finds."""
    labels = label_scan(raw, scores, report)
    iou = intersection_over_union(classes_of(raw.scan.labels), classes_of(labels))
    boxes, matched = [(a.category, bounds(annotated_vertices(a, raw.cads))) for a in raw.annotations], []
    for scan in (dataclasses.replace(raw.scan, labels=labels), raw.scan):
        proposed = [(p.category, bounds(p.points)) for p in propose_instances(scan)]
        hits = [any(c == of and box_iou(box, at) >= MATCH_IOU for c, at in proposed) for of, box in boxes]
        matched.append(sum(hits))
    return {"iou": iou, "objects": len(raw.annotations), "matched": matched[0], "matched_true": matched[1]}


def score_homes(seed: int, count: int, scores: Scores, report: Report) -> dict[str, float]:
    """Return IoU by class over the surfaces of generated buildings of all tiers, their furniture held out."""
    truth, predicted = [], []
    while len(truth) < count:
        seed += 1
        try:
            surface, classes = building_surface(seed - 1, TIERS[len(truth) % len(TIERS)], "test")
        except GenerationError:
            continue
        guess = score_points(surface, (0.0,), scores, lambda stage, share: None)
        inside = guess.any(axis=1)
        truth.append(classes[inside])
        predicted.append(guess[inside].argmax(axis=1))
        report("score", len(truth) / count)
    return intersection_over_union(np.concatenate(truth), np.concatenate(predicted))
