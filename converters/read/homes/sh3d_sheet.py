"""Flat regions in plan or on a wall in, textured triangles of a Sweet Home 3D drawing's structure out."""

import dataclasses
import math
from collections.abc import Callable, Iterator
from typing import Any

import numpy as np
import shapely

from converters.read.homes.parts import Part
from converters.read.obj import TexturedMesh, join_textures

WHITE = np.array([235, 235, 230], np.uint8).reshape(1, 1, 3)
"""Of sides and rooms that have no colour."""
MOST_TILES = 400
"""Copies of a texture on one side or room; more become its mean colour."""

Look = tuple[np.ndarray, np.ndarray | None]
"""Image (h, w, 3), and size (2,) of one copy of it, m; None: a plain colour."""


@dataclasses.dataclass
class Sheet:
    """Triangles with their images, gathered."""

    corners: list[np.ndarray] = dataclasses.field(default_factory=list)
    """(3, 3) each."""
    uv: list[np.ndarray] = dataclasses.field(default_factory=list)
    look: list[np.ndarray] = dataclasses.field(default_factory=list)

    def add(self, region: Any, place: Callable[[np.ndarray], np.ndarray], look: Look, turned: bool = False) -> None:
        """A flat region with holes.

        Args:
            place: (n, 2) of the region -> (n, 3).
        """
        image, size = look
        for tile, low in _tiles(region, size):
            for triangle in shapely.get_parts(shapely.constrained_delaunay_triangles(tile)):
                flat = shapely.get_coordinates(shapely.orient_polygons(triangle))[:3]
                if shapely.area(triangle) < 1e-9:
                    continue
                flat = flat[::-1] if turned else flat
                self.corners.append(place(flat))
                self.uv.append(np.zeros((3, 2)) if size is None else np.clip((flat - low) / size, 0, 1))
                self.look.append(image)

    def quad(self, corners: np.ndarray, look: Look) -> None:
        """(4, 3) corners of a plain patch, counter-clockwise."""
        image = look[0].mean(axis=(0, 1)).astype(np.uint8).reshape(1, 1, 3)
        for some in ((0, 1, 2), (0, 2, 3)):
            self.corners.append(corners[list(some)])
            self.uv.append(np.zeros((3, 2)))
            self.look.append(image)

    def part(self, name: str) -> Part | None:
        """All of it, built in; None of nothing."""
        if not self.corners:
            return None
        names = [image.tobytes() if image.size < 4 else id(image) for image in self.look]
        images = dict(zip(names, self.look, strict=True))
        index = {key: k for k, key in enumerate(images)}
        of = np.array([index[key] for key in names])
        mesh = TexturedMesh(
            np.vstack(self.corners),
            np.arange(3 * len(self.corners)).reshape(-1, 3),
            *join_textures(np.array(self.uv), of, list(images.values())),
        )
        return Part(name, np.eye(4), mesh, None, True, held=True)


def _tiles(region: Any, size: np.ndarray | None) -> Iterator[tuple[Any, np.ndarray]]:
    """The polygons of a region, cut along the copies of a texture, with the corner of each copy."""
    whole = shapely.get_parts(region)
    boxes = [np.zeros(2)]
    if size is not None and not shapely.is_empty(region):
        x0, y0, x1, y1 = shapely.bounds(region)
        steps = [np.arange(math.floor(a / s), math.ceil(b / s)) for a, b, s in ((x0, x1, size[0]), (y0, y1, size[1]))]
        boxes = [size * [i, j] for i in steps[0] for j in steps[1]]
    for low in boxes:
        cut = (
            whole
            if size is None
            else shapely.intersection(whole, shapely.box(low[0], low[1], low[0] + size[0], low[1] + size[1]))
        )
        for piece in shapely.get_parts(cut):
            if shapely.get_type_id(piece) == 3 and shapely.area(piece) > 1e-8:
                yield piece, low


def fitted(look: Look, area_m2: float) -> Look:
    """The look, or its mean colour where it would repeat too often."""
    image, size = look
    if size is None or area_m2 / float(np.prod(size)) > MOST_TILES:
        return image.mean(axis=(0, 1)).astype(np.uint8).reshape(1, 1, 3), None
    return look
