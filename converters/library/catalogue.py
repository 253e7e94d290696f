"""A Sweet Home 3D furniture library (`.sh3f`) in; its pieces with names, sizes and licence, and their models, out.

The file is a ZIP with `PluginFurnitureCatalog.properties` (Java's format: `name#3=Chair`, lengths in centimetres), OBJ
or other models with textures, and icons.
"""

import dataclasses
import math
import re
import zipfile
from pathlib import Path, PurePosixPath

import numpy as np

from converters.read.files import as_number
from converters.records.errors import SceneRejected

PROPERTIES = "PluginFurnitureCatalog.properties"
MOST_BYTES = 256 * 2**20
"""Of one model with its textures, unpacked."""
LARGEST_M = 50.0
_ESCAPE = re.compile(r"\\(?:u([0-9a-fA-F]{4})|(.))")


@dataclasses.dataclass(frozen=True)
class Piece:
    """One piece of furniture of a catalogue."""

    library: str
    """Name of the library's file, without its ending."""
    name: str
    """As people call it."""
    group: str
    """Category of the catalogue, such as Bedroom."""
    model: str
    """Path of the model in the archive."""
    size_m: tuple[float, float, float]
    """Width, height and depth: along x, y (up) and z (to the front) of the turned model."""
    rotation: np.ndarray
    """(3, 3) turns the model's own axes to those."""
    elevation_m: float
    """Of its base above the floor."""
    movable: bool
    door_or_window: bool
    creator: str

    @property
    def key(self) -> str:
        """Names it among all libraries, such as `Scopia/armchair1`."""
        return f"{self.library}/{PurePosixPath(self.model).stem}"


@dataclasses.dataclass(frozen=True)
class Catalogue:
    """A furniture library."""

    path: Path
    licence: str
    pieces: tuple[Piece, ...]


def parse_properties(data: bytes) -> dict[str, str]:
    """Key -> value of a Java properties file (ISO 8859-1, lines that go on, `\\uXXXX`)."""
    text = re.sub(r"\\\r?\n[ \t]*", "", data.decode("latin-1"))
    found = {}
    for line in text.splitlines():
        match = re.match(r"\s*([^\s#!=:][^\s=:]*)\s*[=:]?\s*(.*)", line)
        if match:
            found[match[1]] = _ESCAPE.sub(lambda m: chr(int(m[1], 16)) if m[1] else m[2], match[2])
    return found


def _number(of: dict[str, str], key: str, where: str, default: float | None = None) -> float:
    text = of.get(key)
    if text is None and default is not None:
        return default
    value = as_number(text)
    if not math.isfinite(value):
        raise SceneRejected(f"{where}: {key} is {text!r}, expected a number of centimetres; fetch the library again")
    return value


def _piece(library: str, of: dict[str, str], where: str, names: set[str]) -> Piece:
    model = of.get("model", "").lstrip("/")
    if model not in names:
        raise SceneRejected(f"{where}: its model '{model}' is not in the archive; fetch the library again")
    width, depth, height = (_number(of, key, where) / 100 for key in ("width", "depth", "height"))
    if not all(0 < side < LARGEST_M for side in (width, depth, height)):
        raise SceneRejected(
            f"{where}: is {100 * width:g} x {100 * depth:g} x {100 * height:g} cm, expected sides above 0 and below "
            f"{LARGEST_M:g} m"
        )
    words = of.get("modelRotation", "1 0 0 0 1 0 0 0 1").split()
    turn = np.array([_number({"modelRotation": w}, "modelRotation", where) for w in words])
    if turn.shape != (9,) or not np.allclose(turn.reshape(3, 3) @ turn.reshape(3, 3).T, np.eye(3), atol=1e-3):
        raise SceneRejected(f"{where}: modelRotation is {of['modelRotation']!r}, expected the 9 numbers of a rotation")
    return Piece(
        library,
        of.get("name", ""),
        of.get("category", ""),
        model,
        (width, height, depth),
        turn.reshape(3, 3),
        _number(of, "elevation", where, 0.0) / 100,
        of.get("movable", "true") == "true",
        of.get("doorOrWindow", "false") == "true",
        of.get("creator", ""),
    )


def read_catalogue(path: Path) -> Catalogue:
    """Reads the pieces of a `.sh3f` file."""
    try:
        with zipfile.ZipFile(path) as archive:
            names, data = set(archive.namelist()), archive.read(PROPERTIES)
    except (OSError, KeyError, zipfile.BadZipFile, EOFError, RuntimeError, NotImplementedError) as error:
        reason = "no such file" if isinstance(error, FileNotFoundError) else " ".join(str(error).split())
        raise SceneRejected(f"{path}: not readable as a furniture library ({reason}); fetch it again") from None
    of: dict[int, dict[str, str]] = {}
    whole = parse_properties(data)
    for key, value in whole.items():
        name, _, number = key.partition("#")
        if number.isdecimal() and len(number) < 9:
            of.setdefault(int(number), {})[name] = value
    pieces = [_piece(path.stem, of[k], f"{path}: piece {k} ({of[k].get('name', '')})", names) for k in sorted(of)]
    if not pieces:
        raise SceneRejected(f"{path}: {PROPERTIES} lists no piece; fetch the library again")
    return Catalogue(path, whole.get("license", ""), tuple(pieces))


def unpack_model(catalogue: Catalogue, piece: Piece, folder: Path) -> Path:
    """Writes a piece's model with what lies beside it into an empty folder.

    Returns:
        Path of the model.
    """
    home = PurePosixPath(piece.model).parent
    try:
        with zipfile.ZipFile(catalogue.path) as archive:
            inside = [i for i in archive.infolist() if PurePosixPath(i.filename).parent == home and not i.is_dir()]
            if sum(i.file_size for i in inside) > MOST_BYTES:
                raise SceneRejected(f"{catalogue.path}: {piece.model} unpacks to over {MOST_BYTES >> 20} MiB")
            for item in inside:  # by its bare name: no path of the archive leads anywhere else
                (folder / PurePosixPath(item.filename).name).write_bytes(archive.read(item))
    except (zipfile.BadZipFile, EOFError, RuntimeError, NotImplementedError) as error:
        reason = " ".join(str(error).split())
        raise SceneRejected(f"{catalogue.path}: {piece.model}: damaged ({reason}); fetch the library again") from None
    return folder / PurePosixPath(piece.model).name
