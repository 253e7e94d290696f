"""Draw a scene folder into one PNG: two views, and panels of its objects and collision shapes from above."""

import dataclasses
import math
from collections.abc import Iterable
from pathlib import Path

import matplotlib

matplotlib.use("Agg")
import matplotlib.pyplot as plt
import mujoco
import numpy as np
from matplotlib.axes import Axes
from matplotlib.collections import PolyCollection
from matplotlib.figure import Figure
from matplotlib.patches import Patch
from PIL import Image

from converters.check import pictures
from converters.check.pictures import geom_outline
from converters.read.obj import in_colour
from converters.records.raw import TexturedMesh
from interactive_nav_common.files import whole_file
from scenes_mjcf.categories import CATEGORIES
from scenes_mjcf.look import over, spec_for_people
from scenes_mjcf.schema import SceneError, SceneManifest, SceneMaps, load_manifest, load_maps

LEGEND_ENTRY_IN, LEGEND_LINE_IN = 1.25, 0.19
"""Inches that an entry of the legend takes across and down."""
LETTER_IN = 0.05
"""Width of a letter of an object's label, 6 points high."""
MARGIN_M = 0.3
"""Empty border around the map."""
SURFACE_PIXELS = 480
"""Longer side of a surface's picture; a panel is about as large on the page."""
COLUMNS, PANEL_IN, LEAST_WIDTH_IN = 3, 3.3, 9.0
"""Panels beside each other, how high one is, and the page's least width."""
SLANTWISE = 0.62
"""Of the page's width, the view from the south; that at eye height stands beside it."""
DPI, COLOURS = 100, 192
TRAVERSABLE = (0.85, 0.94, 0.85)
WALL = (0.75, 0.75, 0.75)


def _geoms(model: mujoco.MjModel) -> list[tuple[str, str, int]]:
    """Return (geom name, body name, geom id) of every geom."""
    return [(model.geom(g).name, model.body(model.geom_bodyid[g]).name, g) for g in range(model.ngeom)]


@dataclasses.dataclass(frozen=True)
class _Scene:
    """A scene at rest, ready to draw."""

    model: mujoco.MjModel
    data: mujoco.MjData
    manifest: SceneManifest
    maps: SceneMaps
    surfaces: dict[str, TexturedMesh]
    """What is drawn, by body, in the world."""


def _frame(axes: Axes, scene: _Scene, title: str) -> None:
    left, right, bottom, top = scene.maps.extent_w
    axes.set(xlim=(left - MARGIN_M, right + MARGIN_M), ylim=(bottom - 0.5, top + MARGIN_M), aspect="equal")
    axes.set_title(title, fontsize=10)
    axes.axis("off")
    axes.plot([left, left + 1.0], [bottom - 0.3] * 2, color="black", linewidth=3, solid_capstyle="butt")
    axes.text(left + 0.5, bottom - 0.27, "1 m", ha="center", va="bottom", fontsize=8)


def _draw_from_above(axes: Axes, scene: _Scene, meshes: Iterable[TexturedMesh], title: str) -> None:
    left, right, bottom, top = scene.maps.extent_w
    low, high = np.array([left, bottom]) - MARGIN_M, np.array([right, top]) + MARGIN_M
    pixel_m = float((high - low).max()) / SURFACE_PIXELS
    picture = pictures.Picture(*over(np.eye(3), low, high, pixel_m))
    for mesh in meshes:
        picture.draw(mesh)
    rows, columns = picture.image.shape[:2]
    extent = (low[0], low[0] + columns * pixel_m, low[1], low[1] + rows * pixel_m)
    clear = 255 * (picture.image < 255).any(axis=2, keepdims=True).astype(np.uint8)
    axes.imshow(np.dstack([picture.image, clear]), extent=extent, interpolation="nearest")
    _frame(axes, scene, title)


def _draw_views(slantwise: Axes, standing: Axes, scene: _Scene, width_in: float) -> None:
    """Draw everything at rest, viewed from the south and by somebody who stands there."""
    left, right, bottom, top = scene.maps.extent_w
    low, high = np.array([left, bottom]) - MARGIN_M, np.array([right, top]) + MARGIN_M
    wide = int(SLANTWISE * width_in * DPI)
    slantwise.imshow(pictures.from_the_south(scene.surfaces, scene.maps, low, high, wide), interpolation="nearest")
    slantwise.set_title(f"furnished, from the south; walls cut at {pictures.CUT_M:g} m", fontsize=10)
    wide = int((1 - SLANTWISE) * width_in * DPI)
    eye = pictures.at_eye_height(scene.model, scene.data, scene.surfaces, scene.maps, (int(0.75 * wide), wide))
    standing.imshow(eye, interpolation="nearest")
    standing.set_title(
        f"from {pictures.EYE_M:g} m, {math.degrees(pictures.EYE_VIEW_RAD):.0f} degrees wide", fontsize=10
    )
    for axes in (slantwise, standing):
        axes.axis("off")


def _draw_ground(axes: Axes, scene: _Scene) -> None:
    """Draw traversable area and wall boxes."""
    shade = np.where(scene.maps.traversable[..., None], TRAVERSABLE, 1.0)
    axes.imshow(shade, origin="lower", extent=scene.maps.extent_w, interpolation="nearest")
    for name, _, geom in _geoms(scene.model):
        if name.startswith("wall_"):
            outline = geom_outline(scene.model, scene.data, geom)
            axes.fill(*outline.T, facecolor=WALL, edgecolor="0.45", linewidth=0.4)


def apart(centres: np.ndarray, sizes: np.ndarray) -> np.ndarray:
    """Return label centres [N, 2], moved vertically until no two overlap; `sizes` [N, 2] are width, height."""
    placed = centres.astype(float)
    for i, (x, y) in enumerate(centres):
        beside = np.abs(placed[:i, 0] - x) < (sizes[:i, 0] + sizes[i, 0]) / 2
        ys, apart_by = placed[:i, 1][beside], (sizes[:i, 1][beside] + sizes[i, 1]) / 2
        tried = np.array([y, *(ys + apart_by), *(ys - apart_by)])
        free = (np.abs(tried[:, None] - ys) >= apart_by - 1e-9).all(axis=1)
        placed[i, 1] = min(tried[free], key=lambda at: abs(at - y))
    return placed


def _draw_objects(axes: Axes, scene: _Scene) -> None:
    """Draw each movable object's CAD surface in its category's colour, lit from above, with its name."""
    _draw_ground(axes, scene)
    colours = {o.name: np.array(CATEGORIES[o.category].preview_colour) for o in scene.manifest.objects}
    meshes = [in_colour(scene.surfaces[name], colour) for name, colour in colours.items()]
    area = f"{scene.manifest.floor_area_m2:.1f} m² traversable"
    _draw_from_above(axes, scene, meshes, f"{len(meshes)} objects, {area}")
    names = list(colours)
    metre_in = PANEL_IN / (scene.maps.extent_w[3] - scene.maps.extent_w[2] + 0.5 + MARGIN_M)
    sizes = np.array([(LETTER_IN * len(name) + 0.03, 2.2 * LETTER_IN) for name in names]).reshape(-1, 2) / metre_in
    centres = np.array([scene.data.body(name).xipos[:2] for name in names]).reshape(-1, 2)
    for name, (x, y) in zip(names, apart(centres, sizes), strict=True):
        box = {"boxstyle": "round,pad=0.1", "facecolor": "white", "alpha": 0.75, "linewidth": 0}
        axes.text(x, y, name, ha="center", va="center", fontsize=6, bbox=box)


def _draw_collision(axes: Axes, scene: _Scene, kind: str) -> None:
    """Draw outlines of one kind of collision shape, 'hull' or 'box', in the category's colour."""
    _draw_ground(axes, scene)
    category = {o.name: o.category for o in scene.manifest.objects}
    outlines, colours = [], []
    for name, body, geom in _geoms(scene.model):
        if body in category and name.startswith(f"{body}_{kind}_"):
            colours.append(CATEGORIES[category[body]].preview_colour)
            outlines.append(geom_outline(scene.model, scene.data, geom))
    inner = [(*colour, 0.30) for colour in colours]
    axes.add_collection(PolyCollection(outlines, facecolors=inner, edgecolors=colours, linewidths=0.6))
    count = len(outlines)
    walls = sum(name.startswith("wall_") for name, _, _ in _geoms(scene.model))
    title = f"{count} hulls" if kind == "hull" else f"{count} boxes of objects, {walls} of walls"
    _frame(axes, scene, title)


def draw(scene: _Scene) -> Figure:
    """Draw two views, and panels of the objects, their hulls and their boxes."""
    left, right, bottom, top = scene.maps.extent_w
    ratio = (right - left + 2 * MARGIN_M) / (top - bottom + 0.5 + MARGIN_M)
    width = max(COLUMNS * PANEL_IN * ratio, LEAST_WIDTH_IN)
    tall = width * SLANTWISE * (0.8 / ratio + 0.12) + 0.3  # of the view from the south
    panel = width / COLUMNS / ratio + 0.3
    figure = plt.figure(figsize=(width, tall + panel + 0.7), dpi=DPI)
    places = figure.add_gridspec(2, COLUMNS, height_ratios=(tall, panel))
    top_row = places[0, :].subgridspec(1, 2, width_ratios=(SLANTWISE, 1 - SLANTWISE))
    slantwise, standing = figure.add_subplot(top_row[0]), figure.add_subplot(top_row[1])
    _draw_views(slantwise, standing, scene, width)

    objects, hulls, boxes = (figure.add_subplot(places[1, column]) for column in range(COLUMNS))
    _draw_objects(objects, scene)
    _draw_collision(hulls, scene, "hull")
    _draw_collision(boxes, scene, "box")

    shown = sorted({o.category for o in scene.manifest.objects})
    handles = [Patch(facecolor=CATEGORIES[c].preview_colour, label=c) for c in shown]
    handles += [Patch(facecolor=TRAVERSABLE, label="traversable"), Patch(facecolor=WALL, label="wall")]
    across = min(len(handles), int(width / LEGEND_ENTRY_IN))
    figure.legend(handles=handles, loc="lower center", fontsize=8, ncols=across, frameon=False)
    figure.suptitle(f"{scene.manifest.name} ({scene.manifest.split})", fontsize=11)
    lines = math.ceil(len(handles) / across)
    figure.tight_layout(rect=(0, 0.01 + LEGEND_LINE_IN * lines / figure.get_figheight(), 1, 0.985))
    return figure


def preview(folder: Path, target: Path) -> None:
    """Draw a scene folder into a PNG, atomically."""
    manifest, maps = load_manifest(folder), load_maps(folder)
    try:
        model = spec_for_people(folder).compile()
    except ValueError as error:
        raise SceneError(f"{folder / 'scene.xml'}: does not compile ({error}); convert the scene again") from error
    for item in manifest.objects:
        if mujoco.mj_name2id(model, mujoco.mjtObj.mjOBJ_BODY, item.name) < 0:
            raise SceneError(
                f"{folder / 'scene.xml'}: no body named '{item.name}', which scene.json lists; convert the scene again"
            )
    data = mujoco.MjData(model)
    mujoco.mj_forward(model, data)
    figure = draw(_Scene(model, data, manifest, maps, pictures.world_surfaces(model, data)))
    with whole_file(target) as picture:
        figure.savefig(picture, format="png", metadata={"Software": None})
        with Image.open(picture) as image:
            small = image.convert("RGB").quantize(
                COLOURS, method=Image.Quantize.MAXCOVERAGE, kmeans=1, dither=Image.Dither.NONE
            )
            small.save(picture, "PNG", compress_level=7)
    plt.close(figure)
