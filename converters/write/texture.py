"""Bake textures of meshes from coloured scan points, or keep surfaces as they are where they are small."""

import dataclasses
import math
from collections.abc import Sequence

import numpy as np
import xatlas
from PIL import Image
from scipy import ndimage
from scipy.spatial import KDTree

from converters.bodies.objects import PlacedObject
from converters.geometry.faces import face_areas, sample_faces, simplify_to, surface_loss, unit_normals, vertex_normals
from converters.read.obj import texels
from converters.records.errors import CLOUD
from converters.records.raw import ColourCloud, ScanMesh, TexturedMesh, VisualMesh
from converters.write.light import Daylight, light_on
from interactive_nav_common.grids import nearest_cell
from interactive_nav_common.rotations import matrix_from_quat

VISIBLE_M = 0.08
"""A scan point this close to the model's surface shows it: alignments are off by several centimetres."""
AGREE = 0.5
"""Least |cosine| between the normals of model and scan (CAD normals may point inwards or outwards)."""
TEXTURE_SPACING_M = 0.025
"""Sampling of a textured scan's surface; a vertex-coloured scan is sampled at its vertices."""
LEVELS = 63
"""Steps of each channel, few enough for a small PNG."""
APART = 4
"""Texels between charts of all but small images: what lies between shows the nearer one, so none bleeds."""
NO_CLOUD = ColourCloud(*(np.zeros((0, 3)),) * 3)
PLAIN, MARGIN = 8, 4
"""Levels of a channel that a face of one colour may differ by; texels that are kept around what is looked up."""


def colour_cloud(
    scan: TexturedMesh, vertices_w: np.ndarray, face_index: np.ndarray, spacing_m: float = TEXTURE_SPACING_M
) -> ColourCloud:
    """Sample coloured points of the scan's faces (k,): vertices (n, 3) m, world, or a sampling of the texture."""
    chosen = scan.faces[face_index]
    if scan.texture is None or scan.corner_uv is None:
        assert isinstance(scan, ScanMesh) and scan.vertex_colours is not None
        used = np.unique(chosen)
        normals = vertex_normals(vertices_w, chosen)[used]
        return ColourCloud(vertices_w[used], normals, scan.vertex_colours[used].astype(float))
    spacing_m = max(spacing_m, math.sqrt(2 * face_areas(vertices_w, chosen).sum() / CLOUD))
    corners = np.hstack([vertices_w[chosen].reshape(-1, 3), scan.corner_uv[face_index].reshape(-1, 2)])
    points, index = sample_faces(corners, np.arange(len(corners)).reshape(-1, 3), spacing_m)
    colours = texels(scan.texture, points[:, 3:]).astype(float)
    return ColourCloud(points[:, :3], unit_normals(vertices_w, chosen)[index], colours)


def textured_cloud(mesh: TexturedMesh, spacing_m: float) -> ColourCloud:
    """Sample coloured points of a whole surface with an image; none without one."""
    if mesh.texture is None:
        return NO_CLOUD
    return colour_cloud(mesh, mesh.vertices, np.arange(len(mesh.faces)), spacing_m)


def unwrap(vertices: np.ndarray, faces: np.ndarray, size: int) -> tuple[np.ndarray, np.ndarray]:
    """Compute the texture atlas of a mesh: uv (k, 2) in [0, 1], uv_faces (m, 3)."""
    atlas = xatlas.Atlas()
    atlas.add_mesh(vertices.astype(np.float32), faces.astype(np.uint32))
    chart, pack = xatlas.ChartOptions(), xatlas.PackOptions()
    pack.resolution, pack.padding, pack.bilinear = size, APART if size >= 64 * APART else 1, True
    atlas.generate(chart, pack)
    _, uv_faces, uv = atlas[0]
    return np.asarray(uv, float), np.asarray(uv_faces, np.int64)


def box_pixels(low: np.ndarray, high: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return for every pixel of boxes, from (m, 2) low to below (m, 2) high, the box (n,) and its place (n, 2)."""
    count = (high - low).prod(axis=1)
    box = np.repeat(np.arange(len(low)), count)
    step = np.arange(len(box)) - np.repeat(np.cumsum(count) - count, count)
    wide = (high - low)[box, 0]
    return box, low[box] + np.stack([step % wide, step // wide], axis=1)


def texel_surface(
    vertices: np.ndarray, faces: np.ndarray, uv: np.ndarray, uv_faces: np.ndarray, size: int
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Return each covered texel's flat index (k,) into (size, size), its point (k, 3) m and its face (k,)."""
    corners = uv[uv_faces] * size
    corners[..., 1] = size - corners[..., 1]  # image rows run downwards
    low = np.clip(np.floor(corners.min(axis=1)).astype(int), 0, size - 1)
    high = np.clip(np.ceil(corners.max(axis=1)).astype(int), low + 1, size)
    face, at = box_pixels(low, high)
    column, row = at.T
    (ax, ay), (bx, by), (cx, cy) = (corners[face, k].T for k in range(3))
    px, py, twice = column + 0.5 - ax, row + 0.5 - ay, (bx - ax) * (cy - ay) - (by - ay) * (cx - ax)
    good = np.abs(twice) > 1e-12
    area = np.where(good, twice, 1e-12)
    v, w = (px * (cy - ay) - py * (cx - ax)) / area, ((bx - ax) * py - (by - ay) * px) / area
    slack = 0.02
    inside = good & (v >= -slack) & (w >= -slack) & (v + w <= 1 + slack)
    face, v, w = face[inside], v[inside], w[inside]
    texel = row[inside] * size + column[inside]
    texel, first = np.unique(texel, return_index=True)
    face, v, w = face[first], v[first], w[first]
    p, q, r = (vertices[faces[face, k]] for k in range(3))
    return texel, p * (1 - v - w)[:, None] + q * v[:, None] + r * w[:, None], face


def fill_image(texel: np.ndarray, colours: np.ndarray, size: int) -> np.ndarray:
    """Return a (size, size, 3) uint8 image; texels outside every chart take the nearest chart's colour."""
    image = np.zeros((size * size, 3))
    covered = np.zeros(size * size, bool)
    image[texel], covered[texel] = colours, True
    nearest = tuple(nearest_cell(covered.reshape(size, size)))
    return np.clip(np.rint(image.reshape(size, size, 3)[nearest]), 0, 255).astype(np.uint8)


def as_png(image: np.ndarray) -> Image.Image:
    """Return the image (h, w, 3) uint8 to the bit, with a palette where it has at most 256 colours."""
    packed = image.astype(np.uint32) @ np.array([65536, 256, 1], np.uint32)
    colours, index = np.unique(packed, return_inverse=True)
    if len(colours) > 256:
        return Image.fromarray(image)
    picture = Image.fromarray(index.reshape(packed.shape).astype(np.uint8)).convert("P")
    picture.putpalette((colours[:, None] >> np.array([16, 8, 0], np.uint32) & 255).astype(np.uint8).tobytes())
    return picture


def quantise(image: np.ndarray, colours: int) -> Image.Image:
    """Reduce to a palette image: a third of the bytes, and scan colours carry no more."""
    return Image.fromarray(image).quantize(colours, method=Image.Quantize.MEDIANCUT, dither=Image.Dither.NONE)


def share_plain(visual: VisualMesh) -> VisualMesh:
    """Return the picture in fewer bytes: plain faces share one place, and unused texels are blank.

    Vertices, faces and the image's size stay; `uv` and `uv_faces` change.
    """
    side, faces = len(visual.image), np.arange(len(visual.faces))
    if visual.image.shape[1] != side or not len(faces):
        return visual
    texel, _, face = texel_surface(visual.vertices, visual.faces, visual.uv, visual.uv_faces, side)
    middle = visual.uv[visual.uv_faces].mean(axis=1)
    row, column = (np.clip((v * side).astype(int), 0, side - 1) for v in (1 - middle[:, 1], middle[:, 0]))
    texel, face = np.append(texel, row * side + column), np.append(face, faces)
    colours = visual.image.reshape(-1, 3)[texel].astype(int)
    low, high = np.full((len(faces), 3), 255), np.zeros((len(faces), 3), int)
    np.minimum.at(low, face, colours)
    np.maximum.at(high, face, colours)
    plain = np.ptp([low, high], axis=0).max(axis=1) <= PLAIN
    if not plain.any():
        return visual
    # Each colour is looked up in the largest of its faces.
    chosen = np.flatnonzero(plain)
    chosen = chosen[np.argsort(-np.bincount(face, minlength=len(faces))[chosen], kind="stable")]
    _, first, of = np.unique(visual.image[row, column][chosen], axis=0, return_index=True, return_inverse=True)
    places = chosen[first]
    uv_faces = visual.uv_faces.copy()
    uv_faces[chosen] = len(visual.uv) + of.reshape(-1, 1)
    uv, index = np.unique(np.vstack([visual.uv, middle[places]])[uv_faces.ravel()], axis=0, return_inverse=True)
    used = np.zeros(side * side, bool)
    used[texel[~plain[face] | np.isin(face, places)]] = True
    near = ndimage.binary_dilation(used.reshape(side, side), iterations=MARGIN)
    image = np.where(near[..., None], visual.image, visual.image[row[places[0]], column[places[0]]])
    return dataclasses.replace(visual, uv=uv, uv_faces=index.reshape(-1, 3), image=image)


def bake_structure(
    vertices: np.ndarray,
    faces: np.ndarray,
    cloud: ColourCloud,
    size: int,
    turned_m: float = 0.0,
    light: Daylight | None = None,
) -> VisualMesh:
    """Bake a texture of the simplified scan from coloured points (three nearest, by inverse distance).

    `size` is in pixels. `turned_m` is the added distance for each unit between the normals of point and surface, which
    separates the sides of thin walls. With `light`, the image is exact, with few levels a channel, for a smaller file.
    """
    uv, uv_faces = unwrap(vertices, faces, size)
    texel, point, face = texel_surface(vertices, faces, uv, uv_faces, size)
    points, sought = cloud.points, point
    if turned_m:
        points = np.hstack([points, turned_m * cloud.normals])
        sought = np.hstack([point, turned_m * unit_normals(vertices, faces)[face]])
    distance, index = KDTree(points).query(sought, k=min(3, len(points)))
    distance, index = distance.reshape(len(point), -1), index.reshape(len(point), -1)
    weight = 1.0 / (distance + 0.002)
    colours = (cloud.colours[index] * weight[..., None]).sum(axis=1) / weight.sum(axis=1, keepdims=True)
    if light is not None:
        colours = np.minimum(colours * light_on(point, unit_normals(vertices, faces)[face], light), 255.0)
        colours = np.rint(np.rint(colours * (LEVELS / 255)) * (255 / LEVELS))
    return VisualMesh(vertices, faces, uv, uv_faces, fill_image(texel, colours, size), light is not None)


def bake_object(
    vertices: np.ndarray,
    faces: np.ndarray,
    face_colours: np.ndarray,
    cloud: ColourCloud,
    low: tuple[np.ndarray, np.ndarray],
    size: int,
) -> tuple[VisualMesh, float]:
    """Bake a simplified CAD model, retextured from the scan points that showed the object.

    A texel takes the mean of near scan points with a similar normal, else of the eight nearest such texels of its CAD
    material, or of any. An object that the scan does not show keeps its CAD colours. Return the mesh, in the world's
    frame, and the share of texels that the scan showed.
    """
    low_vertices, low_faces = low
    uv, uv_faces = unwrap(low_vertices, low_faces, size)
    texel, point, face = texel_surface(low_vertices, low_faces, uv, uv_faces, size)
    normal = unit_normals(low_vertices, low_faces)
    sample, sample_face = sample_faces(vertices, faces, max(0.02, float(np.ptp(vertices, axis=0).max()) / 60))
    on_face = sample_face[KDTree(sample).query(point)[1]]
    cad_colour = face_colours[on_face].astype(float)
    material = np.unique(face_colours, axis=0, return_inverse=True)[1].reshape(-1)[on_face]

    visible = np.zeros(len(point), bool)
    colours = cad_colour.copy()
    if len(cloud.points):
        count = min(8, len(cloud.points))
        distance, index = KDTree(cloud.points).query(point, k=count, distance_upper_bound=VISIBLE_M)
        distance, index = distance.reshape(-1, count), index.reshape(-1, count)
        near = np.isfinite(distance)
        index = np.where(near, index, 0)
        cosine = np.abs(np.einsum("kd,knd->kn", normal[face], cloud.normals[index]))
        weight = np.where(near & (cosine > AGREE), 1.0 / (distance + 0.005), 0.0)
        total = weight.sum(axis=1)
        visible = total > 0
        mixed = (cloud.colours[index] * weight[..., None]).sum(axis=1)
        colours[visible] = mixed[visible] / total[visible, None]
    for m in np.unique(material) if visible.any() else ():
        wanted, source = (material == m) & ~visible, (material == m) & visible
        source = visible if source.sum() < 8 else source
        if wanted.any():
            count = min(8, int(source.sum()))
            index = KDTree(point[source]).query(point[wanted], k=count)[1].reshape(-1, count)
            colours[wanted] = colours[source][index].mean(axis=1)
    image = fill_image(texel, colours, size)
    return VisualMesh(low_vertices, low_faces, uv, uv_faces, image), float(visible.mean()) if len(visible) else 0.0


@dataclasses.dataclass(frozen=True)
class Drawn:
    """Hold what is drawn of an object (body frame), and how much of its model's surface that is."""

    mesh: VisualMesh
    shown_share: float
    """Of the texels, what the scan showed."""
    kept_share: float
    """Of the model's area."""
    off_m: float
    """Farthest that the model's surface lies from the drawn one."""


def as_it_is(mesh: TexturedMesh, most_faces: int, size: int) -> VisualMesh | None:
    """Return a surface with its image; None if it repeats, has more pixels a side than `size`, or too many faces."""
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
    objects: Sequence[PlacedObject], clouds: Sequence[ColourCloud], most_faces: int, size: int, least_m: float = 1e-3
) -> list[Drawn]:
    """Draw objects of one model and size (`size`: the texture's, pixels), simplified once by error, then by number.

    Objects take the scan's colours if it shows them, otherwise the model's, by points at least `least_m` apart.
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
            cloud_b = cloud._replace(points=(cloud.points - placed.position_w) @ turn, normals=cloud.normals @ turn)
            done.append(Drawn(*bake_object(*mesh, first.face_colours, cloud_b, low, size), *loss))
            continue
        if unscanned is None:
            spacing_m = max(float(np.ptp(first.vertices_b, axis=0).max()) / size, least_m)
            cloud_b = cloud if surface is None else textured_cloud(surface, spacing_m)
            unscanned = Drawn(bake_object(*mesh, first.face_colours, cloud_b, low, size)[0], 0.0, *loss)
        done.append(unscanned)
    return done
