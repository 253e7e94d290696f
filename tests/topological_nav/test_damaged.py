"""Damaged files and impossible values are told in one line each."""

import numpy as np
import pytest

from interactive_nav_common.errors import UserError
from interactive_nav_common.runs.folder import claimed
from topological_nav.__main__ import main
from topological_nav.data.dataset import load_plan
from topological_nav.data.folders import read_arrays as read_batch
from topological_nav.data.folders import read_shard
from topological_nav.drives.driving import load_policy
from topological_nav.learn.training import load_trained
from topological_nav.maps.graph import load_map
from topological_nav.weights.export import Choice, fitting_map


def told_once(error) -> str:
    text = str(error.value)
    assert "\n" not in text
    return text


@pytest.mark.parametrize(
    "text",
    [
        '{"task": "ro',
        "[]",
        '{"task": "rooms"}',
        '{"task": "rooms", "digest": "d", "export": null}',
        '{"task": "rooms", "digest": "d"}',
    ],
)
def test_a_damaged_description_of_a_network(text, tmp_path, capsys):
    (tmp_path / "network.json").write_text(text)
    with pytest.raises(UserError) as error:
        load_trained(tmp_path)
    assert "network.json" in told_once(error) and "train again" in str(error.value)
    assert main(["map", "nowhere", "--localiser", str(tmp_path), "--detector", str(tmp_path)]) == 2
    assert capsys.readouterr().err.count("\n") == 1


def test_a_damaged_description_of_a_policy_or_of_what_a_map_was_made_with(tmp_path):
    (tmp_path / "network.json").write_text('{"task": "po')
    with pytest.raises(UserError) as error:
        load_policy(tmp_path)
    assert "network.json" in told_once(error)
    with pytest.raises(UserError) as error:
        fitting_map(Choice(tmp_path, tmp_path, "passage", (tmp_path,), True, ""), "toy", "digest")
    assert "network.json" in told_once(error)


@pytest.mark.parametrize("size", [0, 10, 300, 900])
def test_cut_off_arrays(size, tmp_path):
    path = tmp_path / "toy" / "plan.npz"
    path.parent.mkdir()
    with open(path, "wb") as file:
        np.savez_compressed(file, xy_w=np.random.default_rng(0).random((60, 2)), header=np.zeros(9, np.uint8))
    assert path.stat().st_size > 900
    path.write_bytes(path.read_bytes()[:size])
    for read in (lambda: load_plan(tmp_path, "toy"), lambda: read_batch(path), lambda: load_map(path)):
        with pytest.raises(UserError) as error:
            read()
        assert "plan.npz" in told_once(error)
    with pytest.raises(UserError) as error:
        read_shard(path)
    assert "plan.npz" in told_once(error)


def test_settings_of_a_run_that_are_no_settings(tmp_path):
    for text in ("a: [", "just words", ""):
        (tmp_path / "config.yaml").write_text(text)
        with pytest.raises(UserError) as error, claimed(tmp_path, {"seed": 1}):
            pass
        assert "config.yaml" in told_once(error)


@pytest.mark.parametrize(
    ("words", "told"),
    [
        (["evaluate", "SCENE", "--truth", "--contenders", "dense", "clearance_m=50"], "0 places are 50.0 m from"),
        (["navigate", "SCENE", "--truth", "clearance_m=50"], "0 places are 50.0 m from obstacles"),
        (["data", "SCENE", "robot=nobody"], "unknown robot 'nobody'"),
    ],
)
def test_what_no_scene_has(words, told, painted, tmp_path, capsys):
    words = [str(painted) if word == "SCENE" else word for word in words]
    assert main([*words, "-o", str(tmp_path / "out")]) == 2
    error = capsys.readouterr().err
    assert error.startswith("topological_nav: ") and told in error and error.count("\n") == 1
