"""Fetch Debian's package of furniture libraries, or a folder of them, as checked `.sh3f` files."""

import hashlib
import io
import shutil
import subprocess
import tarfile
import tempfile
from pathlib import Path

from converters.bodies.decompose import cache_folder
from interactive_nav_common.errors import FileError, readable
from interactive_nav_common.files import whole_folder

PACKAGE = "sweethome3d-furniture"
VERSION = "1.8"
FILES = {
    "BlendSwap-CC-0": "7ef093fe70cedbb160bdb532d86a84580459635e34130c16777f549eba1993dc",
    "BlendSwap-CC-BY": "29ae78937b4d5dbe93db74067817a984fa411f017b007fd666bc40368bdb0c83",
    "KatorLegaz": "f512443b5d3a6903497573095f971f44334b3165ab32182133051fa9487764a6",
    "Scopia": "b4505451b1e8ab339c101c0afddfef4e1a07b95aa8c821c61ec41487afd43850",
}
"""Library -> sha256 of its `.sh3f` in version 1.8; the package's fifth holds people."""
REMEDY = f"give the package with --from (on Debian: apt-get download {PACKAGE}), or a folder of its .sh3f files"


def library_folder() -> Path:
    """Return where fetched libraries lie."""
    return cache_folder().parent / "library" / f"sweethome3d-{VERSION}"


def fetch(given: Path | None, target: Path, overwrite: bool = False) -> tuple[Path, ...]:
    """Put the libraries into a folder, all or none, and return their paths.

    `given`: the Debian package, or a folder that holds the files somewhere; None: download the package.
    """
    with whole_folder(target, overwrite) as folder, tempfile.TemporaryDirectory(prefix="library-") as scratch:
        place = given or _downloaded(Path(scratch))
        libraries = _of_folder(place) if place.is_dir() else _of_package(place)
        for name, digest in FILES.items():
            data = libraries.get(name)
            if data is None:
                raise FileError(f"{place}: holds no {name}.sh3f; {REMEDY}")
            if hashlib.sha256(data).hexdigest() != digest:
                raise FileError(f"{place}: {name}.sh3f is not that of version {VERSION} (sha256 differs); {REMEDY}")
            (folder / f"{name}.sh3f").write_bytes(data)
    return tuple(target / f"{name}.sh3f" for name in FILES)


def _downloaded(folder: Path) -> Path:
    if shutil.which("apt-get") is None:
        raise FileError(f"{PACKAGE}: apt-get is not here to download it; {REMEDY}")
    done = subprocess.run(["apt-get", "-qq", "download", PACKAGE], cwd=folder, capture_output=True, text=True)
    packages = sorted(folder.glob("*.deb"))
    if done.returncode or not packages:
        last = (done.stderr.strip().splitlines() or ["no message"])[-1]
        raise FileError(f"{PACKAGE}: apt-get cannot download it ({last}); run apt-get update, or {REMEDY}")
    return packages[0]


def _of_folder(folder: Path) -> dict[str, bytes]:
    return {path.stem: path.read_bytes() for path in sorted(folder.rglob("*.sh3f")) if path.stem in FILES}


def _of_package(path: Path) -> dict[str, bytes]:
    """Return the libraries in a Debian package: an `ar` archive with a tar in it."""
    with readable(path, FileError, REMEDY, " as a Debian package"):
        data = path.read_bytes()
        at, tar = 8, b""
        while data.startswith(b"!<arch>\n") and at + 60 <= len(data):
            size = int(data[at + 48 : at + 58])
            if data[at : at + 16].startswith(b"data.tar"):
                tar = data[at + 60 : at + 60 + size]
            at += 60 + size + size % 2
        with tarfile.open(fileobj=io.BytesIO(tar)) as archive:
            inside = [m for m in archive.getmembers() if m.isfile() and m.name.endswith(".sh3f")]
            return {Path(m.name).stem: file.read() for m in inside if (file := archive.extractfile(m)) is not None}
