"""Draw pictures from camera poses with MuJoCo's renderer, offscreen.

`mujoco.Renderer` reads MUJOCO_GL when mujoco is imported, and without it and without a display it looks for a window
system and fails. Here the library is chosen when the first picture is requested: MUJOCO_GL where it is set, else EGL
where there is no display.
"""

import atexit
import importlib
import math
import os
import warnings
import weakref
from collections.abc import Sequence
from typing import Any

import mujoco
import numpy as np

from interactive_nav.sensing.base import CameraPose
from interactive_nav.sensing.shading import SKY_COLOUR
from interactive_nav_common.errors import UserError

LIBRARIES = ("egl", "osmesa", "glfw")
SKY = tuple(round(255 * c) for c in SKY_COLOUR)
"""Where nothing is hit; MuJoCo's would be black."""


class GlPainter:
    """Draws one model, one camera after the other; it must stay in the thread that created it."""

    def __init__(self, model: mujoco.MjModel, width: int, height: int, sky: tuple[int, ...] | None = SKY):
        """Create a context.

        Args:
            width: of the pictures, pixels.
            height: pixels.
            sky: colour where nothing is hit; None: the model's.
        """
        buffer = model.vis.global_
        if width > buffer.offwidth or height > buffer.offheight:
            raise UserError(
                f"engine 'gl' got pictures of {width} x {height} pixels, expected at most {buffer.offwidth} x "
                f"{buffer.offheight}; ask for smaller ones, or for engine=rays"
            )
        self._model, self._size, self._sky = model, (height, width), sky
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
        """Draw pictures of cameras.

        Args:
            pose: of N cameras without roll, leaves [N, ...].
            depth: distances along the axis (m) rather than colours.

        Returns:
            [N, H, W, 3] u8, or [N, H, W] f32.
        """
        self._context.make_current()
        self._model.vis.global_.fovy = fov_deg
        option = mujoco.MjvOption()
        option.geomgroup[:] = np.isin(np.arange(6), groups)
        every = mujoco.mjtCatBit.mjCAT_ALL.value
        images = []
        for pos_w, axes_w in zip(np.asarray(pose.pos_w, float), np.asarray(pose.axes_w), strict=True):
            camera = _free_camera(pos_w, axes_w[:, 0], axes_w[:, 2])
            mujoco.mjv_updateScene(self._model, data, option, None, camera, every, self._scene)
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
