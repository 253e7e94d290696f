"""Draw textured visual meshes for a batch that mixes scenes, with one Warp kernel, on GPU and CPU.

MJX's renderer cannot mix scenes. Here one `wp.Mesh` holds all meshes, each as a group with a tree that is built once.
An environment is a list of instances (which mesh, which body), and rays are transformed into the body's frame.
"""

# What a kernel computes with is none of Python's types.
# pyright: reportArgumentType=false, reportAssignmentType=false, reportCallIssue=false, reportGeneralTypeIssues=false
# pyright: reportIndexIssue=false, reportOperatorIssue=false

import dataclasses

import jax
import jax.numpy as jnp
import mujoco
import numpy as np
import warp as wp
from scipy.spatial import ConvexHull

from interactive_nav.physics.warp_callbacks import held, keep_collector_out
from interactive_nav.scenes.world import World
from interactive_nav.sensing.base import FAR_M, NEAR_M, Renderer, lit_images
from interactive_nav.sensing.boxes import (
    FLOOR_COLOUR,
    PALETTES,
    BoxTables,
    apply_axes,
    body_poses,
    geom_box,
    robot_geoms,
    visual_geoms,
)
from interactive_nav_common.rotations import matrix_from_quat
from scenes_mjcf.agreement import is_lit
from scenes_mjcf.categories import class_id
from scenes_mjcf.look import SKY_COLOUR, Lens, geom_colour, geom_image, mesh_normals, mesh_of

NEAR, FAR = wp.constant(NEAR_M), wp.constant(FAR_M)
SKY, FLOOR = wp.constant(wp.vec3(*SKY_COLOUR)), wp.constant(wp.vec3(*FLOOR_COLOUR))
_CORNERS = np.array([[x, y, z] for x in (-1, 1) for y in (-1, 1) for z in (-1, 1)], float)
_SIDES = np.array(list("013032467475045051237276026064157173"), int).reshape(-1, 3)
"""Triangles of a box: rows of `_CORNERS`."""


@dataclasses.dataclass
class _Surface:
    """One body's surface of one material, in the body's frame."""

    slot: int
    points: np.ndarray
    """[v, 3] m."""
    faces: np.ndarray
    """[f, 3]."""
    uv: np.ndarray
    """[f, 3, 2]; v falls from the image's first row."""
    image: np.ndarray | None
    """[h, w, 3] u8."""
    colour: np.ndarray
    """(3,) in [0, 1] where there is no image."""
    lit: bool = False
    """In the image itself: it is drawn without shading."""
    normals: np.ndarray | None = None
    """[f, 3, 3] at the corners; None: the faces' own."""


def _box_surface(slot: int, boxes: np.ndarray, colour: np.ndarray) -> _Surface:
    corners = boxes[:, None, 7:10] * _CORNERS
    points = boxes[:, None, :3] + np.einsum("nij,nvj->nvi", matrix_from_quat(boxes[:, 3:7]), corners)
    faces = _SIDES + 8 * np.arange(len(boxes))[:, None, None]
    faces = faces.reshape(-1, 3)
    return _Surface(slot, points.reshape(-1, 3), faces, np.zeros((len(faces), 3, 2)), None, colour)


def _geom_surface(model: mujoco.MjModel, geom: int, slot: int) -> _Surface:
    """Return the surface of a geom of the robot's: a mesh, a box, or what is round as its hull."""
    kind, size = mujoco.mjtGeom(int(model.geom_type[geom])), model.geom_size[geom]
    if kind == mujoco.mjtGeom.mjGEOM_MESH:
        return dataclasses.replace(_mesh_surface(model, geom, slot, False), normals=None)  # as robots always looked
    part = _box_surface(slot, geom_box(model, geom)[None], geom_colour(model, geom))
    turn, rise = np.meshgrid(np.arange(24) * np.pi / 12, np.linspace(-np.pi / 2, np.pi / 2, 13))
    ball = np.stack([np.cos(rise) * np.cos(turn), np.cos(rise) * np.sin(turn), np.sin(rise)], -1).reshape(-1, 3)
    ends = np.array([[[0.0, 0.0, -1.0]], [[0.0, 0.0, 1.0]]])
    hulls = {
        mujoco.mjtGeom.mjGEOM_SPHERE: size[0] * ball,
        mujoco.mjtGeom.mjGEOM_ELLIPSOID: size * ball,
        mujoco.mjtGeom.mjGEOM_CAPSULE: size[0] * ball + size[1] * ends,
        mujoco.mjtGeom.mjGEOM_CYLINDER: size[0] * ball * [1, 1, 0] + size[1] * ends,
    }
    if kind not in hulls:
        return part
    hull = ConvexHull(hulls[kind].reshape(-1, 3))
    points = hull.points @ matrix_from_quat(model.geom_quat[geom]).T + model.geom_pos[geom]
    return dataclasses.replace(part, points=points, faces=hull.simplices, uv=np.zeros((len(hull.simplices), 3, 2)))


def _mesh_surface(model: mujoco.MjModel, geom: int, slot: int, standing: bool) -> _Surface:
    (vertices, faces, uv), image = mesh_of(model, model.geom_dataid[geom]), geom_image(model, geom)
    turn, normals = matrix_from_quat(model.geom_quat[geom]).T, mesh_normals(model, model.geom_dataid[geom])
    points = vertices @ turn + model.geom_pos[geom]
    normals = None if normals is None else normals @ turn
    if standing:
        points = points + model.body_pos[model.geom_bodyid[geom]]
    if uv is None or image is None:
        uv, image = np.zeros((len(faces), 3, 2)), None
    lit = standing and is_lit(model)
    image = image if image is None else image[..., :3]
    return _Surface(slot, points, faces, uv, image, geom_colour(model, geom), lit, normals)


def _surfaces(world: World, s: int, tables: BoxTables) -> tuple[list[_Surface], list[int]]:
    """Return the surfaces of a scene, boxes where a body has no visual mesh, and the class of each slot."""
    model, visual = visual_geoms(world.scenes[s])
    slots, ids = world.slots, world.slots.class_ids(tables.classes)[s]
    parts = []
    for slot, name in enumerate((*slots.names[s], "structure")):
        if meshes := [g for g in visual.get(name, []) if model.geom_type[g] == mujoco.mjtGeom.mjGEOM_MESH]:
            parts += [_mesh_surface(model, geom, slot, name == "structure") for geom in meshes]
        elif len(boxes := slots.rows(s, slot)):
            parts.append(_box_surface(slot, boxes, PALETTES[tables.classes][ids[slot]]))
    links = robot_geoms(world) if tables.robot else []
    parts += [_geom_surface(world.models[0], g, len(ids) + i) for i, geoms in enumerate(links) for g in geoms]
    return parts, [*ids, *[class_id("robot", tables.classes)] * len(links)]


def build_meshes(world: World, tables: BoxTables) -> dict[str, np.ndarray]:
    """Read the visual meshes of S scenes of up to K surfaces; bodies without any are drawn as their boxes.

    Equal surfaces and images are kept once.
    """
    scenes = [_surfaces(world, s, tables) for s in range(len(world.scenes))]
    shape = len(scenes), max(len(parts) for parts, _ in scenes)
    surface, slot = np.full(shape, -1, np.int32), np.zeros(shape, np.int32)
    sphere, look, colour = np.full((*shape, 4), -1.0, np.float32), np.zeros((*shape, 5), np.int32), np.ones((*shape, 3))
    surfaces: dict[tuple, int] = {}
    images: dict[bytes, int] = {}
    points, faces, uv, normals, texels = [], [], [], [], [np.zeros(1, np.uint32)]
    for s, (parts, ids) in enumerate(scenes):
        for k, part in enumerate(parts):
            key = np.round(part.points, 5).tobytes(), part.faces.tobytes(), part.uv.tobytes()
            if key not in surfaces:
                surfaces[key] = len(surfaces)
                faces.append(part.faces + sum(map(len, points)))
                points.append(part.points)
                uv.append(part.uv)
                normals.append(np.zeros((len(part.faces), 3, 3)) if part.normals is None else part.normals)
            centre = (part.points.min(0) + part.points.max(0)) / 2
            radius = np.linalg.norm(part.points - centre, axis=1).max() + 1e-4
            surface[s, k], slot[s, k], sphere[s, k] = surfaces[key], part.slot, [*centre, radius]
            look[s, k, 0], look[s, k, 4], colour[s, k] = ids[part.slot], part.lit, part.colour
            if part.image is not None:
                pixels = (part.image.reshape(-1, 3).astype(np.uint32) << [0, 8, 16]).sum(-1, dtype=np.uint32)
                name = pixels.tobytes()
                if name not in images:
                    images[name] = sum(map(len, texels))
                    texels.append(pixels)
                look[s, k, 1:4] = images[name], part.image.shape[1], part.image.shape[0]
    return {
        "points": np.concatenate(points).astype(np.float32),  # [v, 3] m, each surface in its body's frame
        "faces": np.concatenate(faces).astype(np.int32),  # [f, 3]
        "group": np.repeat(np.arange(len(faces), dtype=np.int32), [len(f) for f in faces]),  # [f] surface of each face
        "uv": np.concatenate(uv).astype(np.float32),  # [f, 3, 2]
        "normals": np.concatenate(normals).astype(np.float32),  # [f, 3, 3] as points; 0 where the face's own serves
        "texels": np.concatenate(texels),  # [t] red, green, blue from the lowest byte on
        "surface": surface,  # [S, K], -1 for padding
        "slot": slot,  # [S, K] body that it moves with
        "sphere_b": sphere,  # [S, K, 4] centre and radius of a sphere around it, m; the radius is -1 for padding
        "look": look,  # [S, K, 5] class, first texel, width and height of the image (0: none), 1 if it is not to be lit
        "colour": colour.astype(np.float32),  # [S, K, 3] where there is no image
    }


@wp.kernel
def _roots(mesh: wp.uint64, root: wp.array[int]):
    i = wp.tid()
    root[i] = wp.mesh_get_group_root(mesh, i)


@wp.func
def _texel(at: wp.vec2, first: int, width: int, height: int, texels: wp.array[wp.uint32]):
    column = wp.min(int((at[0] - wp.floor(at[0])) * float(width)), width - 1)
    row = wp.min(int((at[1] - wp.floor(at[1])) * float(height)), height - 1)
    texel = texels[first + row * width + column]
    red = float(texel & wp.uint32(255))
    green = float((texel >> wp.uint32(8)) & wp.uint32(255))
    blue = float((texel >> wp.uint32(16)) & wp.uint32(255))
    return wp.vec3(red, green, blue) / 255.0


@wp.func
def _meet(
    mesh: wp.uint64,
    n: int,
    s: int,
    eye: wp.vec3,
    ray: wp.vec3,
    pos_w: wp.array2d[wp.vec3],
    axes_w: wp.array2d[wp.mat33],
    sphere_w: wp.array2d[wp.vec4],
    root: wp.array2d[int],
):
    """Return the nearest of an environment's surfaces: distance, surface (-1: none), face, two weights, normal."""
    square = wp.dot(ray, ray)
    # Warp takes plain numbers for constants.
    nearest = wp.float32(FAR)
    hit = wp.int32(-1)
    face = wp.int32(0)
    u = wp.float32(0.0)
    v = wp.float32(0.0)
    normal = wp.vec3(0.0, 0.0, 0.0)
    for k in range(sphere_w.shape[1]):
        sphere = sphere_w[n, k]
        radius = sphere[3]
        centre = wp.vec3(sphere[0], sphere[1], sphere[2]) - eye
        along = wp.dot(centre, ray) / square
        reach = radius * radius - wp.dot(centre, centre) + along * along * square
        if radius > 0.0 and reach >= 0.0:
            half = wp.sqrt(reach / square)
            if along + half > NEAR and along - half < nearest:
                axes = wp.transpose(axes_w[n, k])
                start = axes * (eye + NEAR * ray - pos_w[n, k])
                query = wp.mesh_query_ray(mesh, start, axes * ray, nearest - NEAR, root[s, k])
                if query.result:
                    nearest = query.t + NEAR
                    hit = k
                    face = query.face
                    u = query.u
                    v = query.v
                    normal = wp.transpose(axes) * query.normal
    return nearest, hit, face, u, v, normal


@wp.kernel
def _draw(
    handle: wp.array[wp.uint32],
    scene: wp.array[int],
    pos_w: wp.array2d[wp.vec3],
    axes_w: wp.array2d[wp.mat33],
    sphere_w: wp.array2d[wp.vec4],
    eye_w: wp.array[wp.vec3],
    view_w: wp.array[wp.mat33],
    columns: wp.array[float],
    rows: wp.array[float],
    root: wp.array2d[int],
    look: wp.array3d[int],
    colour: wp.array2d[wp.vec3],
    uv: wp.array2d[wp.vec2],
    normals: wp.array2d[wp.vec3],
    texels: wp.array[wp.uint32],
    depth: wp.array3d[float],
    ids: wp.array3d[wp.uint8],
    kind: wp.array3d[wp.uint8],
    normal_w: wp.array3d[wp.vec3],
    base: wp.array3d[wp.vec3],
):
    """Draw one pixel: depth, class, 0 nothing, 1 lit or 2 shining by itself, normal, and colour before light."""
    n, tile_y, tile_x, lane = wp.tid()
    # A warp's 32 rays go the same way.
    y = tile_y * 8 + lane / 4
    x = tile_x * 4 + lane % 4
    if y >= rows.shape[0] or x >= columns.shape[0]:
        return
    # JAX has no integers of 64 bits.
    mesh = (wp.uint64(handle[1]) << wp.uint64(32)) | wp.uint64(handle[0])
    eye = eye_w[n]
    s = scene[n]
    ray = view_w[n] * wp.vec3(1.0, columns[x], rows[y])
    nearest, hit, face, u, v, normal = _meet(mesh, n, s, eye, ray, pos_w, axes_w, sphere_w, root)
    ids[n, y, x] = wp.uint8(0)
    base[n, y, x] = wp.vec3(FLOOR[0], FLOOR[1], FLOOR[2])
    # The plane z = 0 where no mesh lies on it.
    floor = -eye[2] / wp.min(ray[2], -1.0e-6)
    if ray[2] < 0.0 and floor > NEAR and floor < nearest * 0.999:
        depth[n, y, x] = floor
        kind[n, y, x] = wp.uint8(1)
        normal_w[n, y, x] = wp.vec3(0.0, 0.0, 1.0)
        return
    if hit < 0:
        depth[n, y, x] = 0.0
        kind[n, y, x] = wp.uint8(0)
        normal_w[n, y, x] = normal
        base[n, y, x] = wp.vec3(SKY[0], SKY[1], SKY[2])
        return
    depth[n, y, x] = nearest
    ids[n, y, x] = wp.uint8(look[s, hit, 0])
    kind[n, y, x] = wp.uint8(1 + look[s, hit, 4])
    side = -wp.sign(wp.dot(normal, ray))
    smooth = u * normals[face, 0] + v * normals[face, 1] + (1.0 - u - v) * normals[face, 2]
    if wp.length_sq(smooth) > 0.0:
        normal = wp.normalize(axes_w[n, hit] * smooth)
    # Its back may show.
    normal_w[n, y, x] = side * normal
    if look[s, hit, 2] == 0:
        base[n, y, x] = colour[s, hit]
        return
    at = u * uv[face, 0] + v * uv[face, 1] + (1.0 - u - v) * uv[face, 2]
    base[n, y, x] = _texel(at, look[s, hit, 1], look[s, hit, 2], look[s, hit, 3], texels)


class MeshRenderer(Renderer):
    """Draws the textured meshes of any mix of scenes."""

    name = "warp (meshes)"

    def __init__(self, tables: BoxTables, lens: Lens, world: World):
        """Put the meshes of all scenes on the device and build their trees, once."""
        keep_collector_out()
        self.lens, self.tables = lens, tables
        built = build_meshes(world, tables)
        device = "cpu" if jax.default_backend() == "cpu" else "cuda"
        self._mesh = wp.Mesh(
            wp.array(built["points"], dtype=wp.vec3, device=device),
            wp.array(built["faces"].ravel(), dtype=int, device=device),
            # Built slowly and with care, once: rays take a third less time.
            bvh_constructor="sah",
            bvh_leaf_size=1,
            groups=wp.array(built["group"], dtype=int, device=device),
        )
        root = wp.zeros(int(built["group"][-1]) + 1, dtype=int, device=device)
        wp.launch(_roots, len(root), [self._mesh.id], [root], device=device)
        self._slot, self._sphere_b = built["slot"], jnp.asarray(built["sphere_b"])
        self._handle = jnp.asarray([self._mesh.id & 0xFFFFFFFF, self._mesh.id >> 32], jnp.uint32)
        constants = (built[name] for name in ("look", "colour", "uv", "normals", "texels"))
        self._constants = tuple(map(jnp.asarray, (root.numpy()[built["surface"]], *constants)))
        self._draw = wp.jax_kernel(_draw, num_outputs=5)

    def images_batch(self, names, scene, qpos, camera, look=None):
        pos, axes = body_poses(self.tables, scene, qpos)
        slot = jnp.asarray(self._slot)[scene]
        pos = jnp.take_along_axis(pos, slot[..., None], -2)
        axes = jnp.take_along_axis(axes, slot[..., None, None], -3)
        sphere = self._sphere_b[scene]
        sphere = jnp.concatenate([pos + apply_axes(axes, sphere[..., :3]), sphere[..., 3:]], -1)
        columns, rows = jnp.asarray(self.lens.columns), jnp.asarray(self.lens.rows)
        size = (len(scene), self.lens.height, self.lens.width)
        shown = scene, pos, axes, sphere, camera.pos_w, camera.axes_w, columns, rows, *self._constants
        handle, tiles = held(self._handle, self._mesh), (size[0], -(-size[1] // 8), -(-size[2] // 4), 32)
        depth, ids, kind, normal, base = self._draw(handle, *shown, launch_dims=tiles, output_dims=size)
        return {"depth": depth, "segmentation": ids, **lit_images(base, normal, camera, kind == 1, ids, look)}
