"""The toy scene's dataset: what is where, who is held out, what happens when it is stopped or changed."""

import json
import shutil

import numpy as np
import pytest

from interactive_nav.scenes.scene import load_scene
from interactive_nav_common.config import overridden
from interactive_nav_common.errors import FileError
from tests.topological_nav.conftest import WORDS
from topological_nav.config import DataConfig
from topological_nav.data import dataset
from topological_nav.scenes.space import free_space

CONFIG = overridden(DataConfig(), WORDS)


def test_positions_keep_clear_and_rooms_have_at_most_their_share(made):
    plan = dataset.load_plan(made.data, "painted")
    space = free_space(load_scene(made.scene), 1.1)
    assert (space.at(plan.xy_w) >= CONFIG.clearance_m).all()
    counts = np.bincount(plan.room)
    assert len(counts) == 2 and counts.max() <= CONFIG.max_per_room and counts.min() >= 5
    assert (plan.rooms.of(plan.xy_w) == plan.room).all()
    assert ((plan.xy_w[:, 0] > 0) == plan.room).mean() > 0.9  # rooms are numbered from the left; the wall is at x = 0


def test_no_position_is_in_both_splits(made):
    rooms = dataset.load_rooms(made.data)
    assert rooms.test.any() and not rooms.test.all()
    assert not set(map(tuple, rooms.xy_w[rooms.test])) & set(map(tuple, rooms.xy_w[~rooms.test]))
    for room in range(2):
        mine = rooms.test[rooms.label == room]
        assert mine.sum() == round(0.2 * len(mine))  # 2 of 8 to 12


def test_every_position_has_18_headings_and_3_pitches(made):
    rooms = dataset.load_rooms(made.data)
    assert rooms.images.shape == (len(rooms.xy_w), 3, 18, 32, 32, 3)
    assert rooms.names == ("painted/0", "painted/1")
    # Up shows more of the bright background than down: there is no ceiling.
    bright = (rooms.images.min(-1) > 220).mean((0, 2, 3, 4))
    assert bright[0] > bright[1] > bright[2]
    # Looking along -x (the tenth heading) at level from the left room shows red, along x from the right room green.
    left, right = rooms.images[rooms.label == 0][:, 1, 9], rooms.images[rooms.label == 1][:, 1, 0]
    for images, channel in ((left, 0), (right, 1)):
        strongest = images[:, 14:18, 12:20].astype(float).mean((1, 2)).argmax(-1)
        assert (strongest == channel).mean() > 0.8


def test_images_of_some_pitches_are_those_of_all(made):
    rooms, some = dataset.load_rooms(made.data), dataset.load_rooms(made.data, ["level", "up"])
    assert some.images.shape[1] == 2 and (some.images == rooms.images[:, [1, 0]]).all()
    assert (some.of(["up"], some.test) == rooms.images[rooms.test, :1]).all()


def test_passages_are_stored_with_their_labels(made):
    passages, plan = dataset.load_passages(made.data), dataset.load_plan(made.data, "painted").passages
    assert passages.images.shape == (len(plan), 32, 32, 3)
    assert (passages.free == plan.free).all() and (passages.test == plan.test).all()
    assert passages.free.shape == (len(plan), 3) and passages.lengths_m == (0.6, 1.2, 1.8) and passages.scored == 1
    assert (passages.free[:, :-1] >= passages.free[:, 1:]).all()
    for held in (False, True):
        mine = passages.free[passages.test == held, 1]
        assert len(mine) and 2 * mine.sum() == len(mine)


def test_a_stopped_rendering_goes_on_where_it_was(made, tmp_path):
    """Files that exist are kept as they are; a missing one is drawn again, to the byte."""
    copy = tmp_path / "data"
    shutil.copytree(made.data, copy)
    lost, kept = copy / "painted" / "rooms-001.npz", copy / "painted" / "rooms-000.npz"
    whole, stamp = lost.read_bytes(), kept.stat().st_mtime_ns
    lost.unlink()
    with pytest.raises(FileError, match="rooms-001.npz is missing; the same 'data' command goes on"):
        dataset.load_rooms(copy)
    told = []
    dataset.make_dataset([made.scene], copy, CONFIG, lambda *step: told.append(step))
    assert lost.read_bytes() == whole and kept.stat().st_mtime_ns == stamp
    assert told[-1][1] == told[-1][2] == len(dataset.load_rooms(copy).xy_w) * 54 + len(dataset.load_passages(copy).free)


def test_another_dataset_in_the_folder_is_refused(made):
    with pytest.raises(FileError, match="the dataset there has seed = 0, this one 1; choose another folder"):
        dataset.make_dataset([made.scene], made.data, overridden(CONFIG, ["seed=1"]))


def test_a_changed_scene_is_refused(made, tmp_path):
    copy = tmp_path / "data"
    shutil.copytree(made.data, copy)
    header = json.loads((copy / "dataset.json").read_text())
    header["scenes"][0]["digest"] = "0" * 64
    (copy / "dataset.json").write_text(json.dumps(header))
    with pytest.raises(FileError, match="is of painted as they were; the scenes differ"):
        dataset.make_dataset([made.scene], copy, CONFIG)


def test_a_dataset_of_an_older_format_is_refused(made, tmp_path):
    copy = tmp_path / "data"
    shutil.copytree(made.data, copy)
    header = json.loads((copy / "dataset.json").read_text())
    (copy / "dataset.json").write_text(json.dumps({**header, "format": 1}))
    with pytest.raises(FileError, match="format 1, expected 2; make the dataset again"):
        dataset.load_passages(copy)


def test_seeds_draw_other_positions(made):
    scene = load_scene(made.scene)
    space = free_space(scene, 1.1)
    plans = [dataset.plan_scene(scene, space, overridden(CONFIG, [f"seed={s}"])) for s in (0, 0, 1)]
    assert (plans[0].xy_w == plans[1].xy_w).all() and (plans[0].passages.free == plans[1].passages.free).all()
    assert plans[0].xy_w.shape != plans[2].xy_w.shape or (plans[0].xy_w != plans[2].xy_w).any()


def test_a_folder_that_is_no_dataset_is_refused(tmp_path):
    with pytest.raises(FileError, match="is no dataset .no dataset.json.; make one: python -m topological_nav data"):
        dataset.load_rooms(tmp_path)
