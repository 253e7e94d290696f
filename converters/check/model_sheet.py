"""Names of CAD models in, one picture of them out: each from the front, the right and above, with name and size."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

import numpy as np
from PIL import Image, ImageDraw

from converters.generate.models.cad import LIBRARY, cad_model
from converters.generate.models.parts import MATERIALS
from converters.read.obj import texels
from interactive_nav_common.errors import UserError
from interactive_nav_common.files import whole_file

PIXELS = 200
"""Side of a model's picture."""
LABEL_PIXELS = 30
COLUMNS = 8
AZIMUTH_RAD, ELEVATION_RAD = 0.6, 0.42
"""Where the reader stands: to the right of the front, and above."""
LAMP = np.array([-0.45, 0.6, 0.66])
"""Towards the lamp: right, up, towards the reader."""


def camera_axes() -> np.ndarray:
    """Rows: what runs to the right, what runs up, what looks at the reader; the model faces +z, y is up."""
    (sin_a, cos_a), (sin_e, cos_e) = [(np.sin(a), np.cos(a)) for a in (AZIMUTH_RAD, ELEVATION_RAD)]
    toward = np.array([sin_a * cos_e, sin_e, cos_a * cos_e])
    right = np.array([cos_a, 0.0, -sin_a])
    return np.stack([right, np.cross(toward, right), toward])


def model_picture(name: str, pixels: int = PIXELS) -> np.ndarray:
    """(pixels, pixels, 3) uint8 picture of a model, in the colours of its materials or texture, on white.

    Args:
        name: key of `LIBRARY`.
        pixels: side of the picture.
    """
    model = cad_model(name)
    axes = camera_axes() * [model.front, 1, model.front]
    if model.surface is None:
        turned = [part.vertices @ axes.T for part in model.parts]
        drawn = [
            (v[p.faces], [np.array(MATERIALS[p.material])] * len(p.faces))
            for v, p in zip(turned, model.parts, strict=True)
        ]
    else:
        turned = [model.surface.vertices @ axes.T]
        colours = texels(model.surface.image, model.surface.uv[model.surface.uv_faces].mean(axis=1)) / 255
        drawn = [(turned[0][model.surface.faces], colours)]
    low, high = np.concatenate(turned).min(axis=0), np.concatenate(turned).max(axis=0)
    pixel = float((high - low)[:2].max()) / (0.94 * pixels)
    corner = (low[:2] + high[:2] - pixels * pixel) / 2
    image, depth = np.ones((pixels, pixels, 3)), np.full((pixels, pixels), -np.inf)
    for triangles, colours in drawn:
        for triangle, colour in zip(triangles, colours, strict=True):
            _draw_triangle(image, depth, (triangle - [*corner, 0.0]) / pixel, colour)
    return (255 * image[::-1]).astype(np.uint8)


def _draw_triangle(image: np.ndarray, depth: np.ndarray, corners: np.ndarray, colour: np.ndarray) -> None:
    """Draws a triangle, its corners in pixels (right, up, towards the reader), where nothing is before it."""
    normal = np.cross(corners[1] - corners[0], corners[2] - corners[0])
    if normal[2] <= 1e-9:
        return  # seen from behind
    x0, y0 = np.maximum(np.floor(corners[:, :2].min(axis=0)).astype(int), 0)
    x1, y1 = np.minimum(np.ceil(corners[:, :2].max(axis=0)).astype(int), len(image))
    x, y = np.meshgrid(np.arange(x0, x1) + 0.5, np.arange(y0, y1) + 0.5)
    inside = np.ones(x.shape, bool)
    for k in range(3):
        (ax, ay, _), (bx, by, _) = corners[k], corners[(k + 1) % 3]
        inside &= (bx - ax) * (y - ay) - (by - ay) * (x - ax) >= -1e-9
    near = corners[0, 2] - ((x - corners[0, 0]) * normal[0] + (y - corners[0, 1]) * normal[1]) / normal[2]
    shown = inside & (near > depth[y0:y1, x0:x1])
    depth[y0:y1, x0:x1][shown] = near[shown]
    light = 0.42 + 0.58 * max(float(normal @ LAMP / np.linalg.norm(normal)), 0.0)
    image[y0:y1, x0:x1][shown] = light * colour


def model_sheet(target: Path, names: Sequence[str] = ()) -> int:
    """Draws models into a PNG, whole or not at all.

    Args:
        target: the PNG.
        names: of models or categories; empty: all models.

    Returns:
        How many models there are on it.

    Raises:
        UserError: neither a model nor a category has such a name.
        FileError: it cannot be written.
    """
    unknown = [n for n in names if n not in LIBRARY and n not in {d.category for d in LIBRARY.values()}]
    if unknown:
        known = ", ".join(sorted({d.category for d in LIBRARY.values()}))
        raise UserError(f"no model or category named {', '.join(unknown)}; categories: {known}")
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
