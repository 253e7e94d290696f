"""Furniture and its scan in, Scan2CAD-like annotations out: noisy poses and keypoint pairs, as people give.

Frames: the scan is z up; the annotation's world is y up (`trs` of the scan turns -90 degrees about x and
centres it). A pose composes as in Scan2CAD: world = T * R * S * cad. `bbox` holds half extents and `center`
the centre of the CAD's bounding box, both in the CAD frame. Keypoints of both kinds are in world coordinates,
those of the CAD through the annotated pose.
"""

from typing import Any

import numpy as np
from scipy.spatial import KDTree
from scipy.spatial.transform import Rotation

from converters.generate.design.config import BuildingConfig
from converters.generate.design.instance import Instance
from converters.generate.surface.scan import Scan

SCAN_TO_WORLD = Rotation.from_euler("x", -90, degrees=True)
"""z up -> y up: (x, y, z) -> (x, z, -y)."""


def quat_wxyz(rotation: Rotation) -> list[float]:
    """Quaternion, scalar first and not negative."""
    x, y, z, w = rotation.as_quat(canonical=True)
    return [float(w), float(x), float(y), float(z)]


def _trs(translation: np.ndarray, rotation: Rotation, scale: np.ndarray) -> dict[str, list[float]]:
    return {
        "translation": [float(v) for v in translation],
        "rotation": quat_wxyz(rotation),
        "scale": [float(v) for v in scale],
    }


def pose_in_world(item: Instance, scan_to_world_m: np.ndarray, floor_height_m: float) -> tuple[np.ndarray, Rotation]:
    """The exact pose of a piece of furniture.

    Returns:
        (3,) translation and rotation of T * R * S, CAD frame -> world (y up).
    """
    position_scan = item.position + np.array([0.0, 0.0, floor_height_m])
    return SCAN_TO_WORLD.apply(position_scan) + scan_to_world_m, Rotation.from_euler("y", item.yaw_rad)


def pick_keypoints(item: Instance, scan_owned: np.ndarray, n: int, rng: np.random.Generator) -> np.ndarray:
    """Chooses (n, 3) points of the CAD, CAD frame: corners that the scan shows, far from one another.

    A candidate is a vertex of a part; those near a scanned point of the object come first. Spread is by
    farthest points, so that all three scales can be told.
    """
    candidates = np.unique(np.round(np.concatenate([p.vertices for p in item.model.parts]), 5), axis=0)
    placed = item.to_floor(candidates)
    if len(scan_owned):
        distance, _ = KDTree(scan_owned).query(placed)
        visible = distance < 0.04
        if visible.sum() >= 3 * n:
            candidates, placed = candidates[visible], placed[visible]
    chosen = [int(rng.integers(len(candidates)))]
    gap = np.full(len(candidates), np.inf)
    while len(chosen) < n:
        gap = np.minimum(gap, np.linalg.norm(placed - placed[chosen[-1]], axis=1))
        # Not always the very farthest: people do not click extremes only.
        best = np.argsort(-gap, kind="stable")[: max(1, len(gap) // 50)]
        chosen.append(int(best[rng.integers(len(best))]))
    return candidates[chosen]


def annotate_items(items: list[Instance], scan: Scan, floor_height_m: float, cfg: BuildingConfig, seed: int,
             rng: np.random.Generator) -> list[dict[str, Any]]:  # fmt: skip
    """Writes down what an annotator would.

    Returns:
        The content of `alignments.json`: a list of one scan.
    """
    lift = np.array([0.0, 0.0, floor_height_m])
    centre = (scan.vertices.min(axis=0) + scan.vertices.max(axis=0)) / 2 + lift
    to_world_m = -SCAN_TO_WORLD.apply(centre)
    owner = scan.owner
    models = []
    for k, item in enumerate(items):
        true_t, true_r = pose_in_world(item, to_world_m, floor_height_m)
        noise = cfg.annotation_noise_m
        turn = Rotation.from_euler("yxz", rng.normal(0, np.radians([0.8, 0.3, 0.3])) * noise / 0.01)
        t = true_t + rng.normal(0, 0.6 * noise, 3)
        r = true_r * turn
        scale = item.scale * (1 + rng.normal(0, 0.8 * noise, 3))
        points = pick_keypoints(item, scan.vertices[owner == k], int(rng.integers(6, 11)), rng)
        on_cad = r.apply(points * scale) + t
        on_scan = true_r.apply(points * item.scale) + true_t + rng.normal(0, noise, points.shape)
        entry: dict[str, Any] = {
            "trs": _trs(t, r, scale),
            "bbox": [float(v) for v in item.model.half_extents],
            "center": [float(v) for v in item.model.center],
            "sym": item.model.sym,
            "id_cad": item.model.id_cad,
            "catid_cad": item.model.catid,
            "keypoints_cad": {"n_keypoints": len(points), "position": [float(v) for v in on_cad.ravel()]},
            "keypoints_scan": {"n_keypoints": len(points), "position": [float(v) for v in on_scan.ravel()]},
        }
        if item.hinge is not None:
            entry["articulation"] = {
                "type": "hinge",
                "axis": list(item.hinge.axis),
                "origin": list(item.hinge.origin),
                "range_rad": [float(v) for v in item.hinge.range_rad],
            }
        models.append(entry)
    return [{
        "trs": _trs(to_world_m, SCAN_TO_WORLD, np.ones(3)),
        "n_aligned_models": len(models),
        "aligned_models": models,
        "id_alignment": f"generated-{seed}",
        "id_scan": f"generated_{seed:04d}",
    }]  # fmt: skip
