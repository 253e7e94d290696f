"""MuJoCo's renderer against geometry by hand."""

import mujoco
import numpy as np
import pytest

import scenes_mjcf.look as gl
from interactive_nav_common.errors import UserError
from scenes_mjcf.look import SKY, GlPainter
from tests.gl_program import drawn, need_gl

BOX = """
import mujoco, sys, numpy as np
from scenes_mjcf.look import look_along
from scenes_mjcf.look import GlPainter
spec = mujoco.MjSpec()
box = mujoco.mjtGeom.mjGEOM_BOX
spec.worldbody.add_geom(type=box, pos=[3.5, 0, 0], size=[0.5, 1.0, 1.0], rgba=[1, 0, 0, 1], group=2)
spec.worldbody.add_geom(type=box, pos=[1.5, 0, 0], size=[0.1, 5, 5], group=4)
spec.stat.extent = 1.0
spec.visual.map.znear, spec.visual.map.zfar = 0.01, 100.0
model = spec.compile()
data = mujoco.MjData(model)
mujoco.mj_forward(model, data)
painter = GlPainter(model, 80, 80)
camera = look_along(np.zeros((1, 3)), np.array([[1.0, 0.0, 0.0]]))
asked = data, camera, 90.0, [2]
np.savez(sys.argv[1], depth=painter.draw(*asked, depth=True), colour=painter.draw(*asked))
"""


def test_a_box_is_as_far_and_as_large_as_by_hand(tmp_path):
    need_gl()
    made = drawn(BOX, tmp_path)
    depth, colour = made["depth"][0], made["colour"][0]
    # Its face is 3 m ahead and reaches 1 m to all sides: 1/3 of half the picture, 13.3 of 40 pixels.
    shown = depth < 50.0
    assert {shown.sum(0).max(), shown.sum(1).max()} <= {26, 27}
    assert np.abs(depth[shown] - 3.0).max() < 0.01  # the nearer box, of another group, is not drawn
    assert ((colour[..., 0] > 2 * colour[..., 1].astype(int)) == shown).all()
    assert (colour[~shown] == SKY).all()


SHADOW = """
import mujoco, sys, numpy as np
from scenes_mjcf.look import GlPainter, look_along
model = mujoco.MjModel.from_xml_string('''<mujoco><visual><headlight ambient=".4 .4 .4" diffuse="0 0 0"/></visual>
<worldbody><light pos="0 0 6" diffuse=".5 .5 .5"/><light pos="0 0 6" ambient=".1 .1 .1" diffuse="0 0 0"/>
<geom type="plane" size="5 5 1" rgba="1 1 1 1"/><geom type="box" pos="-1 0 3" size=".5 .5 .1"/>
<body pos="1 0 1"><freejoint/><geom type="box" size=".5 .5 .1"/></body></worldbody></mujoco>''')
data = mujoco.MjData(model)
mujoco.mj_forward(model, data)
painter = GlPainter(model, 60, 60, shadows=True)
camera = look_along(np.array([[1.0, -3.0, 0.5], [-1.0, -3.0, 0.5]]), np.array([[0.0, 1.0, -0.17]] * 2))
np.savez(sys.argv[1], seen=painter.draw(data, camera, 10.0, [0]), casts=model.light_castshadow)
"""


def test_what_moves_casts_shadows_and_what_stands_fast_casts_none(tmp_path):
    """Under a body that is free, and under a block that is not; light comes from straight above."""
    need_gl()
    made = drawn(SHADOW, tmp_path)
    assert made["casts"].tolist() == [True, False]  # that with ambient light leaves none
    loose, fast = made["seen"][..., 0].astype(int)
    assert loose[30, 30] < 0.8 * fast[30, 30]
    assert abs(loose[59, 30] - fast[59, 30]) < 5  # nearer than the shadow


def test_without_a_gl_it_says_what_to_install(monkeypatch):
    def none():
        raise ImportError("no library\nhere")

    monkeypatch.setattr(gl, "_context_class", none)
    model = mujoco.MjModel.from_xml_string("<mujoco/>")
    with pytest.raises(UserError, match=r"no library.*here.*install libegl1 and libgl1-mesa-dri"):
        GlPainter(model, 64, 48)


def test_pictures_larger_than_the_buffer_are_refused():
    model = mujoco.MjModel.from_xml_string("<mujoco/>")
    with pytest.raises(UserError, match=r"got pictures of 641 x 480 pixels, expected at most 640 x 480"):
        GlPainter(model, 641, 480)


PANE = """
import mujoco, sys, numpy as np
from pathlib import Path
from PIL import Image
from scenes_mjcf.look import GLASS, GlPainter, cast, glaze, look_along
folder = Path(sys.argv[1]).parent
(folder / "assets").mkdir()
image = np.zeros((4, 4, 3), np.uint8)  # glass on the left, blue on the right
image[:, :2], image[:, 2:] = GLASS, (0, 0, 255)
Image.fromarray(image).save(folder / "assets" / "pane.png")
corners = [(2, y, z) for y in (1, -0.001, 0.001, -1) for z in (-1, 1)]
lines = [f"v {x} {y} {z}" for x, y, z in corners] + [f"vt {u} {v}" for u in (0.1, 0.4, 0.6, 0.9) for v in (0.1, 0.9)]
lines += [f"f {a}/{a} {b}/{b} {c}/{c} {d}/{d}" for a, b, c, d in ((1, 3, 4, 2), (5, 7, 8, 6))]
(folder / "assets" / "pane.obj").write_text("\\n".join(lines) + "\\n")
(folder / "scene.xml").write_text('''<mujoco><compiler meshdir="assets" texturedir="assets"/>
<visual><headlight ambient="1 1 1" diffuse="0 0 0" specular="0 0 0"/><map znear=".01" zfar="100"/></visual>
<statistic extent="1"/><asset><mesh name="pane" file="pane.obj" inertia="shell"/>
<texture name="pane" type="2d" file="pane.png"/><material name="pane" texture="pane" specular="0"/></asset><worldbody>
<geom type="mesh" mesh="pane" name="pane" material="pane" contype="0" conaffinity="0" group="2"/>
<geom type="box" pos="3.5 0 0" size=".5 4 4" rgba="1 0 0 1" group="2"/></worldbody></mujoco>''')
unit = np.array([[1.0, y, z] for y in (-0.3, 0.1, 0.3, 0.7) for z in (-0.2, 0.1, 0.3)])
unit /= np.linalg.norm(unit, axis=1, keepdims=True)
out = {}
for name in ("stored", "glazed"):
    spec = mujoco.MjSpec.from_file(str(folder / "scene.xml"))
    if name == "glazed":
        glaze(spec, folder)
    model = spec.compile()
    data = mujoco.MjData(model)
    mujoco.mj_forward(model, data)
    camera = look_along(np.zeros((1, 3)), np.array([[1.0, 0.0, 0.0]]))
    out[name] = GlPainter(model, 80, 80).draw(data, camera, 60.0, [2])[0]
    out[name + "_m"] = cast(model, data, np.zeros(3), unit, [2])[1] * unit[:, 0]
np.savez(sys.argv[1], **out)
"""


def test_one_sees_through_glass_and_through_nothing_else(tmp_path):
    """Glass of alpha 0.3 before red: 0.3 (170, 198, 202) + 0.7 (255, 0, 0)."""
    need_gl()
    made = drawn(PANE, tmp_path)
    for name, left in (("stored", (170, 198, 202)), ("glazed", (229.5, 59.4, 60.6))):
        assert np.abs(made[name][30:50, 15:38] - np.array(left)).max() <= 2
        assert np.abs(made[name][30:50, 42:65].astype(int) - (0, 0, 255)).max() <= 2
    # Three of four columns of rays meet the pane, 2 m ahead, the last one the wall behind it, 3 m ahead.
    assert np.allclose(made["stored_m"], [2.0] * 9 + [3.0] * 3, atol=1e-6)
    assert np.allclose(made["glazed_m"], made["stored_m"], atol=1e-6)
