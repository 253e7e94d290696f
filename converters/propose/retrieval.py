"""Choose the CAD model and pose that fit each proposal best, and rate how certain the choice is.

In the paper, people chose and aligned models. Here, two-sided iterative closest point fits every model of the class
from several yaws with the same seven parameters, and the distances between scan and model in both directions decide.
"""

import bisect
import dataclasses
import math
import re
from collections.abc import Callable, Mapping
from pathlib import Path

import numpy as np
import trimesh
from scipy.spatial import KDTree

from converters.bodies.alignment import Alignment, AlignmentError, apply_alignment, least_squares
from converters.library.store import read_index, read_shape
from converters.propose.pieces import SIZES_M, Proposal, bounds
from converters.read.annotations import read_cad
from converters.read.files import SourceFolder
from converters.read.obj import texels
from converters.records.errors import SceneRejected
from converters.records.raw import CATEGORY_LABELS, SYNSETS, Annotation, CadModel, TexturedMesh
from interactive_nav_common.rotations import Y_UP_TO_Z_UP, transformed, wrap_angle, yaw_matrix

N_YAWS = 24
"""Starting yaws, even steps over the circle from the box's."""
COARSE_STEPS, FINE_STEPS = 6, 20
KEEP = 4
"""Starts that are refined to the end, per model."""
COARSE_POINTS, FINE_POINTS = 250, 900
FAR_M = 0.15
"""A point farther off than this counts as this far: unseen backs, clutter on the seat."""
CAD_WEIGHT = 0.5
"""Weight of model-to-scan distances beside scan-to-model ones: a scan never shows all of a model."""
SCALE_SPREAD_M = 0.03
"""Cost of scaling the axes unequally, per unit of the standard deviation of the logarithms of the scales."""
LIKELY_M = 0.006
"""Models whose cost is this much higher are e times less likely."""
CLOSE_M = 0.05


@dataclasses.dataclass(frozen=True)
class Retrieval:
    """Hold the best model and pose for one proposal."""

    cad: CadModel
    pose: Alignment
    """Upright, CAD frame -> scan frame; `rms_m` is nan."""
    cost_m: float
    residual_m: float
    """Mean distance of the scan's points to the model, each at most `FAR_M`."""
    explained: float
    """Share of the scan within 5 cm of the model."""
    supported: float
    """Share of the model within 10 cm of the scan."""
    confidence: float = 0.0
    """In [0, 1]: both shares, x likelihood of this model among those tried."""
    ranking: tuple[tuple[str, float], ...] = ()
    """(cad_id, cost in m) of every model tried, best first."""


def read_library(root: Path | None, source: Path | None = None) -> dict[str, CadModel]:
    """Read by id the models `root/cad/<synset>/<id>/models/model_normalized.obj` of the wanted classes.

    `root` None: the source's folder if it contains `cad/`, else the packaged furniture.
    """
    if root is None and source is not None and (source / "cad").is_dir():
        root = source
    library = {}
    for name, model in read_index().items() if root is None else ():
        if model.category in SIZES_M:
            visual, hulls = (shape := read_shape(name)).visual, shape.hulls
            corner_uv, turned = visual.uv[visual.uv_faces], visual.vertices @ Y_UP_TO_Z_UP.T
            look = turned, visual.faces, texels(visual.image, corner_uv.mean(axis=1))
            solids = tuple((hull.vertices @ Y_UP_TO_Z_UP.T, hull.faces) for hull in hulls)
            surface, cad_id = TexturedMesh(*look[:2], corner_uv, visual.image), re.sub("[^A-Za-z0-9_-]", "_", name)
            library[cad_id] = CadModel(model.category, cad_id, *look, solids, surface=surface)
    if root is None:
        return library
    folder = SourceFolder(root)
    for path in sorted((root / "cad").glob("*/*/models/model_normalized.obj")):
        synset, cad_id = path.parts[-4], path.parts[-3]
        if SYNSETS.get(synset) in SIZES_M:
            library[cad_id] = read_cad(folder, synset, cad_id)
    if not library:
        raise SceneRejected(
            f"{root / 'cad'}: no model of a known class (<synset>/<id>/models/model_normalized.obj); "
            "put a library there"
        )
    return library


def _thin(points: np.ndarray, count: int) -> np.ndarray:
    """Return at most about `count` of the points, spread evenly: the first in each cell of the finest fitting grid."""
    if len(points) <= count:
        return points

    def firsts(side_m: float) -> np.ndarray:
        return np.unique(np.floor((points - points.min(axis=0)) / side_m), axis=0, return_index=True)[1]

    sides_m = np.geomspace(max(float(np.ptp(points, axis=0).max()), 2e-3), 1e-3, 400).tolist()
    finest = bisect.bisect_right(sides_m, count, key=lambda side_m: len(firsts(side_m))) - 1
    return points[np.sort(firsts(sides_m[max(finest, 0)]))]


def _surface(cad: CadModel, count: int) -> np.ndarray:
    """Return about `count` even samples of the model's surface, CAD frame."""
    mesh = trimesh.Trimesh(cad.vertices, cad.faces, process=False)
    return _thin(np.asarray(trimesh.sample.sample_surface(mesh, 8 * count, seed=0)[0]), count)


def _start(
    cad_low: np.ndarray, cad_high: np.ndarray, points: np.ndarray, floor_m: float | None, yaw: float
) -> Alignment:
    """Return the pose that lays the model's box on the box of the scan's points along that yaw."""
    turned = points @ yaw_matrix(yaw)
    # The outermost hundredth is noise and mislabelled neighbours.
    low, high = np.percentile(turned, 1, axis=0), np.percentile(turned, 99, axis=0)
    if floor_m is not None:
        low[2] = floor_m
    scale = np.maximum(high - low, 0.05) / np.maximum(cad_high - cad_low, 1e-3)
    middle = (low + high) / 2 - scale * (cad_low + cad_high) / 2
    return Alignment(scale, yaw_matrix(yaw) @ middle, yaw, math.nan)


def _on_floor(pose: Alignment, p: np.ndarray, q: np.ndarray, w: np.ndarray, base: float, floor_m: float) -> Alignment:
    """Return the pose with its base on the floor: the z scale is then a regression through that height."""
    height = p[:, 2] - base
    scale_z = max(float(w @ (height * (q[:, 2] - floor_m))) / max(float(w @ height**2), 1e-12), 0.05)
    scale = pose.scale * [1.0, 1.0, 0.0] + [0.0, 0.0, scale_z]
    return dataclasses.replace(pose, scale=scale, translation=np.append(pose.translation[:2], floor_m - scale_z * base))


def _refine(
    pose: Alignment, surface: np.ndarray, points: np.ndarray, tree: KDTree, steps: int, floor_m: float | None
) -> Alignment:
    """Alternate closest pairs, both ways, with the fit of the seven parameters."""
    reach = 0.3
    base = float(surface[:, 2].min())
    for _ in range(steps):
        moved = apply_alignment(pose, surface)
        to_cad, index = KDTree(moved).query(points)
        to_scan, other = tree.query(moved)
        p = np.vstack([surface[index], surface])
        q = np.vstack([points, points[other]])
        distance = np.concatenate([to_cad, to_scan])
        # Geman-McClure weights: pairs far beyond the reach count little.
        weight = 1.0 / (1.0 + (distance / (reach / 2)) ** 2) ** 2
        weight[len(points) :] *= CAD_WEIGHT * len(points) / len(surface)
        weight[distance > 2 * reach] = 0.0
        used = weight > 0
        try:
            fit = least_squares(p[used], q[used], weights=weight[used])
        except AlignmentError:
            return pose
        # A fit to a partial scan creeps together: bound a step and the inequality of the scales.
        fit = dataclasses.replace(fit, scale=np.clip(fit.scale, 0.9 * pose.scale, 1.1 * pose.scale))
        middle = (weight[used] @ p[used]) / weight[used].sum()
        target = (weight[used] @ q[used]) / weight[used].sum()
        fit = dataclasses.replace(fit, translation=target - yaw_matrix(fit.yaw) @ (fit.scale * middle))
        pose = fit if floor_m is None else _on_floor(fit, p[used], q[used], weight[used], base, floor_m)
        reach = max(0.8 * reach, 0.08)
    return pose


def _judge(cad: CadModel, pose: Alignment, surface: np.ndarray, points: np.ndarray, tree: KDTree) -> Retrieval:
    moved = apply_alignment(pose, surface)
    to_cad = KDTree(moved).query(points)[0]
    to_scan = tree.query(moved)[0]
    residual = float(np.minimum(to_cad, FAR_M).mean())
    unequal = float(np.std(np.log(pose.scale)))
    cost = residual + CAD_WEIGHT * float(np.minimum(to_scan, FAR_M).mean()) + SCALE_SPREAD_M * unequal
    explained, supported = float((to_cad < CLOSE_M).mean()), float((to_scan < 2 * CLOSE_M).mean())
    return Retrieval(cad, dataclasses.replace(pose, rms_m=math.nan), cost, residual, explained, supported)


def fit_model(proposal: Proposal, cad: CadModel, floor_m: float | None) -> Retrieval:
    """Return the best pose of one model: many coarse starts, the best few refined."""
    low, high = cad.vertices.min(axis=0), cad.vertices.max(axis=0)
    coarse = _thin(proposal.points, COARSE_POINTS)
    coarse_tree, coarse_surface = KDTree(coarse), _surface(cad, COARSE_POINTS)
    starts = []
    for k in range(N_YAWS):
        pose = _start(low, high, proposal.points, floor_m, proposal.yaw + 2 * math.pi * k / N_YAWS)
        pose = _refine(pose, coarse_surface, coarse, coarse_tree, COARSE_STEPS, floor_m)
        starts.append(_judge(cad, pose, coarse_surface, coarse, coarse_tree))
    starts.sort(key=lambda f: f.cost_m)
    chosen: list[Retrieval] = []
    for start in starts:
        if all(abs(wrap_angle(start.pose.yaw - c.pose.yaw)) > math.radians(10) for c in chosen):
            chosen.append(start)
    fine = _thin(proposal.points, FINE_POINTS)
    tree, surface = KDTree(fine), _surface(cad, FINE_POINTS)
    poses = [_refine(s.pose, surface, fine, tree, FINE_STEPS, floor_m) for s in chosen[:KEEP]]
    fits = [_judge(cad, pose, surface, fine, tree) for pose in poses]
    best = min(fits, key=lambda f: f.cost_m)
    return dataclasses.replace(best, pose=dataclasses.replace(best.pose, yaw=wrap_angle(best.pose.yaw)))


def retrieve(
    proposal: Proposal, library: Mapping[str, CadModel], floor_m: float | None, any_category: bool = False
) -> Retrieval | None:
    """Return the model of the library that fits a proposal best; None when none is of its class."""
    floor = None if proposal.category == "door" else floor_m
    fits = {
        cad_id: fit_model(proposal, cad, floor)
        for cad_id, cad in sorted(library.items())
        if any_category or proposal.label in CATEGORY_LABELS[cad.category]  # a desk is often labelled a table
    }
    if not fits:
        return None
    ranking = sorted(fits.items(), key=lambda item: item[1].cost_m)
    best = ranking[0][1]
    likelihood = 1.0 / sum(math.exp(-(f.cost_m - best.cost_m) / LIKELY_M) for f in fits.values())
    return dataclasses.replace(
        best,
        residual_m=round(best.residual_m, 5),
        confidence=round(best.explained * best.supported * likelihood, 4),
        ranking=tuple((k, f.cost_m) for k, f in ranking),
    )


MIN_CONFIDENCE = 0.2
"""Retrievals less sure than this are not used by `--auto-align`."""


def annotated_vertices(annotation: Annotation, cads: Mapping[str, CadModel]) -> np.ndarray:
    """Return (n, 3), the annotated model's vertices in the scan frame, m."""
    return transformed(cads[annotation.cad_id].vertices, annotation.pose)


def without_annotation(
    proposals: tuple[Proposal, ...], annotations: tuple[Annotation, ...], cads: Mapping[str, CadModel]
) -> list[int]:
    """Return indices of the proposals of which less than half lies in the (10 cm larger) box of an annotated model."""
    boxes = [np.array(bounds(annotated_vertices(a, cads))) + [[-2 * CLOSE_M], [2 * CLOSE_M]] for a in annotations]

    def inside(points: np.ndarray) -> float:
        return max((float(((points > low) & (points < high)).all(axis=1).mean()) for low, high in boxes), default=0.0)

    return [k for k, proposal in enumerate(proposals) if inside(proposal.points) < 0.5]


def auto_align(
    proposals: tuple[Proposal, ...],
    library: Mapping[str, CadModel],
    floor_m: float | None,
    progress: Callable[[float], None],
) -> dict[int, Retrieval]:
    """Return index of a proposal -> what was retrieved for it, without proposals with no model of their class."""
    retrieved = {}
    for k, proposal in enumerate(proposals):
        one = retrieve(proposal, library, floor_m)
        if one is not None:
            retrieved[k] = one
        progress((k + 1) / len(proposals))
    return retrieved
