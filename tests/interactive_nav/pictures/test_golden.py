"""The pictures of a packaged home are those of the snapshot, by rays and by GL.

`python -m tests.interactive_nav.pictures.test_golden` draws the snapshot anew; look at it before you commit it.
"""

from pathlib import Path

import numpy as np
import pytest
from PIL import Image

from tests.gl_program import drawn, need_gl

GOLDEN = Path(__file__).parents[2] / "snapshots" / "apartment.webp"
ROWS, COLUMNS = 108, 144
ENGINES = ("rays", "gl")
PROGRAM = f"""
import numpy as np, sys
from interactive_nav.pictures.camera import OUTSIDE, SceneView, chase_camera
from interactive_nav.pictures.scene_model import ROBOT, SCENE
from interactive_nav.robots import get_robot
from interactive_nav.scenes.objects import pick
from interactive_nav.scenes.scene import load_scene
from scenes_mjcf.look import Lens, look_along
view = SceneView(get_robot("turtlebot"), load_scene("scenes_mjcf/apartment_0"), pick(3))
camera = chase_camera(np.array([0.5, 0.5, 0.3]), 0.7, {ROWS}, {COLUMNS})
eye = look_along(np.array([1.6, -1.8, 1.6]), np.array([-0.8, 0.9, -0.45])), Lens({COLUMNS}, {ROWS}, 65.0)
np.savez(sys.argv[1], rays=view.render(*camera, OUTSIDE)["rgb"], gl=view.textured(*eye, (*SCENE, ROBOT)))
"""


@pytest.mark.slow
def test_pictures_are_those_of_the_snapshot(tmp_path):
    need_gl()
    pictures = drawn(PROGRAM, tmp_path)
    golden = np.split(np.asarray(Image.open(GOLDEN).convert("RGB"), int), len(ENGINES), axis=1)
    for engine, expected in zip(ENGINES, golden, strict=True):
        difference = np.abs(pictures[engine].astype(int) - expected)
        assert difference.mean() < 3 and np.quantile(difference, 0.99) < 40, engine
        shifted = np.abs(np.roll(pictures[engine], 12, axis=1).astype(int) - expected)
        assert shifted.mean() > 6, engine  # the tolerance tells pictures apart


if __name__ == "__main__":
    import tempfile

    pictures = drawn(PROGRAM, Path(tempfile.mkdtemp()))
    Image.fromarray(np.concatenate([pictures[engine] for engine in ENGINES], 1)).save(GOLDEN, quality=80, method=6)
