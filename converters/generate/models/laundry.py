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
    feet,
    hull,
    oval,
    pillar,
    plate,
    rail,
    rectangle,
    shell,
)  # fmt: skip

# -- washers -----------------------------------------------------------


def washer_front(width=0.6, height=0.85, depth=0.58, body="enamel", trim="grey", y0=0.0) -> list[Part]:
    """A drum behind a round window."""
    z = depth / 2
    parts = [
        block((0, y0, -0.01), (width, height, depth - 0.03), body),
        block((0, y0 + height - 0.02, 0), (width, 0.025, depth), body),
    ]
    middle = y0 + 0.45 * height
    parts += [
        bar((0, middle, z - 0.03), (0, middle, z + 0.012), 0.2, trim, 20),
        bar((0, middle, z), (0, middle, z + 0.025), (0.155, 0.14), "black", 20),
    ]
    parts += [
        box((0, y0 + height - 0.085, z - 0.02), (width - 0.02, 0.11, 0.02), trim),
        box((-0.18, y0 + height - 0.085, z - 0.008), (0.18, 0.08, 0.016), body),
    ]
    parts += [bar((0.02, y0 + height - 0.085, z - 0.02), (0.02, y0 + height - 0.085, z + 0.015), 0.03, "chrome", 12)]
    return [
        *parts,
        box((0.18, y0 + height - 0.085, z - 0.008), (0.14, 0.05, 0.012), "black"),
        box((0.18, middle, z + 0.016), (0.03, 0.1, 0.014), body),
    ]


def washer_stack() -> list[Part]:
    return (
        washer_front() + washer_front(y0=0.86, trim="charcoal") + [block((0, 0.84, -0.01), (0.59, 0.03, 0.54), "black")]
    )


def washer_top(width=0.45, height=0.88, depth=0.6, body="enamel") -> list[Part]:
    parts = feet(width, depth, 0.04, 0.025, "black") + [block((0, 0.03, 0), (width, height - 0.09, depth), body)]
    panel = rectangle(0, -depth / 2 + 0.08, width, 0.16)
    parts += [plate(panel, height - 0.07, height + 0.05, "grey", rectangle(0, -depth / 2 + 0.05, width, 0.09))]
    parts += [
        cushion((0, height - 0.045, 0.08), (width - 0.01, 0.05, depth - 0.18), body, 0.015),
        box((0, height - 0.05, depth / 2), (0.14, 0.025, 0.02), "grey"),
    ]
    return parts + [
        pillar((x, height + 0.0, -depth / 2 + 0.1), 0.05, 0.024, "charcoal", 10) for x in (-0.14, 0.0, 0.14)
    ]


def washer_cabinet(width=0.66, height=0.9, depth=0.62, wood="oak") -> list[Part]:
    """In a frame with a worktop and a basket on it."""
    parts = washer_front(0.6, 0.83, 0.56, "charcoal", "black")
    parts += [block((sx * (width / 2 - 0.012), 0, 0), (0.024, height - 0.03, depth), wood) for sx in (-1, 1)]
    parts.append(block((0, height - 0.035, 0), (width, 0.035, depth), wood))
    return [
        *parts,
        *shell(rectangle(0, 0, 0.42, 0.3, 0.05), height, height + 0.2, 0.02, "wicker"),
        cushion((0, height + 0.1, 0), (0.36, 0.16, 0.24), "white", 0.05),
    ]


# -- laundry baskets ---------------------------------------------------


def basket_round(radius=0.24, height=0.42, weave="wicker", cloth="white", sides=14) -> list[Part]:
    low, top = oval(0, 0, 0.76 * radius, 0.76 * radius, sides), oval(0, 0, radius, radius, sides)
    parts = [
        *shell(low, 0, height, 0.02, weave, top),
        plate(low, 0, 0.02, weave),
        *shell(oval(0, 0, radius + 0.012, radius + 0.012, 8), height - 0.04, height, 0.035, "leather"),
    ]
    return [
        *parts,
        ball((0.04, 0.28, 0.02), (0.15, 0.12, 0.14), cloth),
        ball((-0.07, 0.3, -0.04), (0.1, 0.1, 0.12), "denim"),
    ]


def basket_oblong(width=0.6, height=0.27, depth=0.4, body="sage", cloth="cream") -> list[Part]:
    low, top = rectangle(0, 0, width - 0.12, depth - 0.1, 0.06), rectangle(0, 0, width - 0.04, depth - 0.02, 0.08)
    parts = [*shell(low, 0, height, 0.015, body, top), plate(low, 0, 0.015, body)]
    parts += [cushion((sx * (width / 2 - 0.03), height - 0.02, 0), (0.06, 0.035, 0.16), body, 0.012) for sx in (-1, 1)]
    for k, (x, z) in enumerate(((-0.12, 0.03), (0.1, -0.04), (0.0, 0.06))):
        parts.append(ball((x, 0.19, z), (0.14, 0.1, 0.1), (cloth, "blush", "navy")[k]))
    return parts


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


def rack_wings(length=1.1, depth=0.55, height=0.95, metal="white", cloth="denim") -> list[Part]:
    """Crossed legs, a level frame, and wings that rise to both sides."""
    parts = []
    for sx in (-1, 1):
        x = sx * (length / 2 - 0.03)
        parts += [bar((x, 0.012, sz * depth / 2), (x, height, -sz * depth / 2), 0.013, metal, 6) for sz in (-1, 1)]
        parts += [
            bar((x, height, sz * depth / 2), (x, height + 0.12, sz * (depth / 2 + 0.3)), 0.011, metal, 6)
            for sz in (-1, 1)
        ]
    rails = [(height, depth * (k / 6 - 0.5)) for k in range(7)] + [
        (height + 0.04 * k, s * (depth / 2 + 0.1 * k)) for s in (-1, 1) for k in (1, 2, 3)
    ]
    parts += [rail(length / 2, y, z, 0.008, metal, 6) for y, z in rails]
    parts += [rail(length / 2, 0.014, s * depth / 2, 0.014, metal, 6) for s in (-1, 1)]
    return [
        *parts,
        block((-0.2, height - 0.45, 0.09), (0.4, 0.47, 0.02), cloth),
        block((0.25, height - 0.3, -0.09), (0.3, 0.32, 0.02), "cream"),
    ]


def rack_tower(width=0.66, depth=0.6, height=1.35, metal="grey") -> list[Part]:
    parts = [
        pillar((sx * width / 2, 0.0, sz * depth / 2 * 0.9), height if sz < 0 else height - 0.05, 0.013, metal, 6)
        for sx in (-1, 1)
        for sz in (-1, 1)
    ]
    for tier in range(3):
        y = 0.35 + 0.45 * tier
        parts += [
            bar(
                (-width / 2, y, depth * (0.225 * k - 0.45)), (width / 2, y, depth * (0.225 * k - 0.45)), 0.008, metal, 6
            )
            for k in range(5)
        ]
        parts += [
            bar((sx * width / 2, y, -0.45 * depth), (sx * width / 2, y, 0.45 * depth), 0.01, metal, 6) for sx in (-1, 1)
        ]
    parts += [
        bar((sx * width / 2, 0.03, -0.45 * depth), (sx * width / 2, 0.03, 0.45 * depth), 0.018, metal, 6)
        for sx in (-1, 1)
    ]
    return [
        *parts,
        block((-0.1, 0.86, 0.14), (0.34, 0.4, 0.02), "mustard"),
        block((0.05, 0.45, -0.13), (0.44, 0.36, 0.02), "white"),
    ]


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
    "washer_front": Drawing("washer", washer_front),
    "washer_stack": Drawing("washer", washer_stack),
    "washer_top": Drawing("washer", washer_top, held_out=True),
    "washer_cabinet": Drawing("washer", washer_cabinet, held_out=True),
    "laundry_basket_round": Drawing("laundry_basket", basket_round),
    "laundry_basket_oblong": Drawing("laundry_basket", basket_oblong),
    "laundry_basket_hamper": Drawing("laundry_basket", basket_hamper, held_out=True),
    "laundry_basket_folding": Drawing("laundry_basket", basket_folding, held_out=True),
    "cart_trays": Drawing("cart", cart_trays),
    "cart_butcher": Drawing("cart", cart_butcher),
    "cart_tea": Drawing("cart", cart_tea, held_out=True),
    "cart_bar": Drawing("cart", cart_bar, held_out=True),
    "drying_rack_wings": Drawing("drying_rack", rack_wings, "__SYM_ROTATE_UP_2"),
    "drying_rack_tower": Drawing("drying_rack", rack_tower),
    "drying_rack_frame": Drawing("drying_rack", rack_frame, held_out=True),
    "drying_rack_rail": Drawing("drying_rack", rack_rail, held_out=True),
}
"""Model name -> how it is drawn."""
