"""Draw grids of free floor from a plan and furniture, and find what a disc can reach on them.

Grids are (n, n) bool, rows along +y and columns along +x, cells of `GRID_M`, the scan frame's origin in the
middle.
"""

import numpy as np
import shapely

from converters.generate.design.instance import Instance
from converters.generate.design.plan import CM, Plan, Rect
from interactive_nav_common.grids import clearance, label, largest_component

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


GRID_M = 0.05


def static_grid(plan: Plan) -> np.ndarray:
    """Return (n, n) bool, True where the static map is free."""
    trav = floor_maps(plan)[1] > 0
    step = round(GRID_M / 0.01)
    n = trav.shape[0] // (2 * step) * 2
    half = trav.shape[0] // 2
    keep = slice(half - n // 2 * step, half + n // 2 * step)
    return np.asarray(trav[keep, keep].reshape(n, step, n, step).all(axis=(1, 3)))


def cell_centres(grid: np.ndarray) -> np.ndarray:
    """Return the (n,) coordinate in metres of the cells along either axis."""
    n = grid.shape[0]
    return (np.arange(n) - n / 2 + 0.5) * GRID_M


def without(grid: np.ndarray, items: list[Instance]) -> np.ndarray:
    """Return a copy of the grid with the footprints of the furniture blocked."""
    centres = cell_centres(grid)
    grid = grid.copy()
    for item in items:
        shape = item.footprint.buffer(GRID_M * 0.35)
        x0, y0, x1, y1 = shape.bounds
        columns = slice(*np.searchsorted(centres, (x0, x1)))
        rows = slice(*np.searchsorted(centres, (y0, y1)))
        xs, ys = np.meshgrid(centres[columns], centres[rows])
        grid[rows, columns] &= ~shapely.contains_xy(shape, xs, ys)
    return grid


def free_grid(plan: Plan, items: list[Instance]) -> np.ndarray:
    """Draw static map and furniture on a coarse grid: (n, n) bool, True where free."""
    return without(static_grid(plan), items)


def room_mask(grid: np.ndarray, room: Rect) -> np.ndarray:
    """Return (n, n) bool, the cells of a room."""
    c = cell_centres(grid)
    return ((c > room.y0) & (c < room.y1))[:, None] & ((c > room.x0) & (c < room.x1))[None]


def rooms_joined(grid: np.ndarray, plan: Plan, radius_m: float, least_m2: float = 0.4) -> bool:
    """Return whether a disc of `radius_m` reaches `least_m2` or more of every room from every other."""
    main = largest_component(clearance(grid, GRID_M) >= radius_m)
    return bool(main.any()) and all((main & room_mask(grid, r)).sum() * GRID_M**2 >= least_m2 for r in plan.rooms)


def passes(room_m: np.ndarray, masks: list[np.ndarray], width_m: float) -> bool:
    """Return whether a disc `width_m` wide gets from one mask to the other.

    `room_m`: (n, n) clearance.
    `masks`: two of (n, n) bool.
    `width_m`: the disc's diameter.
    """
    region = label(room_m >= width_m / 2)[0]
    return bool(set(np.unique(region[masks[0]])) & set(np.unique(region[masks[1]])) - {0})
