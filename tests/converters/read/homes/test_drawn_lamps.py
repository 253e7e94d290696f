"""Lamps of a drawing shine: where they hang, in pictures, and in no batch of physics."""

from __future__ import annotations

import re
import shutil
from pathlib import Path

import jax
import mujoco
import numpy as np
import pytest

import interactive_nav
from converters.pipeline import convert
from converters.read.homes.sh3d import LAMPS, read_sh3d
from converters.read.surfaces import split_storeys
from tests.converters.read.homes.test_drawn_pieces import SMALL
from tests.converters.read.homes.test_sh3d import HOME, piece, write_home
from tests.gl_program import drawn, need_gl

FLOOR = HOME[4].replace("floorColor='FF102030'", "floorColor='FF606060'")
PLAIN = [*HOME[:4], FLOOR, *HOME[5:7]]
PICTURE = """
import mujoco, sys, numpy as np
from scenes_mjcf.look import GlPainter
from interactive_nav.pictures.scene_model import SCENE, picture_spec
from interactive_nav.scenes.scene import load_scene
from scenes_mjcf.look import look_along
model = picture_spec(load_scene(sys.argv[2])).compile()
data = mujoco.MjData(model)
mujoco.mj_forward(model, data)
down = look_along(np.array([[1.0, -1.5, 1.7]]), np.array([[0.01, 0.0, -1.0]]))
np.savez(sys.argv[1], shown=GlPainter(model, 64, 64).draw(data, down, 60.0, SCENE)[0])
"""


def lamp(name: str, x: float, y: float, source: str, more: str = "") -> str:
    return piece(name, x, y, "40 20 50", f"elevation='180' {more}", f"<lightSource {source}/>", "light")


@pytest.fixture(scope="module")
def homes(tmp_path_factory, hull_cache) -> tuple[Path, Path]:
    """One home without a lamp, the same with one over (1, -1.5)."""
    root, lit = tmp_path_factory.mktemp("lamps"), lamp("Lamp", 100, 150, "x='.5' y='.5' z='.2'", "power='1'")
    made = []
    for name, more in (("dark", []), ("lit", [lit])):
        done = convert(write_home(root / name, [*PLAIN, *more]), root / name / "out", SMALL, cache=hull_cache)
        assert {g.name for g in done.gates if not g.passed} == set()
        made.append(done.folder)
    return made[0], made[1]


def test_a_lamp_shines_from_where_the_drawing_has_it(tmp_path):
    things = [
        lamp("Turned", 100, 100, "x='1' y='0' z='.5' color='00FF8000'", "angle='1.5707964' power='.5'"),
        lamp("Mirrored", 200, 100, "x='1' y='1' z='0' color='00FFFFFF'", "modelMirrored='true' power='1'"),
        lamp("Off", 300, 100, "x='0' y='0' z='0' color='00FFFFFF'", "power='0'"),
    ]
    raw = read_sh3d(write_home(tmp_path, [*PLAIN, *things]))
    # Turned clockwise by a quarter: its right, 20 cm, is down in the plan, and its front, 10 cm, to the left.
    found = [[*p.at, *p.colour] for p in raw.lamps]
    wanted = [[1.8, -0.9, 1.8, 1.0, 1.0, 1.0], [0.9, -1.2, 2.05, 0.5, 128 / 255 / 2, 0.0]]
    assert np.array(found) == pytest.approx(np.array(wanted), abs=1e-6)
    assert not any("light" in w for w in raw.warnings)


def test_the_brightest_of_each_floor_are_kept_and_the_others_told(tmp_path):
    levels = [f"<level id='l{k}' name='L{k}' elevation='{300 * k}' height='250' floorThickness='12'/>" for k in (0, 1)]
    things = [
        e.replace(" id=", f" level='l{k}' id=", 1).replace("' name", f"{k}' name", 1)
        for k in (0, 1)
        for e in PLAIN[4:5]
    ]
    walls = [e.replace("<wall ", f"<wall level='l{k}' ") for k in (0, 1) for e in PLAIN[:4]]
    own = [
        lamp(f"Lamp{i}", 50 * i, 50, "x='.5' y='.5' z='1' color='00FFFFFF'", f"level='l{k}' power='{0.1 * i:.1f}'")
        for k, count in ((0, 7), (1, 2))
        for i in range(1, count + 1)
    ]
    raw = read_sh3d(write_home(tmp_path, [*levels, *walls, *things, *own]))
    scenes = split_storeys(raw)
    assert LAMPS == 6 and "1 lamps that are not among a floor's 6 brightest: no light" in raw.warnings
    powers = [sorted(round(float(p.colour[0]), 2) for p in scene.lamps) for scene in scenes]
    assert powers == [[0.2, 0.3, 0.4, 0.5, 0.6, 0.7], [0.1, 0.2]]
    assert [p.at[2] for p in scenes[1].lamps] == pytest.approx([5.3, 5.3])


def test_the_scene_has_it_as_a_dim_light_without_shadow(homes):
    dark, lit = (mujoco.MjModel.from_xml_path(str(folder / "scene.xml")) for folder in homes)
    assert (dark.nlight, lit.nlight) == (1, 2)
    assert lit.light_pos[1] == pytest.approx([1.0, -1.5, 1.9]) and not lit.light_castshadow[1]
    assert 0 < lit.light_diffuse[1].max() < 1 and lit.light_attenuation[1][2] > 0
    assert lit.light_diffuse[0].max() < dark.light_diffuse[0].max()
    assert np.array_equal(lit.vis.headlight.ambient, dark.vis.headlight.ambient)


def test_the_floor_under_a_lamp_is_brighter_than_without_its_light(homes, tmp_path):
    need_gl()
    out = shutil.copytree(homes[1], tmp_path / "out")
    text = (out / "scene.xml").read_text()
    (out / "scene.xml").write_text(re.sub(r'(<light name="lamp_0".* diffuse=)"[^"]*"', r'\1"0 0 0"', text))
    assert (out / "scene.xml").read_text() != text
    dark, lit = (drawn(PICTURE, tmp_path, home)["shown"].astype(float).mean(axis=2) for home in (out, homes[1]))
    assert dark.max() < 80 and (lit - dark).min() > 10 and lit.max() < 100


def test_homes_with_lamps_and_without_share_a_batch(homes):
    env = interactive_nav.make("turtlebot", homes, backend="native", num_objects=1)
    state = jax.jit(jax.vmap(env.reset))(jax.random.split(jax.random.PRNGKey(0), 8))
    assert set(np.asarray(state.info["nav"].scene_index).tolist()) == {0, 1}
    stepped = jax.jit(jax.vmap(env.step))(state, np.zeros((8, env.action_size)))
    assert np.isfinite(stepped.obs).all() and env.world.models[1].nlight == env.world.models[0].nlight
