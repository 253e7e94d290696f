"""Draw pictures of a compiled scene: slantwise from the south, from above, and at eye height."""

import dataclasses
import math

import mujoco
import numpy as np
import shapely
from PIL import Image

from converters.check.object_preview import geom_outline
from converters.check.render import Picture
from converters.check.surfaces import geom_surface
from converters.geometry.faces import face_vectors
from converters.records.visual import TexturedMesh
from interactive_nav_common.grids import clearance
from scenes_mjcf.look import CameraPose, Lens, look_along, over
from scenes_mjcf.schema import SceneMaps

ELEVATION_RAD = math.radians(53.0)
CUT_M = 1.3
"""Height that walls are cut at in the view from the south."""
EYE_M, EYE_VIEW_RAD, DOWN = 1.5, math.radians(75.0), 0.2
"""Height and width of the view of somebody who stands there, and how far down they look in a metre."""
FREE_M, NEAR_M, FAR_M = 0.5, 1.2, 7.0
"""Around somebody who stands there; and how far off is what counts as visible."""
HEADINGS, PLACES = 24, 200
SHARP = 2
"""Pixels a side that become one, at eye height: from farther off that is noise, which makes files large."""


def world_surfaces(model: mujoco.MjModel, data: mujoco.MjData) -> dict[str, TexturedMesh]:
    """Return body -> what is drawn of it, in the world."""
    surfaces = {}
    for geom in range(model.ngeom):
        name = model.geom(geom).name
        if name.endswith("_visual"):
            body, surface = model.geom_bodyid[geom], geom_surface(model, geom)
            points = surface.vertices @ data.xmat[body].reshape(3, 3).T + data.xpos[body]
            surfaces[model.body(body).name] = dataclasses.replace(surface, vertices=points)
    return surfaces


def _taken(pose: CameraPose, lens: Lens, surfaces: dict[str, TexturedMesh], cut_m: float = np.inf) -> np.ndarray:
    """Draw the picture (rows, columns, 3) of bodies."""
    picture = Picture(pose, lens)
    for body, surface in surfaces.items():
        structure = body == "structure"
        picture.draw(surface, one_sided=structure, below_m=cut_m if structure else np.inf)
    return picture.image


def from_the_south(
    surfaces: dict[str, TexturedMesh], maps: SceneMaps, low: np.ndarray, high: np.ndarray, pixels: int
) -> np.ndarray:
    """Draw everything, slantwise, `pixels` wide: walls are cut at `CUT_M`; no ceiling or near wall hides a room.

    Args:
        low: (2,) least x and y, m.
        high: (2,) largest.
    """
    sin, cos = math.sin(ELEVATION_RAD), math.cos(ELEVATION_RAD)
    axes_w = np.array([[1.0, 0.0, 0.0], [0.0, sin, cos], [0.0, -cos, sin]])
    half = np.array([high[0] - low[0], sin * (high[1] - low[1]) + cos * CUT_M]) / 2
    middle = axes_w[:2] @ [*(low + high) / 2, CUT_M / 2]
    surfaces = surfaces | {"structure": _without_near_side(surfaces["structure"], maps)}
    return _taken(*over(axes_w, middle - half, middle + half, 2 * half[0] / pixels), surfaces, CUT_M)


def _without_near_side(structure: TexturedMesh, maps: SceneMaps) -> TexturedMesh:
    """Return the structure less upright faces that look south where no floor lies south of them."""
    assert structure.corner_uv is not None
    normal, centre = face_vectors(structure.vertices, structure.faces), structure.vertices[structure.faces].mean(axis=1)
    first = np.where(maps.traversable.any(axis=0), maps.traversable.argmax(axis=0), len(maps.traversable))
    column = np.floor((centre[:, 0] - maps.origin_w[0]) / maps.resolution_m).astype(int)
    south_m = maps.origin_w[1] + maps.resolution_m * first[np.clip(column, 0, len(first) - 1)]
    near = (centre[:, 1] < south_m) & (-normal[:, 1] > 0.7 * np.linalg.norm(normal, axis=1))
    return dataclasses.replace(structure, faces=structure.faces[~near], corner_uv=structure.corner_uv[~near])


def from_above(surface: TexturedMesh, low: np.ndarray, high: np.ndarray, pixel_m: float) -> np.ndarray:
    """Draw what looks up, between corners (2,) m; the last row is the southernmost."""
    return _taken(*over(np.eye(3), low, high, pixel_m), {"structure": surface})


def at_eye_height(
    model: mujoco.MjModel, data: mujoco.MjData, surfaces: dict[str, TexturedMesh], maps: SceneMaps,
    shape: tuple[int, int],
) -> np.ndarray:  # fmt: skip
    """Draw what somebody sees from where most is visible."""
    eye, heading = _vantage(model, data, surfaces, maps)
    eye_w = np.array([*eye, EYE_M])
    tall = math.degrees(2 * math.atan(math.tan(EYE_VIEW_RAD / 2) * shape[0] / shape[1]))
    lens = Lens(SHARP * shape[1], SHARP * shape[0], tall)
    picture = _taken(look_along(eye_w, np.array([*heading, -DOWN])), lens, surfaces)
    return np.asarray(Image.fromarray(picture).reduce(SHARP))


def _vantage(
    model: mujoco.MjModel, data: mujoco.MjData, surfaces: dict[str, TexturedMesh], maps: SceneMaps
) -> tuple[np.ndarray, np.ndarray]:
    """Return place (2,) and heading (2,) with most objects, the larger and nearer the better, before no wall."""
    clear = clearance(maps.traversable, maps.resolution_m)
    rows, columns = np.nonzero(clear >= min(FREE_M, 0.8 * float(clear.max())))
    some = np.unique(np.linspace(0, len(rows) - 1, PLACES).astype(int))
    places = np.array(maps.origin_w) + maps.resolution_m * (np.stack([columns, rows], axis=1)[some] + 0.5)
    boxes = [
        np.stack([s.vertices[:, :2].min(axis=0), s.vertices[:, :2].max(axis=0)])
        for body, s in surfaces.items() if body != "structure"
    ]  # fmt: skip
    low, high = np.array(boxes).reshape(-1, 2, 2).transpose(1, 0, 2)
    off = np.maximum(np.maximum(low - places[:, None], places[:, None] - high), 0.0)
    stands = (np.linalg.norm(off, axis=2) > FREE_M / 2).all(axis=1)
    places = places[stands] if stands.any() else places
    way = (low + high) / 2 - places[:, None]
    distance = np.linalg.norm(way, axis=2)
    weight = np.linalg.norm(high - low, axis=1) / np.maximum(distance, NEAR_M)
    visible = (distance > NEAR_M) & (distance < FAR_M) & ~_hidden(model, data, places, way)
    turns = np.arange(HEADINGS) * 2 * math.pi / HEADINGS
    headings = np.stack([np.cos(turns), np.sin(turns)], axis=1)
    ahead = way @ headings.T > math.cos(0.8 * EYE_VIEW_RAD / 2) * distance[..., None]
    score = np.einsum("pk,pkh->ph", np.where(visible, weight, 0.0), ahead)
    place, heading = np.unravel_index(score.argmax(), score.shape)
    return places[place], headings[heading]


def _hidden(model: mujoco.MjModel, data: mujoco.MjData, places: np.ndarray, way: np.ndarray) -> np.ndarray:
    """Return (p, k) whether a wall stands in the way (p, k, 2) from a place (p, 2)."""
    walls = [g for g in range(model.ngeom) if model.geom(g).name.startswith("wall_")]
    outlines = [shapely.Polygon(geom_outline(model, data, g, np.eye(3))) for g in walls]
    start = np.broadcast_to(places[:, None], way.shape)
    lines = shapely.linestrings(np.stack([start, start + way], axis=2))
    return np.asarray(shapely.intersects(lines, shapely.union_all(outlines)))
