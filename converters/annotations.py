"""Scan2CAD's annotation list (also Gibson's `alignments.json`) in, `Annotation` records out.

Frames of the file (Avetisyan et al. 2019): an annotation world, y up; the scan's `trs` leads scan -> world,
each model's `trs` CAD -> world, and both keypoint sets stand in that world (the CAD's after its `trs`).
"""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
from scipy.spatial.transform import Rotation

from converters.cad import Y_UP_TO_Z_UP
from converters.errors import SceneRejected
from converters.raw import SYNSETS, Annotation, Hinge


def trs_matrix(trs: dict[str, Any]) -> np.ndarray:
    """(4, 4) matrix that scales, then turns (quaternion w x y z), then moves."""
    w, x, y, z = (float(v) for v in trs["rotation"])
    matrix = np.eye(4)
    matrix[:3, :3] = Rotation.from_quat([x, y, z, w]).as_matrix() * np.asarray(trs["scale"], float)
    matrix[:3, 3] = np.asarray(trs["translation"], float)
    return matrix


def _apply(matrix: np.ndarray, points: np.ndarray) -> np.ndarray:
    return points @ matrix[:3, :3].T + matrix[:3, 3]


def _keypoints(model: dict[str, Any], key: str) -> np.ndarray:
    flat = np.asarray(model.get(key, {}).get("position", []), float)
    return flat.reshape(-1, 3)


def _hinge(model: dict[str, Any], where: str) -> Hinge | None:
    raw = model.get("articulation")
    if raw is None:
        return None
    if raw.get("type") != "hinge":
        raise SceneRejected(f"{where}: articulation type is {raw.get('type')!r}, expected 'hinge'")
    axis = Y_UP_TO_Z_UP @ np.asarray(raw["axis"], float)
    if abs(axis[2]) < 0.9 * np.linalg.norm(axis):
        raise SceneRejected(f"{where}: the hinge axis is {raw['axis']}, expected the vertical (0, 1, 0)")
    low, high = sorted(float(v) for v in raw["range_rad"])
    return Hinge(Y_UP_TO_Z_UP @ np.asarray(raw["origin"], float), float(np.sign(axis[2])), (low, high))


def parse_annotations(data: Any, path: Path) -> tuple[str, tuple[tuple[str, Annotation], ...]]:
    """Turns the decoded list of one scan into records.

    Returns:
        The scan id, and for each object its synset id and annotation.

    Raises:
        SceneRejected: not a list of one scan, a missing key, an unknown category, a singular pose.
    """
    if not isinstance(data, list) or len(data) != 1:
        got = f"a list of {len(data)}" if isinstance(data, list) else type(data).__name__
        raise SceneRejected(f"{path}: got {got}, expected a list with the annotation of one scan; cut it to one scan")
    records = []
    where = str(path)
    try:
        scan_to_world = trs_matrix(data[0]["trs"])
        world_to_scan = np.linalg.inv(scan_to_world)
        cad_to_y_up = np.eye(4)
        cad_to_y_up[:3, :3] = Y_UP_TO_Z_UP.T
        for i, model in enumerate(data[0]["aligned_models"]):
            where = f"{path}: aligned_models[{i}]"
            synset, cad_id = str(model["catid_cad"]), str(model["id_cad"])
            if synset not in SYNSETS:
                known = ", ".join(f"{k} ({v})" for k, v in sorted(SYNSETS.items()))
                raise SceneRejected(f"{where}: category id is {synset}, expected one of {known}")
            pose_y_up = trs_matrix(model["trs"])
            if abs(np.linalg.det(pose_y_up)) < 1e-9:
                raise SceneRejected(f"{where}: the scale is {model['trs']['scale']}, expected three non-zero numbers")
            pose = world_to_scan @ pose_y_up @ cad_to_y_up
            cad_points = _apply(np.linalg.inv(pose_y_up @ cad_to_y_up), _keypoints(model, "keypoints_cad"))
            scan_points = _apply(world_to_scan, _keypoints(model, "keypoints_scan"))
            count = min(len(cad_points), len(scan_points))
            records.append(
                (
                    synset,
                    Annotation(
                        category=SYNSETS[synset],
                        cad_id=cad_id,
                        pose=pose,
                        symmetry=str(model.get("sym", "__SYM_NONE")),
                        keypoints_cad=cad_points[:count],
                        keypoints_scan=scan_points[:count],
                        hinge=_hinge(model, where),
                    ),
                )
            )
    except (KeyError, TypeError, ValueError) as error:
        if isinstance(error, SceneRejected):
            raise
        what = f"missing key {error}" if isinstance(error, KeyError) else str(error)
        raise SceneRejected(f"{where}: {what}; expected Scan2CAD's annotation layout") from error
    return str(data[0].get("id_scan", path.parent.name)), tuple(records)
