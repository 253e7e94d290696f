"""Gates: values by hand, and each physical gate shown to fail once on purpose."""

from __future__ import annotations

import dataclasses
import json
import shutil
from pathlib import Path

import mujoco
import numpy as np
import pytest
from scipy import ndimage

from converters.__main__ import main
from converters.check.gates import (
    LIMITS,
    check_folder,
    collide_with,
    evaluate,
    free_space_values,
    free_space_warnings,
    judge,
    objects_off,
    physical_values,
    wall_values,
)
from converters.check.settle import settle
from converters.records.errors import StageFailed
from interactive_nav.geodesic import navigation_grid
from interactive_nav_common.grids import clearance
from scenes_mjcf.schema import SceneMaps, load_manifest, load_maps, save_maps


def maps_of(traversable: np.ndarray) -> SceneMaps:
    return SceneMaps(traversable, 0.05, (0.0, 0.0), 0.0)


def failed(gates) -> set[str]:
    return {g.name for g in gates if not g.passed}


@pytest.mark.parametrize(
    ("name", "value", "passed"),
    [
        ("drift_hulls", 0.01, True),
        ("drift_hulls", 0.0101, False),
        ("drift_hulls", float("nan"), False),
        ("start_goal", 0.99, False),
        ("start_goal", 1.0, True),
    ],
)
def test_judge_holds_values_against_the_table(name, value, passed):
    gate = judge(name, value)
    assert gate.passed is passed
    json.dumps(gate.as_dict(), allow_nan=False)


def test_erosion_by_hand():
    free = np.ones((20, 20), bool)
    # A cell's middle in row r is (r + 0.5) * 0.05 m from the map's edge: 0.175 in row 3, 0.225 in row 4.
    inner = clearance(free, 0.05) >= 0.18
    assert inner.sum() == 12 * 12 and inner[4, 4] and not inner[3, 10]


def test_free_space_of_two_rooms_and_a_slit():
    free = np.zeros((40, 100), bool)
    free[:, :60] = True  # 2 x 3 m
    free[:, 70:] = True  # 2 x 1.5 m
    free[20:22, 60:70] = True  # a slit of 10 cm: too narrow for the disc
    values = free_space_values(maps_of(free))
    assert values["traversable_area"] == pytest.approx((40 * 60 + 40 * 30 + 20) * 0.0025)
    # The larger room but for 6 cells in each of two corners, and what the disc covers of the slit.
    assert values["connected_share"] == pytest.approx((2400 - 12) / 3620, abs=0.003)
    assert values["start_goal"] == pytest.approx(np.hypot(31, 51) * 0.05)


@pytest.mark.parametrize(("overlap", "share"), [(4, 0.499), (5, 0.502), (6, 0.997)])
def test_rooms_that_share_only_a_corner_are_apart_for_the_gate_as_for_the_environment(overlap, share):
    free = np.zeros((130, 130), bool)
    free[5:65, 5:65] = True
    free[65 - overlap : 125 - overlap, 65 - overlap : 125 - overlap] = True
    fits = clearance(free, 0.05) >= 0.18
    # With 5 cells the two pieces of the eroded floor touch diagonally: a disc cannot get from one to the other.
    _, touching = ndimage.label(fits, np.ones((3, 3)))  # type: ignore[misc]
    assert touching == (1 if overlap >= 5 else 2)
    assert free_space_values(maps_of(free))["connected_share"] == pytest.approx(share, abs=1e-3)
    kept = navigation_grid(free, 0.05, 0.18, 0.05).sum() / fits.sum()
    assert kept == pytest.approx(1.0 if overlap == 6 else 0.5, abs=2e-3)


def test_a_piece_too_narrow_for_the_robot_counts_against_the_share_and_is_named():
    free = np.zeros((40, 60), bool)
    free[:20, :30] = True
    free[20, :14] = True  # 614 cells
    free[30:37, :27] = True  # 189, 35 cm wide
    assert free.sum() == 614 + 189
    share = free_space_values(maps_of(free))["connected_share"]
    assert share == pytest.approx((600 - 4 * 3) / 803, abs=0.02) and not judge("connected_share", share).passed
    (warning,) = free_space_warnings(maps_of(free))
    assert warning.startswith("0.5 of 2.0 m2 of free floor cannot be reached")
    assert free_space_warnings(maps_of(np.ones((20, 31), bool))) == ()  # corners are no piece
    assert free_space_warnings(maps_of(np.ones((4, 40), bool)))[0].startswith("0.4 of 0.4 m2")


@pytest.mark.parametrize(("shape", "farthest"), [((9, 40), 31 * 0.05), ((9, 9), 0.0), ((4, 40), 0.0)])
def test_a_corridor_one_cell_wide_and_one_too_narrow(shape, farthest):
    values = free_space_values(maps_of(np.ones(shape, bool)))
    assert values["start_goal"] == pytest.approx(farthest)


def test_objects_beyond_the_mapped_floor_are_named():
    spec = mujoco.MjSpec()
    for name, x in (("near", 0.4), ("far", -1.3), ("beyond", 9.0), ("between", 3.2)):
        body = spec.worldbody.add_body(name=name, pos=[x, 0.5, 0.1])
        body.add_freejoint()
        body.add_geom(type=mujoco.mjtGeom.mjGEOM_BOX, size=[0.1, 0.1, 0.1])
    free = np.zeros((20, 100), bool)
    free[:, :40] = True  # 2 x 1 m from the origin on, of a map of 5 m
    maps = dataclasses.replace(maps_of(free), origin_w=(0.0, 0.0))
    distance = np.asarray(ndimage.distance_transform_edt(~maps.traversable, sampling=maps.resolution_m))
    assert objects_off(spec.compile(), maps, distance) == ("far", "beyond", "between")


def spec_of(folder: Path) -> mujoco.MjSpec:
    return mujoco.MjSpec.from_file(str(folder / "scene.xml"))


def test_the_tiny_scene_passes_every_gate(tiny_scene):
    folder, converted = tiny_scene
    manifest, gates = check_folder(folder)
    assert failed(gates) == set()
    assert {g.name: g.as_dict() for g in gates} == manifest.gates == converted.manifest.gates
    assert [g.name for g in gates] == [name for name in LIMITS if name != "blocked_fronts"]  # nothing there opens


def test_collision_switches_between_hulls_and_boxes(tiny_scene):
    folder, _ = tiny_scene
    for shape in ("hull", "box"):
        model = collide_with(spec_of(folder), shape)
        for kind in ("hull", "box"):
            on = {bool(model.geom_contype[g]) for g in range(model.ngeom) if f"_{kind}_" in model.geom(g).name}
            assert on == {kind == shape}
        data = mujoco.MjData(model)
        mujoco.mj_step(model, data)
        assert data.ncon > 0  # the objects stand on the floor, whichever shape collides


def change(folder: Path, edit) -> set[str]:
    spec = spec_of(folder)
    edit(spec)
    return failed(evaluate(spec, load_maps(folder), load_manifest(folder).objects))


def test_a_floating_object_drifts(tiny_scene):
    def lift(spec):
        spec.body("basket_0").pos = np.array(spec.body("basket_0").pos) + [0, 0, 0.1]

    assert {"drift_hulls", "drift_boxes"} <= change(tiny_scene[0], lift)


def test_an_object_in_a_wall_penetrates(tiny_scene):
    def push(spec):
        spec.body("basket_0").pos = np.array([2.95, 0.6, 0.0])

    assert {"penetration_hulls", "penetration_boxes"} <= change(tiny_scene[0], push)


def test_an_object_that_tips_over_turns(tiny_scene):
    def tilt(spec):
        spec.body("basket_0").quat = np.array([np.cos(0.1), np.sin(0.1), 0, 0])  # 11 degrees: falls back upright
        spec.body("basket_0").pos = np.array(spec.body("basket_0").pos) + [0, 0, 0.06]

    assert {"turn_hulls", "turn_boxes"} <= change(tiny_scene[0], tilt)


def test_three_millimetres_in_a_wall_are_too_much_and_one_is_not(tiny_scene):
    def push(depth):
        def edit(spec):
            body = spec.body("basket_0")
            reach = max(g.pos[0] + g.size[0] for g in body.geoms if "_box_" in g.name)
            inner = min(g.pos[0] - g.size[0] for g in spec.geoms if g.name.startswith("wall_") and g.pos[0] > 2.5)
            body.pos = np.array([inner - reach + depth, 0.6, 0.0])
            body.quat = np.array([1.0, 0, 0, 0])

        return edit

    assert "penetration_boxes" in change(tiny_scene[0], push(0.003))
    assert "penetration_boxes" not in change(tiny_scene[0], push(0.001))


def test_a_model_that_diverges_is_not_finite(tiny_scene):
    def fling(spec):
        spec.option.gravity = np.array([0.0, 0.0, 1e12])

    assert "finite" in change(tiny_scene[0], fling)


@pytest.mark.parametrize("warning", ["BADQPOS", "BADQVEL", "BADQACC"])
def test_a_simulation_that_mujoco_started_over_has_not_settled(tiny_scene, monkeypatch, warning):
    step = mujoco.mj_step

    def bad(model, data):
        if data.time > 0.1 and not any(w.number for w in data.warning):
            {"BADQPOS": data.qpos, "BADQVEL": data.qvel, "BADQACC": data.qfrc_applied}[warning][0] = np.nan
        step(model, data)

    monkeypatch.setattr(mujoco, "mj_step", bad)
    with pytest.raises(StageFailed, match="settle: MuJoCo started the simulation over"):
        settle(tiny_scene[1].settled.parts)


@pytest.mark.parametrize(("name", "value"), [("hulls_per_object", 17), ("hulls", 601), ("walls", 201)])
def test_the_counting_gates_fail_above_their_limits(name, value):
    assert not judge(name, value).passed


def test_split_free_space_fails_its_gate(tiny_scene):
    folder, _ = tiny_scene
    halves = load_maps(folder).traversable.copy()
    halves[:, halves.shape[1] // 2 - 2 : halves.shape[1] // 2 + 2] = False
    maps = dataclasses.replace(load_maps(folder), traversable=halves)
    assert failed(evaluate(spec_of(folder), maps, load_manifest(folder).objects)) == {
        "connected_share",
        "rim_without_wall",
    }


def test_check_warns_of_floor_that_is_cut_off_and_names_a_damaged_map(tiny_scene, tmp_path, capsys):
    folder = Path(shutil.copytree(tiny_scene[0], tmp_path / "scene"))
    maps = load_maps(folder)
    maps.traversable[:, maps.traversable.shape[1] // 4] = False
    save_maps(maps, folder)
    main(["check", str(folder)])
    assert "warning: 1." in capsys.readouterr().out
    (folder / "maps.npz").write_bytes((folder / "maps.npz").read_bytes()[:-30])
    assert main(["check", str(folder)]) == 2
    error = capsys.readouterr().err
    assert "maps.npz: not readable (BadZipFile" in error and error.count("\n") == 1


def gates_of(folder: Path, maps: SceneMaps) -> set[str]:
    return failed(evaluate(spec_of(folder), maps, load_manifest(folder).objects))


def test_a_map_that_is_not_the_walls_fails(tiny_scene):
    folder, maps = tiny_scene[0], load_maps(tiny_scene[0])
    every = dataclasses.replace(maps, traversable=np.ones_like(maps.traversable))
    assert "rim_without_wall" in gates_of(folder, every)
    shifted = dataclasses.replace(maps, origin_w=(maps.origin_w[0] + 0.8, maps.origin_w[1]))
    assert "rim_without_wall" in gates_of(folder, shifted)

    def clear(spec):
        for geom in [g for g in spec.geoms if g.name.startswith("wall_")]:
            spec.delete(geom)

    def pass_through(spec):
        for geom in [g for g in spec.geoms if g.name.startswith("wall_")]:
            geom.contype = geom.conaffinity = 0

    def build(spec):
        box = {"type": mujoco.mjtGeom.mjGEOM_BOX, "size": [0.3, 0.3, 1.0], "pos": [1.5, 0.6, 1.0]}
        spec.body("structure").add_geom(name="wall_of_no_map", contype=1, conaffinity=1, **box)

    assert "walls_in_floor" in change(folder, build)
    assert change(folder, clear) == change(folder, pass_through) == {"rim_without_wall"}


def test_a_share_of_the_rim_by_hand():
    spec = mujoco.MjSpec()
    structure = spec.worldbody.add_body(name="structure")
    structure.add_geom(type=mujoco.mjtGeom.mjGEOM_BOX, size=[0.5, 0.1, 1.0], pos=[0.5, -0.1, 1.0])
    values = wall_values(spec.compile(), maps_of(np.ones((20, 20), bool)))
    # A rim of 4 x 20 cells and 4 corners; the box bounds 20, two corners, and one cell more at either side's end.
    assert values == {"rim_without_wall": pytest.approx(1 - 24 / 84), "walls_in_floor": 0.0}


@pytest.mark.parametrize(("mass", "friction"), [(100.0, 1e-6), (100.0, 1.0), (1.0, 1e-6)])
def test_an_altered_scene_json_is_told(tiny_scene, tmp_path, mass, friction):
    folder = Path(shutil.copytree(tiny_scene[0], tmp_path / "scene"))
    plain = json.loads((folder / "scene.json").read_text())
    for item in plain["objects"]:
        item["mass_kg"] *= mass
        item["friction"] *= friction
    (folder / "scene.json").write_text(json.dumps(plain))
    manifest, gates = check_folder(folder)
    assert failed(gates) == {"manifest_differs"}
    (gate,) = [g for g in gates if g.name == "manifest_differs"]
    assert gate.value == len(manifest.objects) * ((mass > 1) + (friction < 1))
    said = f"mass_kg is {plain['objects'][0]['mass_kg'] / mass:g} in scene.xml"
    assert (f"table_0: {said}" in gate.warnings[0]) == (mass > 1)


def test_masses_and_frictions_that_nothing_of_the_kind_has_fail_where_both_files_say_so(tiny_scene):
    folder, objects = tiny_scene[0], load_manifest(tiny_scene[0]).objects
    spec = spec_of(folder)
    for item in objects:
        spec.body(item.name).mass = 1e6
        for geom in spec.body(item.name).geoms:
            geom.friction = [1e-6, 0.005, 0.0001]
    heavy = [dataclasses.replace(item, mass_kg=1e6, friction=1e-6) for item in objects]
    assert {"mass_ratio", "least_friction"} <= failed(evaluate(spec, load_maps(folder), heavy)) - {"manifest_differs"}


def test_a_friction_edited_by_hand_is_told(tiny_scene):
    def edit(spec):
        spec.geom("basket_0_hull_0").friction = [0.9, 0.005, 0.0001]

    assert change(tiny_scene[0], edit) == {"manifest_differs"}


@pytest.mark.parametrize("option", ["gravity", "contact", "wind", "viscosity", "floor"])
def test_physics_that_is_not_every_scenes_is_told(tiny_scene, option):
    def edit(spec):
        if option == "gravity":
            spec.option.gravity = [0.0, 0.0, 0.0]
        elif option == "contact":
            spec.option.disableflags |= mujoco.mjtDisableBit.mjDSBL_CONTACT
        elif option == "floor":
            spec.geom("floor").pos = [0.0, 0.0, -0.5]
        else:
            setattr(spec.option, option, [1.0, 0.0, 0.0] if option == "wind" else 0.1)

    assert "physics_changed" in change(tiny_scene[0], edit)


def test_a_missing_object_is_counted(tiny_scene):
    def drop(spec):
        spec.delete(spec.body("basket_0"))

    assert change(tiny_scene[0], drop) == {"unmatched_objects"}


def test_no_room_for_start_and_goal(tiny_scene):
    folder, _ = tiny_scene
    maps = load_maps(folder)
    small = dataclasses.replace(maps, traversable=np.ones((15, 15), bool))
    assert gates_of(folder, small) == {
        "traversable_area",
        "start_goal",
        "unmatched_objects",  # They stand where this small map does not reach.
        "rim_without_wall",
    }


def test_a_scene_that_does_not_compile_fails_its_first_gate(tiny_scene, tmp_path):
    folder = Path(shutil.copytree(tiny_scene[0], tmp_path / "scene"))
    (folder / "scene.xml").write_text("<mujoco><worldbody><geom type='box'/></worldbody></mujoco>")
    assert failed(check_folder(folder)[1]) >= {"compiles"}


def test_physical_values_of_a_ball_in_free_fall():
    spec = mujoco.MjSpec()
    body = spec.worldbody.add_body(name="ball", pos=[0, 0, 100.0])
    body.add_freejoint()
    body.add_geom(type=mujoco.mjtGeom.mjGEOM_SPHERE, size=[0.1, 0, 0])
    values = physical_values(spec.compile())
    assert values["drift"] == pytest.approx(0.5 * 9.81 * 5.0**2, rel=0.01)  # g t^2 / 2
    assert values["turn"] == pytest.approx(0.0, abs=1e-6) and values["penetration"] == 0.0 and values["finite"] == 1.0


def test_what_fails_is_named():
    spec = mujoco.MjSpec()
    for name, height in (("still", 0.3), ("sunk", 0.4)):
        body = spec.worldbody.add_body(name=name, pos=[0, 0, height])
        body.add_freejoint()
        body.add_geom(type=mujoco.mjtGeom.mjGEOM_BOX, size=[0.1, 0.1, 0.06])
    named: dict[str, str] = {}
    values = physical_values(spec.compile(), named)
    assert values["penetration"] == pytest.approx(0.02, abs=1e-6) and named["penetration"] == "still and sunk"
    assert values["drift"] > 100 and named["drift"] in ("still", "sunk")
