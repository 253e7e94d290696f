"""Scenes in; one picture of them out: what somebody sees from 1.5 m, two in a row, or each from the south.

python docs/studies/eye_height.py scenes_mjcf/furnished/furnished_00{0,2,3,4,5,7} -o docs/home-rooms.webp
python docs/studies/eye_height.py scenes_mjcf/cluttered/cluttered_010 -o docs/home-cluttered.webp --south
"""

from __future__ import annotations

import argparse
from pathlib import Path

import mujoco
import numpy as np
from PIL import Image

from converters.check.pictures import at_eye_height, from_the_south, world_surfaces
from scenes_mjcf.look import spec_for_people
from scenes_mjcf.schema import load_maps

SHAPE = (360, 600)
"""Rows and columns of one view."""
SOUTH_PX = 1200


def view(scene: Path, south: bool) -> np.ndarray:
    """(rows, columns, 3) uint8."""
    model = spec_for_people(scene).compile()
    data = mujoco.MjData(model)
    mujoco.mj_forward(model, data)
    surfaces, maps = world_surfaces(model, data), load_maps(scene)
    if south:
        points = np.vstack([s.vertices[:, :2] for s in surfaces.values()])
        return from_the_south(surfaces, maps, points.min(axis=0), points.max(axis=0), SOUTH_PX)
    return at_eye_height(model, data, surfaces, maps, SHAPE)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("scenes", nargs="+", type=Path)
    parser.add_argument("-o", "--output", type=Path, required=True)
    parser.add_argument("--south", action="store_true")
    arguments = parser.parse_args()
    views = [view(scene, arguments.south) for scene in arguments.scenes]
    if len(views) % 2 and not arguments.south:
        views.append(np.full_like(views[0], 255))
    rows = [views] if arguments.south else [views[k : k + 2] for k in range(0, len(views), 2)]
    picture = np.vstack([np.hstack(row) for row in rows]) if not arguments.south else np.vstack(views)
    Image.fromarray(picture).save(arguments.output, quality=72, optimize=True)


if __name__ == "__main__":
    main()
