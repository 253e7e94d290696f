"""Draw compiled scenes and models with their textures in NumPy, without a display or a GPU."""

import dataclasses
import math

import mujoco
import numpy as np
import shapely
from PIL import Image
from scipy.ndimage import map_coordinates
from scipy.spatial import ConvexHull
from trimesh.intersections import slice_faces_plane
from trimesh.triangles import nondegenerate

from converters.geometry.faces import corner_normals, face_vectors, unit_normals
from converters.records.raw import TexturedMesh
from converters.write.texture import box_pixels
from interactive_nav_common.grids import cell_centres, clearance
from scenes_mjcf.look import GLASS, GLASS_ALPHA, CameraPose, Lens, geom_image, geom_mesh, look_along, mesh_of, over
from scenes_mjcf.schema import SceneMaps

NEAREST_M = 0.05
"""Nothing nearer is drawn."""
LAMP_W = np.array([0.35, -0.45, 0.82])
"""Where the little light comes from that is not even."""
EVEN = 0.72
"""Of the light that is."""
SQUARE = 0.35
"""Texels a pixel; colours are mixed where there are fewer."""
FRAGMENTS = 30_000
"""Pixels that are looked at together, of boxes about triangles."""
ELEVATION_RAD = math.radians(53.0)
CUT_M = 1.3
"""Height that walls are cut at in the view from the south."""
EYE_M, EYE_VIEW_RAD, DOWN = 1.5, math.radians(75.0), 0.2
"""Height and width of the view of somebody who stands there, and how far down they look in a metre."""
FREE_M, NEAR_M, FAR_M = 0.5, 1.2, 7.0
"""Around somebody who stands there; and how far off is what counts as visible."""
HEADINGS, PLACES = 24, 200
SHARP = 2
"""Pixels a side that become one, at eye height: from farther off that is noise, which makes files large."""
AZIMUTH_RAD, ABOVE_RAD = 0.6, 0.42
"""Where the reader stands: to the right of the front, and above."""
Surfaces = dict[str, TexturedMesh]
"""Body -> what is drawn of it, in the world."""


class Picture:
    """A picture that meshes are drawn into, near before far; white where nothing is."""

    def __init__(self, pose: CameraPose, lens: Lens) -> None:
        """Start an empty picture."""
        self._pose, self._lens = pose, lens
        self._depth = np.full(lens.height * lens.width, np.inf)
        self._colours = np.full((len(self._depth), 3), 255, np.uint8)

    @property
    def image(self) -> np.ndarray:
        """Return (rows, columns, 3) uint8."""
        return self._colours.reshape(self._lens.height, self._lens.width, 3)

    def draw(
        self, mesh: TexturedMesh, one_sided: bool = False, below_m: float = np.inf, glass: bool | None = None
    ) -> None:
        """Draw a mesh; only its `glass`, over what is drawn already, or all but that; None: all, glass opaque."""
        assert mesh.corner_uv is not None and mesh.texture is not None
        lens, eye, axes_w = self._lens, self._pose.pos_w, self._pose.axes_w
        bright = EVEN + (1 - EVEN) * np.abs(corner_normals(mesh.vertices, mesh.faces) @ LAMP_W)
        points, uv = mesh.vertices[mesh.faces].reshape(-1, 3), np.dstack([mesh.corner_uv, bright]).reshape(-1, 3)
        faces = np.arange(len(points)).reshape(-1, 3)
        if one_sided:
            faces = faces[(unit_normals(points, faces) * (eye - points[::3])).sum(axis=1) > 0]
        cuts = [(axes_w[:, 0], eye + NEAREST_M * axes_w[:, 0]), (np.array([0, 0, -1]), np.array([0, 0, below_m]))]
        for normal, at in cuts if np.isfinite(below_m) else cuts[:1]:
            faces = faces[nondegenerate(points[faces], height=1e-6)]  # cutting a thinner one can make its uv NaN
            points, faces, uv = slice_faces_plane(points, faces, normal, at, uv)
        if not len(faces):
            return
        depth, x, y = np.moveaxis((points[faces] - eye) @ axes_w, -1, 0)
        size, uv = np.array([lens.width, lens.height]), np.asarray(uv)[faces]
        pixels = np.stack([x, -y], axis=-1) / lens.pixel / depth[..., None] + size / 2
        keep = np.flatnonzero(_areas(pixels) > 1e-9)
        depth, pixels, uv, light = depth[keep], pixels[keep], uv[keep, :, :2], uv[keep, :, 2]
        texture, between = _fitted(mesh.texture, _areas(uv), _areas(pixels), depth.min(axis=1, initial=np.inf))
        low, high = np.ceil(pixels.min(axis=1) - 0.5), np.floor(pixels.max(axis=1) - 0.5) + 1
        low, high = (np.clip(v, 0, size).astype(int) for v in (low, high))
        inverse = np.linalg.inv(np.dstack([pixels, np.ones_like(depth)]) * depth[..., None])
        high = np.maximum(high, low)
        count = (high - low).prod(axis=1)
        some = np.flatnonzero(count)
        for part in np.split(some, np.flatnonzero(np.diff(np.cumsum(count[some]) // FRAGMENTS)) + 1):
            face, at = box_pixels(low[part], high[part])
            share = np.einsum("nk,nkc->nc", np.column_stack([at + 0.5, np.ones(len(at))]), inverse[part][face])
            outside = share < -1e-6 * np.abs(share).sum(axis=1, keepdims=True)  # no gaps between neighbours
            inside = np.flatnonzero(~outside.any(axis=1))
            face, share = part[face[inside]], share[inside] / share[inside].sum(axis=1, keepdims=True)
            far = (share * depth[face]).sum(axis=1)
            where = at[inside, 1] * lens.width + at[inside, 0]
            order = np.flatnonzero(far < self._depth[where])
            order = order[np.argsort(-far[order], kind="stable")]  # the nearest is written last
            face, share, where = face[order], share[order], where[order]
            u, v = np.einsum("nc,ncd->nd", share, uv[face]).T
            texel = (np.stack([1 - v % 1, u % 1], axis=1) * texture.shape[:2]).T - 0.5  # the nearest, or between four
            planes = [map_coordinates(texture[..., k], texel, order=int(between), mode="nearest") for k in range(3)]
            shown, far = np.stack(planes, -1), far[order]
            if glass is not None:
                chosen = (np.rint(shown) == GLASS).all(axis=1) == glass
                shown, far, where = shown[chosen], far[chosen], where[chosen]
                face, share = face[chosen], share[chosen]
            alpha, shown = GLASS_ALPHA if glass else 1.0, shown * (share * light[face]).sum(axis=1)[:, None]
            self._depth[where] = far
            self._colours[where] = alpha * shown + (1 - alpha) * self._colours[where]


def _areas(corners: np.ndarray) -> np.ndarray:
    """Return twice the areas (m,) of triangles (m, 3, 2)."""
    a, b = corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0]
    return np.abs(a[:, 0] * b[:, 1] - a[:, 1] * b[:, 0])


def _fitted(
    texture: np.ndarray, uv_areas: np.ndarray, pixels: np.ndarray, depth: np.ndarray
) -> tuple[np.ndarray, bool]:
    """Return the texture with at most as many texels as pixels it covers, and whether single texels are visible."""
    rows, columns = texture.shape[:2]
    front = depth > 2 * NEAREST_M
    per_pixel = np.sqrt(uv_areas[front].sum() * rows * columns / max(pixels[front].sum(), 1.0))
    factor = min(int(per_pixel), rows, columns)
    small = texture if factor < 2 else np.asarray(Image.fromarray(texture).reduce(factor))
    return small, bool(per_pixel < SQUARE)


def geom_surface(model: mujoco.MjModel, geom: int) -> TexturedMesh:
    """Return a textured mesh geom as MuJoCo draws it, in the body's frame."""
    uv, image = mesh_of(model, model.geom_dataid[geom])[2], geom_image(model, geom)
    assert uv is not None and image is not None
    return TexturedMesh(*geom_mesh(model, geom), uv * [1.0, -1.0] + [0.0, 1.0], image[..., :3])


def geom_outline(model: mujoco.MjModel, data: mujoco.MjData, geom: int) -> np.ndarray:
    """Return (k, 2) m: outline of a mesh or box geom from above."""
    if model.geom_type[geom] == mujoco.mjtGeom.mjGEOM_BOX:
        corners = np.array(np.meshgrid([-1, 1], [-1, 1], [-1, 1])).reshape(3, -1).T * model.geom_size[geom]
    else:
        corners = mesh_of(model, model.geom_dataid[geom])[0]
    points = (corners @ data.geom_xmat[geom].reshape(3, 3).T + data.geom_xpos[geom])[:, :2]
    return points[ConvexHull(points).vertices]


def world_surfaces(model: mujoco.MjModel, data: mujoco.MjData) -> Surfaces:
    """Return what is drawn of each body."""
    surfaces = {}
    for geom in range(model.ngeom):
        name = model.geom(geom).name
        if name.endswith("_visual"):
            body, surface = model.geom_bodyid[geom], geom_surface(model, geom)
            points = surface.vertices @ data.xmat[body].reshape(3, 3).T + data.xpos[body]
            surfaces[model.body(body).name] = dataclasses.replace(surface, vertices=points)
    return surfaces


def _taken(pose: CameraPose, lens: Lens, surfaces: Surfaces, cut_m: float = np.inf) -> np.ndarray:
    """Draw the picture (rows, columns, 3) of bodies."""
    picture = Picture(pose, lens)
    glazed = [b for b, s in surfaces.items() if s.texture is not None and (s.texture == GLASS).all(axis=2).any()]
    for body, glass in (*((body, False) for body in surfaces), *((body, True) for body in glazed)):
        structure = body == "structure"
        picture.draw(surfaces[body], one_sided=structure, below_m=cut_m if structure else np.inf, glass=glass)
    return picture.image


def from_the_south(surfaces: Surfaces, maps: SceneMaps, low: np.ndarray, high: np.ndarray, pixels: int) -> np.ndarray:
    """Draw the area from (2,) low to (2,) high x and y, m, seen slantwise, `pixels` wide, with walls cut at `CUT_M`."""
    sin, cos = math.sin(ELEVATION_RAD), math.cos(ELEVATION_RAD)
    axes_w = np.array([[1.0, 0.0, 0.0], [0.0, sin, cos], [0.0, -cos, sin]])
    half = np.array([high[0] - low[0], sin * (high[1] - low[1]) + cos * CUT_M]) / 2
    middle = axes_w[:2] @ [*(low + high) / 2, CUT_M / 2]
    # Upright faces that look south, where no floor lies south of them, would hide rooms.
    structure = surfaces["structure"]
    assert structure.corner_uv is not None
    normal, centre = face_vectors(structure.vertices, structure.faces), structure.vertices[structure.faces].mean(axis=1)
    first = np.where(maps.traversable.any(axis=0), maps.traversable.argmax(axis=0), len(maps.traversable))
    column = np.floor((centre[:, 0] - maps.origin_w[0]) / maps.resolution_m).astype(int)
    south_m = maps.origin_w[1] + maps.resolution_m * first[np.clip(column, 0, len(first) - 1)]
    far = (centre[:, 1] >= south_m) | (-normal[:, 1] <= 0.7 * np.linalg.norm(normal, axis=1))
    structure = dataclasses.replace(structure, faces=structure.faces[far], corner_uv=structure.corner_uv[far])
    surfaces = surfaces | {"structure": structure}
    return _taken(*over(axes_w, middle - half, middle + half, 2 * half[0] / pixels), surfaces, CUT_M)


def at_eye_height(
    model: mujoco.MjModel, data: mujoco.MjData, surfaces: Surfaces, maps: SceneMaps, shape: tuple[int, int]
) -> np.ndarray:
    """Draw a (rows, columns, 3) picture, `shape` large, of what somebody sees from where most is visible."""
    eye, heading = _vantage(model, data, surfaces, maps)
    eye_w = np.array([*eye, EYE_M])
    tall = math.degrees(2 * math.atan(math.tan(EYE_VIEW_RAD / 2) * shape[0] / shape[1]))
    lens = Lens(SHARP * shape[1], SHARP * shape[0], tall)
    picture = _taken(look_along(eye_w, np.array([*heading, -DOWN])), lens, surfaces)
    return np.asarray(Image.fromarray(picture).reduce(SHARP))


def _vantage(
    model: mujoco.MjModel, data: mujoco.MjData, surfaces: Surfaces, maps: SceneMaps
) -> tuple[np.ndarray, np.ndarray]:
    """Return place (2,) and heading (2,) with most objects, the larger and nearer the better, before no wall."""
    clear = clearance(maps.traversable, maps.resolution_m)
    places = cell_centres(clear >= min(FREE_M, 0.8 * float(clear.max())), maps.resolution_m, maps.origin_w)
    places = places[np.unique(np.linspace(0, len(places) - 1, PLACES).astype(int))]
    plans = [surface.vertices[:, :2] for body, surface in surfaces.items() if body != "structure"]
    low, high = np.array([(plan.min(axis=0), plan.max(axis=0)) for plan in plans]).reshape(-1, 2, 2).transpose(1, 0, 2)
    off = np.maximum(np.maximum(low - places[:, None], places[:, None] - high), 0.0)
    stands = (np.linalg.norm(off, axis=2) > FREE_M / 2).all(axis=1)
    places = places[stands] if stands.any() else places
    way = (low + high) / 2 - places[:, None]
    distance = np.linalg.norm(way, axis=2)
    weight = np.linalg.norm(high - low, axis=1) / np.maximum(distance, NEAR_M)
    walls = [g for g in range(model.ngeom) if model.geom(g).name.startswith("wall_")]
    stand = shapely.union_all([shapely.Polygon(geom_outline(model, data, g)) for g in walls])
    start = np.broadcast_to(places[:, None], way.shape)
    hidden = np.asarray(shapely.intersects(shapely.linestrings(np.stack([start, start + way], axis=2)), stand))
    visible = (distance > NEAR_M) & (distance < FAR_M) & ~hidden
    turns = np.arange(HEADINGS) * 2 * math.pi / HEADINGS
    headings = np.stack([np.cos(turns), np.sin(turns)], axis=1)
    ahead = way @ headings.T > math.cos(0.8 * EYE_VIEW_RAD / 2) * distance[..., None]
    score = np.einsum("pk,pkh->ph", np.where(visible, weight, 0.0), ahead)
    place, heading = np.unravel_index(score.argmax(), score.shape)
    return places[place], headings[heading]


def camera_axes() -> np.ndarray:
    """Return rows that point right, up and at the reader; the model faces +z, y is up."""
    (sin_a, cos_a), (sin_e, cos_e) = [(np.sin(a), np.cos(a)) for a in (AZIMUTH_RAD, ABOVE_RAD)]
    toward = np.array([sin_a * cos_e, sin_e, cos_a * cos_e])
    right = np.array([cos_a, 0.0, -sin_a])
    return np.stack([right, np.cross(toward, right), toward])


def mesh_picture(mesh: TexturedMesh, axes: np.ndarray, pixels: int) -> np.ndarray:
    """Draw a (pixels, pixels, 3) uint8 picture of a whole mesh on white, along axes such as `camera_axes`'."""
    turned = mesh.vertices @ axes.T
    half, middle = np.ptp(turned, axis=0)[:2].max() / 2 / 0.94, (turned.min(axis=0) + turned.max(axis=0)) / 2
    picture = Picture(*over(axes, middle - half, middle + half, 2 * half / pixels))
    picture.draw(mesh)
    return picture.image
