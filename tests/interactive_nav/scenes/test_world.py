"""Padded worlds: equal structure, right masses, furniture at rest; and the refusals of bad scenes."""

import json
import shutil
from pathlib import Path

import mujoco
import numpy as np
import pytest

from interactive_nav.config import NavConfig, TaskRules
from interactive_nav.navigation.tables import build_tables, furniture_map, rest_poses
from interactive_nav.robots import get_robot
from interactive_nav.scenes import objects
from interactive_nav.scenes.scene import load_scene
from interactive_nav.scenes.world import FEET, build_world, foot_points
from interactive_nav_common.errors import UserError
from interactive_nav_common.grids import clearance, label
from scenes_mjcf.schema import SceneError, load_maps, save_maps
from tests.toys import write_room

ROOT = Path(__file__).parents[3]


@pytest.fixture(scope="module")
def world(room, two_rooms):
    return build_world(get_robot("turtlebot"), (load_scene(room), load_scene(two_rooms)), NavConfig.of(num_objects=3))


def test_slots_masses_and_names(world):
    # Three small objects, two free slots, one hinge; the first scene leaves a free slot and the hinge empty.
    assert world.layout.slot_kind == ("small", "small", "small", "free", "free", "hinge")
    np.testing.assert_array_equal(world.slots.occupied, [[1, 1, 1, 1, 0, 0], [1, 1, 1, 1, 1, 1]])
    assert world.slots.names[0][3:] == ("chair_0", "", "") and world.slots.names[1][3:] == (
        "chair_0",
        "table_0",
        "door_0",
    )
    small = tuple(o.category for o in world.small_objects)
    assert world.slots.categories == ((*small, "chair", "", ""), (*small, "chair", "table", "door"))
    np.testing.assert_allclose(world.slots.mass_kg[1], [0.9, 0.38, 1.4, 5.0, 10.0, 8.0], rtol=1e-5)
    assert world.robot_mass_kg == pytest.approx(2.673)
    for model, rest in zip(world.models, world.rest_qpos, strict=True):
        furniture = [
            at for kind, at in zip(world.layout.slot_kind, world.layout.slot_qpos, strict=True) if kind == "free"
        ]
        assert max(np.abs(rest[at : at + 3] - model.qpos0[at : at + 3]).max() for at in furniture) < 0.01


def test_models_of_different_scenes_have_one_structure(world):
    a, b = world.models
    for name in ("nq", "nv", "ngeom", "nsensordata", "nM", "nC"):
        assert getattr(a, name) == getattr(b, name), name


def test_feet_are_the_outer_corners_of_a_chair():
    # Four legs at (+-0.2, +-0.2), 4 cm thick, a seat of 0.44 m, a back at x = 0.2 m.
    legs = [[x, y, 0.2, 1, 0, 0, 0, 0.02, 0.02, 0.2] for x in (-0.2, 0.2) for y in (-0.2, 0.2)]
    seat = [[0, 0, 0.42, 1, 0, 0, 0, 0.22, 0.22, 0.02], [0.2, 0, 0.7, 1, 0, 0, 0, 0.02, 0.22, 0.25]]
    points = foot_points(np.array(legs + seat))
    bottom = points[points[:, 2] < 0.01]
    np.testing.assert_allclose(
        sorted(map(tuple, bottom.round(6))), [(x, y, 0.0) for x in (-0.22, 0.22) for y in (-0.22, 0.22)]
    )
    assert points[:, 2].max() == pytest.approx(0.95) and len(points) <= FEET


def test_a_chair_rests_on_its_feet_and_weighs_on_the_floor(world):
    model, layout = world.models[1], world.layout
    data = mujoco.MjData(model)
    data.qpos[:] = world.rest_qpos[1]
    mujoco.mj_forward(model, data)
    body = layout.slot_body[3]
    floor = mujoco.mj_name2id(model, mujoco.mjtObj.mjOBJ_GEOM, "floor")
    force, up = np.zeros(6), 0.0
    kinds = set()
    for i in range(data.ncon):
        geoms = data.contact.geom[i]
        if floor in geoms and body in model.geom_bodyid[geoms]:
            mujoco.mj_contactForce(model, data, i, force)
            up += force[0]
            kinds |= {int(model.geom_type[g]) for g in geoms if g != floor}
    assert kinds == {int(mujoco.mjtGeom.mjGEOM_SPHERE)}
    assert up == pytest.approx(9.81 * world.slots.mass_kg[1, 3], rel=0.02)


def test_an_empty_slot_floats_in_place(world):
    model, layout = world.models[0], world.layout
    data = mujoco.MjData(model)
    data.qpos[:] = world.rest_qpos[0]
    for _ in range(500):
        mujoco.mj_step(model, data)
    empty = layout.slot_qpos[4]
    np.testing.assert_allclose(data.qpos[empty : empty + 3], world.rest_qpos[0, empty : empty + 3], atol=1e-3)


def test_furniture_map_covers_the_cube_and_nothing_else(room):
    scene = load_scene(room)
    chair = scene.movables[0]
    covered = furniture_map(scene, {chair.name: (chair.pos_w, chair.quat_w)}, 0.41)
    # The 0.4 m cube at (0.7, 0): 8 x 8 cells of 0.05 m, plus the half-cell rim that counts as covered.
    assert 64 <= covered.sum() <= 100
    r, c = np.nonzero(covered)
    assert scene.maps.origin_w[0] + (c.mean() + 0.5) * 0.05 == pytest.approx(0.7, abs=0.03)
    lifted = furniture_map(scene, {chair.name: (chair.pos_w + [0, 0, 1.0], chair.quat_w)}, 0.41)
    assert not lifted.any()  # the robot passes underneath


def test_small_objects_are_of_four_kinds_with_real_masses():
    ten = objects.pick(10)
    assert [sum(o.category == k for o in ten) for k in ("basket", "shoe", "pot", "toy")] == [3, 3, 2, 2]
    assert all(0.2 < o.mass_kg < 2.0 and 0.09 < o.radius_m < 0.25 for o in ten)


def test_hulls_take_one_scene_only(room, two_rooms):
    scenes = (load_scene(room), load_scene(two_rooms))
    with pytest.raises(UserError, match="collision='hulls' with 2 scenes"):
        build_world(get_robot("turtlebot"), scenes, NavConfig.of(collision="hulls"))
    with pytest.raises(UserError, match="scenes is empty"):
        build_world(get_robot("turtlebot"), (), NavConfig())


def test_a_scene_with_no_room_is_refused(tmp_path):
    closet = load_scene(write_room(tmp_path / "closet", (1.0, 0.8), blocks=()))
    world = build_world(get_robot("turtlebot"), (closet,), NavConfig.of(num_objects=0))
    with pytest.raises(SceneError, match="no room for a start and a goal 1.0 m apart"):
        build_tables(world, TaskRules(num_objects=0))
    slit = load_scene(write_room(tmp_path / "slit", (3.0, 0.3), blocks=()))
    world = build_world(get_robot("turtlebot"), (slit,), NavConfig.of(num_objects=0))
    with pytest.raises(SceneError, match="no room for robot 'turtlebot'"):
        build_tables(world, TaskRules(num_objects=0))


@pytest.mark.parametrize(
    ("spoil", "message"),
    [
        (lambda d: (d / "scene.xml").unlink(), "scene.xml: no such file"),
        (lambda d: (d / "scene.xml").write_text("<mujoco>"), "not readable as MJCF"),
        (lambda d: _rename(d, "chair_0", "chair_7"), "no body named 'chair_7', which its JSON file lists"),
        (lambda d: _empty(d), "traversable map is empty"),
    ],
)
def test_bad_scene_folders_are_refused_in_one_line(room, tmp_path, spoil, message):
    folder = shutil.copytree(room, tmp_path / "copy")
    spoil(folder)
    with pytest.raises(SceneError, match=message) as caught:
        load_scene(folder)
    assert "\n" not in str(caught.value)


def _rename(folder, old, new):
    data = json.loads((folder / "scene.json").read_text())
    data["objects"][0]["name"] = new
    (folder / "scene.json").write_text(json.dumps(data))


def _empty(folder):
    maps = load_maps(folder)
    save_maps(type(maps)(maps.traversable & False, maps.resolution_m, maps.origin_w, 0.0), folder)


def test_a_door_keeps_its_range_in_radians_and_swings(world):
    # Once read as degrees: doors were locked within 1.5 degrees and barred their rooms.
    model, layout = world.models[1], world.layout
    assert layout.slot_kind[5] == "hinge"
    joint = model.body_jntadr[layout.slot_body[5]]
    np.testing.assert_allclose(model.jnt_range[joint], [-1.5, 1.5])
    data = mujoco.MjData(model)
    data.qpos[:] = world.rest_qpos[1]
    for _ in range(150):
        data.qfrc_applied[layout.slot_qvel[5]] = 4.0  # N m: 5 N at the leaf's edge
        mujoco.mj_step(model, data)
    assert data.qpos[layout.slot_qpos[5]] > 1.0


def test_shut_doors_part_the_rooms():
    # Packaged homes: alder's two doors close one room off, elm's three close two; both have doorways without a leaf.
    homes = tuple(load_scene(ROOT / "scenes_mjcf" / name) for name in ("alder", "elm"))
    worlds = {ends: build_world(get_robot("turtlebot"), homes, NavConfig.of(num_objects=0, doors_shut=ends))
              for ends in ((0.0, 0.0), (1.0, 1.0), (0.2, 0.6))}  # fmt: skip
    parts, shares = {}, []
    for ends, world in worlds.items():
        for k, home in enumerate(homes):
            doors = [m.name for m in home.movables if m.category == "door"]
            poses = rest_poses(world, k)
            free = home.maps.traversable & ~furniture_map(home, {name: poses[name] for name in doors}, 0.4)
            rooms = label(clearance(free, home.maps.resolution_m) > 0.15)[0]
            sizes = np.bincount(rooms.ravel())[1:] * home.maps.resolution_m**2
            parts[ends, home.name] = int((sizes > 5).sum())
            at = [q for q, kind in zip(world.layout.slot_qpos, world.layout.slot_kind, strict=True) if kind == "hinge"]
            ranges = [m.joint.range for m in home.movables if m.name in doors and m.joint and m.joint.range]
            furthest = [max(map(abs, ends)) for ends in ranges]
            angles = world.rest_qpos[k, at[: len(doors)]]
            if ends == (0.2, 0.6):
                shares += sorted(np.abs(angles) / np.mean(furthest))
            else:
                np.testing.assert_allclose(np.sort(np.abs(angles)), np.sort(furthest) * ends[0], atol=0.02)
    assert parts == {((0.0, 0.0), "alder"): 1, ((0.0, 0.0), "elm"): 1, ((1.0, 1.0), "alder"): 2, ((1.0, 1.0), "elm"): 3,
                     ((0.2, 0.6), "alder"): 1, ((0.2, 0.6), "elm"): 1}  # fmt: skip
    assert len(shares) == 5 and 0.19 < min(shares) < 0.35 and 0.45 < max(shares) < 0.62


def test_goals_and_starts_are_clear_of_furniture_and_walls(world, two_rooms):
    tables = build_tables(world, TaskRules(num_objects=3))
    scene = world.scenes[1]
    cubes = np.array([[1.2, 0.0], [-1.2, 1.0]])  # 0.4 m cubes, see the fixture
    goals = np.asarray(tables.goal_xy_w[1])[: int(tables.num_goals[1])]
    starts = np.asarray(tables.start_xy_w[1])[: int(tables.num_starts[1])]
    for places in (goals, starts):
        assert len(places) > 100
        gap = np.maximum(np.abs(places[:, None] - cubes[None]) - 0.2, 0.0)
        assert np.linalg.norm(gap, axis=-1).min() >= 0.18
        assert (np.abs(places) <= np.array([2.5, 2.0]) - 0.18 + 1e-6).all()
    assert scene.name == "two_rooms"
