"""Command `library` of `python -m converters`, and what it prints; its words are in words.yaml."""

from __future__ import annotations

import argparse

from rich.console import Console

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


LIBRARY = {"get": _get, "build": _build, "list": _list}
"""Action -> what runs it."""
