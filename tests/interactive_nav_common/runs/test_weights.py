"""One file for weights: exact or rounded, packed or not, refused in one line where it is damaged or hostile."""

import hashlib
import json
import zlib

import numpy as np
import pytest
import safetensors.numpy
from hypothesis import given
from hypothesis import strategies as st

from interactive_nav_common.errors import FileError
from interactive_nav_common.runs import weights
from interactive_nav_common.untrusted import reading

TENSORS = {
    "a/kernel": np.arange(6, dtype=np.float32).reshape(2, 3).T,  # not in C order
    "a/count": np.array(7, np.uint32),
    "b": np.array([True, False]),
}


@pytest.mark.parametrize("name", ["w.safetensors", "w.safetensors.xz"])
def test_tensors_and_header_are_read_back(tmp_path, name):
    written = weights.write_weights(tmp_path / name, TENSORS, {"task": "rooms", "commit": "abc"})
    parts = (
        b"a/count <u4 ()\n\x07\0\0\0",
        b"a/kernel <f4 (3, 2)\n",
        np.array([0, 3, 1, 4, 2, 5], np.float32),
        b"b |b1 (2,)\n\1\0",
    )
    digest = hashlib.sha256(b"".join(bytes(part) for part in parts)).hexdigest()
    assert written == {"format": 1, "commit": "abc", "task": "rooms", "digest": digest}
    tensors, about = weights.read_weights(tmp_path / name, FileError, "train again")
    assert about == written and list(tensors) == ["a/count", "a/kernel", "b"]
    for key, value in TENSORS.items():
        assert tensors[key].dtype == value.dtype and tensors[key].shape == value.shape
        np.testing.assert_array_equal(tensors[key], value)
    again = tmp_path / f"again-{name}"
    weights.write_weights(again, tensors, {"task": "rooms", "commit": "abc"})
    assert again.read_bytes() == (tmp_path / name).read_bytes()


def test_other_programs_read_it(tmp_path):
    weights.write_weights(tmp_path / "w.safetensors", TENSORS, {"task": "rooms"})
    with safetensors.safe_open(tmp_path / "w.safetensors", framework="np") as file:
        np.testing.assert_array_equal(file.get_tensor("a/kernel"), [[0, 3], [1, 4], [2, 5]])
        assert json.loads(file.metadata()["about"])["task"] == "rooms"


def stored(tmp_path, tensors):
    weights.write_weights(tmp_path / "w.safetensors", tensors, {"commit": "abc"})
    return weights.read_weights(tmp_path / "w.safetensors", FileError, "train again")[0]


@given(st.integers(1, 100), st.integers(1, 100), st.floats(1e-3, 1e3), st.floats(0.01, 2.0))
def test_rounding_is_within_half_a_step(tmp_path_factory, outputs, inputs, size, step):
    matrix = (np.random.default_rng(inputs).normal(size=(inputs, outputs)) * size).astype(np.float32)
    small = weights.rounded({"a/kernel": matrix, "a/bias": matrix[0]}, step)
    large = {"a/kernel:scale", "a/kernel:shape"} if matrix.size >= weights.LARGE else set()
    assert set(small) == {"a/kernel", "a/bias"} | large and (not large or small["a/kernel"].dtype == np.uint8)
    back = stored(tmp_path_factory.mktemp("w"), small)
    np.testing.assert_array_equal(back["a/bias"], matrix[0])
    if not large:
        np.testing.assert_array_equal(back["a/kernel"], matrix.astype(np.float16))
    else:
        half = np.maximum(step * matrix.std(0), np.abs(matrix).max(0) / 127) / 2
        assert (np.abs(back["a/kernel"] - matrix) <= half * (1 + 1e-5) + 1e-30).all()


def test_an_output_without_weights_stays_zero(tmp_path):
    matrix = np.zeros((4_000, 2), np.float32)
    matrix[:, 1] = np.tile([2.0, -2.0, 1.0, -1.0], 1_000)  # a deviation of the root of 2.5
    back = stored(tmp_path, weights.rounded({"w": matrix}, 1.0))["w"]
    assert not back[:, 0].any()
    np.testing.assert_allclose(back[:4, 1], np.array([1, -1, 1, -1]) * 2.5**0.5, rtol=1e-6)


def test_a_weight_beyond_the_range_of_eight_bits_widens_the_steps(tmp_path):
    matrix = np.zeros((5_000, 1), np.float32)
    matrix[7] = 5.0  # 70 deviations
    small = weights.rounded({"w": matrix}, 0.1)
    back = stored(tmp_path, small)["w"]
    assert (back / small["w:scale"]).max() == pytest.approx(127) and back[7] == pytest.approx(5.0)


def test_without_a_step_each_output_has_127_levels_on_either_side(tmp_path):
    matrix = np.array([[127.0, -0.5], [-3.4, 0.25], [0.6, 0.001]], np.float32)
    back = stored(tmp_path, weights.rounded({"w": matrix}, 0.0, least=0))["w"]
    np.testing.assert_allclose(back, [[127, -0.5], [-3, 64 / 254], [1, 0.0]], rtol=1e-6)


def test_numbers_that_half_precision_cannot_hold_are_refused():
    kept = weights.half({"kernel": np.full((1, 2), 65504.0, np.float32), "var": np.array([1e6, 1e-9], np.float32)})
    assert kept["kernel"].dtype == np.float16 and kept["kernel"][0, 0] == 65504
    assert kept["var"].tolist() == pytest.approx([1e6, 1e-9])
    with pytest.raises(FileError, match="body/kernel holds 7e"):
        weights.half({"body/kernel": np.full((1, 2), -7e4, np.float32)})


def refused(path, match):
    with pytest.raises(FileError, match=match) as error:
        weights.read_weights(path, FileError, "train again")
    assert "\n" not in str(error.value) and str(error.value).startswith(str(path))


def test_damaged_and_hostile_files_are_refused(tmp_path, monkeypatch):
    path = tmp_path / "w.safetensors"
    weights.write_weights(path, TENSORS, {"commit": "abc"})
    good = path.read_bytes()
    for content in (b"", b"PK garbage", good[:-1], good[:40], (2**60).to_bytes(8, "little") + good[8:]):
        path.write_bytes(content)
        refused(path, "not readable as safetensors .*train again")
    path.write_bytes(good[:-1] + bytes([good[-1] ^ 1]))
    refused(path, "its tensors are not those that its digest is of")
    safetensors.numpy.save_file({"a": np.zeros(1)}, path)  # of another program
    refused(path, "not readable as safetensors")
    safetensors.numpy.save_file({"a": np.zeros(1)}, path, {"about": json.dumps({"format": 2})})
    refused(path, "its format is 2, expected 1")
    for shape, scale, why in (
        ([5, 1], [1.0], "reshape"),
        ([4, 1], np.ones(10_000), "broadcast"),
        ([-1], [1.0, 1.0], ""),
    ):
        codes = np.frombuffer(zlib.compress(bytes(4)), np.uint8)
        hostile = {"a": codes, "a:shape": np.array(shape), "a:scale": np.asarray(scale)}
        weights.write_weights(path, hostile, {"commit": "abc"})
        refused(path, f"not readable as safetensors .*{why}")
    bomb = np.frombuffer(zlib.compress(bytes(2**20)), np.uint8)
    weights.write_weights(path, {"a": bomb, "a:shape": np.array([2**20]), "a:scale": np.ones(1)}, {"commit": "abc"})
    refused(path, "unpacks to more than 0.0[0-9]* MiB")
    monkeypatch.setattr(reading, "MOST_ARRAYS", 1)
    refused(path, "it has 0 MiB, expected at most 0")


def test_tensors_fill_the_places_of_their_names(tmp_path):
    template = {"params": {"w": np.zeros((2, 1), np.float32)}, "batch_stats": {}, "rest": np.ones(1, np.float32)}
    tensors = {"params/w": np.array([[1.5], [2.5]], np.float16)}

    def fill(tensors):
        state = weights.fill(template, tensors, tmp_path, lambda: ["params/w"], FileError, "train again")
        return weights.fitting(template, state, tmp_path, FileError)

    state = fill(tensors)
    assert state["batch_stats"] == {} and state["rest"].tolist() == [1.0]
    assert state["params"]["w"].dtype == np.float32 and state["params"]["w"].tolist() == [[1.5], [2.5]]
    for others, match in (
        ({}, "lacks params/w, which this network reads; train again"),
        ({**tensors, "params/v": np.zeros(1)}, "holds params/v, which this network has not"),
        ({**tensors, "batch_stats": np.zeros(1)}, "holds batch_stats, which"),
        ({"params/w": np.zeros((1, 2))}, r"\['params'\]\['w'\] has shape \(1, 2\), expected \(2, 1\)"),
        ({"params/w": np.array([[1], [np.inf]])}, r"\['params'\]\['w'\] has values that are not finite"),
    ):
        with pytest.raises(FileError, match=match):
            fill(others)
