"""Sizes and materials in, small things of convex parts out: bags, suitcases, plants, lamps, poufs."""

from __future__ import annotations

import math

from converters.generate.models.parts import (
    Drawing,
    Part,
    ball,
    bar,
    block,
    box,
    corners,
    cushion,
    leaf,
    oval,
    pillar,
    plate,
    rail,
    rectangle,
    shell,
    turned,
)


def strap(points, radius, material) -> list[Part]:
    """Bars from point to point."""
    return [bar(a, b, radius, material, 6) for a, b in zip(points, points[1:], strict=False)]


def bag_duffel(length=0.58, radius=0.14, cloth="moss", trim="leather") -> list[Part]:
    parts = [rail(length / 2, radius, 0, radius, cloth, 12), block((0, 0, 0), (length - 0.04, 0.06, 0.2), cloth)]
    parts += [bar((x - 0.015, radius, 0), (x + 0.015, radius, 0), radius + 0.006, trim, 12) for x in (-0.14, 0.14)]
    for sz in (-1, 1):
        parts += strap(
            [(-0.14, 0.24, sz * 0.08), (-0.1, 0.38, sz * 0.03), (0.1, 0.38, sz * 0.03), (0.14, 0.24, sz * 0.08)],
            0.012,
            trim,
        )
    return parts


def bag_paper(width=0.32, height=0.36, depth=0.18, paper="cardboard") -> list[Part]:
    """Open, with a loaf and greens that look out."""
    outline = rectangle(0, 0, width, depth)
    parts = [
        *shell(outline, 0, height, 0.012, paper),
        block((0, 0, 0), (width, 0.012, depth), paper),
        block((-0.05, 0.01, 0), (0.2, height - 0.06, 0.13), "cream"),
    ]
    parts += [
        bar((-0.08, 0.15, 0.02), (-0.12, height + 0.14, 0.03), 0.032, "oak", 8),
        ball((0.07, height, 0), (0.07, 0.1, 0.06), "fern"),
        ball((-0.01, height - 0.02, -0.03), (0.045, 0.05, 0.045), "red"),
    ]
    return parts


def bin_pedal(radius=0.15, height=0.42, metal="steel") -> list[Part]:
    parts = turned((0, 0, 0), [(radius, 0), (radius, 0.03)], "black", 18) + turned(
        (0, 0.03, 0), [(0.97 * radius, 0), (0.97 * radius, height - 0.09)], metal, 18
    )
    parts += turned((0, height - 0.06, 0), [(radius, 0), (radius, 0.02), (0.6 * radius, 0.06)], "black", 18)
    return [
        *parts,
        box((0, 0.02, radius + 0.03), (0.08, 0.015, 0.07), "black"),
        box((0, height - 0.08, -radius), (0.08, 0.06, 0.03), "black"),
    ]


def bin_open(radius=0.15, height=0.3, material="black", sides=12, waste="white") -> list[Part]:
    low, top = oval(0, 0, 0.75 * radius, 0.75 * radius, sides), oval(0, 0, radius, radius, sides)
    parts = [*shell(low, 0, height, 0.01, material, top), plate(low, 0, 0.012, material)]
    return [
        *parts,
        ball((0.03, 0.6 * height, 0), (0.07, 0.06, 0.07), waste),
        ball((-0.04, 0.5 * height, 0.03), (0.06, 0.06, 0.06), waste),
    ]


def suitcase_hard(width=0.42, height=0.62, depth=0.25, body="teal", ribs=5) -> list[Part]:
    parts = [cushion((0, 0.05 + height / 2, 0), (width, height, depth), body, 0.045)]
    parts += [
        block((width * ((k + 0.5) / ribs - 0.5), 0.12, 0), (0.025, height - 0.14, depth + 0.012), body)
        for k in range(ribs)
    ]
    parts += [block((0, 0.06, 0), (width + 0.006, height - 0.02, 0.016), "charcoal")]
    parts += [pillar((x, 0, z), 0.07, 0.026, "black", 10) for x, z in corners(0.15, 0.08)]
    parts += [bar((sx * 0.08, height, -0.06), (sx * 0.08, height + 0.34, -0.06), 0.009, "chrome", 6) for sx in (-1, 1)]
    return [
        *parts,
        cushion((0, height + 0.345, -0.06), (0.2, 0.03, 0.035), "black", 0.01),
        cushion((0, height + 0.07, 0.03), (0.16, 0.03, 0.03), "black", 0.01),
    ]


def suitcase_vintage(width=0.6, height=0.19, depth=0.42, hide="leather", metal="brass") -> list[Part]:
    """Lies flat."""
    parts = [
        cushion((0, height / 2, 0), (width, height, depth), hide, 0.02),
        block((0, height / 2 - 0.01, 0), (width + 0.008, 0.02, depth + 0.008), "bark"),
    ]
    parts += [block((sx * 0.18, 0.002, 0), (0.045, height + 0.004, depth + 0.012), "bark") for sx in (-1, 1)]
    parts += [box((sx * 0.18, height / 2, depth / 2 + 0.012), (0.05, 0.06, 0.016), metal) for sx in (-1, 1)]
    return parts + strap(
        [
            (-0.08, height / 2, depth / 2),
            (-0.07, height / 2, depth / 2 + 0.045),
            (0.07, height / 2, depth / 2 + 0.045),
            (0.08, height / 2, depth / 2),
        ],
        0.012,
        "bark",
    )


def planter(radius, height, material="terracotta", rim=True) -> list[Part]:
    """A tapered pot with earth in it; a rim where one is wanted."""
    body = turned((0, 0, 0), [(0.72 * radius, 0), (0.95 * radius, height)], material, 16)
    body += turned((0, height - 0.05, 0), [(radius, 0), (radius, 0.05)], material, 16) if rim else []
    return [*body, pillar((0, height - 0.01, 0), 0.015, 0.86 * radius, "soil", 16)]


def _mix(a, b, share):
    return tuple(x + share * (y - x) for x, y in zip(a, b, strict=True))


def plant_monstera(height=0.9) -> list[Part]:
    """Broad leaves on long stalks."""
    parts = planter(0.18, 0.28)
    for k in range(10):
        a = 2.4 * k
        reach, top = 0.16 + 0.02 * (k % 4), height - 0.06 * k
        stalk = (reach * math.cos(a), top - 0.1, reach * math.sin(a))
        tip = ((reach + 0.26) * math.cos(a), top - 0.16, (reach + 0.26) * math.sin(a))
        parts += [
            bar((0, 0.27, 0), stalk, 0.008, "fern", 4),
            leaf(_mix(stalk, tip, -0.1), tip, 0.24, "leaf" if k % 2 else "fern", 0.012),
        ]
    return parts


def plant_cactus(height=0.95) -> list[Part]:
    """A column with two arms."""
    parts = planter(0.16, 0.22, "terracotta")
    parts += turned((0, 0.2, 0), [(0.06, 0), (0.075, 0.1), (0.075, height - 0.36), (0.03, height - 0.2)], "moss", 10)
    for sx, y in ((-1, 0.42), (1, 0.55)):
        parts += [
            bar((0, y, 0), (sx * 0.15, y + 0.02, 0), 0.042, "moss", 8),
            bar((sx * 0.15, y - 0.02, 0), (sx * 0.15, y + 0.2, 0), (0.044, 0.04), "moss", 8),
            ball((sx * 0.15, y + 0.2, 0), (0.04, 0.04, 0.04), "moss"),
        ]
    return parts


def lamp_shade(height=1.55, foot=0.17, metal="black", shade="lampshade", top=0.11, low=0.16) -> list[Part]:
    parts = turned((0, 0, 0), [(foot, 0), (foot, 0.035), (0.5 * foot, 0.055)], metal, 18)
    parts.append(pillar((0, 0.05, 0), height - 0.28, 0.013, metal, 8))
    return [
        *parts,
        pillar((0, height - 0.22, 0), 0.22, (low, top), shade, 18),
        bar((0.05, height - 0.3, 0), (0.05, height - 0.22, 0), 0.004, metal, 4),
    ]


def lamp_tripod(height=1.5, wood="oak", shade="white") -> list[Part]:
    """Its legs carry a tray, which keeps their hulls apart and its weight low."""
    parts = [
        pillar((0, height - 0.27, 0), 0.22, (0.16, 0.13), shade, 18),
        pillar((0, height - 0.4, 0), 0.14, 0.03, "black", 10),
    ]
    for a in (math.pi / 2, math.pi * 7 / 6, math.pi * 11 / 6):
        c, s = math.cos(a), math.sin(a)
        parts += [bar((0.32 * c, 0, 0.32 * s), (0.02 * c, height - 0.36, 0.02 * s), (0.032, 0.022), wood, 8)]
        parts += [pillar((0.32 * c, 0, 0.32 * s), 0.05, 0.045, wood, 10)]
    return [*parts, pillar((0, 0.42, 0), 0.03, 0.25, wood, 18)]


def lamp_uplighter(height=1.75, foot=0.15, metal="steel", shade="ceramic") -> list[Part]:
    parts = turned((0, 0, 0), [(foot, 0), (foot, 0.05), (0.03, 0.07)], metal, 18)
    parts.append(pillar((0, 0.06, 0), height - 0.14, 0.014, metal, 8))
    parts += turned((0, height - 0.1, 0), [(0.03, 0), (0.14, 0.08), (0.16, 0.1)], shade, 18)
    parts += [
        bar((0.01, 1.15, 0), (0.16, 1.25, 0.1), 0.008, metal, 6),
        bar((0.15, 1.27, 0.09), (0.2, 1.2, 0.13), (0.02, 0.05), shade, 10),
    ]
    return parts


def lamp_arc(height=1.7, reach=0.45, metal="chrome", stone="marble") -> list[Part]:
    """Bends over from a heavy foot."""
    parts = [
        plate(rectangle(0, 0.03, 0.36, 0.46, 0.03), 0, 0.14, stone),
        pillar((0, 0.13, -0.12), 1.0, 0.014, metal, 8),
    ]
    arc = [
        (0, 1.12 + (height - 1.12) * math.sin(a), -0.12 + reach * (1 - math.cos(a)))
        for a in (0, 0.45, 0.9, 1.35, 1.75, 2.1)
    ]
    parts += [bar(a, b, 0.012, metal, 8) for a, b in zip(arc, arc[1:], strict=False)]
    x, y, z = arc[-1]
    return [*parts, *turned((x, y - 0.13, z), [(0.12, 0), (0.1, 0.07), (0.03, 0.13)], metal, 16)]


def lamp_column(height=1.3, side=0.3, frame="black", paper="lampshade") -> list[Part]:
    """A tall lantern of paper with shelves below it."""
    h = side / 2 - 0.012
    parts = [block((x, 0, z), (0.024, height, 0.024), frame) for x, z in corners(h, h)]
    parts += [block((0, y, 0), (side, 0.022, side), frame) for y in (0.02, 0.3, 0.58, height - 0.022)]
    parts.append(block((0, 0.6, 0), (side - 0.03, height - 0.62, side - 0.03), paper))
    return [
        *parts,
        block((0, 0.04, 0), (0.2, 0.18, 0.2), "navy"),
        cushion((0.02, 0.37, 0), (0.14, 0.1, 0.18), "rust", 0.03),
        box((0, 0.46, 0.02), (0.1, 0.04, 0.14), "cream"),
    ]


def pouf_beanbag(cloth="denim") -> list[Part]:
    low = turned((0, 0, 0), [(0.34, 0), (0.42, 0.07), (0.43, 0.2), (0.36, 0.34)], cloth, 14)
    back = plate(oval(0, -0.06, 0.34, 0.28, 12), 0.3, 0.52, cloth, oval(0, -0.18, 0.24, 0.16, 12))
    return [*low, back, plate(oval(0, -0.18, 0.2, 0.13, 12), 0.5, 0.66, cloth, oval(0, -0.22, 0.07, 0.05, 12))]


def pouf_moroccan(radius=0.28, hide="leather", seam="tape") -> list[Part]:
    parts = [ball((0, 0.165, 0), (radius, 0.185, radius), hide, 16), pillar((0, 0, 0), 0.1, 0.75 * radius, hide, 16)]
    for i in range(8):
        a = 2 * math.pi * i / 8
        c, s = math.cos(a), math.sin(a)
        parts.append(bar((0.08 * c, 0.348, 0.08 * s), (0.19 * c, 0.30, 0.19 * s), 0.01, seam, 4))
    parts.append(pillar((0, 0.33, 0), 0.03, 0.08, seam, 12))
    return parts


DRAWINGS = {
    "bag_duffel": Drawing("bag", bag_duffel, held_out=True),
    "bag_paper": Drawing("bag", bag_paper, held_out=True),
    "bin_pedal": Drawing("bin", bin_pedal),
    "bin_open": Drawing("bin", bin_open),
    "suitcase_hard": Drawing("suitcase", suitcase_hard),
    "suitcase_vintage": Drawing("suitcase", suitcase_vintage, held_out=True),
    "plant_monstera": Drawing("plant", plant_monstera, held_out=True),
    "plant_cactus": Drawing("plant", plant_cactus, held_out=True),
    "floor_lamp_shade": Drawing("floor_lamp", lamp_shade, "__SYM_ROTATE_UP_INF"),
    "floor_lamp_tripod": Drawing("floor_lamp", lamp_tripod),
    "floor_lamp_uplighter": Drawing("floor_lamp", lamp_uplighter),
    "floor_lamp_arc": Drawing("floor_lamp", lamp_arc, held_out=True),
    "floor_lamp_column": Drawing("floor_lamp", lamp_column, "__SYM_ROTATE_UP_4", held_out=True),
    "pouf_beanbag": Drawing("pouf", pouf_beanbag, held_out=True),
    "pouf_moroccan": Drawing("pouf", pouf_moroccan, "__SYM_ROTATE_UP_INF", held_out=True),
}
"""Model name -> how it is drawn."""
