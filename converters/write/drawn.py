"""Prepare source surfaces for drawing: as they are where they are small, else simplified and baked."""

import dataclasses
from collections.abc import Sequence

import numpy as np

from converters.bodies.objects import PlacedObject
from converters.geometry.simplify import simplify_to, surface_loss
from converters.records.visual import ColourCloud, TexturedMesh, VisualMesh
from converters.write.texture import bake_object, textured_cloud
from interactive_nav_common.rotations import matrix_from_quat


@dataclasses.dataclass(frozen=True)
class Drawn:
    """What is drawn of an object (body frame), and how much of its model's surface that is."""

    mesh: VisualMesh
    shown_share: float
    """Of the texels, what the scan showed."""
    kept_share: float
    """Of the model's area."""
    off_m: float
    """Farthest that the model's surface lies from the drawn one."""


def as_it_is(mesh: TexturedMesh, most_faces: int, size: int) -> VisualMesh | None:
    """Return the surface with its vertices and image; None where it has too many faces or too large an image.

    Args:
        size: most pixels a side of the image, which must not repeat.
    """
    if mesh.texture is None or mesh.corner_uv is None or len(mesh.faces) > most_faces or max(mesh.texture.shape) > size:
        return None
    if mesh.corner_uv.min() < -1e-6 or mesh.corner_uv.max() > 1 + 1e-6:
        return None
    # Corners of different charts lie in one place: the place is written once.
    corners = mesh.vertices[mesh.faces].reshape(-1, 3)
    # In order of appearance, which a scale does not change: copies in other proportions share the mesh.
    _, first, place = np.unique(np.round(corners, 5), axis=0, return_index=True, return_inverse=True)
    order = np.argsort(first)
    first, faces = first[order], np.argsort(order)[place.reshape(-1)]
    uv, uv_faces = np.unique(np.clip(mesh.corner_uv, 0, 1).reshape(-1, 2), axis=0, return_inverse=True)
    shape = (-1, 3)
    return VisualMesh(corners[first], faces.reshape(shape), uv, uv_faces.reshape(shape), mesh.texture, True)


def draw_objects(
    objects: Sequence[PlacedObject], clouds: Sequence[ColourCloud], most_faces: int, size: int
) -> list[Drawn]:
    """Draw objects of one model and size: simplify the model once, by an error first, then to a number of faces.

    One that the scan shows takes the scan's colours, any other one its model's.
    `size`: of the texture, pixels.
    """
    first, unscanned = objects[0], None
    surface, mesh = first.surface_b, (first.vertices_b, first.faces)
    small = None if surface is None else as_it_is(surface, most_faces, size)
    if small is not None:
        unscanned = Drawn(small, 0.0, 1.0, 0.0)
    low, loss, done = mesh, (1.0, 0.0), []
    if unscanned is None or any(len(cloud.points) for cloud in clouds):
        low = simplify_to(*mesh, most_faces)
        loss = surface_loss(*mesh, *low)
    for placed, cloud in zip(objects, clouds, strict=True):
        if len(cloud.points):
            turn = matrix_from_quat(placed.quaternion_w)
            cloud_b = dataclasses.replace(
                cloud, points=(cloud.points - placed.position_w) @ turn, normals=cloud.normals @ turn
            )
            done.append(Drawn(*bake_object(*mesh, first.face_colours, cloud_b, low, size), *loss))
            continue
        if unscanned is None:
            spacing_m = max(float(np.ptp(first.vertices_b, axis=0).max()) / size, 1e-3)
            cloud_b = cloud if surface is None else textured_cloud(surface, spacing_m)
            unscanned = Drawn(bake_object(*mesh, first.face_colours, cloud_b, low, size)[0], 0.0, *loss)
        done.append(unscanned)
    return done
