"""Lamps of a drawing shine: where they hang, in the structure's image, and in no batch of physics."""

from __future__ import annotations

from pathlib import Path

import jax
import mujoco
import numpy as np
import pytest

import interactive_nav
from converters.check.pictures import geom_surface
from converters.geometry.faces import sample_faces
from converters.pipeline import convert
from converters.read.homes.sh3d import read_sh3d
from converters.read.obj import texels
from converters.read.surfaces import split_storeys
from scenes_mjcf.agreement import is_lit
from tests.converters.read.homes.test_drawn_pieces import SMALL
from tests.converters.read.homes.test_sh3d import HOME, piece, write_home

FLOOR = HOME[4].replace("floorColor='FF102030'", "floorColor='FF606060'")
PLAIN = [*HOME[:4], FLOOR, *HOME[5:7]]


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
    found = sorted(([*p.at, *p.colour] for p in raw.lamps), reverse=True)
    wanted = [[1.8, -0.9, 1.8, 1.0, 1.0, 1.0], [0.9, -1.2, 2.05, 0.5, 128 / 255 / 2, 0.0]]
    assert np.array(found) == pytest.approx(np.array(wanted), abs=1e-6)
    assert not any("light" in w for w in raw.warnings)


def test_each_floor_has_its_lamps(tmp_path):
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
    powers = [sorted(round(float(p.colour[0]), 2) for p in scene.lamps) for scene in scenes]
    assert powers == [[0.1, 0.2, 0.3, 0.4, 0.5, 0.6, 0.7], [0.1, 0.2]]
    assert [p.at[2] for p in scenes[1].lamps] == pytest.approx([5.3, 5.3])


def test_the_floor_is_painted_brighter_where_a_lamp_hangs(homes):
    bright = []
    for folder in homes:
        model = mujoco.MjModel.from_xml_path(str(folder / "scene.xml"))
        assert model.nlight == 1 and is_lit(model)  # both have a window
        surface = geom_surface(model, model.geom("structure_visual").id)
        assert surface.corner_uv is not None and surface.texture is not None
        corners = np.hstack([surface.vertices[surface.faces].reshape(-1, 3), surface.corner_uv.reshape(-1, 2)])
        points, _ = sample_faces(corners, np.arange(len(corners)).reshape(-1, 3), 0.02)
        points = points[np.abs(points[:, 2]) < 0.02]
        light = texels(surface.texture, points[:, 3:]).mean(axis=1)
        bright.append(light.mean())
    assert bright[1] > 1.03 * bright[0] and 50 < bright[0] < 96  # the drawing's grey is 96


def test_homes_with_lamps_and_without_share_a_batch(homes):
    env = interactive_nav.make("turtlebot", homes, backend="native", num_objects=1)
    state = jax.jit(jax.vmap(env.reset))(jax.random.split(jax.random.PRNGKey(0), 8))
    assert set(np.asarray(state.info["nav"].scene_index).tolist()) == {0, 1}
    stepped = jax.jit(jax.vmap(env.step))(state, np.zeros((8, env.action_size)))
    assert np.isfinite(stepped.obs).all()
