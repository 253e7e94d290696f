"""Hold a person's annotations of a scan, and read and write them; actions return a new `Session`."""

import dataclasses
import hashlib
import json
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any, Literal

import numpy as np

from converters.bodies import alignment
from converters.propose.pieces import Proposal
from converters.propose.proposals import scan2cad_list, scan2cad_model
from converters.propose.retrieval import read_library
from converters.read.annotations import ANNOTATION, inside_scan, parse_annotations
from converters.read.files import SourceFolder, read_json
from converters.records.errors import SceneRejected
from converters.records.raw import SYNSETS, CadModel, RawScene
from interactive_nav_common.errors import FileError
from interactive_nav_common.files import write_text
from interactive_nav_common.records import Reader

SESSION = "session.json"
MAX_UNDO = 200
"""Actions that can be taken back."""
Point = tuple[float, float, float]


@dataclasses.dataclass(frozen=True)
class Item:
    """One object of the scan and its annotation."""

    category: str
    centre: Point
    """Of its box, scan frame, m."""
    extent_m: Point
    """Full sizes along the box's axes."""
    yaw: float
    """rad, of the box's x axis."""
    label: int
    """NYU40 id that most of it carries; 0: nobody proposed it."""
    cad_id: str = ""
    symmetry: str = "__SYM_NONE"
    scan: tuple[Point, ...] = ()
    """Clicked points, scan frame, m."""
    model: tuple[Point, ...] = ()
    """Clicked points, CAD frame; of these and of `scan` one may have a point more, whose partner is not yet clicked."""
    state: Literal["open", "accepted", "skipped"] = "open"

    @property
    def pairs(self) -> int:
        """Return the number of whole pairs."""
        return min(len(self.scan), len(self.model))

    def points(self) -> tuple[np.ndarray, np.ndarray]:
        """Return (pairs, 3) points of the model and of the scan."""
        return np.array(self.model[: self.pairs]), np.array(self.scan[: self.pairs])

    def fit(self) -> alignment.Alignment:
        """Return the model's placement by the whole pairs, as `convert` would solve it."""
        return alignment.solve_alignment(*self.points(), self.symmetry)


@dataclasses.dataclass(frozen=True)
class Session:
    """All objects, the one that is worked on, and the way back."""

    scan_id: str
    scan_sha256: str
    """Of the vertices: pairs of one scan mean nothing on another."""
    items: tuple[Item, ...]
    at: int = 0
    """Index of the object that is worked on."""
    undo: tuple[tuple[int, Item | None], ...] = ()
    """Index and what stood there before, the last action last; None: it was not there."""
    wrote_sha256: tuple[str, ...] = ()
    """Of the annotation file, as it was before this action and as it is after."""

    @property
    def item(self) -> Item:
        """Return the object that is worked on."""
        if not self.items:
            raise alignment.AlignmentError("there is no object yet; add one first")
        return self.items[self.at]

    def changed(self, **what: Any) -> "Session":
        """Change the object that is worked on."""
        items, undo = list(self.items), (*self.undo, (self.at, self.item))[-MAX_UNDO:]
        items[self.at] = dataclasses.replace(self.item, **what)
        return dataclasses.replace(self, items=tuple(items), undo=undo)

    def chose(self, cad: CadModel) -> "Session":
        """Take a model: points that were clicked on another one are dropped with it, and its class is taken."""
        model = self.item.model if self.item.cad_id == cad.cad_id else ()
        return self.changed(cad_id=cad.cad_id, category=cad.category, model=model, state="open")

    def clicked(self, side: Literal["scan", "model"], point: np.ndarray) -> "Session":
        """Add a point; a second one on a side whose last point has no partner yet takes that one's place."""
        points, other = (self.item.scan, self.item.model)[:: 1 if side == "scan" else -1]
        kept = points[:-1] if len(points) > len(other) else points
        return self.changed(**{side: (*kept, _point(point))}, state="open")

    def accepted(self) -> "Session":
        """Accept the fit and go on to the next open object."""
        if not self.item.cad_id:
            raise alignment.AlignmentError("no model is chosen; choose one, then click pairs")
        self.item.fit()
        return self.changed(state="accepted").next_open()

    def skipped(self) -> "Session":
        """Leave the object out and go on to the next open one."""
        return self.changed(state="skipped").next_open()

    def next_open(self) -> "Session":
        """Go to the next object that is neither accepted nor skipped; stay where there is none."""
        order = [(self.at + k) % len(self.items) for k in range(len(self.items))]
        return dataclasses.replace(self, at=next((k for k in order if self.items[k].state == "open"), self.at))

    def added(self, category: str, centre: np.ndarray) -> "Session":
        """Add an object that nobody proposed, and work on it."""
        item = Item(category, _point(centre), (1.0, 1.0, 1.0), 0.0, 0)
        undo = (*self.undo, (len(self.items), None))[-MAX_UNDO:]
        return dataclasses.replace(self, items=(*self.items, item), at=len(self.items), undo=undo)

    def undone(self) -> "Session":
        """Take the last action back; without one nothing changes."""
        if not self.undo:
            return self
        (at, before), items = self.undo[-1], list(self.items)
        items[at : at + 1] = [] if before is None else [before]
        at = max(min(at, len(items) - 1), 0)
        return dataclasses.replace(self, items=tuple(items), at=at, undo=self.undo[:-1])


def _point(values: np.ndarray) -> Point:
    """Round to 1 um."""
    x, y, z = np.round(np.asarray(values, float), 6).tolist()
    return x, y, z


def scan_sha256(raw: RawScene) -> str:
    """Return a digest of the scan's vertices."""
    return hashlib.sha256(np.ascontiguousarray(raw.scan.vertices, np.float64).tobytes()).hexdigest()


def start(raw: RawScene, proposals: tuple[Proposal, ...]) -> Session:
    """Return a session without annotations."""
    items = [Item(p.category, _point(p.centre), _point(p.extent_m), round(p.yaw, 6), p.label) for p in proposals]
    return Session(raw.name, scan_sha256(raw), tuple(items))


def as_annotations(session: Session, library: Mapping[str, CadModel]) -> list[dict[str, Any]]:
    """Return the accepted objects as Scan2CAD's annotation list."""
    models = []
    for item in session.items:
        if item.state != "accepted":
            continue
        cad, fit = library[item.cad_id], item.fit()
        of_model, of_scan = item.points()
        pose, pairs = (fit.scale, fit.yaw, fit.translation), (alignment.apply_alignment(fit, of_model), of_scan)
        models.append(scan2cad_model(item.category, item.cad_id, pose, cad.vertices, item.symmetry, pairs))
    return scan2cad_list(session.scan_id, models)


def with_annotations(raw: RawScene, path: Path, library_root: Path | None) -> RawScene:
    """Replace the scene's annotations by a file's; models are of a folder with `cad/`, or the packaged furniture."""
    _, records = parse_annotations(read_json(path), path)
    library, annotations = read_library(library_root), tuple(a for _, a in records)
    missing = sorted({a.cad_id for a in annotations} - set(library))
    if missing:
        where = library_root / "cad" if library_root else "the packaged furniture"
        raise SceneRejected(f"{path}: names model {missing[0]}, which {where} lacks; give its --library")
    source = SourceFolder(path.parent)
    source.use(path.name, "")
    kept, cads = inside_scan(source, path.name, annotations, library, raw.scan)
    return dataclasses.replace(
        raw,
        annotations=kept,
        cads=cads,
        sources=raw.sources | source.sha256,
        warnings=raw.warnings + tuple(source.warnings),
    )


class Store:
    """The folder of one session. Nobody else may write there meanwhile (`interactive_nav_common.files.alone_in`)."""

    def __init__(self, folder: Path, library: Mapping[str, CadModel]) -> None:
        """Open a folder, with the models that annotations may name."""
        self.folder, self.library = folder, library
        self._read: dict[str, str] = {}

    def _digest(self, name: str) -> str:
        try:
            return hashlib.sha256((self.folder / name).read_bytes()).hexdigest()
        except FileNotFoundError:
            return ""
        except OSError as error:
            raise FileError(f"{self.folder / name}: cannot be read ({error.strerror}); mend it") from None

    def open(self, raw: RawScene, begin: Callable[[], Session]) -> Session:
        """Return the session that the folder holds, or what `begin` returns."""
        path = self.folder / SESSION
        self._read = {name: self._digest(name) for name in (SESSION, ANNOTATION)}
        given = Reader(FileError, "remove it to start again").json(path, absent={})
        session = Reader(FileError, "remove it to start again").record(given, Session, str(path)) if given else None
        if self._read[ANNOTATION] not in ("", *(session.wrote_sha256 if session else ())):
            raise FileError(
                f"{self.folder / ANNOTATION}: was not written by this session, expected none or its own; "
                "choose another folder (-o) or move the file away"
            )
        if session is None:
            return begin()
        if session.scan_sha256 != scan_sha256(raw):
            raise FileError(
                f"{path}: is of scan {session.scan_id} with other vertices than {raw.name}; "
                "choose another folder (-o), or give the scan that it was begun with"
            )
        for k, item in enumerate(session.items):
            if item.category not in SYNSETS.values() or item.symmetry not in alignment.SYMMETRY_PERIOD_RAD:
                raise FileError(f"{path}: items[{k}] has class {item.category}, symmetry {item.symmetry}; mend them")
            if (item.cad_id or item.state == "accepted") and item.cad_id not in self.library:
                raise FileError(f"{path}: items[{k}] names model {item.cad_id}, which is not there; give its --library")
        if session.items and not 0 <= session.at < len(session.items):
            raise FileError(f"{path}: at is {session.at}, expected an index of {len(session.items)} items; mend it")
        return session

    def save(self, session: Session) -> Session:
        """Write the session, then its annotations, each whole or not at all; return what stands there."""
        for name, digest in self._read.items():
            if self._digest(name) != digest:
                raise FileError(
                    f"{self.folder / name}: another program has changed it since it was read, expected it as it was; "
                    "nothing was overwritten: move it away, or stop and start again to take it"
                )
        text = json.dumps(as_annotations(session, self.library), indent=1, allow_nan=False) + "\n"
        digest = hashlib.sha256(text.encode()).hexdigest()
        session = dataclasses.replace(session, wrote_sha256=(self._read[ANNOTATION], digest))
        write_text(self.folder / SESSION, json.dumps(dataclasses.asdict(session), allow_nan=False) + "\n")
        self._read[SESSION] = self._digest(SESSION)
        write_text(self.folder / ANNOTATION, text)
        self._read[ANNOTATION] = digest
        return session


def step_of(item: Item) -> int:
    """Return which step is next: 1 choose a model, 2 click pairs, 3 look and accept."""
    return 1 if not item.cad_id else 2 if item.pairs < alignment.MIN_POINTS else 3
