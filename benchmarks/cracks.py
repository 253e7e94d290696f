"""How well the filled patches of a scan join it.

    python -m benchmarks.cracks ../shared/data/scan2cad_scene0470_00

Converts up to the fill, and prints for each plane (0 the floor, then the walls) the length of its patches' border, how
much of it no other face joins, and how much of that runs within 2 cm and 10 cm of other open border: a crack. The
rest is the rim of a patch where nothing was scanned. Hulls come from the converter's cache where they are there.
"""

from __future__ import annotations

import argparse
from pathlib import Path

import numpy as np

from converters.bodies.decompose import DOOR_OVERRIDES, DecomposeConfig, cache_folder, decompose_all
from converters.bodies.objects import name_objects, place_object
from converters.fill.holes import hidden_surfaces
from converters.fill.join import OpenBorder, open_border
from converters.fill.patches import Filled, fill_planes, wall_planes
from converters.geometry.boxes import Hull
from converters.pipeline import align_objects
from converters.propose.report import floor_of
from converters.read.source import read_source
from converters.structure.cut import cut_furniture
from converters.structure.floor import level_floor
from converters.structure.maps import main_direction, make_floor_plan

NARROW_M, WIDE_M = 0.02, 0.10


def fill(source: Path, cache: Path | None = None) -> Filled:
    """A raw folder of one floor, converted up to the filled structure.

    Args:
        source: the folder.
        cache: of hulls; None: the converter's own.
    """
    raw = read_source(source)
    placements, _ = align_objects(raw)
    height = floor_of(raw)
    vertices = raw.scan.vertices - [0.0, 0.0, height]
    yaw = main_direction(vertices, raw.scan.faces, raw.scan.labels)
    todo = {k: c for k, c in sorted(raw.cads.items()) if c.pieces is None}
    doors = {k: DOOR_OVERRIDES for k, c in todo.items() if c.category == "door"}
    meshes = {k: (c.vertices, c.faces) for k, c in todo.items()}
    hulls = decompose_all(meshes, DecomposeConfig(), 2, cache or cache_folder(), lambda share: None, doors, False).hulls
    hulls |= {k: tuple(Hull(*p) for p in c.pieces) for k, c in raw.cads.items() if c.pieces is not None}
    objects = tuple(
        place_object(name, a, raw.cads[a.cad_id], hulls[a.cad_id], pose, height, yaw)
        for name, a, pose in zip(name_objects(raw.annotations), raw.annotations, placements, strict=True)
    )
    faces = raw.scan.faces[cut_furniture(vertices, raw.scan.faces, raw.scan.labels, objects).keep]
    plan = make_floor_plan(vertices, faces, raw.scan.labels, objects, raw.given_map, yaw)
    level = level_floor(vertices, raw.scan.faces, raw.scan.labels)
    planes = wall_planes(level, faces, raw.scan.labels)
    return fill_planes(level, faces, hidden_surfaces(plan, planes, level, faces, objects))


def measure(filled: Filled) -> tuple[dict[int, OpenBorder], dict[int, OpenBorder]]:
    """Open border by plane, cracks counted to `NARROW_M` and to `WIDE_M`."""
    narrow, wide = (open_border(filled.vertices, filled.faces, filled.patch_plane, r) for r in (NARROW_M, WIDE_M))
    return narrow, wide


def main() -> None:
    """Prints the table."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("source", type=Path)
    narrow, wide = measure(fill(parser.parse_args().source))
    rows = [[narrow[k].border_m, narrow[k].open_m, narrow[k].crack_m, wide[k].crack_m] for k in narrow]
    print("plane  border m   open m  crack 2 cm  crack 10 cm")
    for name, row in [*zip(narrow, rows, strict=True), ("sum", np.sum(rows, axis=0))]:
        print(f"{name!s:<5} {row[0]:>9.2f} {row[1]:>8.2f} {row[2]:>11.2f} {row[3]:>12.2f}")


if __name__ == "__main__":
    main()
