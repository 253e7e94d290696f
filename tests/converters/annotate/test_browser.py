"""The page in a real headless Chromium: six pairs clicked give the known alignment; nothing is lost."""

from __future__ import annotations

import contextlib
import dataclasses
import io
import json
import math

import numpy as np
import pytest
import trimesh

from converters.__main__ import main
from converters.annotate.browser import Page, hit
from converters.annotate.session import Store, start
from converters.bodies.alignment import apply_alignment
from converters.bodies.objects import upright
from converters.propose.pieces import bounds, box_iou
from converters.propose.proposals import propose_instances
from converters.propose.retrieval import annotated_vertices, read_library
from converters.read.source import read_source
from interactive_nav_common.rotations import wrap_angle
from interactive_nav_common.untrusted.guard import guarded_server
from tests.converters.annotate.chromium import Tab, tab, until

pytest.importorskip("viser", reason="viser is not installed (pip install 'viser>=1.1,<1.2')")


@contextlib.contextmanager
def opened(source, folder):
    """The tool on a source, served on a port of its own."""
    raw = read_source(source)
    store, proposals = Store(folder, read_library(source)), propose_instances(raw.scan)
    session = store.save(store.open(raw, lambda: start(raw, proposals)))
    server, address = guarded_server("127.0.0.1", 0, raw.name, "annotate")
    # Without a GPU reflections and shadows take half of the time, and no test looks at them.
    server.scene.configure_environment_map(None)
    server.scene.configure_default_lights(cast_shadow=False)
    try:
        yield Page(server, store, session, raw, proposals), address
    finally:
        server.stop()


def look(page: Page, browser: Tab, point: np.ndarray, eye: np.ndarray) -> tuple[float, float]:
    """Turns the browser's camera to a point; its pixel by the camera that the browser reports then."""
    [client] = page.server.get_clients().values()
    reports = []
    client.camera.on_update(reports.append)
    with client.atomic():
        client.camera.position, client.camera.look_at = eye, point

    def there() -> bool:  # the server takes its own word at once: only a report is the browser's
        camera = client.camera
        return (
            bool(reports)
            and np.allclose(camera.position, eye, atol=1e-3)
            and np.allclose(camera.look_at, point, atol=1e-3)
        )

    until(there, what="the camera")
    camera = client.camera
    turn = trimesh.transformations.quaternion_matrix(camera.wxyz)[:3, :3]
    x, y, z = turn.T @ (point - camera.position)
    # The picture may have fewer pixels than the page: the browser draws coarser where it is slow.
    left, top, wide, high = browser.evaluate(
        "(b => [b.x, b.y, b.width, b.height])(document.querySelector('canvas').getBoundingClientRect())"
    )
    focal = high / 2 / math.tan(camera.fov / 2)
    return left + wide / 2 + focal * x / z, top + high / 2 + focal * y / z


def seen_pairs(page: Page, truth, cad, scan: trimesh.Trimesh, bench: trimesh.Trimesh):
    """Six points of the model, far from one another, that both show: CAD, scan, bench, two eyes."""
    surface = trimesh.Trimesh(cad.vertices, cad.faces, process=False)
    points, face = trimesh.sample.sample_surface(surface, 400, seed=0)[:2]
    normals = np.asarray(surface.face_normals)[face]
    pose, found = page._drawn["bench"], []
    for p, n in zip(np.asarray(points), normals, strict=True):
        q, b = truth[:3, :3] @ p + truth[:3, 3], apply_alignment(pose, p[None])[0]
        eyes = []
        for at, direction, mesh in (
            (q, np.linalg.inv(truth[:3, :3]).T @ n, scan),
            (b, apply_alignment(pose, (p + n)[None])[0] - b, bench),
        ):
            direction = direction / np.linalg.norm(direction) + [0.013, 0.017, 0.3]
            eye = at + 0.9 * direction / np.linalg.norm(direction)
            far, where = hit(mesh, eye, at - eye)
            # From afar nothing else of either must stand before it.
            if np.linalg.norm(where - at) < 0.03 and all(hit(m, eye, at - eye)[0] >= far - 1e-6 for m in (scan, bench)):
                eyes.append(eye)
        if len(eyes) == 2:
            found.append((p, q, b, *eyes))
    assert len(found) >= 6
    chosen = [max(found, key=lambda f: f[0][2])]
    while len(chosen) < 6:
        chosen.append(
            max(found, key=lambda f: min(np.linalg.norm((f[0] - c[0]) / np.ptp(points, axis=0)) for c in chosen))
        )
    return chosen


def click_six_pairs(page: Page, browser: Tab, k: int) -> int:
    """Chooses the annotated model of an object and clicks six pairs; the object's index in the session."""
    truth, boxes = page.raw.annotations[k], [bounds(p.points) for p in page._proposals]
    own = bounds(annotated_vertices(truth, page.raw.cads))
    at = max(range(len(boxes)), key=lambda i: box_iou(own, boxes[i]))
    page.do(lambda s: dataclasses.replace(s, at=at))
    page._pool.submit(int).result(120)  # the ranking is done: until then candidates change places
    number = page.candidates().index(truth.cad_id)
    for _ in range(number // 4):
        browser.press("more")
    browser.press(str(number % 4 + 1))
    until(lambda: page.session.item.cad_id == truth.cad_id, what="the model")
    cad = page.raw.cads[truth.cad_id]
    with page._lock:  # it is drawn once the lock is free
        shown = dict(page._drawn)
    pairs = seen_pairs(page, truth.pose, cad, shown["scan"], shown["model"])
    for count, (_, q, b, scan_eye, model_eye) in enumerate(pairs, 1):
        browser.click(*look(page, browser, q, scan_eye))
        until(lambda count=count: len(page.session.item.scan) == count, what=f"point {count} of the scan")
        browser.click(*look(page, browser, b, model_eye))
        until(lambda count=count: page.session.item.pairs == count, what=f"pair {count}")
    page._look(page.server.get_clients().values())
    until(lambda: "Residual" in browser.text(), what="the residual")
    return at


def off(page: Page, k: int, at: int) -> tuple[float, float]:
    """How far the fit is from the annotation: of the model's middle, m, and of its yaw, rad."""
    truth = page.raw.annotations[k]
    vertices = page.raw.cads[truth.cad_id].vertices
    pivot = (vertices.min(axis=0) + vertices.max(axis=0)) / 2
    known, _ = upright(truth.pose, pivot)
    fit = page.session.items[at].fit()
    moved = apply_alignment(fit, pivot[None]) - apply_alignment(known, pivot[None])
    return float(np.linalg.norm(moved)), abs(wrap_angle(fit.yaw - known.yaw))


@pytest.mark.heavy
def test_six_pairs_on_a_generated_scan_give_its_alignment(tmp_path):
    with contextlib.redirect_stdout(io.StringIO()):
        assert main(["generate", str(tmp_path / "raw"), "--seed", "6", "floor_area_m2=30", "n_rooms=2"]) == 0
    with opened(tmp_path / "raw", tmp_path / "mine") as (page, address), tab(address, tmp_path / "profile") as browser:
        until(lambda: page.server.get_clients(), what="the browser")
        k = [a.category for a in page.raw.annotations].index("chair")
        at = click_six_pairs(page, browser, k)
        browser.picture(tmp_path / "clicked.png")
        moved_m, turned = off(page, k, at)
        assert moved_m < 0.1 and math.degrees(turned) < 5
        browser.press("Accept (A)")
        until(lambda: page.session.items[at].state == "accepted", what="accepted")
        written = json.loads((tmp_path / "mine" / "full_annotations.json").read_text())
        assert [m["id_cad"] for m in written[0]["aligned_models"]] == [page.raw.annotations[k].cad_id]


@pytest.mark.data
@pytest.mark.heavy
def test_six_pairs_in_the_real_room_give_the_peoples_alignment(sample_data, tmp_path):
    source = sample_data / "scan2cad_scene0470_00"
    with opened(source, tmp_path / "mine") as (page, address), tab(address, tmp_path / "profile") as browser:
        until(lambda: page.server.get_clients(), what="the browser")
        k = [a.category for a in page.raw.annotations].index("chair")
        moved_m, turned = off(page, k, click_six_pairs(page, browser, k))
        browser.picture(tmp_path / "clicked.png")
        assert moved_m < 0.1 and math.degrees(turned) < 5


@pytest.mark.heavy
def test_a_browser_that_goes_away_loses_nothing(scan2cad_raw, tmp_path):
    with opened(scan2cad_raw, tmp_path / "mine") as (page, address):
        with tab(address, tmp_path / "one") as browser:
            until(lambda: page.server.get_clients(), what="the browser")
            browser.press("1")
            until(lambda: page.session.item.cad_id, what="the model")
        until(lambda: not page.server.get_clients(), what="the browser to go")
        page.do(lambda s: s.clicked("scan", np.zeros(3)))
        with tab(address, tmp_path / "two") as browser:
            until(lambda: "0 of at least 6 pairs; now on the model" in browser.text(), what="the state")
            browser.press("Undo (U)")
            until(lambda: not page.session.item.scan, what="undo")
            browser.press("Skip (S)")
            until(lambda: "1 of 2 objects done" in browser.text(), what="skip")
            (tmp_path / "mine" / "session.json").write_text("{}")
            browser.press("Skip (S)")
            until(lambda: "another program has changed it" in browser.text(), what="the refusal")
        assert (tmp_path / "mine" / "session.json").read_text() == "{}"
        assert [item.state for item in page.session.items] == ["skipped", "open"]
