"""Build the packaged furniture from furniture libraries: scaled, simplified, textured, decomposed.

`selection.yaml` names the models of each category and split; no creator is in both splits.
"""

import concurrent.futures
import concurrent.futures.process
import dataclasses
import functools
import hashlib
import multiprocessing
import re
import tempfile
import zipfile
from collections.abc import Callable, Sequence
from pathlib import Path, PurePosixPath

import numpy as np

from converters.bodies.decompose import DecomposeConfig, cache_folder, decompose_all
from converters.geometry import faces as geometry
from converters.geometry.boxes import convex_hull
from converters.library.store import Credit, Model, Shape, attribution, write_library
from converters.read.files import SourceFolder
from converters.read.meshes import colours_of_faces, read_surface
from converters.read.obj import join_meshes
from converters.records.errors import SceneRejected, StageFailed
from converters.records.raw import TexturedMesh
from converters.write.texture import bake_object, textured_cloud
from interactive_nav_common.errors import ConfigError, FileError, readable
from interactive_nav_common.files import whole_file, write_text
from interactive_nav_common.records import Reader
from scenes_mjcf.categories import CATEGORIES

PROPERTIES = "PluginFurnitureCatalog.properties"
PACKAGE = "sweethome3d-furniture"
VERSION = "1.8"
FILES = {
    "BlendSwap-CC-0": "7ef093fe70cedbb160bdb532d86a84580459635e34130c16777f549eba1993dc",
    "BlendSwap-CC-BY": "29ae78937b4d5dbe93db74067817a984fa411f017b007fd666bc40368bdb0c83",
    "KatorLegaz": "f512443b5d3a6903497573095f971f44334b3165ab32182133051fa9487764a6",
    "Scopia": "b4505451b1e8ab339c101c0afddfef4e1a07b95aa8c821c61ec41487afd43850",
}
"""Library -> sha256 of its `.sh3f` in version 1.8; the package's fifth holds people."""
REMEDY = (
    f"give the folder of its .sh3f files (on Debian: apt-get download {PACKAGE}, then dpkg-deb -x {PACKAGE}_*.deb .)"
)
_ESCAPE = re.compile(r"\\(?:u([0-9a-fA-F]{4})|(.))")


@dataclasses.dataclass(frozen=True)
class CatalogueModel:
    """One piece of furniture of a catalogue."""

    library: Path
    """The library's file."""
    licence: str
    """Of the library."""
    name: str
    """As people call it."""
    model: str
    """Path of the model in the archive."""
    size_m: tuple[float, float, float]
    """Width, height and depth: along x, y (up) and z (to the front) of the turned model."""
    rotation: np.ndarray
    """(3, 3) turns the model's axes to those."""
    creator: str

    @property
    def key(self) -> str:
        """Return its name among all libraries, such as `Scopia/armchair1`."""
        return f"{self.library.stem}/{PurePosixPath(self.model).stem}"


def parse_properties(data: bytes) -> dict[str, str]:
    """Return key -> value of a Java properties file (ISO 8859-1, lines that go on, `\\uXXXX`)."""
    text = re.sub(r"\\\r?\n[ \t]*", "", data.decode("latin-1"))
    values = {}
    for line in text.splitlines():
        match = re.match(r"\s*([^\s#!=:][^\s=:]*)\s*[=:]?\s*(.*)", line)
        if match:
            values[match[1]] = _ESCAPE.sub(lambda m: chr(int(m[1], 16)) if m[1] else m[2], match[2])
    return values


def _piece(library: Path, licence: str, of: dict[str, str]) -> CatalogueModel:
    width, depth, height = (float(of[key]) / 100 for key in ("width", "depth", "height"))
    turn = np.array(of.get("modelRotation", "1 0 0 0 1 0 0 0 1").split(), float).reshape(3, 3)
    name, creator = (of.get(key, "") for key in ("name", "creator"))
    return CatalogueModel(library, licence, name, of["model"].lstrip("/"), (width, height, depth), turn, creator)


def read_catalogue(path: Path) -> tuple[CatalogueModel, ...]:
    """Read the pieces of a `.sh3f` file, one that `libraries_in` has checked."""
    with readable(path, SceneRejected, "fetch it again", " as a furniture library"), zipfile.ZipFile(path) as archive:
        whole = parse_properties(archive.read(PROPERTIES))
    of: dict[int, dict[str, str]] = {}
    for key, value in whole.items():
        name, _, number = key.partition("#")
        if number:
            of.setdefault(int(number), {})[name] = value
    return tuple(_piece(path, whole.get("license", ""), of[k]) for k in sorted(of))


def unpack_model(piece: CatalogueModel, folder: Path) -> Path:
    """Write a piece's model with what lies beside it into an empty folder; return the model's path."""
    home = PurePosixPath(piece.model).parent
    with zipfile.ZipFile(piece.library) as archive:
        for item in archive.infolist():  # by its bare name: no path of the archive leads anywhere else
            if PurePosixPath(item.filename).parent == home and not item.is_dir():
                (folder / PurePosixPath(item.filename).name).write_bytes(archive.read(item))
    return folder / PurePosixPath(piece.model).name


SELECTION = Path(__file__).with_name("selection.yaml")
MOST_FACES = 3000
MOST_LOST, MOST_OFF_M = 0.1, 0.04
"""What a model may lose of its area, and lie off, at that number."""
LEAN_FACES, LEAN_LOST, LEAN_OFF_M = (1200, 2000), 0.05, 0.02
"""Faces that do where no more than so much is lost."""
SOLID_M = 0.004
"""Error of the surface that is decomposed."""
TEXELS = 256
FOOT_SHARE = 0.03
"""Of the height: hulls that end within it above the base reach down to it."""
HULLS = DecomposeConfig()


@dataclasses.dataclass(frozen=True)
class Chosen:
    """A piece and what it is to be."""

    key: str
    """Keys of the piece and of what stands on it: `Scopia/desk+Scopia/lamp`."""
    pieces: tuple[CatalogueModel, ...]
    category: str
    split: str


def read_selection(pieces: Sequence[CatalogueModel], path: Path = SELECTION) -> tuple[Chosen, ...]:
    """Return those of the pieces that a selection names, by category."""
    named = {piece.key: piece for piece in pieces}
    data = Reader(ConfigError, "converters/library/selection.yaml shows the form").decoded(
        path.read_bytes(), "YAML", str(path)
    )
    chosen, splits = [], {}
    for category, of in data.items():
        if category not in CATEGORIES:
            raise ConfigError(f"{path}: category is '{category}', expected one of {', '.join(CATEGORIES)}")
        for split in sorted(of):
            for key in of[split]:
                keys = key.split("+")
                if not named.keys() >= set(keys):
                    raise ConfigError(f"{path}: {category}: no piece '{key}' in the libraries")
                chosen.append(Chosen(key, tuple(named[one] for one in keys), category, split))
                for creator in (one.creator for one in chosen[-1].pieces):
                    if splits.setdefault(creator, split) != split:
                        raise ConfigError(f"{path}: {key}: its creator {creator} has models in both splits")
    return tuple(chosen)


def as_catalogued(surface: TexturedMesh, piece: CatalogueModel) -> TexturedMesh:
    """Return the surface turned and scaled as its catalogue says, the middle of its base at the origin."""
    vertices, faces = geometry.compacted(surface.vertices, surface.faces)
    vertices = vertices @ piece.rotation.T
    low, span = vertices.min(axis=0), np.ptp(vertices, axis=0)
    vertices = (vertices - low - span * [0.5, 0.0, 0.5]) * (np.array(piece.size_m) / span)
    return dataclasses.replace(surface, vertices=vertices, faces=faces)


def _surface(piece: CatalogueModel) -> TexturedMesh:
    with tempfile.TemporaryDirectory(prefix="library-") as folder:
        path = unpack_model(piece, Path(folder))
        return as_catalogued(read_surface(SourceFolder(path.parent), path.name, ""), piece)


def on_top(surface: TexturedMesh, rider: TexturedMesh) -> TexturedMesh:
    """Join both: the rider on what is highest below its footprint, at the middle, its back near the other's."""
    span, rider_span = np.ptp(surface.vertices, axis=0), np.ptp(rider.vertices, axis=0)
    back = min(0.0, rider_span[2] / 2 + 0.03 - span[2] / 2)
    points, _ = geometry.sample_faces(surface.vertices, surface.faces, 0.02)
    below = (np.abs(points[:, [0, 2]] - [0.0, back]) < rider_span[[0, 2]] / 2).all(axis=1)
    top = float(points[below, 1].max()) if below.any() else float(span[1])
    return join_meshes(surface, dataclasses.replace(rider, vertices=rider.vertices + [0.0, top, back]))


def make_model(chosen: Chosen, cache: Path | None = None) -> tuple[Model, Shape]:
    """Build one model, ready to be packaged."""
    where = f"{chosen.pieces[0].library}: {chosen.pieces[0].model}"
    surface = functools.reduce(on_top, map(_surface, chosen.pieces))
    vertices, faces, keep = geometry.merge_vertices(surface.vertices, surface.faces)
    colours = colours_of_faces(surface)[keep]
    solid = geometry.simplify_within(vertices, faces, SOLID_M)
    result = decompose_all({chosen.key: solid}, HULLS, 1, cache or cache_folder(), strict=True)
    size_m = np.ptp(surface.vertices, axis=0)
    foot_m = FOOT_SHARE * size_m[1]
    solids = (hull.vertices for hull in result.hulls[chosen.key])
    hulls = tuple(convex_hull(np.vstack([v, v[v[:, 1] < foot_m] * [1.0, 0.0, 1.0]])) for v in solids)
    for most in (*LEAN_FACES, MOST_FACES):
        low = geometry.simplify_to(vertices, faces, most)
        kept, off_m = geometry.surface_loss(vertices, faces, *low)
        lost = 1 - kept
        if lost <= LEAN_LOST and off_m <= LEAN_OFF_M:
            break
    if lost > MOST_LOST or off_m > MOST_OFF_M:
        raise SceneRejected(
            f"{where}: loses {lost:.2f} of its surface or {off_m:.3f} m at {len(low[1])} faces; leave it out"
        )
    if len(low[1]) > 1.1 * MOST_FACES:
        raise SceneRejected(f"{where}: has {len(low[1])} faces when simplified, expected {MOST_FACES}; leave it out")
    spacing_m = max(float(size_m.max()) / TEXELS, 1e-3)
    visual, _ = bake_object(vertices, faces, colours, textured_cloud(surface, spacing_m), low, TEXELS)
    credits = []
    for of in chosen.pieces:
        by = re.search(r"Attribution 3.0( United States)?", text := of.licence)
        named = "CC0 1.0" if text == "Public domain" else f"CC BY 3.0{' US' if by[1] else ''}" if by else text
        credits.append(Credit(of.name, of.creator, named, of.key))
    sides = tuple(float(side) for side in np.round(size_m, 4))
    model = Model(chosen.key, chosen.category, chosen.split, sides, len(visual.faces), len(hulls), tuple(credits))
    return model, Shape(visual, hulls)


def build(
    files: Sequence[Path], target: Path, jobs: int, report: Callable[[str, float], None], selection: Path = SELECTION
) -> int:
    """Build `models.zip` and `ATTRIBUTION.md` from `.sh3f` libraries, whole or not at all; return how many models."""
    chosen = read_selection([piece for path in files for piece in read_catalogue(path)], selection)
    done: list[tuple[Model, Shape]] = []
    with concurrent.futures.ProcessPoolExecutor(jobs, multiprocessing.get_context("spawn")) as pool:
        running = [pool.submit(make_model, one) for one in chosen]
        try:
            for one, future in zip(chosen, running, strict=True):
                done.append(future.result())
                report(one.key, len(done) / len(chosen))
        except concurrent.futures.process.BrokenProcessPool:
            raise StageFailed(f"library: a process died, one of {jobs}; try again with fewer --jobs") from None
        finally:
            pool.shutdown(cancel_futures=True)
    with whole_file(target / "models.zip") as partial:
        write_library(partial, done)
    write_text(target / "ATTRIBUTION.md", attribution([model for model, _ in done]))
    return len(done)


def libraries_in(folder: Path) -> tuple[Path, ...]:
    """Return the `.sh3f` files in or below a folder, all of version `VERSION`."""
    paths = {path.stem: path for path in sorted(folder.rglob("*.sh3f"))}
    for name, digest in FILES.items():
        if name not in paths:
            raise FileError(f"{folder}: holds no {name}.sh3f; {REMEDY}")
        if hashlib.sha256(paths[name].read_bytes()).hexdigest() != digest:
            raise FileError(f"{paths[name]}: is not that of version {VERSION} (sha256 differs); {REMEDY}")
    return tuple(paths[name] for name in FILES)
