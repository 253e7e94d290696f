"""MuJoCo's own renderer, offscreen: camera poses in, pictures out.

`mujoco.Renderer` reads MUJOCO_GL when mujoco is imported, and without it and without a display it looks for a window
system and fails. Here the library is chosen when the first picture is asked for: MUJOCO_GL where it is set, else EGL
where there is no display.
"""

from __future__ import annotations

import importlib
import math
import os
import warnings
import weakref
from typing import Any

import mujoco
import numpy as np

from interactive_nav.sensing.base import Lens
from interactive_nav_common.errors import UserError

LIBRARIES = ("egl", "osmesa", "glfw")
SKY = (237, 242, 247)
"""Where nothing is hit, as in `interactive_nav.sensing.warp`; MuJoCo's would be black."""


class GlPainter:
    """Draws the visual geoms of one model, one camera after the other; it must stay in the thread that made it."""

    def __init__(self, model: mujoco.MjModel, data: mujoco.MjData, lens: Lens, group: int):
        """Makes a context.

        Args:
            model: its offscreen buffer is at least as large as the pictures.
            data: where everything stands.
            lens: of the pictures.
            group: of the geoms that are shown.

        Raises:
            UserError: no GL library starts here.
        """
        self._model, self._data, self._lens = model, data, lens
        try:
            with warnings.catch_warnings():
                warnings.simplefilter("ignore")
                self._context = _context_class()(lens.width, lens.height)
                weakref.finalize(self, self._context.free)  # at exit, before the modules that it needs are gone
                self._context.make_current()
                self._drawn = mujoco.MjrContext(model, mujoco.mjtFontScale.mjFONTSCALE_100.value)
        except Exception as error:  # noqa: BLE001  (GL bindings raise what they like where no GL is)
            raise UserError(
                f"engine 'gl' does not start here ({' '.join(repr(error).split())[:200]}); install libegl1 and "
                "libgl1-mesa-dri, or libosmesa6 and set MUJOCO_GL=osmesa; or engine=warp"
            ) from error
        mujoco.mjr_setBuffer(mujoco.mjtFramebuffer.mjFB_OFFSCREEN.value, self._drawn)
        self._scene = mujoco.MjvScene(model, model.ngeom + 100)
        self._option = mujoco.MjvOption()
        self._option.geomgroup[:] = np.arange(6) == group
        self._view = mujoco.MjrRect(0, 0, lens.width, lens.height)
        model.vis.global_.fovy = lens.fov_deg

    def draw(self, pos_w: np.ndarray, axes_w: np.ndarray, depth: bool = False) -> np.ndarray:
        """Pictures of cameras.

        Args:
            pos_w: [N, 3] m.
            axes_w: [N, 3, 3] forward, right, up as columns; forward is not vertical.
            depth: distances along the axis (m) rather than colours.

        Returns:
            [N, H, W, 3] u8, or [N, H, W] f32.
        """
        self._context.make_current()
        return np.stack([self._one(p, a[:, 0], depth) for p, a in zip(pos_w.astype(float), axes_w, strict=True)])

    def _one(self, pos_w: np.ndarray, forward: np.ndarray, depth: bool) -> np.ndarray:
        camera = mujoco.MjvCamera()
        camera.type = mujoco.mjtCamera.mjCAMERA_FREE
        camera.lookat[:], camera.distance = pos_w + forward, 1.0
        camera.elevation = math.degrees(math.asin(np.clip(forward[2], -1.0, 1.0)))
        camera.azimuth = math.degrees(math.atan2(forward[1], forward[0]))
        every = mujoco.mjtCatBit.mjCAT_ALL.value
        mujoco.mjv_updateScene(self._model, self._data, self._option, None, camera, every, self._scene)
        mujoco.mjr_render(self._view, self._scene, self._drawn)
        colour = np.zeros((self._lens.height, self._lens.width, 3), np.uint8)
        window = np.zeros((self._lens.height, self._lens.width), np.float32)
        mujoco.mjr_readPixels(colour, window, self._view, self._drawn)
        if not depth:
            colour[window >= 1.0] = SKY
            return colour[::-1].copy()
        extent, planes = self._model.stat.extent, self._model.vis.map
        near, far = planes.znear * extent, planes.zfar * extent
        return (near / (1.0 - window * (1.0 - near / far)))[::-1].copy()


def _context_class() -> Any:
    asked = os.environ.get("MUJOCO_GL", "").lower().strip()
    if asked not in LIBRARIES:
        asked = "glfw" if os.environ.get("DISPLAY") else "egl"
    return importlib.import_module(f"mujoco.{asked}").GLContext
