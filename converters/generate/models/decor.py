"""Sizes and materials in, potted plants and floor lamps of convex parts out."""

from __future__ import annotations

import functools
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
    rectangle,
    turned,
)  # fmt: skip

# -- plants ------------------------------------------------------------


def planter(radius, height, material="terracotta", rim=True) -> list[Part]:
    """A tapered pot with earth in it; a rim where one is wanted."""
    body = turned((0, 0, 0), [(0.72 * radius, 0), (0.95 * radius, height)], material, 16)
    body += turned((0, height - 0.05, 0), [(radius, 0), (radius, 0.05)], material, 16) if rim else []
    return [*body, pillar((0, height - 0.01, 0), 0.015, 0.86 * radius, "soil", 16)]


def rosette(base, count, length, rise, width, material, turn=0.0, droop=0.0) -> list[Part]:
    """Leaves about an axis: they climb by `rise`, then hang by `droop`."""
    leaves = []
    for k in range(count):
        a = 2 * math.pi * k / count + turn
        c, s = math.cos(a), math.sin(a)
        middle = (base[0] + 0.55 * length * c, base[1] + rise, base[2] + 0.55 * length * s)
        tip = (base[0] + length * c, base[1] + rise - droop, base[2] + length * s)
        leaves += [leaf(base, middle if droop else tip, width, material)] + (
            [leaf(_mix(base, middle, 0.8), tip, width, material)] if droop else []
        )
    return leaves


def _mix(a, b, share):
    return tuple(x + share * (y - x) for x, y in zip(a, b, strict=True))


def plant_ficus(height=1.25) -> list[Part]:
    """A small tree with a round crown."""
    parts = [
        *planter(0.22, 0.3, "cream"),
        bar((0, 0.28, 0), (0.02, height - 0.35, 0.01), (0.022, 0.016), "bark", 8),
    ]
    for k, (x, y, z, r) in enumerate(
        (
            (0, 0, 0, 0.24),
            (0.16, -0.1, 0.06, 0.15),
            (-0.15, -0.08, 0.07, 0.16),
            (0.02, -0.09, -0.17, 0.15),
            (0.04, 0.16, 0.02, 0.15),
        )
    ):
        parts.append(ball((x, height - 0.28 + y, z), (r, 0.8 * r, r), "leaf" if k % 2 else "fern", 9))
    return parts


def plant_snake(blades=9, height=0.85) -> list[Part]:
    """Stiff upright blades."""
    parts = planter(0.15, 0.26, "charcoal", False)
    for k in range(blades):
        a, r = 2.4 * k, 0.03 + 0.008 * k
        top = height - 0.05 * (k % 4)
        x, z = r * math.cos(a), r * math.sin(a)
        parts.append(
            plate(
                oval(x, z, 0.03, 0.012, 6),
                0.22,
                0.6 * top,
                "leaf" if k % 2 else "fern",
                oval(1.4 * x, 1.4 * z, 0.036, 0.012, 6),
            )
        )
        parts.append(
            plate(
                oval(1.4 * x, 1.4 * z, 0.036, 0.012, 6),
                0.59 * top,
                top,
                "leaf" if k % 2 else "fern",
                oval(1.8 * x, 1.8 * z, 0.004, 0.004, 6),
            )
        )
    return parts


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


def plant_palm(height=1.5) -> list[Part]:
    """A trunk with a tuft of hanging fronds, in a basket."""
    parts = [
        *turned((0, 0, 0), [(0.2, 0), (0.23, 0.16), (0.19, 0.3)], "wicker", 14),
        pillar((0, 0.29, 0), 0.012, 0.16, "soil", 14),
    ]
    crown = (0.03, height - 0.35, 0.0)
    parts.append(bar((0, 0.28, 0), crown, (0.035, 0.022), "bark", 8))
    return (
        parts
        + rosette(crown, 8, 0.46, 0.3, 0.09, "leaf", 0.2, 0.22)
        + rosette(crown, 5, 0.3, 0.36, 0.08, "fern", 0.5, 0.06)
    )


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


def plant_fern(stand=0.5) -> list[Part]:
    """A bushy one on a stand of three legs."""
    parts = [
        bar(
            (0.18 * math.cos(a), 0, 0.18 * math.sin(a)),
            (0.1 * math.cos(a), stand + 0.06, 0.1 * math.sin(a)),
            0.013,
            "oak",
            6,
        )
        for a in (0.5, 2.6, 4.7)
    ]
    parts += [
        pillar((0, stand - 0.06, 0), 0.02, 0.12, "oak", 12),
        *turned((0, stand - 0.04, 0), [(0.09, 0), (0.13, 0.06), (0.12, 0.17)], "ceramic", 14),
    ]
    top = (0.0, stand + 0.12, 0.0)
    return parts + rosette(top, 8, 0.36, 0.16, 0.08, "fern", 0.0, 0.2) + rosette(top, 7, 0.22, 0.26, 0.07, "leaf", 0.3)


# -- floor lamps: their weight is in the foot --------------------------


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


_f = functools.partial
DRAWINGS = {
    "plant_ficus": Drawing("plant", plant_ficus),
    "plant_snake": Drawing("plant", plant_snake),
    "plant_palm": Drawing("plant", plant_palm),
    "plant_fern": Drawing("plant", plant_fern),
    "plant_monstera": Drawing("plant", plant_monstera, held_out=True),
    "plant_cactus": Drawing("plant", plant_cactus, held_out=True),
    "floor_lamp_shade": Drawing("floor_lamp", lamp_shade, "__SYM_ROTATE_UP_INF"),
    "floor_lamp_tripod": Drawing("floor_lamp", lamp_tripod),
    "floor_lamp_uplighter": Drawing("floor_lamp", lamp_uplighter),
    "floor_lamp_arc": Drawing("floor_lamp", lamp_arc, held_out=True),
    "floor_lamp_column": Drawing("floor_lamp", lamp_column, "__SYM_ROTATE_UP_4", held_out=True),
}
"""Model name -> how it is drawn."""
