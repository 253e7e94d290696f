"""Early scenes have whole walls, windows and ceilings for people; observations draw what was scanned."""

from __future__ import annotations

import gzip
import json
import shutil

import mujoco
import numpy as np
import pytest

from interactive_nav.pictures.scene_model import picture_spec
from interactive_nav.scenes.scene import load_scene
from interactive_nav_common.grids import cell_centres, clearance
from scenes_mjcf.agreement import is_lit
from scenes_mjcf.look import LOOK, cast, spec_for_people
from scenes_mjcf.schema import SceneError
from tests.test_scenes import GENERATED, SCENES


def structure(model: mujoco.MjModel) -> tuple[np.ndarray, np.ndarray]:
    """Vertices and image of the mesh that is drawn as the structure."""
    mesh, image = model.geom("structure_visual").dataid[0], model.texture("structure_texture")
    first, count = model.mesh_vertadr[mesh], model.mesh_vertnum[mesh]
    start = model.tex_adr[image.id]
    size = model.tex_height[image.id] * model.tex_width[image.id] * model.tex_nchannel[image.id]
    return model.mesh_vert[first : first + count], model.tex_data[start : start + size]


@pytest.mark.parametrize("name", GENERATED)
def test_people_see_rooms_that_are_closed_above_and_at_the_sides(name):
    scene = load_scene(SCENES / name)
    model = spec_for_people(scene.path).compile()
    data = mujoco.MjData(model)
    mujoco.mj_forward(model, data)
    maps, only = scene.maps, model.geom("structure_visual").id
    free = clearance(maps.traversable, maps.resolution_m) > 0.15
    places = cell_centres(free, maps.resolution_m, maps.origin_w)[::211]
    low, high = 2.4, 2.6  # the generator's walls
    group, geom = np.array([0, 0, 1, 0, 0, 0], np.uint8), np.zeros(1, np.int32)
    for body in range(1, model.nbody):  # furniture out of the way
        if model.body_jntnum[body]:
            model.geom_group[model.geom_bodyid == body] = 3
    heights = []
    for x, y in places:
        up = mujoco.mj_ray(model, data, np.array([x, y, 1.0]), np.array([0.0, 0.0, 1.0]), group, 1, -1, geom)
        assert geom[0] == only
        heights.append(up + 1.0)
        for turn in np.arange(8) * np.pi / 4 + 0.1:
            way = np.array([np.cos(turn), np.sin(turn), 0.0])
            assert mujoco.mj_ray(model, data, np.array([x, y, 1.5]), way, group, 1, -1, geom) > 0.1
    # Ceilings, and lintels of doorways 2.06 to 2.12 m high.
    above = np.array(heights)
    assert above.min() > 2.05 and above.max() < high + 0.01 and np.mean(above > low - 0.01) > 0.9


@pytest.mark.parametrize("name", ["alder", "drawn/flat"])
def test_observations_draw_what_is_stored_and_nothing_else_differs(name):
    scene = load_scene(SCENES / name)
    stored = mujoco.MjModel.from_xml_path(str(scene.path / "scene.xml"))
    people, watched = spec_for_people(scene.path).compile(), picture_spec(scene).compile()
    for mine, other in zip(structure(watched), structure(stored), strict=True):
        assert np.array_equal(mine, other)
    assert len(structure(people)[0]) != len(structure(stored)[0])
    for field in ("body_mass", "body_pos", "body_inertia", "jnt_range"):
        assert np.array_equal(getattr(people, field), getattr(stored, field))
    for field in ("geom_size", "geom_pos", "geom_contype", "geom_friction"):
        mine, other = (np.delete(getattr(m, field), m.geom("structure_visual").id, 0) for m in (people, stored))
        assert np.array_equal(mine, other)


def test_the_drawn_flat_is_lit_for_people_on_the_surfaces_that_observations_have():
    scene = load_scene(SCENES / "drawn/flat")
    models = mujoco.MjModel.from_xml_path(str(scene.path / "scene.xml")), spec_for_people(scene.path).compile()
    assert [is_lit(model) for model in models] == [False, True]
    turns = np.linspace(0, 2 * np.pi, 400, endpoint=False)
    way = np.stack([np.cos(turns), np.sin(turns), 0.3 * np.sin(9 * turns)], -1)
    way /= np.linalg.norm(way, axis=1, keepdims=True)
    distances = []
    for model in models:
        data = mujoco.MjData(model)
        mujoco.mj_forward(model, data)
        places = np.array([[2.0, -2.0, 1.2], [6.0, -2.5, 1.2], [5.5, -4.5, 1.2]])  # one in each room
        distances.append([cast(model, data, place, way, (2,))[1] for place in places])
    stored, lit = np.array(distances)
    assert np.mean(lit > 0) > 0.9 and np.array_equal(lit > 0, stored > 0)
    assert np.mean(np.abs(lit - stored) < 0.005) > 0.99  # others pass by an edge


@pytest.mark.parametrize("content", [b"", b"no archive", None])
def test_a_damaged_look_is_refused_in_one_line(tmp_path, content):
    folder = shutil.copytree(SCENES / "apartment_0", tmp_path / "flat")
    path = folder / "assets" / LOOK
    if content is None:
        np.savez(path, corners=np.array([4], np.uint8))
    else:
        path.write_bytes(content)
    with pytest.raises(SceneError, match=r"look\.npz: .*make the scene again") as caught:
        spec_for_people(folder)
    assert "\n" not in str(caught.value)


@pytest.mark.parametrize("split", ["train", "test"])
def test_the_committed_episodes_are_of_these_scenes(split):
    """Files of hulls are part of a task's digest, byte by byte."""
    stored = json.loads(gzip.decompress((SCENES / "episodes" / f"sparse-turtlebot-{split}.json.gz").read_bytes()))
    assert [[n, load_scene(SCENES / n).task_digest] for n, _ in stored["scenes"]] == stored["scenes"]
