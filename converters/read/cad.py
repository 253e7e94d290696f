"""A ShapeNet-like OBJ with its materials in, one `CadModel` (z up) out."""

import numpy as np

from converters.geometry.faces import merge_vertices
from converters.geometry.pieces import convex_pieces
from converters.read.files import SourceFolder, read_obj
from converters.read.obj import GREY, join_textures, read_painted_obj, texels
from converters.records.errors import SceneRejected
from converters.records.raw import CadModel, category_of_id
from converters.records.visual import TexturedMesh
from interactive_nav_common.rotations import Y_UP_TO_Z_UP

COLLISION = "collision.obj"
"""Beside a model: its collision mesh, made of convex pieces that share no vertex."""
MOST_OWN = 10
"""Convex pieces of a model that came with its own."""
OWN_SLACK = 0.007
"""Share of the model's bounding box that joining two of them may add: slats become a back, legs stay legs."""


def read_cad(source: SourceFolder, synset: str, cad_id: str) -> CadModel:
    """Reads `cad/<synset>/<id>/models/model_normalized.obj` and turns it to z up.

    A `collision.obj` beside it, of convex pieces, saves the decomposition.
    """
    category = category_of_id(synset, f"{source.root}: CAD model {cad_id} has category id")
    relative = f"cad/{synset}/{cad_id}/models/model_normalized.obj"
    mesh, image, images = read_painted_obj(
        source,
        relative,
        f"an annotation names CAD model {cad_id} of category {synset} ({category}); "
        "put the model there or remove the annotation",
    )
    colours = np.full((len(mesh.faces), 3), GREY, np.uint8)
    for k, own in enumerate(images):
        of = image == k
        middle = np.zeros((int(of.sum()), 2)) if mesh.corner_uv is None else mesh.corner_uv[of].mean(axis=1)
        colours[of] = texels(own, middle)
    # By material, the last first: decompositions depend on the order of the faces, and stored ones have this.
    order = np.argsort(-image, kind="stable")
    used, faces = np.unique(mesh.faces[order], return_inverse=True)
    vertices, faces, keep = merge_vertices(mesh.vertices[used], faces.reshape(-1, 3))
    vertices, faces, colours = clean_surface(source, relative, vertices, faces, colours[order][keep])
    pieces = _own_pieces(source, f"cad/{synset}/{cad_id}/models/{COLLISION}")
    surface = None
    if images:
        uv = np.zeros((len(mesh.faces), 3, 2)) if mesh.corner_uv is None else mesh.corner_uv
        surface = TexturedMesh(mesh.vertices @ Y_UP_TO_Z_UP.T, mesh.faces, *join_textures(uv, image, images))
    turned = vertices @ Y_UP_TO_Z_UP.T
    return CadModel(category, cad_id, turned, faces, colours, pieces, surface=surface)


def _own_pieces(source: SourceFolder, relative: str) -> tuple[tuple[np.ndarray, np.ndarray], ...] | None:
    """Convex pieces that came with a model, z up; None where there are none, or not all of them are convex."""
    if not source.has(relative):
        return None
    mesh = read_obj(source.use(relative, ""))
    pieces = convex_pieces(mesh.vertices @ Y_UP_TO_Z_UP.T, mesh.faces, MOST_OWN, OWN_SLACK)
    if pieces is None:
        source.repaired(f"{relative}: has a piece that is not convex; the model is decomposed")
    return pieces


def clean_surface(
    source: SourceFolder, where: str, vertices: np.ndarray, faces: np.ndarray, colours: np.ndarray
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Drops faces without area and says what else is wrong; open and non-manifold surfaces are left as they are.

    Decomposition rebuilds such surfaces as closed ones (coacd's manifold preprocessing), so that they need no repair
    here; their hulls are a voxel thicker.

    `vertices`: (n, 3), equal positions joined.
    `faces`: (m, 3).
    `colours`: (m, 3) of the faces.
    """
    a, b, c = (vertices[faces[:, k]] for k in range(3))
    extent = np.ptp(vertices, axis=0)
    longest = np.max([np.linalg.norm(b - a, axis=1), np.linalg.norm(c - b, axis=1), np.linalg.norm(a - c, axis=1)], 0)
    area = np.linalg.norm(np.cross(b - a, c - a), axis=1)
    good = area > 1e-9 * np.maximum(longest, 1e-12) ** 2
    if not good.any() or (extent > 1e-6 * max(float(extent.max()), 1e-12)).sum() < 2:
        raise SceneRejected(f"{source.root / where}: its {len(faces)} faces enclose no area; fetch the model again")
    if not good.all():
        source.note(f"{where}: {int((~good).sum())} of {len(faces)} faces have no area; they are dropped")
        faces, colours = faces[good], colours[good]
    open_edges, busy_edges = edge_defects(faces)
    if busy_edges:
        source.note(
            f"{where}: is not manifold ({busy_edges} edges with three faces or more); collision uses closed hulls"
        )
    elif open_edges:
        source.note(f"{where}: is not watertight ({open_edges} open edges); collision uses closed hulls")
    return vertices, faces, colours


def edge_defects(faces: np.ndarray) -> tuple[int, int]:
    """How many edges have one face only, and how many have three or more."""
    edges = np.sort(faces[:, [0, 1, 1, 2, 2, 0]].reshape(-1, 2), axis=1)
    count = np.unique(edges, axis=0, return_counts=True)[1]
    return int((count == 1).sum()), int((count > 2).sum())
