"""Sizes and materials in, storage of convex parts out: shelves, shoe racks, dressers, carts."""

from __future__ import annotations

import functools

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
)

_f = functools.partial


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


def chest(
    width, height, depth, columns, rows, wood, handle="bar", front="", legs=0.0, metal="steel", top=""
) -> list[Part]:
    """A carcass on legs, or on a plinth where they are 0, with drawers or doors and a top that juts out."""
    parts = [block((0, 0, -0.015), (width - 0.04, 0.06, depth - 0.05), "charcoal")]
    if legs:
        parts = four_legs(width - 0.02, depth - 0.02, legs + 0.01, 0.045, top or wood, splay=0.02, square=False)
    under = legs or 0.05
    parts.append(block((0, under, 0), (width, height - under - 0.02, depth - 0.01), wood))
    parts.append(block((0, height - 0.025, 0.008), (width + 0.02, 0.025, depth + 0.016), top or wood))
    low, high = (-width / 2 + 0.015, under + 0.015), (width / 2 - 0.015, height - 0.035)
    return parts + fronts(low, high, depth / 2 - 0.005, columns, rows, front or wood, handle, metal)


def dresser_tall(width=0.55, height=1.2, depth=0.42, wood="pine") -> list[Part]:
    parts = [plate_foot(width, depth, sx) for sx in (-1, 1)]
    parts.append(block((0, 0.08, 0), (width, height - 0.1, depth - 0.01), wood))
    parts.append(block((0, height - 0.03, 0.01), (width + 0.05, 0.03, depth + 0.03), wood))
    parts += fronts((-width / 2 + 0.02, 0.1), (width / 2 - 0.02, 0.92), depth / 2 - 0.005, 1, 4, wood, "knob", "black")
    return parts + fronts((-width / 2 + 0.02, 0.92), (width / 2 - 0.02, height - 0.04), depth / 2 - 0.005, 2, 1, wood,
                          "knob", "black")  # fmt: skip


def plate_foot(width, depth, side) -> Part:
    """A foot along the depth, narrower at the floor."""
    x = side * (width / 2 - 0.03)
    low = oval(x, 0, 0.03, depth / 2 - 0.03, 8)
    return plate(low, 0, 0.09, "pine", oval(x, 0, 0.035, depth / 2 - 0.01, 8))


DRAWINGS = {
    "shelf_pantry": Drawing("shelf", shelf_unit),
    "shelf_builtin": Drawing("shelf", shelf_builtin),
    "shelf_metal": Drawing("shelf", _f(shelf_unit, 1.0, 1.9, 0.45, "steel", "steel", 4), held_out=True),
    "shelf_narrow": Drawing("shelf", _f(bookcase_cubes, 2, 5, 0.38, 0.34, "oak"), held_out=True),
    "shoe_rack_bars": Drawing("shoe_rack", shoe_rack_bars),
    "shoe_rack_bench": Drawing("shoe_rack", shoe_rack_bench),
    "shoe_rack_tilting": Drawing("shoe_rack", shoe_rack_tilting, held_out=True),
    "shoe_rack_slats": Drawing("shoe_rack", shoe_rack_slats, held_out=True),
    "dresser_tall": Drawing("dresser", dresser_tall, held_out=True),
    "dresser_nine": Drawing(
        "dresser", _f(chest, 1.1, 0.86, 0.42, 3, 3, "sage", "knob", "cream", top="oak"), held_out=True
    ),
}
"""Model name -> how it is drawn."""
