"""Sizes and materials in, what things lie in or on out, of convex parts: sideboards, bookcases, tables, desks."""

from __future__ import annotations

import functools

from converters.generate.models.beds import chest
from converters.generate.models.parts import (
    Drawing,
    Part,
    bar,
    block,
    box,
    corners,
    cushion,
    four_legs,
    fronts,
    oval,
    pillar,
    plate,
    rectangle,
    turned,
)  # fmt: skip

# -- sideboards and television benches ---------------------------------


def sideboard_mixed(width=1.5, height=0.78, depth=0.42, wood="walnut", front="walnut") -> list[Part]:
    parts = four_legs(width - 0.2, depth - 0.04, 0.17, 0.045, wood, splay=0.04, square=False)
    parts.append(block((0, 0.16, 0), (width, height - 0.16, depth - 0.01), wood))
    parts += fronts((-width / 2 + 0.02, 0.18), (-width / 6, height - 0.02), depth / 2 - 0.005, 1, 1, front, "pull")
    parts += fronts((-width / 6, 0.18), (width / 6, height - 0.02), depth / 2 - 0.005, 1, 3, front, "bar")
    return parts + fronts((width / 6, 0.18), (width / 2 - 0.02, height - 0.02), depth / 2 - 0.005, 1, 1, front, "pull")


def sideboard_buffet(width=1.2, height=0.9, depth=0.45, paint="cream", top="oak") -> list[Part]:
    parts = [pillar((x, 0, z), 0.1, (0.03, 0.045), paint) for x, z in corners(width / 2 - 0.05, 0.16)]
    parts.append(block((0, 0.09, 0), (width, height - 0.12, depth - 0.02), paint))
    parts.append(block((0, height - 0.035, 0.01), (width + 0.06, 0.035, depth + 0.03), top))
    z = depth / 2 - 0.01
    parts += fronts((-width / 2 + 0.03, 0.11), (width / 2 - 0.03, 0.64), z, 3, 1, paint, "knob", "brass")
    return parts + fronts((-width / 2 + 0.03, 0.64), (width / 2 - 0.03, height - 0.05), z, 3, 1, paint, "knob", "brass")


def sideboard_hutch(width=1.1, height=1.75, depth=0.42, wood="pine") -> list[Part]:
    parts = chest(width, 0.85, depth, 2, 1, wood, "pull", metal="black")
    for sx in (-1, 0, 1):
        parts.append(block((sx * (width / 2 - 0.02), 0.85, -0.06), (0.03, height - 0.87, depth - 0.16), wood))
    parts.append(block((0, 0.85, -depth / 2 + 0.02), (width, height - 0.87, 0.02), wood))
    parts += [block((0, y, -0.06), (width - 0.02, 0.025, depth - 0.16), wood) for y in (1.15, 1.45)]
    parts.append(block((0, height - 0.04, -0.05), (width + 0.06, 0.04, depth - 0.1), wood))
    for k in range(6):
        parts.append(pillar((-0.4 + 0.16 * k, 1.175 + 0.3 * (k % 2), -0.06), 0.14, (0.03, 0.05), "ceramic", 10))
    return parts


def bench_tv_shelf(width=1.4, height=0.42, depth=0.4, wood="black", metal="steel") -> list[Part]:
    parts = [block((0, y, 0), (width, 0.03, depth), wood) for y in (0.05, 0.22, height - 0.03)]
    for sx in (-1, 1):
        parts.append(block((sx * (width / 2 - 0.03), 0, 0), (0.04, height - 0.02, depth - 0.02), metal))
    parts.append(block((0, 0.06, 0), (0.03, height - 0.08, depth - 0.06), metal))
    parts.append(block((-0.36, 0.25, 0), (0.42, 0.06, 0.28), "charcoal"))
    return parts


def bench_tv_corner(width=1.2, height=0.5, depth=0.5, wood="cherry") -> list[Part]:
    """Its back is narrower, so that it stands in corners."""
    outline = rectangle(0, 0, width, depth)
    outline[[0, 3]] *= [0.6, 1.0]
    parts = [plate(outline * 0.94, 0, 0.06, "charcoal"), plate(outline, 0.05, height - 0.02, wood)]
    parts.append(plate(outline * 1.03, height - 0.03, height, wood))
    z = depth / 2 - 0.005
    parts += fronts((-width / 2 + 0.02, 0.07), (width / 2 - 0.02, 0.3), z, 2, 1, wood, "knob", "brass")
    parts.append(box((0, 0.385, depth / 2 - 0.005), (width - 0.08, 0.14, 0.02), "black"))
    return parts


# -- bookcases, shelves and shoe racks ---------------------------------


def books(x0, x1, y, z, depth, seed) -> list[Part]:
    """Rows of books, three blocks of a height each, that lean on nothing."""
    colours = ("navy", "rust", "cream", "moss", "teal", "red", "slate", "mustard")
    width = (x1 - x0) / 3
    return [
        block(
            (x0 + width * (k + 0.5), y, z),
            (width - 0.012, 0.19 + 0.025 * ((seed + k) % 3), 0.75 * depth),
            colours[(3 * seed + k) % 8],
        )  # fmt: skip
        for k in range(3 if seed % 3 else 2)
    ]


def bookcase_tall(width=0.8, height=2.0, depth=0.28, wood="oak", shelves=5, filled=4) -> list[Part]:
    parts = [block((0, 0, -depth / 2 + 0.01), (width, height, 0.015), wood)]
    parts += [block((sx * (width / 2 - 0.012), 0, 0), (0.024, height, depth), wood) for sx in (-1, 1)]
    ys = [0.06 + (height - 0.085) * k / shelves for k in range(shelves + 1)]
    parts += [block((0, y, 0), (width - 0.02, 0.024, depth - 0.01), wood) for y in ys]
    parts.append(block((0, 0, depth / 2 - 0.03), (width - 0.04, 0.065, 0.02), wood))
    for k in range(filled):
        parts += books(-width / 2 + 0.04, width / 2 - 0.1, ys[k] + 0.024, -0.01, depth, k + 1)
    return parts


def bookcase_cubes(columns=3, rows=3, side=0.37, depth=0.36, paint="white") -> list[Part]:
    width, height = columns * side + 0.04, rows * side + 0.04
    parts = [block((0, side * k, 0), (width, 0.04 if k in (0, rows) else 0.02, depth), paint) for k in range(rows + 1)]
    for k in range(columns + 1):
        parts.append(
            block(
                (side * (k - columns / 2), 0.01, 0), (0.04 if k in (0, columns) else 0.02, height - 0.02, depth), paint
            )
        )
    for k, cloth in enumerate(("wicker", "denim", "grey", "mustard")):
        column, row = (2 * k) % columns, k % rows
        parts.append(
            block(
                (side * (column + 0.5 - columns / 2), side * row + 0.04, 0),
                (side - 0.06, side - 0.09, depth - 0.06),
                cloth,
            )
        )
    return parts


def bookcase_ladder(width=0.62, height=1.8, depth=0.42, wood="walnut", metal="black") -> list[Part]:
    parts = []
    for sx in (-1, 1):
        x = sx * (width / 2 - 0.015)
        parts.append(bar((x, 0, depth / 2 - 0.02), (x, height, -depth / 2 + 0.05), 0.02, metal, 4))
        parts.append(bar((x, 0, -depth / 2 + 0.03), (x, height, -depth / 2 + 0.03), 0.02, metal, 4))
    for k in range(5):
        y = 0.12 + 0.38 * k
        reach = depth - 0.08 - (depth - 0.14) * y / height
        parts.append(block((0, y, -depth / 2 + 0.04 + reach / 2), (width - 0.03, 0.025, reach), wood))
        if k < 3:
            parts += books(-0.22, 0.12, y + 0.025, -depth / 2 + 0.14, 0.2, k + 1)
    return parts


def bookcase_low(width=1.1, height=0.85, depth=0.3, wood="cherry") -> list[Part]:
    parts = bookcase_tall(width, height, depth, wood, 2, 2)
    parts.append(block((0, 0.06, 0), (0.024, height - 0.08, depth - 0.01), wood))
    parts.append(block((0, height - 0.02, 0.005), (width + 0.05, 0.03, depth + 0.03), wood))
    return parts


def bookcase_steps(width=1.2, depth=0.3, wood="birch") -> list[Part]:
    """Columns of different heights, open to both sides."""
    parts = []
    for k, height in enumerate((0.75, 1.1, 1.45)):
        x = width * (k - 1) / 3
        parts.append(block((x - width / 6, 0, 0), (0.024, height, depth), wood))
        parts += [block((x, y, 0), (width / 3, 0.024, depth), wood) for y in (0.0, 0.35, 0.7, 1.05, 1.42) if y < height]
        parts += books(x - 0.15, x + 0.12, 0.374, 0, depth, k + 1)
    return [*parts, block((width / 2, 0, 0), (0.024, 1.45, depth), wood)]


def shelf_unit(width=1.6, height=2.2, depth=0.34, wood="pine", metal="pine", levels=5, goods=True) -> list[Part]:
    parts = [block((x, 0, z), (0.04, height, 0.04), metal) for x, z in corners(width / 2 - 0.02, depth / 2 - 0.02)]
    ys = [0.08 + (height - 0.14) * k / (levels - 1) for k in range(levels)]
    parts += [block((0, y, 0), (width, 0.03, depth), wood) for y in ys]
    if goods:
        for k in range(2 * levels - 2):
            size = (0.26 + 0.06 * (k % 3), 0.18 + 0.05 * (k % 2), depth - 0.08)
            material = ("cardboard", "wicker", "grey", "teal")[k % 4]
            parts.append(block(((k % 2 - 0.5) * width * 0.5 + 0.05 * (k % 3), ys[k // 2] + 0.03, 0), size, material))
    return parts


def shelf_builtin(width=2.0, height=2.3, depth=0.32, paint="white") -> list[Part]:
    parts = [block((0, 0, 0), (width, 0.7, depth), paint), block((0, height - 0.08, 0), (width, 0.08, depth), paint)]
    parts.append(block((0, 0.69, -depth / 2 + 0.01), (width, height - 0.7, 0.02), paint))
    parts += [block((width * (k / 4 - 0.5) * 0.985, 0.69, 0), (0.03, height - 0.7, depth), paint) for k in range(5)]
    parts += [block((0, y, 0), (width - 0.02, 0.025, depth - 0.02), paint) for y in (1.05, 1.4, 1.75)]
    parts += fronts(
        (-width / 2 + 0.02, 0.06), (width / 2 - 0.02, 0.68), depth / 2 - 0.005, 4, 1, paint, "knob", "brass"
    )
    for k in range(3):
        parts += books(-0.9 + 0.5 * k, -0.58 + 0.5 * k, (1.075, 0.71, 1.425)[k], 0, depth, k + 1)
    return parts


def shoe_rack_bars(width=0.8, depth=0.3, tiers=3, metal="chrome", side="black") -> list[Part]:
    height = 0.18 * tiers
    parts = []
    for sx in (-1, 1):
        for sz in (-1, 1):
            parts.append(pillar((sx * (width / 2 - 0.015), 0, sz * (depth / 2 - 0.015)), height, 0.014, side, 8))
    for k in range(tiers):
        y = 0.06 + 0.18 * k
        parts += [
            bar(
                (-width / 2, y + 0.02 * (1 - j), depth * (0.4 * j - 0.4)),
                (width / 2, y + 0.02 * (1 - j), depth * (0.4 * j - 0.4)),
                0.011,
                metal,
                6,
            )
            for j in range(3)
        ]
        if k < 2:
            parts += [
                cushion((0.25 * j - 0.2, y + 0.06, 0.0), (0.09, 0.08, 0.26), ("navy", "leather", "white")[j], 0.03)
                for j in range(k, 3)
            ]
    return parts


def shoe_rack_bench(width=0.9, depth=0.34, height=0.48, wood="oak", cloth="grey") -> list[Part]:
    parts = [block((sx * (width / 2 - 0.015), 0, 0), (0.03, height - 0.05, depth), wood) for sx in (-1, 1)]
    parts += [block((0, y, 0), (width - 0.04, 0.02, depth - 0.01), wood) for y in (0.05, 0.23, height - 0.07)]
    parts.append(block((0, 0.06, 0), (0.02, height - 0.12, depth - 0.02), wood))
    parts.append(cushion((0, height - 0.025, 0), (width, 0.05, depth), cloth, 0.015))
    for k in range(4):
        place = (-0.3 + 0.2 * k, 0.11 + 0.18 * (k % 2), 0.01)
        parts.append(cushion(place, (0.16, 0.08, 0.27), ("rust", "black", "white", "denim")[k], 0.03))
    return parts


def shoe_rack_tilting(width=0.6, height=1.05, depth=0.24, paint="white") -> list[Part]:
    parts = [
        block((0, 0, 0), (width, height, depth - 0.02), paint),
        block((0, height - 0.02, 0.01), (width + 0.04, 0.03, depth + 0.02), "oak"),
    ]
    for k in range(3):
        parts.append(box((0, 0.18 + 0.32 * k, depth / 2 + 0.005), (width - 0.04, 0.3, 0.02), paint, -0.06))
        parts.append(box((0, 0.29 + 0.32 * k, depth / 2 + 0.018), (0.16, 0.02, 0.02), "black"))
    return parts


def shoe_rack_slats(width=0.7, depth=0.3, wood="birch", tiers=2) -> list[Part]:
    parts = []
    for sx in (-1, 1):
        parts += [
            block((sx * (width / 2 - 0.02), 0, sz * (depth / 2 - 0.02)), (0.035, 0.25 * tiers, 0.035), wood)
            for sz in (-1, 1)
        ]
    for k in range(tiers):
        parts += [
            block((0, 0.09 + 0.25 * k, depth * (0.25 * j - 0.375)), (width - 0.02, 0.018, 0.055), wood)
            for j in range(4)
        ]
    return [
        *parts,
        cushion((-0.15, 0.15, 0), (0.2, 0.09, 0.27), "leather", 0.03),
        cushion((0.15, 0.4, 0), (0.2, 0.09, 0.27), "navy", 0.03),
    ]


# -- tables ------------------------------------------------------------


def coffee_shelf(width=1.05, depth=0.6, height=0.44, wood="walnut") -> list[Part]:
    parts = four_legs(width, depth, height - 0.02, 0.045, wood)
    parts.append(block((0, height - 0.035, 0), (width + 0.02, 0.035, depth + 0.02), wood))
    parts.append(block((0, 0.14, 0), (width - 0.06, 0.022, depth - 0.06), wood))
    parts += [
        block((-0.2, 0.162, 0.05), (0.3, 0.03, 0.22), "red"),
        block((-0.2, 0.192, 0.05), (0.26, 0.03, 0.2), "cream"),
    ]
    return parts


def coffee_round(radius=0.42, height=0.4, top="marble", metal="brass") -> list[Part]:
    parts = [pillar((0, height - 0.03, 0), 0.03, radius, top, 20), pillar((0, 0, 0), 0.02, 0.7 * radius, metal, 20)]
    for sx, sz in ((-1, 0), (1, 0), (0, -1), (0, 1)):
        parts.append(
            bar(
                (0.62 * radius * sx, 0.01, 0.62 * radius * sz),
                (-0.62 * radius * sz, height - 0.02, 0.62 * radius * sx),
                0.014,
                metal,
                8,
            )
        )
    return parts


def coffee_trunk(width=1.0, depth=0.55, height=0.45, wood="leather", metal="brass") -> list[Part]:
    parts = [
        block((0, 0.02, 0), (width, height - 0.12, depth), wood),
        block((0, height - 0.11, 0), (width + 0.01, 0.11, depth + 0.01), wood),
    ]
    parts += [block((x, 0, z), (0.06, height, 0.06), metal) for x, z in corners(width / 2 - 0.02, depth / 2 - 0.02)]
    parts += [block((0.28 * sx, 0.03, 0), (0.05, height - 0.02, depth + 0.024), "black") for sx in (-1, 1)]
    return [*parts, block((0, height - 0.17, depth / 2), (0.1, 0.1, 0.02), metal)]


def coffee_nest(wood="birch", metal="black") -> list[Part]:
    parts = []
    for x, z, radius, height in ((-0.12, -0.05, 0.34, 0.46), (0.3, 0.16, 0.25, 0.36)):
        parts.append(pillar((x, height - 0.025, z), 0.025, radius, wood, 18))
        for dx, dz in ((0, -1), (0.87, 0.5), (-0.87, 0.5)):
            parts.append(
                bar(
                    (x + 0.9 * radius * dx, 0, z + 0.9 * radius * dz),
                    (x + 0.5 * radius * dx, height - 0.02, z + 0.5 * radius * dz),
                    0.014,
                    metal,
                    6,
                )
            )
    return parts


def coffee_slab(width=1.1, depth=0.6, height=0.34, top="oak", stone="grey") -> list[Part]:
    parts = [plate(rectangle(0, 0, width, depth, 0.1), height - 0.06, height, top)]
    parts += [plate(oval(sx * 0.3, 0, 0.1, 0.22, 14), 0, height - 0.055, stone) for sx in (-1, 1)]
    return parts


def table_oval(width=1.38, depth=0.9, height=0.75, top="cherry", leg="cherry") -> list[Part]:
    parts = [plate(oval(0, 0, width / 2, depth / 2, 24), height - 0.035, height, top)]
    parts += turned((0, 0.1, 0), [(0.09, 0), (0.11, 0.12), (0.05, 0.3), (0.08, height - 0.14)], leg)
    for sx, sz in ((-1, -1), (1, -1), (-1, 1), (1, 1)):
        parts.append(bar((0, 0.2, 0), (sx * 0.34, 0.03, sz * 0.26), (0.05, 0.035), leg, 8))
        parts.append(pillar((sx * 0.34, 0, sz * 0.26), 0.04, 0.035, leg, 8))
    return parts


def table_cross(width=1.35, depth=0.8, height=0.74, top="pine", metal="black") -> list[Part]:
    parts = [block((0, height - 0.035, depth * (k - 2) / 5), (width, 0.035, depth / 5 - 0.006), top) for k in range(5)]
    for sx in (-1, 1):
        x = sx * (width / 2 - 0.2)
        for sz in (-1, 1):
            parts.append(
                bar((x, 0.0, sz * (depth / 2 - 0.06)), (x, height - 0.03, -sz * (depth / 2 - 0.1)), 0.035, metal, 4)
            )
    parts.append(bar((-width / 2 + 0.2, height / 2, 0), (width / 2 - 0.2, height / 2, 0), 0.024, metal, 8))
    return parts


def desk_trestles(width=1.38, depth=0.68, height=0.74, top="glass", wood="birch") -> list[Part]:
    parts = [block((0, height - 0.025, 0), (width, 0.025, depth), top)]
    for sx in (-1, 1):
        x = sx * (width / 2 - 0.25)
        for dx in (-1, 1):
            for sz in (-1, 1):
                foot = (x + 0.13 * dx, 0, sz * (depth / 2 - 0.06))
                parts.append(bar(foot, (x + 0.02 * dx, height - 0.05, sz * (depth / 2 - 0.1)), 0.022, wood, 4))
        parts.append(block((x, height - 0.07, 0), (0.07, 0.05, depth - 0.1), wood))
        parts += [box((x + 0.1 * dx, 0.2, 0), (0.02, 0.05, depth - 0.16), wood) for dx in (-1, 1)]
    return parts


def desk_bookcase(width=1.3, depth=0.6, height=0.75, wood="birch", metal="black") -> list[Part]:
    parts = [block((0, height - 0.03, 0), (width, 0.03, depth), wood)]
    parts += [
        block((width / 2 - 0.02, 0, sz * (depth / 2 - 0.03)), (0.04, height - 0.03, 0.04), metal) for sz in (-1, 1)
    ]
    parts.append(box((width / 2 - 0.02, 0.05, 0), (0.04, 0.04, depth - 0.06), metal))
    x = -width / 2 + 0.17
    parts += [block((x + sx * 0.155, 0, 0), (0.03, height - 0.03, depth - 0.04), wood) for sx in (-1, 1)]
    parts += [block((x, y, 0), (0.3, 0.02, depth - 0.05), wood) for y in (0.04, 0.38)]
    parts += books(x - 0.13, x + 0.1, 0.4, 0.05, 0.3, 2) + books(x - 0.13, x + 0.1, 0.06, 0.05, 0.3, 1)
    parts.append(box((0.15, height - 0.2, -depth / 2 + 0.04), (width - 0.45, 0.3, 0.02), wood))
    return parts


_f = functools.partial
DRAWINGS = {
    "sideboard_mixed": Drawing("sideboard", sideboard_mixed),
    "sideboard_buffet": Drawing("sideboard", sideboard_buffet),
    "sideboard_doors": Drawing(
        "sideboard", _f(chest, 1.6, 0.72, 0.4, 4, 1, "white", "", legs=0.15, top="oak"), held_out=True
    ),
    "sideboard_hutch": Drawing("sideboard", sideboard_hutch, held_out=True),
    "tv_bench_shelf": Drawing("tv_bench", bench_tv_shelf),
    "tv_bench_drawers": Drawing("tv_bench", _f(chest, 1.6, 0.45, 0.42, 3, 1, "oak", "", "white", legs=0.14)),
    "tv_bench_corner": Drawing("tv_bench", bench_tv_corner, held_out=True),
    "tv_bench_cubes": Drawing("tv_bench", _f(bookcase_cubes, 4, 1, 0.37, 0.38, "birch"), held_out=True),
    "bookcase_tall": Drawing("bookcase", bookcase_tall),
    "bookcase_cubes": Drawing("bookcase", bookcase_cubes),
    "bookcase_low": Drawing("bookcase", bookcase_low),
    "bookcase_ladder": Drawing("bookcase", bookcase_ladder, held_out=True),
    "bookcase_steps": Drawing("bookcase", bookcase_steps, held_out=True),
    "shelf_pantry": Drawing("shelf", shelf_unit),
    "shelf_builtin": Drawing("shelf", shelf_builtin),
    "shelf_metal": Drawing("shelf", _f(shelf_unit, 1.0, 1.9, 0.45, "steel", "steel", 4), held_out=True),
    "shelf_narrow": Drawing("shelf", _f(bookcase_cubes, 2, 5, 0.38, 0.34, "oak"), held_out=True),
    "shoe_rack_bars": Drawing("shoe_rack", shoe_rack_bars),
    "shoe_rack_bench": Drawing("shoe_rack", shoe_rack_bench),
    "shoe_rack_tilting": Drawing("shoe_rack", shoe_rack_tilting, held_out=True),
    "shoe_rack_slats": Drawing("shoe_rack", shoe_rack_slats, held_out=True),
    "coffee_table_shelf": Drawing("coffee_table", coffee_shelf),
    "coffee_table_round": Drawing("coffee_table", coffee_round, "__SYM_ROTATE_UP_4"),
    "coffee_table_trunk": Drawing("coffee_table", coffee_trunk),
    "coffee_table_nest": Drawing("coffee_table", coffee_nest, held_out=True),
    "coffee_table_slab": Drawing("coffee_table", coffee_slab, "__SYM_ROTATE_UP_2", held_out=True),
    "table_oval": Drawing("table", table_oval, "__SYM_ROTATE_UP_2"),
    "table_cross": Drawing("table", table_cross, "__SYM_ROTATE_UP_2", held_out=True),
    "desk_trestles": Drawing("desk", desk_trestles, held_out=True),
    "desk_bookcase": Drawing("desk", desk_bookcase),
}
"""Model name -> how it is drawn."""
