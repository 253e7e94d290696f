"""MuJoCo's renderer against MJX-Warp's: the same place, pose and lens show the same shapes."""

import os
import subprocess
import sys
from pathlib import Path

import mujoco
import numpy as np
import pytest

from interactive_nav.robots import get_robot
from interactive_nav.scenes.scene import load_scene
from interactive_nav.sensing.base import Lens
from interactive_nav_common.errors import UserError
from topological_nav.scenes import gl
from topological_nav.scenes.gl import SKY, GlPainter
from topological_nav.scenes.rendering import SceneRenderer, camera_pose

LENS, FINER = Lens(64, 48, 90.0), 4
PLACES = np.array([[-1.5, 0.0], [1.5, 0.5], [-2.0, -1.0], [1.0, -1.2]])
HEADINGS = np.array([np.pi, 0.2, 1.2, -2.4])


PLAIN = """
import mujoco
from mujoco.egl import GLContext
context = GLContext(16, 16)
context.make_current()
mujoco.MjrContext(mujoco.MjModel.from_xml_string("<mujoco/>"), mujoco.mjtFontScale.mjFONTSCALE_100.value)
"""
BOX = """
import mujoco, sys, numpy as np
from interactive_nav.sensing.base import Lens, look_along
from topological_nav.scenes.gl import GlPainter
spec = mujoco.MjSpec()
box = mujoco.mjtGeom.mjGEOM_BOX
spec.worldbody.add_geom(type=box, pos=[3.5, 0, 0], size=[0.5, 1.0, 1.0], rgba=[1, 0, 0, 1], group=2)
spec.worldbody.add_geom(type=box, pos=[1.5, 0, 0], size=[0.1, 5, 5], group=4)
spec.stat.extent = 1.0
spec.visual.map.znear, spec.visual.map.zfar = 0.01, 100.0
model = spec.compile()
data = mujoco.MjData(model)
mujoco.mj_forward(model, data)
painter = GlPainter(model, data, Lens(80, 80, 90.0), 2)
camera = look_along(np.zeros((1, 3)), np.array([[1.0, 0.0, 0.0]]))
poses = np.asarray(camera.pos_w), np.asarray(camera.axes_w)
np.savez(sys.argv[1], depth=painter.draw(*poses, depth=True), colour=painter.draw(*poses))
"""
ROOMS = """
import gc, sys, weakref, numpy as np
from pathlib import Path
from interactive_nav.sensing.base import Lens
from interactive_nav.robots import get_robot
from interactive_nav.scenes.scene import load_scene
from topological_nav.scenes.rendering import SceneRenderer, camera_pose
asked = np.load(sys.argv[2])
lens = Lens(int(asked["width"]), int(asked["height"]), float(asked["fov_deg"]))
renderer = SceneRenderer(load_scene(Path(sys.argv[3])), lens, int(asked["finer"]), engine="gl")
pose = camera_pose(get_robot("ttbot"), asked["places"], asked["headings"], np.full(len(asked["places"]), -0.1))
images, held = renderer.draw(pose), weakref.ref(renderer)
gc.disable()
del renderer
np.savez(sys.argv[1], images=images, held=held() is not None)
"""


def drawn(program: str, folder: Path, *words: Path | str) -> dict[str, np.ndarray]:
    """What a program of its own saves: GL libraries abort rather than raise, and MuJoCo chooses its own at import."""
    out = folder / "drawn.npz"
    env = {k: v for k, v in os.environ.items() if k not in ("MUJOCO_GL", "PYOPENGL_PLATFORM", "DISPLAY")}
    words = (sys.executable, "-c", program, str(out), *map(str, words))
    done = subprocess.run(words, env=env, capture_output=True, text=True, timeout=300)
    assert done.returncode == 0, done.stderr
    with np.load(out) as made:
        return dict(made)


@pytest.fixture(scope="module")
def gl_here():
    """Skips where MuJoCo itself, without our code, starts no EGL."""
    done = subprocess.run([sys.executable, "-c", PLAIN], capture_output=True, text=True, timeout=300)
    if done.returncode:
        pytest.skip(f"no GL here (exit code {done.returncode}): {done.stderr.strip()[-300:]}")


def test_a_box_is_as_far_and_as_large_as_by_hand(gl_here, tmp_path):
    made = drawn(BOX, tmp_path)
    depth, colour = made["depth"][0], made["colour"][0]
    # Its face is 3 m ahead and reaches 1 m to all sides: 1/3 of half the picture, 13.3 of 40 pixels.
    shown = depth < 50.0
    assert {shown.sum(0).max(), shown.sum(1).max()} <= {26, 27}
    assert np.abs(depth[shown] - 3.0).max() < 0.01  # the nearer box, of another group, is not drawn
    assert ((colour[..., 0] > 2 * colour[..., 1].astype(int)) == shown).all()
    assert (colour[~shown] == SKY).all()


@pytest.fixture(scope="module")
def by_gl(gl_here, painted, tmp_path_factory):
    """The painted rooms, from above the panels, and whether the renderer outlives its last use."""
    folder = tmp_path_factory.mktemp("gl")
    lens = {"width": LENS.width, "height": LENS.height, "fov_deg": LENS.fov_deg}
    np.savez(folder / "asked.npz", places=PLACES, headings=HEADINGS, finer=FINER, **lens)
    return drawn(ROOMS, folder, folder / "asked.npz", painted)


@pytest.fixture(scope="module")
def both(by_gl, painted):
    """The same by both engines."""
    pose = camera_pose(get_robot("ttbot"), PLACES, HEADINGS, np.full(4, -0.1))
    return by_gl["images"], SceneRenderer(load_scene(painted), LENS, FINER, engine="warp").draw(pose)


def test_a_context_goes_with_its_renderer(by_gl):
    assert not by_gl["held"]


def kinds(images):
    """[..., H, W] 0 sky, 1 reddish, 2 greenish, 3 else: what is seen, whatever the light."""
    red, green, blue = np.moveaxis(images.astype(int), -1, 0)
    sky = np.abs(images.astype(int) - SKY).max(-1) <= 3
    strong = 1.5
    out = np.where((red > strong * green) & (red > strong * blue), 1, 3)
    out = np.where((green > strong * red) & (green > strong * blue), 2, out)
    return np.where(sky, 0, out)


def test_both_engines_show_the_same_shapes(both):
    by_gl, by_warp = (kinds(images) for images in both)
    assert all((by_warp == kind).mean() > 0.02 for kind in range(4))
    same = (by_gl == by_warp).mean((1, 2))
    assert same.min() > 0.97
    # Moved by four pixels, mirrored, or of another place, they do not.
    for other in (np.roll(by_gl, 4, 1), np.roll(by_gl, 4, 2), by_gl[:, :, ::-1], by_gl[:, ::-1], by_gl[[1, 2, 3, 0]]):
        assert (other == by_warp).mean() < same.mean() - 0.02


def test_without_a_gl_it_says_what_to_install(monkeypatch):
    def none():
        raise ImportError("no library\nhere")

    monkeypatch.setattr(gl, "_context_class", none)
    model = mujoco.MjModel.from_xml_string("<mujoco/>")
    with pytest.raises(UserError, match=r"no library.*here.*install libegl1 and libgl1-mesa-dri"):
        GlPainter(model, mujoco.MjData(model), LENS, 2)
