"""Sizes and materials in, what laundry is done with out, of convex parts: washers, baskets, drying racks; carts."""

from __future__ import annotations

import math

from converters.generate.models.parts import (
    Drawing,
    Part,
    ball,
    bar,
    beam,
    block,
    box,
    corners,
    cushion,
    hull,
    oval,
    pillar,
    plate,
    rail,
    rectangle,
    shell,
)  # fmt: skip

# -- laundry baskets ---------------------------------------------------


def basket_hamper(width=0.44, height=0.6, depth=0.34, weave="wicker", lid="bark") -> list[Part]:
    parts = [
        block((0, 0, 0), (width, 0.04, depth), lid),
        block((0, 0.03, 0), (width - 0.02, height - 0.07, depth - 0.02), weave),
    ]
    parts += [
        block((x, 0, z), (0.045, height - 0.03, 0.045), lid) for x, z in corners(width / 2 - 0.02, depth / 2 - 0.02)
    ]
    parts += [block((0, y, 0), (width - 0.005, 0.025, depth - 0.005), lid) for y in (0.2, 0.38)]
    return [
        *parts,
        cushion((0, height - 0.02, 0), (width + 0.02, 0.05, depth + 0.02), weave, 0.012),
        box((0, height - 0.09, depth / 2), (0.08, 0.06, 0.02), "leather"),
    ]


def basket_folding(width=0.5, height=0.66, depth=0.4, cloth="grey", wood="birch") -> list[Part]:
    """A sack of cloth between crossed legs."""
    parts = []
    for sz in (-1, 1):
        z = sz * (depth / 2 - 0.015)
        parts += [
            bar((sx * (width / 2 - 0.02), 0, z), (-sx * (width / 2 - 0.02), height, z), 0.018, wood, 4)
            for sx in (-1, 1)
        ]
    parts += [beam(sx * (width / 2 - 0.02), height - 0.01, depth / 2, 0.016, wood, 6) for sx in (-1, 1)]
    parts += [beam(sx * (width / 2 - 0.02), 0.02, depth / 2, 0.016, wood, 6) for sx in (-1, 1)]
    low, top = rectangle(0, 0, 0.24, depth - 0.08), rectangle(0, 0, width - 0.05, depth - 0.07)
    return [
        *parts,
        *shell(low, 0.12, height - 0.02, 0.014, cloth, top),
        plate(low, 0.11, 0.13, cloth),
        ball((0, 0.4, 0), (0.16, 0.16, 0.13), "white"),
    ]


# -- carts -------------------------------------------------------------


def castors(x, z, radius=0.035) -> list[Part]:
    """Wheels under the corners."""
    return [bar((x - 0.012, radius, z), (x + 0.012, radius, z), radius, "black", 12) for x, z in corners(x, z)]


def cart_trays(width=0.44, depth=0.34, height=0.8, paint="teal") -> list[Part]:
    parts = castors(width / 2 - 0.02, depth / 2 - 0.03)
    parts += [
        pillar((x, 0.06, z), height - 0.06, 0.011, paint, 6) for x, z in corners(width / 2 - 0.02, depth / 2 - 0.03)
    ]
    for y in (0.1, 0.4, 0.7):
        parts += [
            block((0, y, 0), (width, 0.012, depth), paint),
            *shell(rectangle(0, 0, width, depth), y, y + 0.08, 0.01, paint),
        ]
    parts += [
        pillar((-0.1 + 0.1 * k, 0.41 + 0.3 * (k % 2), 0.02), 0.17, (0.03, 0.025), ("moss", "rust", "cream")[k], 10)
        for k in range(3)
    ]
    return parts


def cart_tea(radius=0.3, height=0.72, metal="brass", top="glass") -> list[Part]:
    parts = [pillar((0, y, 0), 0.02, radius, top, 20) for y in (0.2, height - 0.14)]
    for k in range(4):
        a = math.pi / 2 * (k + 0.5)
        x, z = 0.97 * radius * math.cos(a), 0.97 * radius * math.sin(a)
        parts += [
            pillar((x, 0.05, z), height - 0.14 - 0.03, 0.014, metal, 8),
            bar((x - 0.012, 0.035, z), (x + 0.012, 0.035, z), 0.035, "black", 12),
        ]
    parts += shell(oval(0, 0, radius + 0.01, radius + 0.01, 10), height - 0.1, height - 0.07, 0.015, metal)
    return [
        *parts,
        *(
            pillar(
                (-0.1 + 0.1 * k, height - 0.12, 0.04 * k),
                0.12 + 0.06 * (k % 2),
                (0.035, 0.02),
                ("glass", "moss", "glass")[k],
                10,
            )
            for k in range(3)
        ),
    ]


def cart_butcher(width=0.75, depth=0.46, height=0.88, wood="oak", paint="white") -> list[Part]:
    parts = castors(width / 2 - 0.05, depth / 2 - 0.05, 0.04)
    parts += [
        block((x, 0.07, z), (0.05, height - 0.1, 0.05), paint) for x, z in corners(width / 2 - 0.05, depth / 2 - 0.05)
    ]
    parts += [
        block((0, height - 0.04, 0), (width, 0.04, depth), wood),
        block((0, height - 0.2, 0), (width - 0.08, 0.16, depth - 0.08), paint),
    ]
    parts += [block((0, y, 0.08 * (k - 2)), (width - 0.08, 0.018, 0.06), wood) for y in (0.16, 0.42) for k in range(5)]
    parts += [box((sx * 0.17, height - 0.12, depth / 2 - 0.03), (0.3, 0.13, 0.02), paint) for sx in (-1, 1)] + [
        box((sx * 0.17, height - 0.12, depth / 2 - 0.01), (0.1, 0.02, 0.02), "black") for sx in (-1, 1)
    ]
    return [
        *parts,
        beam(width / 2 + 0.04, height - 0.07, 0.16, 0.012, "steel", 8),
        block((width / 2 + 0.02, height - 0.08, 0), (0.05, 0.02, 0.34), "steel"),
    ]


def cart_bar(width=0.7, depth=0.4, height=0.82, wood="walnut", metal="brass") -> list[Part]:
    """Two large wheels behind, two feet before, a handle to pull it by."""
    parts = [
        bar((-0.24, 0.15, sz * (depth / 2)), (-0.24, 0.15, sz * (depth / 2 + 0.02)), 0.15, metal, 18) for sz in (-1, 1)
    ]
    parts += [block((0, y, 0), (width, 0.025, depth - 0.03), wood) for y in (0.2, height - 0.16)]
    for sz in (-1, 1):
        z = sz * (depth / 2 - 0.03)
        parts += [
            pillar((0.3, 0, z), height - 0.1, 0.014, metal, 8),
            pillar((-0.3, 0.15, z), height - 0.2, 0.014, metal, 8),
            bar((-width / 2, height - 0.09, z), (width / 2 + 0.02, height - 0.09, z), 0.011, metal, 6),
        ]
    parts += [beam(width / 2 + 0.02, height - 0.09, 0.17, 0.014, metal, 8)]
    return [
        *parts,
        *(
            pillar(
                (-0.2 + 0.13 * k, (0.22, height - 0.14)[k % 2], 0.02),
                0.24,
                (0.04, 0.028),
                ("moss", "leather", "glass", "red")[k],
                10,
            )
            for k in range(4)
        ),
    ]


# -- drying racks ------------------------------------------------------


def rack_frame(width=0.75, depth=0.6, height=1.3, wood="birch", cloth="blush") -> list[Part]:
    """Two ladders that lean together."""
    parts = []
    for sz in (-1, 1):
        for sx in (-1, 1):
            parts.append(
                bar(
                    (sx * (width / 2 - 0.02), 0, sz * depth / 2),
                    (sx * (width / 2 - 0.02), height, sz * 0.03),
                    0.02,
                    wood,
                    4,
                )
            )
        for k in range(4):
            y = 0.3 + 0.28 * k
            z = sz * (depth / 2 - (depth / 2 - 0.03) * y / height)
            parts.append(rail(width / 2, y, z, 0.012, wood, 8))
    parts.append(rail(width / 2, height - 0.01, 0, 0.022, wood, 8))
    parts += [beam(sx * (width / 2 - 0.02), 0.2, 0.25, 0.01, "steel", 6) for sx in (-1, 1)]
    return [
        *parts,
        box((0.05, 0.72, 0.16), (0.45, 0.48, 0.02), cloth, 0.2),
        box((-0.1, 0.45, -0.21), (0.4, 0.4, 0.02), "denim", -0.2),
    ]


def rack_rail(width=1.0, height=1.5, depth=0.45, metal="black") -> list[Part]:
    """A rail on a stand with castors, for shirts on hangers."""
    parts = castors(width / 2, depth / 2 - 0.03, 0.03)
    for sx in (-1, 1):
        x = sx * width / 2
        parts += [beam(x, 0.065, depth / 2, 0.016, metal, 6), pillar((x, 0.06, 0), height - 0.06, 0.015, metal, 8)]
    parts += [rail(width / 2, y, 0, 0.014, metal, 8) for y in (0.09, height - 0.015)]
    for k, cloth in enumerate(("white", "denim", "sage", "cream", "charcoal")):
        x = 0.15 * (k - 2.2)
        parts += [
            hull(
                [
                    (x + e, y, z)
                    for e in (-0.025, 0.025)
                    for y, z in (
                        (height - 0.72 + 0.07 * (k % 2), -0.2),
                        (height - 0.72 + 0.07 * (k % 2), 0.2),
                        (height - 0.16, 0.21),
                        (height - 0.16, -0.21),
                        (height - 0.09, 0.0),
                    )
                ],
                cloth,
            ),
            pillar((x, height - 0.11, 0), 0.1, 0.008, "steel", 4),
        ]
    return parts


DRAWINGS = {
    "laundry_basket_hamper": Drawing("laundry_basket", basket_hamper, held_out=True),
    "laundry_basket_folding": Drawing("laundry_basket", basket_folding, held_out=True),
    "cart_trays": Drawing("cart", cart_trays),
    "cart_butcher": Drawing("cart", cart_butcher),
    "cart_tea": Drawing("cart", cart_tea, held_out=True),
    "cart_bar": Drawing("cart", cart_bar, held_out=True),
    "drying_rack_frame": Drawing("drying_rack", rack_frame, held_out=True),
    "drying_rack_rail": Drawing("drying_rack", rack_rail, held_out=True),
}
"""Model name -> how it is drawn."""
