"""Random bytes, truncated and mutated files: a reader reads them or refuses them with one line, nothing else."""

from __future__ import annotations

import json
import os

import pytest
import trimesh
from hypothesis import HealthCheck, example, given, settings
from hypothesis import strategies as st

from converters.read.files import SourceFolder
from converters.read.gibson import read_gibson
from converters.read.interactive_gibson import read_interactive_gibson
from converters.read.scan2cad import read_scan2cad
from converters.read.urdf import read_urdf
from converters.records.errors import SceneRejected
from tests.converters import tiny_raw
from tests.converters.read.released import write_released

EXAMPLES = int(os.environ.get("FUZZ_EXAMPLES", "5"))
"""For each file; more by hand."""
FUZZ = settings(
    max_examples=EXAMPLES,
    deadline=None,
    derandomize=True,
    suppress_health_check=[HealthCheck.function_scoped_fixture, HealthCheck.too_slow],
)
WORDS = [
    "nan",
    "inf",
    "-1",
    "0",
    "1e308",
    "99999999999",
    "-",
    "/",
    "\\",
    "{",
    "]",
    "<",
    "\0",
    "\n",
    " ",
    "é",
    "v ",
    "f ",
]


@st.composite
def mutations(draw):
    """A function of bytes: cut off, overwrite, insert, delete, swap in a hostile word, or all bytes new."""
    kind = draw(st.sampled_from(["cut", "bytes", "word", "delete", "new", "repeat"]))
    where = draw(st.floats(0, 1, exclude_max=True))
    count = draw(st.integers(1, 64))
    noise = draw(st.binary(max_size=16))
    word = draw(st.sampled_from(WORDS)).encode()

    def change(data: bytes) -> bytes:
        at = int(where * max(len(data), 1))
        return {
            "cut": data[:at],
            "bytes": data[:at] + noise + data[at + len(noise) :],
            "word": data[:at] + word + data[at + len(word) :],
            "delete": data[:at] + data[at + count :],
            "new": noise * count,
            "repeat": data[:at] + data[at : at + count] * 3 + data[at:],
        }[kind]

    return change


def survives(read, path, change) -> None:
    """Reads with the file changed and puts it back."""
    good = path.read_bytes()
    path.write_bytes(change(good))
    try:
        read()
    except SceneRejected as error:
        assert "\n" not in str(error) and len(str(error)) > 20
    finally:
        path.write_bytes(good)


GIBSON = (
    "mesh_z_up.obj",
    "mesh_z_up.mtl",
    "mesh_z_up.labels.npz",
    "paint.png",
    "floors.txt",
    "alignments.json",
    "cad/04379243/table-a/models/model_normalized.obj",
    "cad/04379243/table-a/models/model_normalized.mtl",
)


@pytest.mark.parametrize("name", GIBSON)
def test_gibson_files(gibson_raw, name):
    @FUZZ
    @given(change=mutations())
    def run(change):
        survives(lambda: read_gibson(gibson_raw), gibson_raw / name, change)

    run()


@pytest.mark.parametrize("name", ["scan/scene_tiny_vh_clean_2.ply", "scan/scene_tiny_vh_clean_2.labels.ply"])
def test_scan2cad_files(scan2cad_raw, name):
    @FUZZ
    @given(change=mutations())
    def run(change):
        survives(lambda: read_scan2cad(scan2cad_raw), scan2cad_raw / name, change)

    run()


@pytest.mark.parametrize(
    "name",
    ["alignment_centered_0_04379243.urdf", "0_04379243.obj", "pos_0_04379243.txt", "plane_z_up_0.obj", "plane.mtl"],
)
def test_released_files(tmp_path, pristine, name):
    root = write_released(read_gibson(pristine / "gibson"), tmp_path / "released")

    @FUZZ
    @given(change=mutations())
    def run(change):
        survives(lambda: read_interactive_gibson(root), root / name, change)

    run()


VALUES = st.recursive(
    st.none() | st.booleans() | st.integers() | st.floats() | st.text(max_size=5) | st.just(10**400),
    lambda inner: st.lists(inner, max_size=4) | st.dictionaries(st.text(max_size=5), inner, max_size=3),
    max_leaves=6,
)


def leaves(tree, path=()):
    """Paths of every value in a JSON tree."""
    yield path
    items = tree.items() if isinstance(tree, dict) else enumerate(tree) if isinstance(tree, list) else ()
    for key, value in items:
        yield from leaves(value, (*path, key))


def test_annotations_with_any_value_anywhere(gibson_raw):
    """Valid JSON of a wrong shape: each value in turn is replaced by something else."""
    path = gibson_raw / "alignments.json"
    good = tiny_raw.annotation()
    good[0]["aligned_models"][0]["articulation"] = {
        "type": "hinge", "axis": [0, 1, 0], "origin": [0, 0, 0], "range_rad": [0, 1]
    }  # fmt: skip
    places = [p for p in leaves(good) if p and "position" not in p[:-1]]

    @settings(FUZZ, max_examples=6 * EXAMPLES)
    @given(place=st.sampled_from(places), value=VALUES)
    @example(place=(0, "trs", "rotation"), value=[0, 0, 0, 0])
    @example(place=(0, "trs", "scale"), value=[1e300, 1e300, 1e300])
    @example(place=(0, "aligned_models", 0, "id_cad"), value="..\0")
    @example(place=(0, "aligned_models", 0, "keypoints_cad"), value=[])
    @example(place=(0, "aligned_models", 0, "articulation"), value="hinge")
    @example(place=(0, "id_scan"), value={"a": 1})
    def run(place, value):
        data = json.loads(json.dumps(good))
        at = data
        for key in place[:-1]:
            at = at[key]
        at[place[-1]] = value
        text = json.dumps(data).encode()
        survives(lambda: read_gibson(gibson_raw), path, lambda _: text)

    run()


def test_deep_and_endless_json(gibson_raw):
    path = gibson_raw / "alignments.json"
    for text in (b"[" * 50_000, b'{"a":' * 50_000, b"1" * 10_000, b"[1e999]", b"\xff\xff"):
        survives(lambda: read_gibson(gibson_raw), path, lambda _, text=text: text)


def test_urdf_attributes(tmp_path):
    trimesh.creation.box((0.3, 0.2, 0.1)).export(tmp_path / "box.obj")
    template = (
        "<robot name='r'><link name='a'><contact><lateral_friction value='{0}'/></contact>"
        "<inertial><mass value='{1}'/></inertial><visual><origin xyz='{2}' rpy='{3}'/><geometry>"
        "<mesh filename='{4}' scale='{5}'/></geometry></visual>"
        "<collision><geometry><cylinder radius='{6}' length='{7}'/></geometry></collision></link></robot>"
    )
    good = ["1", "2", "0 0 0", "0 0 0", "box.obj", "1 1 1", "0.1", "0.2"]
    text = st.text(st.characters(blacklist_characters="<&'\"", blacklist_categories=("Cs", "Cc")), max_size=8)

    @settings(FUZZ, max_examples=3 * EXAMPLES)
    @given(where=st.integers(0, 7), value=text | st.sampled_from(["nan", "0", "-1", "1e9", "1 2", "0 0 0", "..", "/"]))
    def run(where, value):
        words = list(good)
        words[where] = value
        (tmp_path / "r.urdf").write_text(template.format(*words), encoding="utf-8")
        try:
            read_urdf(SourceFolder(tmp_path), "r.urdf", "")
        except SceneRejected as error:
            assert "\n" not in str(error)

    run()
