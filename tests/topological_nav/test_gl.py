"""MuJoCo's renderer against MJX-Warp's: the same place, pose and lens show the same shapes."""

import os
import subprocess
import sys

import mujoco
import numpy as np
import pytest

from interactive_nav.rendering.base import Lens, look_along
from interactive_nav.robots import get_robot
from interactive_nav.scene import load_scene
from topological_nav import gl
from topological_nav.errors import TopologicalError
from topological_nav.gl import SKY, GlPainter
from topological_nav.rendering import SceneRenderer, camera_pose

LENS, FINER = Lens(64, 48, 90.0), 4
PLACES = np.array([[-1.5, 0.0], [1.5, 0.5], [-2.0, -1.0], [1.0, -1.2]])
HEADINGS = np.array([np.pi, 0.2, 1.2, -2.4])


def box_model() -> mujoco.MjModel:
    spec = mujoco.MjSpec()
    box = mujoco.mjtGeom.mjGEOM_BOX
    spec.worldbody.add_geom(type=box, pos=[3.5, 0, 0], size=[0.5, 1.0, 1.0], rgba=[1, 0, 0, 1], group=2)
    spec.worldbody.add_geom(type=box, pos=[1.5, 0, 0], size=[0.1, 5, 5], group=4)
    spec.stat.extent = 1.0
    spec.visual.map.znear, spec.visual.map.zfar = 0.01, 100.0
    return spec.compile()


def paint(model: mujoco.MjModel, lens: Lens, group: int) -> GlPainter:
    """A painter, or a skipped test where no GL is."""
    data = mujoco.MjData(model)
    mujoco.mj_forward(model, data)
    try:
        return GlPainter(model, data, lens, group)
    except TopologicalError as error:
        pytest.skip(f"no GL here: {error}")


def test_a_box_is_as_far_and_as_large_as_by_hand():
    painter = paint(box_model(), Lens(80, 80, 90.0), 2)
    camera = look_along(np.zeros((1, 3)), np.array([[1.0, 0.0, 0.0]]))  # type: ignore[arg-type]
    depth = painter.draw(np.asarray(camera.pos_w), np.asarray(camera.axes_w), depth=True)[0]
    colour = painter.draw(np.asarray(camera.pos_w), np.asarray(camera.axes_w))[0]
    # Its face is 3 m ahead and reaches 1 m to all sides: 1/3 of half the picture, 13.3 of 40 pixels.
    shown = depth < 50.0
    assert {shown.sum(0).max(), shown.sum(1).max()} <= {26, 27}
    assert np.abs(depth[shown] - 3.0).max() < 0.01  # the nearer box, of another group, is not drawn
    assert ((colour[..., 0] > 2 * colour[..., 1].astype(int)) == shown).all()
    assert (colour[~shown] == SKY).all()


@pytest.fixture(scope="module")
def both(painted):
    """The painted rooms by both engines, from above the panels."""
    scene, robot = load_scene(painted), get_robot("ttbot")
    pose = camera_pose(robot, PLACES, HEADINGS, np.full(4, -0.1))
    try:
        drawn = SceneRenderer(scene, LENS, FINER, engine="gl", batch=4).draw(pose)
    except TopologicalError as error:
        pytest.skip(f"no GL here: {error}")
    return drawn, SceneRenderer(scene, LENS, FINER, engine="warp", batch=4).draw(pose)


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


def test_the_engine_starts_in_a_process_that_says_nothing_of_gl(both, painted):
    """MuJoCo itself chooses its library at import, and without a display the wrong one."""
    told = (
        "import numpy as np\n"
        "from pathlib import Path\n"
        "from interactive_nav.rendering.base import Lens\n"
        "from interactive_nav.robots import get_robot\n"
        "from interactive_nav.scene import load_scene\n"
        "from topological_nav.rendering import SceneRenderer, camera_pose\n"
        f"renderer = SceneRenderer(load_scene(Path({str(painted)!r})), Lens(16, 12, 60.0), engine='gl')\n"
        "print(renderer.draw(camera_pose(get_robot('ttbot'), np.zeros(2), np.zeros(1), np.zeros(1))).shape)\n"
    )
    env = {k: v for k, v in os.environ.items() if k not in ("MUJOCO_GL", "PYOPENGL_PLATFORM", "DISPLAY")}
    done = subprocess.run([sys.executable, "-c", told], env=env, capture_output=True, text=True)
    assert done.returncode == 0 and done.stdout.strip() == "(1, 12, 16, 3)", done.stderr


def test_without_a_gl_it_says_what_to_install(monkeypatch):
    def none():
        raise ImportError("no library\nhere")

    monkeypatch.setattr(gl, "_context_class", none)
    model = box_model()
    with pytest.raises(TopologicalError, match=r"no library.*here.*install libegl1 and libgl1-mesa-dri"):
        GlPainter(model, mujoco.MjData(model), LENS, 2)
