"""Draw CAD models in one picture: each from the front, the right and above, with name and size."""

from collections.abc import Sequence
from pathlib import Path

import numpy as np
from PIL import Image, ImageDraw

from converters.check.render import Picture
from converters.generate.models.cad import LIBRARY, cad_model
from converters.generate.models.parts import MATERIALS
from converters.read.meshes import textured_by_face
from converters.read.obj import join_meshes
from converters.records.visual import TexturedMesh
from interactive_nav_common.errors import UserError
from interactive_nav_common.files import whole_file
from scenes_mjcf.look import over

PIXELS = 200
"""Side of a model's picture."""
LABEL_PIXELS = 30
COLUMNS = 8
AZIMUTH_RAD, ELEVATION_RAD = 0.6, 0.42
"""Where the reader stands: to the right of the front, and above."""


def camera_axes() -> np.ndarray:
    """Return rows that point right, up and at the reader; the model faces +z, y is up."""
    (sin_a, cos_a), (sin_e, cos_e) = [(np.sin(a), np.cos(a)) for a in (AZIMUTH_RAD, ELEVATION_RAD)]
    toward = np.array([sin_a * cos_e, sin_e, cos_a * cos_e])
    right = np.array([cos_a, 0.0, -sin_a])
    return np.stack([right, np.cross(toward, right), toward])


def model_picture(name: str, pixels: int = PIXELS) -> np.ndarray:
    """Draw a (pixels, pixels, 3) uint8 picture of a model, in the colours of its materials or texture, on white."""
    model = cad_model(name)
    if (surface := model.surface) is not None:
        mesh = TexturedMesh(surface.vertices, surface.faces, surface.uv[surface.uv_faces], surface.image)
    else:
        colours = [np.tile(np.rint(255 * np.array(MATERIALS[p.material])), (len(p.faces), 1)) for p in model.parts]
        parts = zip(model.parts, colours, strict=True)
        mesh = join_meshes(*(textured_by_face(p.vertices, p.faces, colour) for p, colour in parts))
    return mesh_picture(mesh, camera_axes() * [model.front, 1, model.front], pixels, one_sided=True)


def mesh_picture(mesh: TexturedMesh, axes: np.ndarray, pixels: int, one_sided: bool = False) -> np.ndarray:
    """Draw a (pixels, pixels, 3) uint8 picture of a whole mesh on white, along axes such as `camera_axes`'."""
    turned = mesh.vertices @ axes.T
    half, middle = np.ptp(turned, axis=0)[:2].max() / 2 / 0.94, (turned.min(axis=0) + turned.max(axis=0)) / 2
    picture = Picture(*over(axes, middle - half, middle + half, 2 * half / pixels))
    picture.draw(mesh, one_sided)
    return picture.image


def model_sheet(target: Path, names: Sequence[str] = ()) -> int:
    """Draw models into a PNG, whole or not at all.

    Returns:
        How many models there are on it.
    """
    unknown = [n for n in names if n not in LIBRARY and n not in {d.category for d in LIBRARY.values()}]
    if unknown:
        categories = ", ".join(sorted({d.category for d in LIBRARY.values()}))
        raise UserError(f"no model or category named {', '.join(unknown)}; categories: {categories}")
    wanted = [n for n, d in LIBRARY.items() if not names or n in names or d.category in names]
    wanted.sort(key=lambda name: LIBRARY[name].category)
    rows = -(-len(wanted) // COLUMNS)
    columns = min(COLUMNS, len(wanted))
    sheet = Image.new("RGB", (columns * PIXELS, rows * (PIXELS + LABEL_PIXELS)), "white")
    draw = ImageDraw.Draw(sheet)
    for k, name in enumerate(wanted):
        x, y = k % COLUMNS * PIXELS, k // COLUMNS * (PIXELS + LABEL_PIXELS)
        sheet.paste(Image.fromarray(model_picture(name)), (x, y))
        size = " x ".join(f"{v:.2f}" for v in 2 * cad_model(name).half_extents * cad_model(name).unit_m)
        draw.text((x + 4, y + PIXELS + 2), name, fill="black", font_size=12)
        draw.text((x + 4, y + PIXELS + 15), f"{size} m", fill="grey", font_size=11)
    with whole_file(target) as partial:
        sheet.save(partial, format="PNG", optimize=True)
    return len(wanted)
