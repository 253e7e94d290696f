"""A floor plan in, the two map images of the raw layout out.

Both images show the STATIC structure only: walls and built-in cupboards that stand in the robot's height
band; movable furniture and door leaves are in neither. 0.01 m a pixel, square, the image's centre is the
origin of the scan frame, rows run along +y and columns along +x. `floor_0`: 0 where something static stands,
255 elsewhere (outside the building too: nothing stands there). `floor_trav_0`: 255 where there is floor and
nothing static, 0 elsewhere.
"""

import numpy as np
import shapely

from converters.generate.design.plan import CM, Plan, Rect

BAND_M = (0.02, 1.2)
"""Heights above the floor between which a robot meets obstacles."""
MARGIN_M = 0.5
"""Empty border of the images around the building."""


def image_size(plan: Plan) -> int:
    """Side of the square map images in pixels: even, so that the origin lies on a pixel corner."""
    o = plan.outer
    half_m = max(abs(o.x0), abs(o.y0), abs(o.x1), abs(o.y1)) + MARGIN_M
    return 2 * int(np.ceil(half_m / CM - 1e-6))


def fill(image: np.ndarray, rect: Rect, value) -> None:
    """Sets the pixels whose centres lie in a rectangle (scan frame); writes into `image`."""
    half = image.shape[0] // 2
    c0, r0, c1, r1 = (round(v / CM) + half for v in (rect.x0, rect.y0, rect.x1, rect.y1))
    image[r0:r1, c0:c1] = value


def floor_maps(plan: Plan) -> tuple[np.ndarray, np.ndarray]:
    """Draws both maps.

    Returns:
        `floor_0` and `floor_trav_0`, each (size, size) uint8 of 0 and 255, row = y / 0.01 + size / 2.
    """
    size = image_size(plan)
    obstacles = np.full((size, size), 255, np.uint8)
    traversable = np.zeros((size, size), np.uint8)
    for rect in (*plan.rooms, *(d.rect for d in plan.doorways)):
        fill(traversable, rect, 255)
    for box in (*plan.walls, *plan.fixtures):
        if box.low[2] < BAND_M[1] and box.high[2] > BAND_M[0]:
            fill(obstacles, box.rect, 0)
            fill(traversable, box.rect, 0)
    half = size // 2
    for item in plan.built_in:
        for outline in item.outlines(BAND_M):
            x0, y0, x1, y1 = outline.bounds
            c0, r0, c1, r1 = (int(np.floor(v / CM)) + half + k for v, k in ((x0, 0), (y0, 0), (x1, 1), (y1, 1)))
            xs, ys = np.meshgrid((np.arange(c0, c1) - half + 0.5) * CM, (np.arange(r0, r1) - half + 0.5) * CM)
            inside = shapely.contains_xy(outline, xs, ys)
            obstacles[r0:r1, c0:c1][inside] = 0
            traversable[r0:r1, c0:c1][inside] = 0
    return obstacles, traversable
