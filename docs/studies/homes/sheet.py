"""Draw homes from where most of them is visible to a person, one a row.

python -m docs.studies.homes.sheet GENERATED... DRAWN... -o sheet.png
"""

import argparse
from pathlib import Path

import mujoco
import numpy as np
from PIL import Image

from converters.check import pictures
from scenes_mjcf.look import spec_for_people
from scenes_mjcf.schema import load_maps

SHAPE = (360, 600)
"""Rows and columns of one view."""


def main() -> None:
    """Write the sheet."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("scenes", nargs="+", type=Path, help="scene folders")
    parser.add_argument("-o", "--output", type=Path, required=True)
    args = parser.parse_args()
    rows = []
    for folder in args.scenes:
        model = spec_for_people(folder).compile()
        data = mujoco.MjData(model)
        mujoco.mj_forward(model, data)
        about = model, data, pictures.world_surfaces(model, data), load_maps(folder), SHAPE
        rows.append(pictures.at_eye_height(*about))
    Image.fromarray(np.vstack(rows)).save(args.output)


if __name__ == "__main__":
    main()
