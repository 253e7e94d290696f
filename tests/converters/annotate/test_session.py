"""What a person says about a scan: pairs, undo, files, two writers; and `convert` takes what was written."""

from __future__ import annotations

import dataclasses
import json

import numpy as np
import pytest

from converters.__main__ import main
from converters.annotate.session import Item, Session, Store, as_annotations, start, step_of, with_annotations
from converters.bodies.alignment import AlignmentError, apply_alignment
from converters.pipeline import ConvertConfig, convert_building
from converters.propose.proposals import propose_instances
from converters.propose.retrieval import annotated_vertices, read_library
from converters.read.annotations import parse_annotations
from converters.read.source import read_source
from converters.records.errors import SceneRejected
from interactive_nav_common.errors import FileError
from interactive_nav_common.rotations import yaw_matrix

SMALL = ConvertConfig(structure_texture=64, object_texture=32)
YAW, SCALE, SHIFT = 0.7, np.array([1.2, 0.8, 1.5]), np.array([2.0, -1.0, 0.4])
CAD = np.array([(0, 0, 0), (1, 0, 0), (0, 1, 0), (0, 0, 1), (1, 1, 0), (1, 0, 1.0)])
SCAN = CAD * SCALE @ yaw_matrix(YAW).T + SHIFT
BOX = Item("table", (0.0, 0.0, 0.0), (1.0, 1.0, 1.0), 0.0, 7)


@pytest.fixture
def read(scan2cad_raw):
    """The tiny room and its models."""
    return read_source(scan2cad_raw), read_library(scan2cad_raw)


def click_corners(session: Session, raw, cads) -> Session:
    """Chooses the annotated table and clicks its box's corners on both sides."""
    truth = next(a for a in raw.annotations if a.cad_id == "table-a")
    session = session.chose(cads["table-a"])
    for p, q in zip(truth.keypoints_cad, truth.keypoints_scan, strict=True):
        session = session.clicked("scan", q).clicked("model", p)
    return session


def test_six_pairs_of_a_known_transform_give_it_back():
    session = Session("s", "", (dataclasses.replace(BOX, cad_id="m"),))
    for k, (p, q) in enumerate(zip(CAD, SCAN, strict=True)):
        with pytest.raises(AlignmentError, match=f"{k} keypoint pairs, expected at least 6|shapes"):
            session.item.fit()
        session = session.clicked("model", p).clicked("scan", q)
        assert (session.item.pairs, step_of(session.item)) == (k + 1, 3 if k == 5 else 2)
    fit = session.item.fit()
    assert fit.scale == pytest.approx(SCALE, abs=1e-5) and fit.yaw == pytest.approx(YAW, abs=1e-6)
    assert fit.translation == pytest.approx(SHIFT, abs=1e-5) and fit.rms_m < 1e-5


def test_a_point_clicked_twice_takes_the_first_ones_place():
    session = Session("s", "", (BOX,)).clicked("scan", SCAN[0]).clicked("scan", SCAN[1]).clicked("model", CAD[1])
    assert session.item.scan == (tuple(np.round(SCAN[1], 6)),) and session.item.pairs == 1
    assert session.clicked("scan", SCAN[2]).item.scan[0] == session.item.scan[0]


def test_every_action_can_be_taken_back(read):
    raw, cads = read
    begun = start(raw, propose_instances(raw.scan))
    seen = [begun]
    seen.append(begun.chose(cads["basket-a"]))
    seen.append(seen[-1].clicked("scan", SCAN[0]))
    seen.append(seen[-1].changed(symmetry="__SYM_ROTATE_UP_4"))
    seen.append(seen[-1].skipped())
    seen.append(seen[-1].added("chair", SCAN[0]))
    seen.append(seen[-1].changed(category="sofa"))
    assert len(begun.items) == 2 and len(seen[-1].items) == 3 and seen[4].items[0].state == "skipped"
    session = seen[-1]
    for before in reversed(seen[:-1]):
        session = session.undone()
        assert session.items == before.items and session.undo == before.undo
    assert session.undone() == session


def test_another_model_drops_its_points_and_keeps_the_scans(read):
    _, cads = read
    session = Session("s", "", (BOX,)).chose(cads["table-a"]).clicked("scan", SCAN[0]).clicked("model", CAD[0])
    assert session.chose(cads["table-a"]).item.model == session.item.model
    other = session.chose(cads["basket-a"]).item
    assert (other.model, other.scan, other.category) == ((), session.item.scan, "basket")


def test_nothing_is_accepted_without_a_fit(read):
    _, cads = read
    session = Session("s", "", (BOX, BOX))
    with pytest.raises(AlignmentError, match="no model is chosen"):
        session.accepted()
    with pytest.raises(AlignmentError, match="expected at least 6"):
        session.chose(cads["table-a"]).clicked("scan", SCAN[0]).clicked("model", CAD[0]).accepted()
    with pytest.raises(AlignmentError, match="no object yet"):
        Session("s", "", ()).clicked("scan", SCAN[0])
    assert session.skipped().at == 1 and session.skipped().skipped().at == 1


def test_what_was_accepted_is_read_back_where_it_stood(read, tmp_path):
    raw, cads = read
    session = click_corners(start(raw, propose_instances(raw.scan)), raw, cads).accepted()
    assert session.items[0].state == "accepted" and session.at == 1
    scan_id, records = parse_annotations(as_annotations(session, cads), tmp_path)
    [(synset, found)] = records
    truth = next(a for a in raw.annotations if a.cad_id == "table-a")
    assert (scan_id, synset, found.symmetry) == (raw.name, "04379243", "__SYM_NONE")
    assert annotated_vertices(found, cads) == pytest.approx(annotated_vertices(truth, cads), abs=1e-4)
    assert found.keypoints_scan == pytest.approx(truth.keypoints_scan, abs=1e-5)
    assert found.keypoints_cad == pytest.approx(truth.keypoints_cad, abs=1e-4)
    assert apply_alignment(session.items[0].fit(), truth.keypoints_cad) == pytest.approx(found.keypoints_scan, abs=1e-4)


def test_a_session_goes_on_where_it_was(read, tmp_path):
    raw, cads = read
    proposals = propose_instances(raw.scan)
    store = Store(tmp_path, cads)
    session = store.save(click_corners(store.open(raw, lambda: start(raw, proposals)), raw, cads).accepted())
    again = Store(tmp_path, cads).open(raw, lambda: pytest.fail("begun anew"))
    assert again == session and again.undone().item.state == "open"
    assert len(json.loads((tmp_path / "full_annotations.json").read_text())[0]["aligned_models"]) == 1


def test_a_stop_between_the_two_files_loses_nothing(read, tmp_path):
    raw, cads = read
    store = Store(tmp_path, cads)
    first = store.save(store.open(raw, lambda: start(raw, propose_instances(raw.scan))))
    before = (tmp_path / "full_annotations.json").read_bytes()
    second = store.save(click_corners(first, raw, cads).accepted())
    (tmp_path / "full_annotations.json").write_bytes(before)  # the session was written, its annotations not yet
    store = Store(tmp_path, cads)
    store.save(store.open(raw, lambda: pytest.fail("begun anew")))
    assert json.loads((tmp_path / "full_annotations.json").read_text()) == as_annotations(second, cads)


def test_of_two_writers_neither_overwrites_the_other(read, tmp_path):
    raw, cads = read
    mine, theirs = Store(tmp_path, cads), Store(tmp_path, cads)
    begun = [s.open(raw, lambda: start(raw, propose_instances(raw.scan))) for s in (mine, theirs)]
    mine.save(begun[0].skipped())
    kept = (tmp_path / "session.json").read_bytes()
    with pytest.raises(FileError, match="another program has changed it since it was read, expected it as it was"):
        theirs.save(begun[1])
    assert (tmp_path / "session.json").read_bytes() == kept


def test_files_of_others_are_refused(read, tmp_path):
    raw, cads = read
    (tmp_path / "full_annotations.json").write_text("[]")
    with pytest.raises(FileError, match="was not written by this session, expected none or its own; choose another"):
        Store(tmp_path, cads).open(raw, lambda: start(raw, ()))
    assert (tmp_path / "full_annotations.json").read_text() == "[]"


@pytest.mark.parametrize(
    ("mended", "message"),
    [
        (lambda s: "{", "not readable as JSON .* remove it to start again"),
        (lambda s: json.dumps(s | {"colour": 1}), "unknown key 'colour'"),
        (lambda s: json.dumps(s | {"scan_sha256": "0"}), "is of scan scene_tiny with other vertices than scene_tiny"),
        (lambda s: json.dumps(s | {"at": 7}), "at is 7, expected an index of 2 items"),
        (lambda s: json.dumps(s | {"items": [s["items"][0] | {"cad_id": "x"}]}), "names model x, which is not there"),
        (lambda s: json.dumps(s | {"items": [s["items"][0] | {"state": "accepted"}]}), "names model , which is not"),
        (lambda s: json.dumps(s | {"items": [s["items"][0] | {"symmetry": "x"}]}), "has class .* symmetry x; mend"),
        (lambda s: json.dumps(s | {"items": [s["items"][0] | {"scan": [[0, 0, None]]}]}), "is null, expected a number"),
    ],
)
def test_damaged_sessions_are_one_line(read, tmp_path, mended, message):
    raw, cads = read
    store = Store(tmp_path, cads)
    session = store.save(store.open(raw, lambda: start(raw, propose_instances(raw.scan))))
    (tmp_path / "session.json").write_text(mended(dataclasses.asdict(session)))
    with pytest.raises(FileError, match=message):
        Store(tmp_path, cads).open(raw, lambda: start(raw, ()))


def test_convert_takes_the_file_in_place_of_the_sources_own(read, scan2cad_raw, tmp_path, hull_cache):
    raw, cads = read
    store = Store(tmp_path / "mine", cads)
    store.save(click_corners(store.open(raw, lambda: start(raw, propose_instances(raw.scan))), raw, cads).accepted())
    file = tmp_path / "mine" / "full_annotations.json"
    [made] = convert_building(
        scan2cad_raw,
        tmp_path / "s",
        SMALL,
        cache=hull_cache,
        annotations=file,
    )
    [table] = made.manifest.objects
    assert table.category == "table" and made.manifest.alignment[0]["n_keypoints"] == 8
    with pytest.raises(SceneRejected, match="names model table-a, which the packaged furniture lacks; give its --lib"):
        with_annotations(raw, file, None)


def test_a_file_of_one_scan_is_refused_for_many(tmp_path, capsys):
    assert main(["convert", str(tmp_path), "--into", str(tmp_path / "o"), "--annotations", "a.json"]) == 2
    assert "--annotations" in capsys.readouterr().err
