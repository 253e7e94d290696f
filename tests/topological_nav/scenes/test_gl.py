"""MuJoCo's renderer against MJX-Warp's: the same place, pose and lens show the same shapes."""

import numpy as np
import pytest

from interactive_nav.robots import get_robot
from interactive_nav.scenes.scene import load_scene
from scenes_mjcf.look import SKY, Lens
from tests.gl_program import drawn, need_gl
from topological_nav.scenes.rendering import SceneRenderer, camera_pose

LENS, FINER = Lens(64, 48, 90.0), 4
PLACES = np.array([[-1.5, 0.0], [1.5, 0.5], [-2.0, -1.0], [1.0, -1.2]])
HEADINGS = np.array([np.pi, 0.2, 1.2, -2.4])


ROOMS = """
import gc, sys, weakref, numpy as np
from pathlib import Path
from scenes_mjcf.look import Lens
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


@pytest.fixture(scope="module")
def by_gl(painted, tmp_path_factory):
    """The painted rooms, from above the panels, and whether the renderer outlives its last use."""
    need_gl()
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
