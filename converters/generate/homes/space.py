"""Draw grids of free floor and compute what a disc can reach on them.

Grids are (n, n) bool, rows along +y, columns along +x, cells of `GRID_M`, the scan frame's origin in the middle.
"""

import dataclasses

import numpy as np
import shapely

from converters.generate.homes.building import CM, Plan, Rect
from converters.generate.models.cad import Instance
from interactive_nav_common.grids import clearance, largest_component

BAND_M = (0.02, 1.2)
"""Heights above the floor between which a robot meets obstacles."""
MARGIN_M = 0.5
"""Empty border of the images around the building."""


def image_size(plan: Plan) -> int:
    """Return the side of the square map images in pixels: even, so that the origin lies on a pixel corner."""
    half_m = np.abs(dataclasses.astuple(plan.outer)).max() + MARGIN_M
    return 2 * int(np.ceil(half_m / CM - 1e-6))


def floor_maps(plan: Plan) -> tuple[np.ndarray, np.ndarray]:
    """Draw `floor_0` and `floor_trav_0`, each (size, size) uint8 of 0 and 255, row = y / 0.01 + size / 2."""
    size = image_size(plan)
    half = size // 2
    obstacles = np.full((size, size), 255, np.uint8)
    traversable = np.zeros((size, size), np.uint8)

    def pixels(rect: Rect) -> tuple[slice, slice]:
        c0, r0, c1, r1 = (round(v / CM) + half for v in dataclasses.astuple(rect))
        return slice(r0, r1), slice(c0, c1)

    for rect in (*plan.rooms, *(d.rect for d in plan.doorways)):
        traversable[pixels(rect)] = 255
    for box in plan.walls:
        if box.low[2] < BAND_M[1] and box.high[2] > BAND_M[0]:
            obstacles[pixels(box.rect)] = traversable[pixels(box.rect)] = 0
    middles = (np.arange(size) - half + 0.5) * CM
    for item in plan.built_in:
        for outline in item.outlines(BAND_M):
            block(obstacles, outline, middles)
            block(traversable, outline, middles)
    return obstacles, traversable


def block(grid: np.ndarray, shape: shapely.Geometry, middles: np.ndarray) -> None:
    """Set the cells with their middle in a shape to 0; `middles` (n,) are the coordinates along either axis."""
    x0, y0, x1, y1 = shape.bounds
    columns, rows = (slice(*np.searchsorted(middles, ends)) for ends in ((x0, x1), (y0, y1)))
    grid[rows, columns][shapely.contains_xy(shape, *np.meshgrid(middles[columns], middles[rows]))] = 0


GRID_M = 0.05


def static_grid(plan: Plan) -> np.ndarray:
    """Return (n, n) bool, True where the static map is free."""
    trav = floor_maps(plan)[1] > 0
    step = round(GRID_M / CM)
    n = trav.shape[0] // (2 * step) * 2
    border = (trav.shape[0] - n * step) // 2
    inside = trav[border : border + n * step, border : border + n * step]
    return np.asarray(inside.reshape(n, step, n, step).all(axis=(1, 3)))


def cell_centres(grid: np.ndarray) -> np.ndarray:
    """Return the (n,) coordinate in metres of the cells along either axis."""
    n = grid.shape[0]
    return (np.arange(n) - n / 2 + 0.5) * GRID_M


def free_grid(plan: Plan, items: list[Instance]) -> np.ndarray:
    """Draw static map and furniture on a coarse grid: (n, n) bool, True where free."""
    grid = static_grid(plan)
    middles = cell_centres(grid)
    for item in items:
        block(grid, item.footprint.buffer(GRID_M * 0.35), middles)
    return grid


def room_mask(grid: np.ndarray, room: Rect) -> np.ndarray:
    """Return (n, n) bool, the cells of a room."""
    c = cell_centres(grid)
    return ((c > room.y0) & (c < room.y1))[:, None] & ((c > room.x0) & (c < room.x1))[None]


def rooms_joined(grid: np.ndarray, plan: Plan, radius_m: float, least_m2: float = 0.4) -> bool:
    """Return whether a disc of `radius_m` reaches `least_m2` or more of every room from every other."""
    main = largest_component(clearance(grid, GRID_M) >= radius_m)
    return bool(main.any()) and all((main & room_mask(grid, r)).sum() * GRID_M**2 >= least_m2 for r in plan.rooms)
