"""Define cameras, and draw what they see of a MuJoCo model: with its renderer, offscreen, or with its rays.

`mujoco.Renderer` reads MUJOCO_GL when mujoco is imported, and without it and without a display it looks for a window
system and fails. Here the library is chosen when the first picture is requested: MUJOCO_GL where it is set, else EGL
where there is no display.
"""

import atexit
import contextlib
import dataclasses
import importlib
import io
import math
import os
import warnings
import weakref
from collections.abc import Sequence
from pathlib import Path
from typing import Any, NamedTuple

import mujoco
import numpy as np
from PIL import Image

from interactive_nav_common.errors import UserError
from interactive_nav_common.rotations import matrix_from_quat
from interactive_nav_common.untrusted.reading import read_npz
from scenes_mjcf.agreement import light_evenly
from scenes_mjcf.schema import SceneError

LIBRARIES = ("egl", "osmesa", "glfw")
SKY_COLOUR = (0.93, 0.95, 0.97)
"""RGB in [0, 1] of pictures where nothing is met."""
SKY = tuple(round(255 * c) for c in SKY_COLOUR)
"""Where nothing is hit; MuJoCo's would be black."""
LOOK = "look.npz"
UV_STEPS = 4096
"""In `assets`: the structure that people look at, flat convex polygons. Arrays `corners` (p,) u8, how many each has;
of these `vertices_mm` (3, n) i16, and `uv` (2, n) u16, which counts these steps from the upper left of `image`, the
bytes of a WebP file."""
SUN, SHADOW_TEXELS, SHADOW_M = 0.2, 4096, 12.0
"""Brightness of a light that casts shadows, side of the map that these are looked up in, how far that reaches."""

GLASS = (170, 198, 202)
"""Of 255, as images have it: faces in just this colour are glass."""
GLASS_ALPHA = 0.3
"""Share of the glass in what one sees; the rest is what lies behind."""


class CameraPose(NamedTuple):
    """Where a camera is, world frame; a pytree."""

    pos_w: Any
    """[..., 3], m: f32 of JAX, or NumPy's on the host."""
    axes_w: Any
    """[..., 3, 3], columns: forward, right, up."""


@dataclasses.dataclass(frozen=True)
class Lens:
    """A pinhole camera with square pixels."""

    width: int
    height: int
    fov_deg: float
    """Vertical field of view."""

    @property
    def half_height(self) -> float:
        """Return half of the image's height at depth 1."""
        return math.tan(math.radians(self.fov_deg) / 2)

    @property
    def pixel(self) -> float:
        """Return the side of a pixel at depth 1."""
        return 2 * self.half_height / self.height

    @property
    def columns(self) -> np.ndarray:
        """Return [width] f32: rightward offset of the pixels' centres at depth 1, left to right."""
        return ((np.arange(self.width) + 0.5 - self.width / 2) * self.pixel).astype(np.float32)

    @property
    def rows(self) -> np.ndarray:
        """Return [height] f32: upward offset at depth 1, top to bottom."""
        return ((self.height / 2 - np.arange(self.height) - 0.5) * self.pixel).astype(np.float32)

    def rays(self, pose: CameraPose) -> np.ndarray:
        """Return the rays [height, width, 3] of one camera's pixels, world frame; along its axis their length is 1."""
        right, up = np.meshgrid(self.columns.astype(float), self.rows.astype(float))
        return np.stack([np.ones_like(right), right, up], -1) @ np.asarray(pose.axes_w, float).T


def spec_for_people(folder: Path) -> mujoco.MjSpec:
    """Return the spec of a scene folder, its structure drawn as `LOOK` has it where the scene has that file.

    Observations draw what `scene.xml` names, which learned policies know.
    """
    spec, path = mujoco.MjSpec.from_file(str(folder / "scene.xml")), folder / "assets" / LOOK
    if not path.is_file():
        return spec
    mesh, texture = spec.mesh("structure_visual"), spec.texture("structure_texture")
    with read_npz(path, SceneError, "make the scene again") as arrays:
        first, count = np.cumsum(arrays["corners"], dtype=int) - arrays["corners"], arrays["corners"]
        fans = [(k, k + i, k + i + 1) for k, n in zip(first, count, strict=True) for i in range(1, n - 1)]
        mesh.uservert, mesh.usertexcoord = arrays["vertices_mm"].T.ravel() / 1000.0, arrays["uv"].T.ravel() / UV_STEPS
        mesh.userface = mesh.userfacetexcoord = np.ravel(fans).astype(np.int32)
        image = np.asarray(Image.open(io.BytesIO(arrays["image"])).convert("RGB"))
    mesh.file = texture.file = ""
    texture.height, texture.width, texture.nchannel = image.shape
    texture.data = image.tobytes()
    light_evenly(spec)
    return spec


def glaze(spec: mujoco.MjSpec, folder: Path) -> None:
    """Split the glass off textured meshes of a scene folder's spec, into geoms `<geom>_glass` that one sees through."""
    clear = [1.0, 1.0, 1.0, 1 - math.sqrt(1 - GLASS_ALPHA)]  # MuJoCo draws what is translucent twice
    images: dict[str, np.ndarray] = {}
    for texture in spec.textures:
        with contextlib.suppress(OSError, ValueError):  # compiling says what is wrong with a file
            image = Image.open(folder / spec.texturedir / texture.file)
            colours = image.getpalette() if image.mode == "P" else None
            if colours is None or GLASS in zip(*[iter(colours)] * 3, strict=False):
                images[texture.name] = np.asarray(image.convert("RGB"))
    of = {m.name: images.get(m.textures[mujoco.mjtTextureRole.mjTEXROLE_RGB]) for m in spec.materials}
    for geom in list(spec.geoms):
        image = of.get(geom.material)
        if geom.type != mujoco.mjtGeom.mjGEOM_MESH or image is None or not (image == GLASS).all(axis=2).any():
            continue
        mesh, alone = spec.mesh(geom.meshname), mujoco.MjSpec()
        alone.add_mesh(name="mesh", file=str((folder / spec.meshdir / mesh.file).absolute()), inertia=mesh.inertia)
        alone.worldbody.add_geom(type=geom.type, meshname="mesh", contype=0, conaffinity=0)
        model = alone.compile()
        uv = mesh_of(model, 0)[2]
        assert uv is not None
        inner = np.concatenate([uv.mean(axis=1, keepdims=True), (uv + uv.mean(axis=1, keepdims=True)) / 2], axis=1)
        column, row = np.moveaxis((inner * image.shape[1::-1]).astype(int), -1, 0)
        glass = (image[row % len(image), column % image.shape[1]] == GLASS).all(axis=(1, 2))
        if glass.all():
            geom.rgba = clear
        elif glass.any():
            pane = geom.parent.add_geom(type=geom.type, name=f"{geom.name}_glass", rgba=clear)
            pane.pos, pane.quat, pane.material, pane.group = geom.pos, geom.quat, geom.material, geom.group
            pane.contype = pane.conaffinity = pane.mass = 0
            for part, chosen in ((geom, ~glass), (pane, glass)):
                part.meshname = f"{part.name}_part"
                cut = spec.add_mesh(name=part.meshname, scale=mesh.scale, inertia=mesh.inertia)
                _take_faces(cut, model, uv, chosen)


def _take_faces(mesh: mujoco.MjsMesh, model: mujoco.MjModel, uv: np.ndarray, chosen: np.ndarray) -> None:
    """Give a mesh some faces (m,) of a model's only mesh, whose texture coordinates are [m, 3, 2]."""
    vertices, faces = geom_mesh(model, 0)
    used, index = np.unique(faces[chosen], return_inverse=True)
    corners = np.arange(3 * chosen.sum(), dtype=np.int32)
    mesh.uservert, mesh.userface = vertices[used].ravel(), index.ravel().astype(np.int32)
    mesh.usertexcoord, mesh.userfacetexcoord = uv[chosen].ravel(), corners
    if (normals := mesh_normals(model, 0)) is not None:
        turned = normals[chosen] @ matrix_from_quat(model.geom_quat[0]).T
        mesh.usernormal, mesh.userfacenormal = turned.ravel(), corners


def look_along(pos_w: Any, forward_w: Any) -> CameraPose:
    """Return a camera without roll: its right is horizontal, as if the world's z were up.

    NumPy's arrays stay NumPy's: JAX would compile each operation again for every number of cameras.

    Args:
        pos_w: [..., 3] m.
        forward_w: [..., 3], any length; a vertical one takes the world's -y as right.
    """
    xp = forward_w.__array_namespace__()
    forward = forward_w / xp.linalg.norm(forward_w, axis=-1, keepdims=True)
    flat = xp.stack([forward[..., 1], -forward[..., 0], xp.zeros_like(forward[..., 0])], -1)
    length = xp.linalg.norm(flat, axis=-1, keepdims=True)
    aside = xp.broadcast_to(xp.asarray([0.0, -1.0, 0.0], forward.dtype), flat.shape)
    right = xp.where(length > 1e-6, flat / xp.where(length > 1e-6, length, 1.0), aside)
    up = xp.cross(right, forward)
    return CameraPose(pos_w, xp.stack([forward, right, up], -1))


def straight_down(low_w: np.ndarray, high_w: np.ndarray, aspect: float, fov_deg: float) -> CameraPose:
    """Return a camera, x to the right and y up, over the floor between two corners (2,), m, and its walls."""
    size, centre = np.subtract(high_w, low_w), np.add(high_w, low_w) / 2
    above = max(size[1], size[0] / aspect) / 2 / math.tan(math.radians(fov_deg / 2)) + 2.5
    return CameraPose(np.array([*centre, above]), np.array([[0, 1, 0], [0, 0, 1], [-1, 0, 0]], float))


def over(axes_w: np.ndarray, low: np.ndarray, high: np.ndarray, pixel_m: float) -> tuple[CameraPose, Lens]:
    """Return a camera so far off a rectangle that its rays are parallel.

    The rows of `axes_w` (3, 3) point to the right, up, and at the viewer; `low` and `high` are corners (m) along them.
    The picture is some whole pixels of `pixel_m` large, from the lower left corner on.
    """
    columns, rows = np.ceil((high - low)[:2] / pixel_m - 1e-6).astype(int).tolist()
    away, half = 1e4 * pixel_m * max(columns, rows), np.array([columns, rows]) * pixel_m / 2
    axes = np.stack([-axes_w[2], axes_w[0], axes_w[1]], -1)
    lens = Lens(columns, rows, math.degrees(2 * math.atan(half[1] / away)))
    return CameraPose(np.array([*low[:2] + half, away]) @ axes_w, axes), lens


def cast(
    model: mujoco.MjModel, data: mujoco.MjData, origin_w: np.ndarray, unit_w: np.ndarray, groups: Sequence[int]
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Return what rays from (3,), m, with unit directions [n, 3] meet first of some geom groups.

    These are [n] geoms, -1 for nothing; [n] distances, m; [n, 3] normals.
    """
    count = len(unit_w)
    geom, distance, normal = np.zeros(count, np.int32), np.zeros(count), np.zeros(3 * count)
    origin, flat = np.asarray(origin_w, float), np.ascontiguousarray(unit_w).ravel()
    shown = np.isin(np.arange(6), groups).astype(np.uint8)
    far = mujoco.mjMAXVAL
    mujoco.mj_multiRay(model, data, origin, flat, shown, 1, -1, geom, distance, normal, count, far)
    return geom, distance, normal.reshape(-1, 3)


def trace(
    model: mujoco.MjModel, data: mujoco.MjData, pose: CameraPose, lens: Lens, groups: Sequence[int]
) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]:
    """Return what the pixels of a camera show of some geom groups.

    These are [H, W, 3] rays, see `Lens.rays`; [H, W] geoms, -1 for nothing; [H, W] depths along the optical axis, m;
    [H, W, 3] normals.
    """
    ray = lens.rays(pose)
    length = np.linalg.norm(ray, axis=-1, keepdims=True)
    geom, distance, normal = cast(model, data, pose.pos_w, (ray / length).reshape(-1, 3), groups)
    shape = ray.shape[:2]
    return ray, geom.reshape(shape), distance.reshape(shape) / length[..., 0], normal.reshape(ray.shape)


def mesh_of(model: mujoco.MjModel, mesh: int) -> tuple[np.ndarray, np.ndarray, np.ndarray | None]:
    """Return vertices [n, 3] f32 (m), faces [m, 3] i32 and their texture coordinates [m, 3, 2] of a compiled mesh."""
    first, face, start = model.mesh_vertadr[mesh], model.mesh_faceadr[mesh], model.mesh_texcoordadr[mesh]
    rows = slice(face, face + model.mesh_facenum[mesh])
    uv = model.mesh_texcoord[start + model.mesh_facetexcoord[rows]] if start >= 0 else None
    return model.mesh_vert[first : first + model.mesh_vertnum[mesh]], model.mesh_face[rows], uv


def mesh_normals(model: mujoco.MjModel, mesh: int) -> np.ndarray | None:
    """Return the normals [m, 3, 3] that a compiled mesh's file has at the corners of its faces; None: it has none."""
    face, first = model.mesh_faceadr[mesh], model.mesh_normaladr[mesh]
    rows = slice(face, face + model.mesh_facenum[mesh])
    if (model.mesh_facenormal[rows] == model.mesh_face[rows]).all():  # MuJoCo's, one a vertex
        return None
    return model.mesh_normal[first + model.mesh_facenormal[rows]]


def geom_mesh(model: mujoco.MjModel, geom: int) -> tuple[np.ndarray, np.ndarray]:
    """Return vertices [n, 3] f64 (m, in the body's frame) and faces [m, 3] i64 of a mesh geom."""
    (vertices, faces, _), turn = mesh_of(model, model.geom_dataid[geom]), matrix_from_quat(model.geom_quat[geom])
    return vertices.astype(float) @ turn.T + model.geom_pos[geom], faces.astype(np.int64)


def geom_image(model: mujoco.MjModel, geom: int) -> np.ndarray | None:
    """Return the texture [h, w, channels] u8 of a geom's material; None where it has none."""
    material = model.geom_matid[geom]
    texture = model.mat_texid[material, mujoco.mjtTextureRole.mjTEXROLE_RGB] if material >= 0 else -1
    if texture < 0:
        return None
    shape = model.tex_height[texture], model.tex_width[texture], model.tex_nchannel[texture]
    return model.tex_data[model.tex_adr[texture] :][: np.prod(shape)].reshape(shape)


def geom_colour(model: mujoco.MjModel, geom: int) -> np.ndarray:
    """Return (3,) in [0, 1]: of the geom, or its texture's mean."""
    material, image = model.geom_matid[geom], geom_image(model, geom)
    if image is None:
        return (model.mat_rgba[material] if material >= 0 else model.geom_rgba[geom])[:3]
    pixels = image.reshape(-1, image.shape[-1])[:, :3]
    # Atlases are padded with black.
    used = pixels.max(1) > 8
    return pixels[used].mean(0) / 255.0 if used.any() else np.full(3, 0.5)


class GlPainter:
    """Draws one model, one camera after the other; it must stay in the thread that created it."""

    def __init__(
        self, model: mujoco.MjModel, width: int, height: int, sky: tuple[int, ...] | None = SKY, shadows: bool = False
    ):
        """Create a context for pictures of so many pixels; `sky` is the colour of the background (None: the model's).

        With `shadows`, what stands in a building casts some, by the lights that are neither lamps nor have ambient
        light, which MuJoCo takes from shadows too; these lights become as even as the sun's, in the model.
        """
        buffer = model.vis.global_
        if width > buffer.offwidth or height > buffer.offheight:
            raise UserError(
                f"engine 'gl' got pictures of {width} x {height} pixels, expected at most {buffer.offwidth} x "
                f"{buffer.offheight}; ask for smaller ones, or for engine=rays"
            )
        self._model, self._size, self._sky, self._shadows = model, (height, width), sky, shadows
        if shadows:
            suns = ~model.light_ambient.any(axis=1) & (model.light_cutoff <= 90)
            model.light_castshadow[:] = suns
            model.light_type[suns] = mujoco.mjtLightType.mjLIGHT_DIRECTIONAL
            model.light_diffuse[suns], model.light_specular[suns] = SUN, 0.0
            model.vis.quality.shadowsize, model.vis.map.shadowclip = SHADOW_TEXELS, SHADOW_M / model.stat.extent
        try:
            with warnings.catch_warnings():
                warnings.simplefilter("ignore")
                self._context = _context_class()(width, height)
                # At exit, before the library that was imported just now ends.
                atexit.register(weakref.finalize(self, self._context.free))
                self._context.make_current()
                self._drawn = mujoco.MjrContext(model, mujoco.mjtFontScale.mjFONTSCALE_100.value)
        except Exception as error:  # noqa: BLE001  (GL bindings raise what they like where no GL is)
            raise UserError(
                f"engine 'gl' does not start here ({' '.join(repr(error).split())[:200]}); install libegl1 and "
                "libgl1-mesa-dri, or libosmesa6 and set MUJOCO_GL=osmesa; or engine=warp"
            ) from error
        mujoco.mjr_setBuffer(mujoco.mjtFramebuffer.mjFB_OFFSCREEN.value, self._drawn)
        self._scene = mujoco.MjvScene(model, model.ngeom + 100)
        self._view = mujoco.MjrRect(0, 0, width, height)

    def draw(
        self, data: mujoco.MjData, pose: CameraPose, fov_deg: float, groups: Sequence[int], depth: bool = False
    ) -> np.ndarray:
        """Draw pictures [N, H, W, 3] u8 of N cameras without roll; or `depth` [N, H, W] f32, m along the axis."""
        self._context.make_current()
        self._model.vis.global_.fovy = fov_deg
        option = mujoco.MjvOption()
        option.geomgroup[:] = np.isin(np.arange(6), groups)
        every = mujoco.mjtCatBit.mjCAT_ALL.value
        images = []
        for pos_w, axes_w in zip(np.asarray(pose.pos_w, float), np.asarray(pose.axes_w), strict=True):
            camera = _free_camera(pos_w, axes_w[:, 0], axes_w[:, 2])
            mujoco.mjv_updateScene(self._model, data, option, None, camera, every, self._scene)
            if self._shadows:  # MuJoCo's of walls and ceilings would fill the rooms; decoration casts none
                for geom in self._scene.geoms[: self._scene.ngeom]:
                    standing = geom.objid >= 0 and self._model.body_weldid[self._model.geom_bodyid[geom.objid]] == 0
                    geom.category = mujoco.mjtCatBit.mjCAT_DECOR if standing else geom.category
            images.append(self._read(depth))
        return np.stack(images)

    def _read(self, depth: bool) -> np.ndarray:
        mujoco.mjr_render(self._view, self._scene, self._drawn)
        colour, window = np.zeros((*self._size, 3), np.uint8), np.zeros(self._size, np.float32)
        mujoco.mjr_readPixels(colour, window, self._view, self._drawn)
        if not depth:
            if self._sky is not None:
                colour[window >= 1.0] = self._sky
            return colour[::-1].copy()
        extent, planes = self._model.stat.extent, self._model.vis.map
        near, far = planes.znear * extent, planes.zfar * extent
        return (near / (1.0 - window * (1.0 - near / far)))[::-1].copy()


def _free_camera(pos_w: np.ndarray, forward: np.ndarray, up: np.ndarray) -> mujoco.MjvCamera:
    camera = mujoco.MjvCamera()
    camera.type = mujoco.mjtCamera.mjCAMERA_FREE
    camera.lookat[:], camera.distance = pos_w + forward, 1.0
    camera.elevation = math.degrees(math.asin(np.clip(forward[2], -1.0, 1.0)))
    flat = forward if abs(forward[2]) < 1 - 1e-9 else up
    camera.azimuth = math.degrees(math.atan2(flat[1], flat[0]))
    return camera


def _context_class() -> Any:
    library = os.environ.get("MUJOCO_GL", "").lower().strip()
    if library not in LIBRARIES:
        library = "glfw" if os.environ.get("DISPLAY") else "egl"
    return importlib.import_module(f"mujoco.{library}").GLContext
