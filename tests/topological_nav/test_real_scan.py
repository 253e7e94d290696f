"""The licensed scanned room as a target domain, in its true colours; skipped with a reason where the data is absent."""

import json

import numpy as np
import pytest

from converters.pipeline import ConvertConfig, convert
from topological_nav.__main__ import main
from topological_nav.data.dataset import load_passages, load_rooms, read_header

pytestmark = [pytest.mark.data, pytest.mark.heavy]


def test_the_real_room_is_converted_drawn_and_judged(sample_data, made, tmp_path, capsys):
    scan, data, out = tmp_path / "scan", tmp_path / "data", tmp_path / "passages"
    convert(sample_data / "scan2cad_scene0470_00", scan, ConvertConfig(format="scan2cad"), cache=tmp_path / "hulls")
    words = ["width=32", "height=32", "supersample=2", "num_rooms=1", "positions=20", "max_per_room=3"]
    words += ["passage_sources=40", "passage_length_m=1.2", "passage_lengths_m=[0.6,1.2,1.8]", "test_share=0.3"]
    assert main(["data", str(scan), "-o", str(data), *words]) == 0
    (scene,) = read_header(data)[0]["scenes"]
    rooms, passages = load_rooms(data), load_passages(data)
    assert (scene["rooms"], scene["positions"]) == (1, 3) and rooms.images.shape == (3, 3, 18, 32, 32, 3)
    # As many free as blocked for the length that is asked about, in training and in test.
    scored = passages.free[:, read_header(data)[1].passage_column]
    for held in (False, True):
        assert scored[passages.test == held].mean() == 0.5
    assert len(passages.free) > 60 and (passages.test.sum() > 15)
    # A picture of a room: light walls, darker floor and furniture, hardly any two alike.
    grey = passages.images.astype(float).mean((1, 2, 3))
    assert 40 < grey.mean() < 220 and passages.images.std() > 25
    assert len(np.unique(passages.images.reshape(len(grey), -1), axis=0)) > 0.95 * len(grey)
    capsys.readouterr()
    words = ["adapt", "passages", "--target", str(data), "--detector", str(made.passages), "-o", str(out)]
    assert main([*words, "domain=clean", "fine_tune=60", "test=40", "fine_tune_epochs=8"]) == 0
    assert "C  the source's weights" in capsys.readouterr().out
    results = json.loads((out / "results.json").read_text())
    tested = min(40, 2 * int(scored[passages.test].sum()))
    assert results["tested_on"] == tested and 20 <= results["fine_tuned_on"] <= 60
    for name in "ABCD":
        confusion = np.array(results[name]["confusion"])
        assert confusion.sum(1).tolist() == [tested // 2] * 2
        assert results[name]["accuracy"] == pytest.approx(np.trace(confusion) / tested)
    print({name: results[name]["accuracy"] for name in "ABCD"})
