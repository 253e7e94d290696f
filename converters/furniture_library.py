"""Command `library` of `python -m converters`: its words, and what they print."""

from __future__ import annotations

import argparse
import os
from pathlib import Path

from rich.console import Console

from converters.generating import Commands, positive
from interactive_nav_common.errors import FileError
from interactive_nav_common.progress import stage_progress


def _get(arguments: argparse.Namespace, console: Console) -> int:
    from converters.library.fetch import fetch, library_folder

    target = arguments.out or library_folder()
    files = fetch(arguments.given, target, arguments.overwrite)
    console.print(f"{target}: {len(files)} furniture libraries, checked by digest", soft_wrap=True)
    return 0


def _build(arguments: argparse.Namespace, console: Console) -> int:
    from converters.library.build import build
    from converters.library.fetch import FILES, library_folder

    given = arguments.given or library_folder()
    files = [given / f"{name}.sh3f" for name in FILES]
    if not all(path.is_file() for path in files):
        raise FileError(f"{given}: lacks furniture libraries; run 'python -m converters library get sweethome3d' first")
    with stage_progress(console) as report:
        count = build(files, arguments.out, arguments.jobs, report)
    console.print(f"{arguments.out}: {count} models with their hulls, and ATTRIBUTION.md", soft_wrap=True)
    return 0


def _list(arguments: argparse.Namespace, console: Console) -> int:
    from converters.library.store import read_index

    for model in read_index().values():
        width, height, depth = model.size_m
        print(
            f"{model.name:<40} {model.category:<15} {model.split:<6} {width:.2f} x {depth:.2f} x {height:.2f} m "
            f"{model.faces:>5} faces {model.hulls:>3} hulls  "
            + "; ".join(f"{c.creator}, {c.licence}" for c in model.credits)
        )
    return 0


def add_library(commands: Commands) -> None:
    """Words of `library`."""
    command = commands.add_parser("library", help="furniture that people modelled: fetch it, package it, list it")
    actions = command.add_subparsers(required=True, metavar="ACTION")
    get = actions.add_parser("get", help="fetch the furniture libraries of Sweet Home 3D")
    get.add_argument("name", choices=("sweethome3d",))
    get.add_argument("--from", dest="given", type=Path, metavar="FILE.deb|DIR", help="default: apt-get downloads it")
    get.add_argument("-o", "--out", type=Path, metavar="DIR", help="default: the cache folder")
    get.add_argument("--overwrite", action="store_true", help="replace what was fetched before")
    get.set_defaults(run=_get, writes=("{}",))
    build = actions.add_parser("build", help="make the packaged selection again: models.zip and ATTRIBUTION.md")
    build.add_argument("out", type=Path, metavar="OUT", help="folder that takes both files")
    build.add_argument("--from", dest="given", type=Path, metavar="DIR", help="of the .sh3f files; default: as fetched")
    build.add_argument("--jobs", type=positive, default=os.cpu_count() or 1, metavar="N", help="models side by side")
    build.set_defaults(run=_build, writes=("{}/*",))
    actions.add_parser("list", help="the packaged models, with size and credit").set_defaults(run=_list, writes=())
