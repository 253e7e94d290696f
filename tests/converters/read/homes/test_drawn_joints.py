"""A kitchen cabinet with a door and a drawer in a drawing: where they stand and how far they open, by hand."""

import math

import mujoco
import numpy as np
import pytest

from converters.pipeline import convert
from converters.read.homes.sh3d import read_sh3d
from tests.converters.read.homes.test_drawn_pieces import SMALL
from tests.converters.read.homes.test_joints import _nearest, _opened
from tests.converters.read.homes.test_sh3d import HOME, cuboid, piece, write_home

# In cm, y up, front along z; the door hangs at its left edge on two pins, the drawer on a rail as long as it is.
GROUPS = {
    "body": ((-30, 0, -25), (30, 80, 20)),
    "sweethome3d_hinge_1_low": ((-29.8, 10, 20.2), (-29.2, 12, 20.8)),
    "sweethome3d_hinge_1_high": ((-29.8, 48, 20.2), (-29.2, 50, 20.8)),
    "sweethome3d_opening_on_hinge_1_panel": ((-29, 5, 20), (29, 55, 22)),
    "sweethome3d_rail_2": ((-1, 58, -20), (1, 60, 22)),
    "sweethome3d_opening_on_rail_2": ((-29, 57, -20), (29, 78, 22)),
}
MODEL = "".join(f"g {name}\n{cuboid(at[0], at[1], 8 * k)}" for k, (name, at) in enumerate(GROUPS.items()))
COS, SIN = math.cos(math.pi / 6), 0.5
DEEP = 25 + 20.5 + SIN * 58.5 + COS * 1.5  # with the door open by 30 degrees
# About y through the pin at (-29.5, 20.5), towards the front; and the drawer 12 cm out.
AJAR = (
    f"<transformation name='sweethome3d_hinge_1' matrix='{COS} 0 {-SIN} {-29.5 + 29.5 * COS + 20.5 * SIN} 0 1 0 0 "
    f"{SIN} 0 {COS} {20.5 + 29.5 * SIN - 20.5 * COS}'/>"
    "<transformation name='sweethome3d_rail_2' matrix='1 0 0 0 0 1 0 0 0 0 1 12'/>"
)


def _cabinet(x, y, more="", inner="", deep=47.0, name="Cabinet"):
    about = f"catalogId='eTeks#kitchenCabinet' model='5' {more}"
    return piece(name, x, y, f"60 {deep} 80", about, inner)


@pytest.mark.parametrize("mirrored", [False, True])
@pytest.mark.parametrize("ajar", [False, True])
def test_parts_open_on_what_the_model_shows(tmp_path, ajar, mirrored):
    """The piece is turned by a quarter: its front, -y, looks along -x."""
    deep = DEEP if ajar else 47.0
    more = "angle='1.5707963267948966'" + " modelMirrored='true'" * mirrored
    path = write_home(tmp_path, [*HOME[:5], _cabinet(200, 150, more, AJAR * ajar, deep)], {"5": MODEL})
    raw = read_sh3d(path)
    fronts = {a.category: a for a in raw.annotations}
    assert sorted(fronts) == ["cabinet_door", "drawer"] and not any("stay as drawn" in w for w in raw.warnings)
    side, rear = (-1.0 if mirrored else 1.0), deep / 200

    def place(x, z, height):  # of the model's point, cm; its rear is at z = -25
        return np.array([2.0 + rear - (z + 25) / 100, -1.5 - side * x / 100, height / 100])

    for kind, at, most in (("cabinet_door", ajar * math.pi / 6, math.pi / 2), ("drawer", ajar * 0.12, 0.42)):
        annotation, cad = fronts[kind], raw.cads[fronts[kind].cad_id]
        assert annotation.hinge is not None
        assert annotation.hinge.range_rad == pytest.approx((-at, most - at), abs=1e-6)
        for q in (0.0, at, most):
            x, z, height = (
                -29.5 + 58.5 * math.cos(q) - 1.5 * math.sin(q),
                20.5 + 58.5 * math.sin(q) + 1.5 * math.cos(q),
                55,
            )
            if kind == "drawer":
                x, z, height = 29, 22 + 100 * q, 78
            assert _nearest(_opened(annotation, cad, q - at), place(x, z, height)) < 1e-6
    door = fronts["cabinet_door"]
    assert door.hinge is not None
    pin = door.pose[:3, :3] @ door.hinge.origin + door.pose[:3, 3]
    assert pin[:2] == pytest.approx(place(-29.5, 20.5, 0)[:2])


def test_what_is_stretched_turns_as_a_rigid_body(tmp_path):
    """Twice as deep as modelled."""
    raw = read_sh3d(write_home(tmp_path, [*HOME[:5], _cabinet(200, 150, "", AJAR, 2 * DEEP)], {"5": MODEL}))
    (door,) = (raw.cads[a.cad_id] for a in raw.annotations if a.category == "cabinet_door")
    (hinge,) = (a.hinge for a in raw.annotations if a.category == "cabinet_door")
    assert hinge is not None
    turn = hinge.motion(hinge.range_rad[0])[:3, :3]
    assert np.ptp(door.vertices @ turn.T, axis=0) == pytest.approx([0.58, 0.04, 0.5])


@pytest.mark.parametrize(("name", "fronts"), [("eTeks#chest", 0), ("eTeks#wardrobe", 2), ("eTeks#slidingDoors", 0)])
def test_parts_of_what_moves_stay_as_drawn(tmp_path, name, fronts):
    thing = _cabinet(200, 150).replace("eTeks#kitchenCabinet", name)
    raw = read_sh3d(write_home(tmp_path, [*HOME[:5], thing], {"5": MODEL}))
    assert sum(a.hinge is not None for a in raw.annotations) == fronts
    assert any("its sliding or folding parts stay as drawn" in w for w in raw.warnings) == (fronts == 0)


def test_a_door_before_a_wall_opens_as_far_as_there_is_room(tmp_path, hull_cache):
    """In eighths: 58.5 cm of a door meet a wall 35 cm before them at 4. Two face each other at 25 cm, and do at 3."""
    facing = [_cabinet(305, 90, "angle='1.5707963'", name="B"), _cabinet(233, 90, "angle='-1.5707963'", name="C")]
    home = write_home(tmp_path, [*HOME[:5], _cabinet(100, 300 - 35 - 23.5), *facing], {"5": MODEL})
    done = convert(home, tmp_path / "out", SMALL, cache=hull_cache)
    assert {g.name for g in done.gates if not g.passed} == set()
    (line,) = (w for w in done.manifest.warnings if "hit" in w or "welded" in w)
    words = sorted(words.partition(" (")[0] for words in line.partition(": ")[2].split(", "))
    assert words[:2] == ["hinge_1_of_B_1 not at all", "hinge_1_of_C_1 not at all"]
    hinge, rail = words[2::3]  # 6 / 8 of 0.42 m are 0.315 m, which processors round either way
    assert hinge == "hinge_1_of_Cabinet_1 to 0.59 of 1.57 rad"
    assert rail in [f"rail_2_of_Cabinet_1 to {most_m} of 0.42 m" for most_m in (0.31, 0.32)]
    assert [w.partition(" to ")[0] for w in words[3:5]] == ["rail_2_of_B_1", "rail_2_of_C_1"]
    model = mujoco.MjModel.from_xml_path(str(tmp_path / "out" / "scene.xml"))
    low, high = model.jnt_range.T
    assert len(high) == 4 and high[:2] == pytest.approx([3 / 8 * math.pi / 2, 6 / 8 * 0.42], abs=1e-6)
    assert not low.any() and (high[2:] > 0.42 / 3).all() and (high[2:] < 0.28).all()
    # 130 kg/m3: the door's 0.75 kg are below what one weighs at least.
    assert model.body_mass[2:] == pytest.approx([3.0, *[130 * 0.58 * 0.21 * 0.42] * 3], abs=1e-3)
