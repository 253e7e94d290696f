"""A scene folder in, one top-down PNG out: textured scene beside its collision shapes."""

from __future__ import annotations

import tempfile
from pathlib import Path

import matplotlib

matplotlib.use("Agg")
import matplotlib.pyplot as plt
import mujoco
import numpy as np
from matplotlib.axes import Axes
from matplotlib.patches import Patch
from PIL import Image
from scipy.spatial import ConvexHull

from converters.emit import CATEGORY_COLOURS
from converters.files import read_image, read_textured_obj
from converters.raw import ScanMesh
from converters.texture import colour_cloud
from scenes_mjcf.schema import SceneError, SceneManifest, SceneMaps, load_manifest, load_maps


def _geoms(model: mujoco.MjModel) -> list[tuple[str, str, int]]:
    """(geom name, body name, geom id) of every named geom."""
    found = []
    for geom in range(model.ngeom):
        name = mujoco.mj_id2name(model, mujoco.mjtObj.mjOBJ_GEOM, geom) or ""
        body = mujoco.mj_id2name(model, mujoco.mjtObj.mjOBJ_BODY, int(model.geom_bodyid[geom])) or ""
        found.append((name, body, geom))
    return found


def _outline(model: mujoco.MjModel, data: mujoco.MjData, geom: int) -> np.ndarray:
    """(k, 2) world outline of a mesh or box geom seen from above, m."""
    if model.geom_type[geom] == mujoco.mjtGeom.mjGEOM_BOX:
        corners = np.array(np.meshgrid([-1, 1], [-1, 1], [-1, 1])).reshape(3, -1).T * model.geom_size[geom]
    else:
        mesh = int(model.geom_dataid[geom])
        first = int(model.mesh_vertadr[mesh])
        corners = model.mesh_vert[first : first + int(model.mesh_vertnum[mesh])]
    points = (corners @ data.geom_xmat[geom].reshape(3, 3).T + data.geom_xpos[geom])[:, :2]
    return points[ConvexHull(points).vertices]


def _coloured_points(folder: Path, stem: str, spacing_m: float) -> tuple[np.ndarray, np.ndarray]:
    """Points (n, 3) on a visual mesh, as stored, and their colours (n, 3) uint8."""
    vertices, faces, corner_uv = read_textured_obj(folder / "assets" / f"{stem}_visual.obj")
    image = read_image(folder / "assets" / f"{stem}.png", "RGB")
    assert corner_uv is not None
    scan = ScanMesh(vertices, faces, np.zeros(len(vertices), np.int64), None, corner_uv, image)
    cloud = colour_cloud(scan, vertices, faces, np.arange(len(faces)), spacing_m)
    return cloud.points, cloud.colours.astype(np.uint8)


def _view_from_above(
    points: np.ndarray, colours: np.ndarray, low: np.ndarray, shape: tuple[int, int], pixel_m: float
) -> np.ndarray:
    """(rows, columns, 3) uint8 view from above: the highest point of a pixel shows; white without any."""
    index = np.floor((points[:, :2] - low) / pixel_m).astype(int)
    inside = (index >= 0).all(axis=1) & (index[:, 0] < shape[1]) & (index[:, 1] < shape[0])
    flat = index[inside, 1] * shape[1] + index[inside, 0]
    order = np.argsort(points[inside, 2], kind="stable")
    image = np.full((shape[0] * shape[1], 3), 255, np.uint8)
    image[flat[order]] = colours[inside][order]  # later (higher) points overwrite earlier ones
    return image.reshape(*shape, 3)


def _frame(axes: Axes, maps: SceneMaps, title: str) -> None:
    rows, columns = maps.traversable.shape
    x, y = maps.origin_w
    side = maps.resolution_m
    axes.set_xlim(x - 0.3, x + columns * side + 0.3)
    axes.set_ylim(y - 0.5, y + rows * side + 0.3)
    axes.set_aspect("equal")
    axes.set_title(title, fontsize=10)
    axes.axis("off")
    axes.plot([x, x + 1.0], [y - 0.3, y - 0.3], color="black", linewidth=3, solid_capstyle="butt")
    axes.text(x + 0.5, y - 0.27, "1 m", ha="center", va="bottom", fontsize=8)


def draw(folder: Path, model: mujoco.MjModel, manifest: SceneManifest, maps: SceneMaps, target: Path) -> None:
    """Draws two panels: the textured scene, and its collision shapes over the traversable area."""
    data = mujoco.MjData(model)
    mujoco.mj_forward(model, data)
    rows, columns = maps.traversable.shape
    ratio = (columns * maps.resolution_m + 0.6) / (rows * maps.resolution_m + 0.8)
    height = 6.5
    figure, (left, right) = plt.subplots(1, 2, figsize=(2 * height * ratio, height + 0.6), dpi=110)

    low = np.array(maps.origin_w) - 0.3
    size_m = np.array([columns, rows]) * maps.resolution_m + 0.6
    pixel_m = float(size_m.max()) / 700
    clouds = [_coloured_points(folder, "structure", pixel_m)]
    for item in manifest.objects:
        points, colours = _coloured_points(folder, item.name, pixel_m)
        body = model.body(item.name).id
        clouds.append((points @ data.xmat[body].reshape(3, 3).T + data.xpos[body], colours))
    shape = (int(np.ceil(size_m[1] / pixel_m)), int(np.ceil(size_m[0] / pixel_m)))
    view = _view_from_above(np.vstack([p for p, _ in clouds]), np.vstack([c for _, c in clouds]), low, shape, pixel_m)
    left.imshow(
        view,
        origin="lower",
        extent=(low[0], low[0] + shape[1] * pixel_m, low[1], low[1] + shape[0] * pixel_m),
    )
    _frame(left, maps, f"{manifest.name}: scan and {len(manifest.objects)} movable objects")

    extent = (
        maps.origin_w[0],
        maps.origin_w[0] + columns * maps.resolution_m,
        maps.origin_w[1],
        maps.origin_w[1] + rows * maps.resolution_m,
    )
    shade = np.where(maps.traversable[..., None], [0.85, 0.94, 0.85], [1.0, 1.0, 1.0])
    right.imshow(shade, origin="lower", extent=extent, interpolation="nearest")
    category = {o.name: o.category for o in manifest.objects}
    for name, body, geom in _geoms(model):
        if name.startswith("wall_"):
            right.fill(*_outline(model, data, geom).T, facecolor="0.75", edgecolor="0.45", linewidth=0.4)
        elif "_hull_" in name and body in category:
            colour = CATEGORY_COLOURS[category[body]]
            right.fill(*_outline(model, data, geom).T, facecolor=(*colour[:3], 0.35), edgecolor=colour, linewidth=0.6)
        elif "_box_" in name and body in category:
            corners = _outline(model, data, geom)
            right.plot(*np.vstack([corners, corners[:1]]).T, color="black", linewidth=0.35, alpha=0.7)
    for item in manifest.objects:
        x, y = data.body(item.name).xipos[:2]
        right.text(
            x,
            y,
            item.name,
            ha="center",
            va="center",
            fontsize=7,
            bbox={"boxstyle": "round,pad=0.15", "facecolor": "white", "alpha": 0.7, "linewidth": 0},
        )
    shown = sorted(set(category.values()))
    handles = [Patch(facecolor=CATEGORY_COLOURS[c], label=c) for c in shown]
    handles += [
        Patch(facecolor=(0.85, 0.94, 0.85), label="traversable"),
        Patch(facecolor="0.75", label="wall boxes"),
        Patch(facecolor="white", edgecolor="black", label="object boxes"),
    ]
    figure.legend(handles=handles, loc="lower center", fontsize=8, ncols=len(handles), frameon=False)
    _frame(right, maps, f"collision shapes, {manifest.floor_area_m2:.1f} m² traversable")
    figure.tight_layout(rect=(0, 0.03, 1, 1))
    figure.savefig(target, metadata={"Software": None})
    plt.close(figure)


def preview(folder: Path, target: Path) -> None:
    """Draws a scene folder into a PNG of few colours, whole or not at all.

    Raises:
        SceneError: the folder is not a readable scene, or the picture cannot be written.
    """
    manifest, maps = load_manifest(folder), load_maps(folder)
    try:
        model = mujoco.MjModel.from_xml_path(str(folder / "scene.xml"))
    except ValueError as error:
        raise SceneError(f"{folder / 'scene.xml'}: does not compile ({error}); convert the scene again") from error
    if not target.parent.is_dir():
        raise SceneError(f"{target.parent}: no such folder; give another -o")
    with tempfile.TemporaryDirectory(dir=target.parent, prefix=".preview-") as scratch:
        picture = Path(scratch) / "preview.png"
        draw(folder, model, manifest, maps, picture)
        with Image.open(picture) as image:
            image.convert("RGB").quantize(256, method=Image.Quantize.FASTOCTREE, dither=Image.Dither.NONE).save(
                picture, optimize=True
            )
        picture.replace(target)
