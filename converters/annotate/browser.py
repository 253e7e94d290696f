"""Serve the annotation page (viser); all visitors share one scene, and every change is saved before it is shown."""

import concurrent.futures
import contextlib
import dataclasses
import functools
import math
import threading
from collections.abc import Callable, Mapping
from typing import Any

import numpy as np
import trimesh

from converters.annotate.session import Item, Session, Store, step_of
from converters.bodies.alignment import MIN_POINTS, Alignment, AlignmentError, apply_alignment
from converters.check.pictures import camera_axes, mesh_picture
from converters.propose.pieces import Proposal, bounds
from converters.propose.proposals import floor_of
from converters.propose.retrieval import retrieve
from converters.read.obj import texels, textured_by_face
from converters.records.raw import CEILING, CadModel, RawScene, ScanMesh
from interactive_nav_common.errors import UserError
from interactive_nav_common.rotations import Y_UP_TO_Z_UP, yaw_matrix

MARGIN_M = 0.3
"""So much of the scan is shown around an object."""
THUMBNAIL = 116
"""Pixels a side."""


def painted(scan: ScanMesh) -> trimesh.Trimesh:
    """Return the scan with a colour at each vertex, without its ceiling."""
    colours = scan.vertex_colours
    if scan.texture is not None and scan.corner_uv is not None:
        colours = np.full((len(scan.vertices), 3), 180, np.uint8)
        colours[scan.faces.ravel()] = texels(scan.texture, scan.corner_uv.reshape(-1, 2))
    keep = ~(scan.labels[scan.faces] == CEILING).all(axis=1)
    return trimesh.Trimesh(scan.vertices, scan.faces[keep], vertex_colors=colours, process=False)


def around(mesh: trimesh.Trimesh, item: Item) -> trimesh.Trimesh:
    """Return the scan's faces about an object; all of them where there are none."""
    half = np.array([math.hypot(*item.extent_m[:2]) / 2] * 2 + [item.extent_m[2] / 2]) + MARGIN_M
    near = (np.abs(mesh.triangles_center - item.centre) < half).all(axis=1)
    part = mesh.submesh([np.flatnonzero(near)], append=True, repair=False) if near.any() else mesh
    assert isinstance(part, trimesh.Trimesh)
    return part


def view_of(item: Item, cad: CadModel | None, raw: RawScene) -> tuple[Alignment, np.ndarray, np.ndarray]:
    """Show the object on the left and its model on the right, facing the camera.

    Return the model's pose (CAD frame -> scan frame), and the camera's position and target, (3,) m each, scan frame.
    """
    inwards = raw.scan.vertices[:, :2].mean(axis=0) - item.centre[:2]
    far = float(np.linalg.norm(inwards))
    x, y = inwards / far if far > 0.3 else (0.0, -1.0)
    right, wide = np.array([-y, x, 0.0]), math.hypot(*item.extent_m[:2]) + 2 * MARGIN_M
    low, high = bounds(cad.vertices) if cad else (np.full(3, -0.5), np.full(3, 0.5))
    size = max(item.extent_m) / max(float((high - low).max()), 1e-6)
    yaw = math.atan2(y, x) + math.pi / 2  # a model's front is -y of the CAD frame
    gap = wide / 2 + size * math.hypot(*(high - low)[:2]) / 2 + 0.1
    at = np.array(item.centre) + gap * right
    bench = Alignment(np.full(3, size), at - size * (yaw_matrix(yaw) @ ((low + high) / 2)), yaw, math.nan)
    middle = np.array(item.centre) + gap / 2 * right
    return bench, middle + 0.95 * (wide + gap) * np.array([0.8 * x, 0.8 * y, 0.5]), middle


def coloured(cad: CadModel, pose: Alignment) -> trimesh.Trimesh:
    """Return a model under a pose, its faces coloured."""
    mesh = trimesh.Trimesh(apply_alignment(pose, cad.vertices), cad.faces, face_colors=cad.face_colours, process=False)
    mesh.unmerge_vertices()
    return mesh


def hit(mesh: trimesh.Trimesh, origin: np.ndarray, direction: np.ndarray) -> tuple[float, np.ndarray]:
    """Return the distance along a ray to the nearest surface, m, and the point (3,); infinite where it meets none."""
    points = mesh.ray.intersects_location([origin], [direction])[0].reshape(-1, 3)
    along = (points - origin) @ (direction / np.linalg.norm(direction))
    k = int(np.argmin(along)) if len(along) else -1
    return (float(along[k]), points[k]) if k >= 0 else (math.inf, np.zeros(3))


SYMMETRIES = {
    "none": "__SYM_NONE",
    "half turn": "__SYM_ROTATE_UP_2",
    "quarter turn": "__SYM_ROTATE_UP_4",
    "round": "__SYM_ROTATE_UP_INF",
}
COLOURS = ((230, 60, 60), (40, 130, 230), (250, 170, 20), (30, 160, 80), (160, 70, 200), (0, 180, 190), (240, 100, 180))
"""Of pairs, in turn."""
SHOWN = 4
"""Candidates side by side."""
FITTED = (255, 140, 30)
"""Colour of the fitted model, and of the frame of the one that was chosen."""
MARKS = {"open": "", "accepted": " ✔ accepted", "skipped": " – skipped"}


class Page:
    """The page of a server, and its reactions to clicks."""

    def __init__(
        self, server: Any, store: Store, session: Session, raw: RawScene, proposals: tuple[Proposal, ...]
    ) -> None:
        """Fill the page of a running viser server."""
        self.server, self.store, self.session, self.raw = server, store, session, raw
        self.library: Mapping[str, CadModel] = store.library
        self._proposals, self._room = proposals, painted(raw.scan)
        self._lock, self._pool = threading.RLock(), concurrent.futures.ThreadPoolExecutor(1)
        self._ranked: dict[int, list[str]] = {}
        self._drawn: dict[str, Any] = {}
        self._first, self._adding, self._error = 0, False, ""
        self._picture = functools.cache(self._thumbnail)
        server.gui.configure_theme(control_width="large", show_share_button=False, show_logo=False)
        self._words()
        server.scene.on_click()(self._clicked)
        server.on_client_connect(lambda client: self._look([client]))
        self._draw()

    def _thumbnail(self, cad_id: str) -> np.ndarray:
        cad = self.library[cad_id]
        mesh = cad.surface or textured_by_face(cad.vertices, cad.faces, cad.face_colours)
        return mesh_picture(mesh, camera_axes() @ Y_UP_TO_Z_UP.T, THUMBNAIL)

    def _words(self) -> None:
        gui, classes = self.server.gui, sorted({cad.category for cad in self.library.values()})
        self._steps, self._progress = gui.add_markdown(""), gui.add_progress_bar(0)
        self._object = gui.add_dropdown("Object", ["-"])
        self._class = gui.add_dropdown("Class", classes)
        self._symmetry = gui.add_dropdown("Symmetry", list(SYMMETRIES), hint="turns after which it looks the same")
        self._image = gui.add_image(np.full((THUMBNAIL, SHOWN * THUMBNAIL, 3), 255, np.uint8))
        self._pick = gui.add_button_group("Model", [*map(str, range(1, SHOWN + 1)), "more"])
        self._fit = gui.add_markdown("")
        actions = {"Accept (A)": Session.accepted, "Skip (S)": Session.skipped, "Undo (U)": Session.undone}
        for label, action in actions.items():
            gui.add_button(label, color="green" if action is Session.accepted else "gray").on_click(
                lambda _, action=action: self.do(action)
            )
            gui.add_command(label, hotkey=label[-2]).on_trigger(lambda _, action=action: self.do(action))
        gui.add_button("Add an object", color="gray").on_click(lambda _: self._add())
        self._whole = gui.add_checkbox("Show the whole room", False)
        self._whole.on_update(lambda _: self._draw())

        def choose(handle: Any, action: Callable[[str], Callable[[Session], Session]]) -> None:
            # Values that the page sets raise an event too, without a client.
            handle.on_update(lambda event: event.client_id is not None and self.do(action(handle.value)))

        choose(self._object, lambda word: lambda s: dataclasses.replace(s, at=int(word.split()[0]) - 1))
        choose(self._class, lambda word: lambda s: s.changed(category=word, cad_id="", model=(), state="open"))
        choose(self._symmetry, lambda word: lambda s: s.changed(symmetry=SYMMETRIES[word], state="open"))
        self._pick.on_click(lambda event: self._picked(event.target.value))

    def do(self, action: Callable[[Session], Session]) -> None:
        """Save the session after an action, then show it; a refused action shows an error and changes nothing."""
        with self._lock:
            try:
                before, self._error = self.session, ""
                self.session = self.store.save(action(self.session))
                if before.items and self.session.item.category != before.item.category or self.session.at != before.at:
                    self._first = 0
            except UserError as error:
                self._error = str(error)
            self._draw()

    def candidates(self) -> list[str]:
        """Return ids of the models of the object's class, the likeliest first."""
        models = [k for k, cad in sorted(self.library.items()) if cad.category == self.session.item.category]
        ranked = self._ranked.get(self.session.at, [])
        return sorted(models, key=lambda k: ranked.index(k) if k in ranked else len(ranked))

    def _add(self) -> None:
        self._adding = not self._adding
        self._draw()

    def _picked(self, word: str) -> None:
        with self._lock:
            candidates = self.candidates() if self.session.items else []
            at = self._first + (SHOWN if word == "more" else int(word) - 1)
            if word == "more":
                self._first = at if at < len(candidates) else 0
                self._draw()
            elif at < len(candidates):
                self.do(lambda s: s.chose(self.library[candidates[at]]))

    def _clicked(self, event: Any) -> None:
        """Handle a click: a point of the scan, or of the model that stands beside it, whichever the ray meets first."""
        origin, direction = np.array(event.ray_origin), np.array(event.ray_direction)
        with self._lock:
            hits = {of: hit(self._drawn[of], origin, direction) for of in ("scan", "model") if of in self._drawn}
            side = min(hits, key=lambda k: hits[k][0], default="scan")
            if not hits or not np.isfinite(hits[side][0]):
                return
            point = hits[side][1]
            if self._adding:
                self._adding = False
                self.do(lambda s: s.added(self._class.value, point))
            elif side == "scan":
                self.do(lambda s: s.clicked("scan", point))
            else:
                bench = self._drawn["bench"]
                self.do(lambda s: s.clicked("model", (point - bench.translation) @ yaw_matrix(bench.yaw) / bench.scale))

    def _rank(self) -> None:
        """Fit every model of the object's class, on another thread; the pictures then stand in that order."""
        at, item = self.session.at, self.session.item
        if at in self._ranked or at >= len(self._proposals):
            return
        self._ranked[at] = []

        def work() -> None:
            if self.session.at != at:
                del self._ranked[at]  # looked at no longer; later perhaps
                return
            models = {k: cad for k, cad in self.library.items() if cad.category == item.category}
            best = retrieve(self._proposals[at], models, floor_of(self.raw), any_category=True)
            with self._lock:
                self._ranked[at] = [k for k, _ in best.ranking] if best else []
                self._draw()

        self._pool.submit(work)

    def _draw(self) -> None:
        with self._lock, self.server.atomic():
            session = self.session
            done = sum(item.state != "open" for item in session.items)
            self._progress.value = 100 * done / max(len(session.items), 1)
            if session.items:
                names = [f"{k} {item.category}{MARKS[item.state]}" for k, item in enumerate(session.items, 1)]
                self._object.options = names
                self._object.value = names[session.at]
                self._class.value = session.item.category
                self._symmetry.value = next(k for k, v in SYMMETRIES.items() if v == session.item.symmetry)
                self._show_candidates()
                self._rank()
            self._scene()
            self._steps.content = self._status(done)

    def _status(self, done: int) -> str:
        """Return the steps, the next one in bold, and the last error."""
        if self._adding:
            return "**Click the middle of the new object in the scan.**"
        if not self.session.items:
            return "No object was proposed. Add one, or label the scan first (`segment`)."
        item = self.session.item
        steps = [
            "Choose a model below (its class first, if it is wrong)",
            f"Click the same spots on scan and model: {item.pairs} of at least {MIN_POINTS} pairs",
            "Look at the orange model over the scan, then accept",
        ]
        if len(item.scan) != len(item.model):
            steps[1] += f"; now on the **{'model' if len(item.scan) > len(item.model) else 'scan'}**"
        rows = [f"{'▶' if k == step_of(item) else ''} {k}. {text}" for k, text in enumerate(steps, 1)]
        rows[step_of(item) - 1] = f"**{rows[step_of(item) - 1].strip().replace('**', '')}**"
        error = f"\n\n⚠ {self._error}" if self._error else ""
        return f"{done} of {len(self.session.items)} objects done\n\n" + "\n\n".join(rows) + error

    def _show_candidates(self) -> None:
        strip = np.full((THUMBNAIL, SHOWN, THUMBNAIL, 3), 255, np.uint8)
        for k, cad_id in enumerate(self.candidates()[self._first : self._first + SHOWN]):
            strip[:, k] = FITTED if cad_id == self.session.item.cad_id else 255
            strip[3:-3, k, 3:-3] = self._picture(cad_id)[3:-3, 3:-3]
        self._image.image = strip.reshape(THUMBNAIL, -1, 3)

    def _scene(self) -> None:
        """Show scan, model beside it, points, and the fitted model; send meshes only if they have changed."""
        item = self.session.item if self.session.items else None
        cad, scene = self.library.get(item.cad_id) if item else None, self.server.scene
        whole = self._adding or self._whole.value or item is None
        key = (self.session.at, whole, len(self.session.items), item and item.cad_id)
        before = self._drawn.get("key", ())
        if before != key:
            shown = item or Item("", tuple(self._room.centroid), tuple(self._room.extents), 0.0, 0)
            bench, *camera = view_of(shown, cad, self.raw)
            self._drawn = {
                "key": key,
                "bench": bench,
                "camera": camera,
                "scan": self._room if whole else around(self._room, shown),
            }
            if cad is not None:
                self._drawn["model"] = coloured(cad, bench)
            for side in ("scan", "model"):
                scene.remove_by_name(f"/{side}")
                if side in self._drawn:
                    scene.add_mesh_trimesh(f"/{side}", self._drawn[side])
            if before[:2] != key[:2]:
                self._look(self.server.get_clients().values())
        scene.remove_by_name("/said")
        scene.add_frame("/said", show_axes=False)  # the parent of what the person clicked, which is removed with it
        self._fit.content = ""
        if item is None:
            return
        bench = self._drawn["bench"]
        for side, points in (("scan", item.scan), ("model", item.model)):
            at = np.array(points).reshape(-1, 3)
            for k, point in enumerate(at if side == "scan" else apply_alignment(bench, at)):
                name = f"/said/{side}{k + 1}"
                scene.add_icosphere(name, 0.015, color=COLOURS[k % len(COLOURS)], position=point)
                scene.add_label(f"{name}/number", str(k + 1))
        if cad is None or item.pairs < MIN_POINTS:
            return
        try:
            out = np.flatnonzero((fit := item.fit()).outliers) + 1
            left = f", without pair {', '.join(map(str, out))}" if len(out) else ""
            self._fit.content = f"**Residual {100 * fit.rms_m:.1f} cm** over {item.pairs} pairs{left}"
            points, paint = apply_alignment(fit, cad.vertices), {"color": FITTED, "opacity": 0.6, "side": "double"}
            scene.add_mesh_simple("/said/fit", points, cad.faces, **paint)
        except AlignmentError as error:
            self._fit.content = f"⚠ {error}"

    def _look(self, clients: Any) -> None:
        """Turn the cameras to the object and its model."""
        for client in clients:
            with contextlib.suppress(Exception), client.atomic():  # one that has gone away meanwhile
                client.camera.position, client.camera.look_at = self._drawn["camera"]
