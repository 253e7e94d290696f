"""What the browser shows of an object: the scan around it, the model beside it, the camera, pictures of models."""

import dataclasses
import math

import numpy as np
import trimesh

from converters.annotate.session import Item
from converters.bodies.alignment import Alignment, apply_alignment
from converters.check.model_sheet import camera_axes, mesh_picture
from converters.propose.proposals import bounds
from converters.read.meshes import textured_by_face
from converters.read.obj import texels
from converters.records.raw import CEILING, CadModel, RawScene, ScanMesh
from interactive_nav_common.rotations import Y_UP_TO_Z_UP, yaw_matrix

MARGIN_M = 0.3
"""So much of the scan is shown around an object."""
THUMBNAIL = 116
"""Pixels a side."""


@dataclasses.dataclass(frozen=True)
class View:
    """Of one object."""

    bench: Alignment
    """CAD frame -> scan frame, where the model stands beside its object, facing the camera."""
    eye: np.ndarray
    """(3,) of the camera, scan frame, m."""
    middle: np.ndarray
    """(3,) between object and model: where it looks."""


def painted(scan: ScanMesh) -> trimesh.Trimesh:
    """The scan with a colour at each vertex, without its ceiling."""
    colours = scan.vertex_colours
    if scan.texture is not None and scan.corner_uv is not None:
        colours = np.full((len(scan.vertices), 3), 180, np.uint8)
        colours[scan.faces.ravel()] = texels(scan.texture, scan.corner_uv.reshape(-1, 2))
    keep = ~(scan.labels[scan.faces] == CEILING).all(axis=1)
    return trimesh.Trimesh(scan.vertices, scan.faces[keep], vertex_colors=colours, process=False)


def around(mesh: trimesh.Trimesh, item: Item) -> trimesh.Trimesh:
    """The scan's faces about an object; all of them where there are none."""
    half = np.array([math.hypot(*item.extent_m[:2]) / 2] * 2 + [item.extent_m[2] / 2]) + MARGIN_M
    near = (np.abs(mesh.triangles_center - item.centre) < half).all(axis=1)
    found = mesh.submesh([np.flatnonzero(near)], append=True, repair=False) if near.any() else mesh
    assert isinstance(found, trimesh.Trimesh)
    return found


def view_of(item: Item, cad: CadModel | None, raw: RawScene) -> View:
    """Object on the left, model on the right, seen from the room's middle so that walls stand behind."""
    inwards = raw.scan.vertices[:, :2].mean(axis=0) - item.centre[:2]
    far = float(np.linalg.norm(inwards))
    x, y = inwards / far if far > 0.3 else (0.0, -1.0)
    right, wide = np.array([-y, x, 0.0]), math.hypot(*item.extent_m[:2]) + 2 * MARGIN_M
    low, high = bounds(cad.vertices) if cad else (np.full(3, -0.5), np.full(3, 0.5))
    size = max(item.extent_m) / max(float((high - low).max()), 1e-6)
    yaw = math.atan2(y, x) + math.pi / 2  # a model's front is -y of the CAD frame
    gap = wide / 2 + size * math.hypot(*(high - low)[:2]) / 2 + 0.1
    at = np.array(item.centre) + gap * right
    bench = Alignment(np.full(3, size), at - size * (yaw_matrix(yaw) @ ((low + high) / 2)), yaw, math.nan)
    middle = np.array(item.centre) + gap / 2 * right
    return View(bench, middle + 0.95 * (wide + gap) * np.array([0.8 * x, 0.8 * y, 0.5]), middle)


def coloured(cad: CadModel, pose: Alignment) -> trimesh.Trimesh:
    """A model under a pose, its faces coloured."""
    mesh = trimesh.Trimesh(apply_alignment(pose, cad.vertices), cad.faces, face_colors=cad.face_colours, process=False)
    mesh.unmerge_vertices()
    return mesh


def hit(mesh: trimesh.Trimesh, origin: np.ndarray, direction: np.ndarray) -> tuple[float, np.ndarray]:
    """Distance along a ray to the nearest surface, m, and the point (3,); infinite where it meets none."""
    points = mesh.ray.intersects_location([origin], [direction])[0].reshape(-1, 3)
    along = (points - origin) @ (direction / np.linalg.norm(direction))
    k = int(np.argmin(along)) if len(along) else -1
    return (float(along[k]), points[k]) if k >= 0 else (math.inf, np.zeros(3))


def thumbnail(cad: CadModel) -> np.ndarray:
    """(`THUMBNAIL`, `THUMBNAIL`, 3) uint8 picture of a model from its front, right and above."""
    mesh = cad.surface or textured_by_face(cad.vertices, cad.faces, cad.face_colours)
    return mesh_picture(mesh, camera_axes() @ Y_UP_TO_Z_UP.T, THUMBNAIL)
