"""Read a raw folder in any supported layout into a `RawScene`."""

import dataclasses
import functools
from collections.abc import Callable
from pathlib import Path
from typing import Any

from converters.read import annotations, gibson, meshes
from converters.read.datasets import scanned
from converters.read.homes import habitat, mjcf, sdf, sh3d
from converters.records.errors import SceneRejected
from converters.records.raw import RawScene

READERS = {
    "interactive-gibson": (
        lambda root: (root / gibson.CLEANED).is_file() and any(root.glob(f"{gibson.PREFIX}*.urdf")),
        gibson.read_interactive_gibson,
    ),
    "gibson": (lambda root: (root / gibson.MESH).is_file(), gibson.read_gibson),
    "scan2cad": (lambda root: (root / annotations.ANNOTATION).is_file(), annotations.read_scan2cad),
    "sdf": (sdf.worlds_of, sdf.read_sdf),
    "habitat": (habitat.scenes_of, habitat.read_habitat),
    "mjcf": (mjcf.mains_of, mjcf.read_mjcf),
    "sh3d": (lambda root: len(list(root.glob(f"*{sh3d.ENDING}"))) == 1, sh3d.read_sh3d),
    **{
        name: (lambda root, mark=of.marks[0]: any(root.glob(mark)), functools.partial(scanned.read_scan, name))
        for name, of in scanned.COLLECTIONS.items()
    },
}
"""Layout -> what of a folder shows it, if anything does; its reader."""
FILES = {
    (".world", ".sdf"): (sdf.root_of, sdf.read_sdf),
    (habitat.SCENE,): (habitat.root_of, habitat.read_habitat),
    (".xml",): (lambda path: path.resolve().parent, mjcf.read_mjcf),
    (sh3d.ENDING, f"{sh3d.ENDING}.zip"): (lambda path: path.resolve().parent, sh3d.read_sh3d),
}
"""Ending of a file that says which home of a folder is meant -> its folder, its reader."""
WITHIN = (sdf.read_sdf, mjcf.read_mjcf)
"""Readers of homes that may name files outside of their own folder."""


def detect_format(source: Path) -> str:
    """Name of the layout that the folder has."""
    for name, (shows, _) in READERS.items():
        if source.is_dir() and shows(source):
            return name
    if not source.exists():
        raise SceneRejected(f"{source}: no such file or folder; give the raw scene")
    raise SceneRejected(
        f"{source}: no known layout; expected {gibson.MESH} (gibson), {gibson.CLEANED} with furniture URDFs "
        f"(interactive-gibson), {annotations.ANNOTATION} (scan2cad), worlds/*.world (sdf), "
        f"*{habitat.SCENE} (habitat), scene.xml (mjcf) or *{sh3d.ENDING} (sh3d) in it, "
        f"or one scene of {', '.join(scanned.COLLECTIONS)}"
    )


def root_of(source: Path) -> Path:
    """Return the folder that names of a source's files are relative to."""
    if source.is_dir():
        return source
    of_home = (root for endings, (root, _) in FILES.items() if source.name.lower().endswith(endings))
    return next(of_home, lambda path: path.parent)(source)


def read_source(
    source: Path, layout: str = "auto", strict: bool = False, up: str = "auto", unit: str = "auto",
    within: Path | None = None, mirror: bool = False,
) -> RawScene:  # fmt: skip
    """Read a raw folder in the given layout, or in the one that its files show; or a file of a home, or a mesh."""
    about_mesh = (up, unit, mirror) != ("auto", "auto", False)
    chosen = READERS[layout][1] if layout != "auto" else None
    if source.is_file() and (chosen is None or chosen in [read for _, read in FILES.values()]):
        for endings, (root_of, read) in FILES.items():
            if (source.name.lower().endswith(endings) if chosen is None else read is chosen) and not about_mesh:
                raw = _read(read, root_of(source), strict, source, within=within)
                return dataclasses.replace(raw, name=source.name.partition(".")[0])
        if source.suffix.lower() not in meshes.SUFFIXES:
            homes = ", ".join(ending for endings in FILES for ending in endings)
            raise SceneRejected(
                f"{source}: is no mesh file; expected one of {', '.join(meshes.SUFFIXES)}, of a home's ({homes}), or a "
                "folder"
            )
        return _read(meshes.read_single_mesh, source, strict, up, unit, mirror, within=within)
    if about_mesh:
        raise SceneRejected(f"{source}: --up, --unit and --mirror are for a single mesh file; leave them out")
    return _read(READERS[layout if layout != "auto" else detect_format(source)][1], source, strict, within=within)


def _read(read: Callable[..., RawScene], *words: Any, within: Path | None) -> RawScene:
    if within is None:
        return read(*words)
    if read not in WITHIN:
        raise SceneRejected(f"--root {within}: is for MJCF and Gazebo homes; leave it out, {words[0]} is none")
    return read(*words, within=within)
