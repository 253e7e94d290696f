"""Where a robot stands and looks in, what its camera sees out: a scene at rest, drawn in batches of any size.

`warp` (MJX-Warp's ray tracer, on a CPU or an NVIDIA GPU) and `gl` (MuJoCo's own renderer, which needs EGL or OSMesa)
both draw the visual meshes with their textures. Their light differs, so the images of one do not fit networks that
learned from the other.
"""

from __future__ import annotations

import math
import os
import warnings
from collections.abc import Callable

import mujoco
import numpy as np

from interactive_nav.rendering.base import CameraPose, Lens, look_along
from interactive_nav.robots import RobotSpec
from interactive_nav.scene import Scene
from topological_nav.errors import TopologicalError

BATCH = 18
"""Images a call unless asked otherwise: the headings of one position and pitch."""
_SHOWN = 2
"""Geom group of all that is drawn."""


def camera_pose(robot: RobotSpec, xy_w: np.ndarray, heading_rad: np.ndarray, pitch_rad: np.ndarray) -> CameraPose:
    """Where the camera of a robot is that stands on the floor.

    Args:
        robot: its camera is fixed to its base, whose frame lies on the floor.
        xy_w: [..., 2] m, of the base.
        heading_rad: [...], yaw of the base.
        pitch_rad: [...], how far up the camera looks beside its mount's own pitch.

    Raises:
        TopologicalError: the robot's camera is carried by another link.
    """
    camera = robot.camera
    if camera.body != robot.base_body:
        raise TopologicalError(
            f"the camera of '{robot.name}' sits on '{camera.body}', expected its base '{robot.base_body}'; "
            "choose a robot with a camera on its base, such as ttbot"
        )
    shape = np.broadcast_shapes(np.shape(xy_w)[:-1], np.shape(heading_rad), np.shape(pitch_rad))
    xy = np.broadcast_to(xy_w, (*shape, 2))
    heading, pitch = np.broadcast_to(heading_rad, shape), np.broadcast_to(pitch_rad, shape) - camera.pitch_rad
    cos, sin = np.cos(heading), np.sin(heading)
    x, y, z = camera.pos_m
    pos = np.stack([xy[..., 0] + cos * x - sin * y, xy[..., 1] + sin * x + cos * y, np.full(shape, z)], -1)
    forward = np.stack([np.cos(pitch) * cos, np.cos(pitch) * sin, np.sin(pitch)], -1)
    return look_along(np.asarray(pos, np.float32), np.asarray(forward, np.float32))  # type: ignore[arg-type]


class SceneRenderer:
    """Draws one scene, its furniture at rest and no robot in it."""

    def __init__(self, scene: Scene, lens: Lens, supersample: int = 1, engine: str = "warp", batch: int = BATCH):
        """Loads the scene's meshes; the first picture may compile.

        Args:
            scene: what is drawn.
            lens: of the images returned.
            supersample: images are drawn this many times larger along each side and averaged.
            engine: warp or gl.
            batch: images a call of the engine; fewer are padded.
        """
        self._lens, self._by, self._batch = lens, supersample, batch
        self._large = Lens(lens.width * supersample, lens.height * supersample, lens.fov_deg)
        self._model = _visual_model(scene, self._large)
        self._data = mujoco.MjData(self._model)
        mujoco.mj_forward(self._model, self._data)
        self._draw: Callable[[np.ndarray, np.ndarray], np.ndarray] = (
            self._warp_painter() if engine == "warp" else self._gl_painter()
        )

    def draw(self, pose: CameraPose) -> np.ndarray:
        """[N, H, W, 3] u8 images of cameras with leaves [N, ...]."""
        pos, axes = np.asarray(pose.pos_w, np.float32), np.asarray(pose.axes_w, np.float32)
        count = len(pos)
        out = np.empty((count, self._lens.height, self._lens.width, 3), np.uint8)
        for first in range(0, count, self._batch):
            # Padded by the last camera: Warp draws batches of one size only.
            rows = np.minimum(np.arange(first, first + self._batch), count - 1)
            drawn = self._draw(pos[rows], axes[rows])[: count - first]
            out[first : first + self._batch] = shrink(drawn, self._by)
        return out

    def _warp_painter(self):
        try:
            from interactive_nav.rendering.warp import WarpColour
        except ImportError as error:
            raise TopologicalError(
                f"engine 'warp' does not start here ({error}); pip install 'interactive-nav[warp]', or engine=gl"
            ) from error
        painter = WarpColour(self._model, self._large, self._batch, [_SHOWN])
        xpos = np.tile(self._data.geom_xpos, (self._batch, 1, 1))
        xmat = np.tile(self._data.geom_xmat.reshape(-1, 3, 3), (self._batch, 1, 1, 1))
        return lambda pos, axes: np.asarray(painter.draw(xpos, xmat, CameraPose(pos, axes)))

    def _gl_painter(self):
        if not os.environ.get("DISPLAY"):
            os.environ.setdefault("MUJOCO_GL", "egl")
        try:
            with warnings.catch_warnings():
                warnings.simplefilter("ignore")
                renderer = mujoco.Renderer(self._model, self._large.height, self._large.width)
        except Exception as error:  # noqa: BLE001  (GL bindings raise what they like where no GL is)
            raise TopologicalError(
                f"engine 'gl' does not start here ({error!r}); set MUJOCO_GL to egl or osmesa and install that "
                "library, or engine=warp"
            ) from error
        option = mujoco.MjvOption()
        option.geomgroup[:] = np.arange(6) == _SHOWN
        self._model.vis.global_.fovy = self._large.fov_deg

        def paint(pos: np.ndarray, axes: np.ndarray) -> np.ndarray:
            pictures = []
            for at, frame in zip(pos.astype(float), axes.astype(float), strict=True):
                forward = frame[:, 0]
                camera = mujoco.MjvCamera()
                camera.type = mujoco.mjtCamera.mjCAMERA_FREE
                camera.lookat[:], camera.distance = at + forward, 1.0
                camera.elevation = math.degrees(math.asin(np.clip(forward[2], -1.0, 1.0)))
                camera.azimuth = math.degrees(math.atan2(forward[1], forward[0]))
                renderer.update_scene(self._data, camera, option)
                pictures.append(renderer.render())
            return np.stack(pictures)

        return paint


def shrink(images: np.ndarray, by: int) -> np.ndarray:
    """[N, by H, by W, 3] u8 to [N, H, W, 3] u8: means over squares of `by` pixels, rounded."""
    n, height, width, channels = images.shape
    blocks = images.reshape(n, height // by, by, width // by, by, channels)
    return np.rint(blocks.mean((2, 4), dtype=np.float32)).astype(np.uint8)


def _visual_model(scene: Scene, lens: Lens) -> mujoco.MjModel:
    """The scene's visual meshes and floor in one group; boxes stand for bodies without a mesh."""
    spec = mujoco.MjSpec.from_file(str(scene.path / "scene.xml"))
    with_mesh = {g.parent.name for g in spec.geoms if g.group == _SHOWN}
    for geom in list(spec.geoms):
        plane, box = geom.type == mujoco.mjtGeom.mjGEOM_PLANE, geom.type == mujoco.mjtGeom.mjGEOM_BOX
        shown = geom.group == _SHOWN or plane or (box and geom.parent.name not in with_mesh)
        geom.group = _SHOWN if shown else 4
        if plane:
            geom.rgba = [0.56, 0.50, 0.43, 1.0]
    for camera in list(spec.cameras):
        spec.delete(camera)  # MJX-Warp would draw through every camera of the model
    if not any(body.joints for body in spec.bodies):
        # MJX-Warp wants at least one degree of freedom.
        body = spec.worldbody.add_body(name="unseen", pos=[0, 0, -60.0])
        body.add_joint(type=mujoco.mjtJoint.mjJNT_SLIDE)
        body.mass, body.inertia, body.explicitinertial = 1.0, np.ones(3), True
    spec.worldbody.add_light(pos=[0, 0, 6], dir=[0.3, 0.2, -1], diffuse=[0.5] * 3, castshadow=False)
    spec.worldbody.add_camera(name="view", fovy=lens.fov_deg)
    spec.visual.global_.offwidth, spec.visual.global_.offheight = max(lens.width, 640), max(lens.height, 480)
    spec.stat.extent = 1.0  # the clipping planes are given as shares of the extent
    spec.visual.map.znear, spec.visual.map.zfar = 0.01, 100.0
    return spec.compile()
