"""Draw a single object's folder as a figure from above, from the front and from the side."""

import dataclasses
from pathlib import Path

import matplotlib.pyplot as plt
import mujoco
import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from scipy.spatial import ConvexHull

from converters.check.render import Picture
from converters.check.surfaces import geom_surface
from interactive_nav_common.files import check_name
from scenes_mjcf.look import over
from scenes_mjcf.schema import SCENES, SceneError

VIEWS = {
    "from above": np.eye(3),
    "from the front": np.array([[1.0, 0.0, 0.0], [0.0, 0.0, 1.0], [0.0, -1.0, 0.0]]),
    "from the side": np.array([[0.0, 1.0, 0.0], [0.0, 0.0, 1.0], [1.0, 0.0, 0.0]]),
}
"""Rows: what runs to the right, what runs up, and what looks at the reader."""
PIXELS = 260
"""Longer side of a picture of the surface; a panel is about as large on the page."""


@dataclasses.dataclass(frozen=True)
class _About:
    """What is read of object.json."""

    name: str
    category: str
    mass_kg: float


def draw_object(folder: Path) -> Figure:
    """Draw the textured surface, and the hulls and boxes that collide, as the object stands at rest."""
    described = folder / "object.json"
    about = SCENES.record(SCENES.json(described), _About, str(described), others=True)
    name = check_name(about.name, f"{described}: name", SceneError)
    try:
        model = mujoco.MjModel.from_xml_path(str(folder / "object.xml"))
        body = model.body(name).id
    except (OSError, KeyError, ValueError) as error:
        raise SceneError(f"{folder}: is no readable object ({error}); convert it again") from error
    data = mujoco.MjData(model)
    mujoco.mj_forward(model, data)
    turn, origin = data.xmat[body].reshape(3, 3), data.xpos[body]
    surface_b = geom_surface(model, model.geom(f"{name}_visual").id)
    size_m = float(np.ptp(surface_b.vertices, axis=0).max())
    surface_w = dataclasses.replace(surface_b, vertices=surface_b.vertices @ turn.T + origin)
    figure, grid = plt.subplots(2, 3, figsize=(10.5, 7.4), dpi=100)
    for (title, axes_w), (surface, solid) in zip(VIEWS.items(), grid.T, strict=True):
        points = surface_w.vertices @ axes_w[:2].T
        low, high = points.min(axis=0) - 0.1 * size_m, points.max(axis=0) + 0.1 * size_m
        pixel_m = float((high - low).max()) / PIXELS
        picture = Picture(*over(axes_w, low, high, pixel_m))
        picture.draw(surface_w)
        rows, columns = picture.image.shape[:2]
        extent = (low[0], low[0] + columns * pixel_m, low[1], low[1] + rows * pixel_m)
        surface.imshow(picture.image, extent=extent, interpolation="nearest")
        _draw_solids(solid, model, data, body, axes_w)
        for axes in (surface, solid):
            axes.set(xlim=extent[:2], ylim=extent[2:], aspect="equal")
            axes.axis("off")
            if title != "from above":
                axes.axhline(0.0, color="0.6", linewidth=0.8)  # the floor
        surface.set_title(title, fontsize=10)
    bar_m = 10.0 ** np.floor(np.log10(size_m))
    left, bottom = grid[0, 0].get_xlim()[0], grid[0, 0].get_ylim()[0]
    grid[0, 0].plot([left, left + bar_m], [bottom] * 2, color="black", linewidth=4, solid_capstyle="butt")
    grid[0, 0].text(left, bottom, f" {100 * bar_m:g} cm", va="bottom", fontsize=8)
    hulls = sum(model.geom_type[g] == mujoco.mjtGeom.mjGEOM_BOX for g in range(model.ngeom))
    figure.suptitle(
        f"{name}: {about.category}, {about.mass_kg:.3g} kg; below: {hulls} hulls (filled) and their boxes (lines)"
    )
    figure.tight_layout()
    return figure


def geom_outline(model: mujoco.MjModel, data: mujoco.MjData, geom: int, axes_w: np.ndarray) -> np.ndarray:
    """Return (k, 2) m: outline of a mesh or box geom, viewed along the third of the axes."""
    if model.geom_type[geom] == mujoco.mjtGeom.mjGEOM_BOX:
        corners = np.array(np.meshgrid([-1, 1], [-1, 1], [-1, 1])).reshape(3, -1).T * model.geom_size[geom]
    else:
        mesh = model.geom_dataid[geom]
        first = model.mesh_vertadr[mesh]
        corners = model.mesh_vert[first : first + model.mesh_vertnum[mesh]]
    points = (corners @ data.geom_xmat[geom].reshape(3, 3).T + data.geom_xpos[geom]) @ axes_w[:2].T
    return points[ConvexHull(points).vertices]


def _draw_solids(axes: Axes, model: mujoco.MjModel, data: mujoco.MjData, body: int, axes_w: np.ndarray) -> None:
    """Draw outlines of hulls, filled, and boxes, as lines."""
    for geom in np.flatnonzero(model.geom_bodyid == body):
        box = model.geom_type[geom] == mujoco.mjtGeom.mjGEOM_BOX
        if not box and not model.geom_contype[geom]:
            continue  # the surface
        outline = geom_outline(model, data, int(geom), axes_w)
        fill, line = ("none", "#b03020") if box else ("#3070c040", "none")
        axes.fill(*outline.T, facecolor=fill, edgecolor=line, linewidth=0.8)
