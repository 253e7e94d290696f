"""Sizes and materials in, what is built in of convex parts out: stoves, fridges, showers."""

from __future__ import annotations

import functools

import numpy as np

from converters.generate.models.parts import (
    Drawing,
    Part,
    bar,
    block,
    box,
    corners,
    cushion,
    fronts,
    pillar,
    plate,
    rail,
    rectangle,
    shell,
)

TOP_M = 0.9
"""Height of every worktop, so that modules make a row."""
DEPTH_M = 0.6
_f = functools.partial


def base_unit(width, paint, columns, rows, handle="bar", front="") -> list[Part]:
    """Plinth, carcass and fronts below a worktop."""
    parts = [block((0, 0, -0.03), (width, 0.11, DEPTH_M - 0.1), "charcoal")]
    parts.append(block((0, 0.1, -0.015), (width, TOP_M - 0.14, DEPTH_M - 0.03), paint))
    low, high = (-width / 2, 0.11), (width / 2, TOP_M - 0.05)
    return parts + fronts(low, high, DEPTH_M / 2 - 0.03, columns, rows, front or paint, handle)


def worktop(width, material, thick=0.04) -> Part:
    """The slab over a module."""
    return block((0, TOP_M - thick, 0), (width, thick, DEPTH_M), material)


def tap(x, y, z, reach=0.16, height=0.25, metal="chrome") -> list[Part]:
    """An upright, an arm that points to the front, and a lever."""
    return [
        pillar((x, y, z), height, (0.022, 0.014), metal, 10),
        bar((x, y + height - 0.01, z - 0.008), (x, y + height - 0.03, z + reach), 0.013, metal, 8),
        bar((x, y + height - 0.02, z + reach - 0.01), (x, y + height - 0.07, z + reach - 0.01), 0.013, metal, 8),
        bar((x + 0.015, y + 0.07, z), (x + 0.08, y + 0.1, z), 0.009, metal, 6),
    ]


def oven(width, y0, y1, body, z, window="black") -> list[Part]:
    """A door with a window and a bar to open it."""
    return [
        box((0, (y0 + y1) / 2, z), (width - 0.03, y1 - y0, 0.03), body),
        box((0, y0 + 0.42 * (y1 - y0), z + 0.01), (width - 0.16, 0.55 * (y1 - y0), 0.02), window),
        bar((-width / 2 + 0.07, y1 - 0.05, z + 0.045), (width / 2 - 0.07, y1 - 0.05, z + 0.045), 0.012, "chrome", 8),
    ]


def knobs(count, width, y, z, material="charcoal") -> list[Part]:
    """A row of round knobs that face the front."""
    xs = [width * (k / (count - 1) - 0.5) if count > 1 else 0.0 for k in range(count)]
    return [bar((x, y, z), (x, y, z + 0.025), 0.02, material, 10) for x in xs]


def stove_ceramic(width=0.6, paint="white", top="oak") -> list[Part]:
    """An oven below a worktop with a glass hob."""
    parts = [
        *base_unit(width, paint, 1, 1, "")[:2],
        worktop(width, top),
        block((0, TOP_M, 0), (width - 0.04, 0.008, 0.52), "black"),
    ]
    for k in range(4):
        x, dz = 0.14 * (2 * (k % 2) - 1), 0.12 * (2 * (k // 2) - 1)
        parts.append(pillar((x, TOP_M + 0.006, dz), 0.004, 0.08 if k % 2 else 0.1, "charcoal", 16))
    return [*parts, box((0, 0.18, 0.28), (width - 0.02, 0.12, 0.02), paint), *oven(width, 0.26, 0.74, "steel", 0.28),
            box((0, 0.8, 0.28), (width - 0.02, 0.1, 0.03), "steel"), *knobs(3, 0.3, 0.8, 0.29)]  # fmt: skip


def stove_range(width=0.9, body="red", metal="steel") -> list[Part]:
    z = DEPTH_M / 2
    parts = [pillar((x, 0, z), 0.12, 0.025, metal, 8) for x, z in corners(width / 2 - 0.06, 0.2)]
    parts.append(block((0, 0.11, -0.015), (width, TOP_M - 0.14, DEPTH_M - 0.03), body))
    parts.append(block((0, TOP_M - 0.04, 0), (width, 0.04, DEPTH_M), metal))
    parts.append(block((0, TOP_M - 0.01, -z + 0.02), (width, 0.12, 0.04), metal))
    for k in range(5):
        x, dz = (0.3 * (k % 3 - 1), -0.12) if k < 3 else (0.3 * (2 * k - 7), 0.12)
        parts.append(pillar((x, TOP_M - 0.002, dz), 0.02, 0.07, "black", 12))
        parts.append(block((x, TOP_M + 0.015, dz), (0.2, 0.012, 0.02), "black"))
    for x, width_k in ((-0.2, 0.46), (0.23, 0.4)):
        for part in oven(width_k, 0.2, 0.7, body, z - 0.02):
            parts.append(Part(part.vertices + [x, 0, 0], part.faces, part.material))
    return parts + knobs(7, 0.7, 0.78, z - 0.03, "brass")


def stove_hood(width=0.6, paint="grey", metal="steel") -> list[Part]:
    parts = stove_ceramic(width, paint, "granite")
    parts.append(block((0, TOP_M, -DEPTH_M / 2 + 0.008), (width, 0.7, 0.016), "ceramic"))
    low, high = rectangle(0, -0.05, width, 0.5), rectangle(0, -0.15, 0.24, 0.28)
    parts.append(plate(low, 1.6, 1.64, metal))
    parts.append(plate(low, 1.63, 1.78, metal, high))
    return [*parts, block((0, 1.77, -0.15), (0.24, 0.45, 0.28), metal)]


def fridge_doors(width=0.6, height=1.8, depth=0.65, body="enamel", split=0.66, handle="chrome") -> list[Part]:
    """A cold one over, or under, a freezer: two doors one over the other."""
    z = depth / 2
    parts = [block((0, 0, -0.03), (width - 0.04, 0.06, depth - 0.12), "charcoal")]
    parts.append(block((0, 0.05, -0.035), (width, height - 0.05, depth - 0.07), body))
    cut = 0.06 + split * (height - 0.06)
    for y0, y1 in ((0.06, cut - 0.008), (cut + 0.008, height)):
        parts.append(cushion((0, (y0 + y1) / 2, z - 0.035), (width, y1 - y0, 0.065), body, 0.012))
        long = min(0.4, 0.6 * (y1 - y0))
        y = (y1 - long / 2 - 0.06) if y1 < height - 0.01 else (y0 + long / 2 + 0.06)
        parts.append(
            bar((0.4 * width, y - long / 2, z + 0.015), (0.4 * width, y + long / 2, z + 0.015), 0.012, handle, 8)
        )
    return parts


def fridge_american(width=0.91, height=1.78, depth=0.72, body="steel") -> list[Part]:
    z = depth / 2
    parts = [block((0, 0, -0.03), (width - 0.04, 0.06, depth - 0.12), "charcoal")]
    parts.append(block((0, 0.05, -0.035), (width, height - 0.05, depth - 0.07), "charcoal"))
    for sx in (-1, 1):
        parts.append(
            box(
                (sx * width / 4, 0.06 + (height - 0.06) / 2, z - 0.035), (width / 2 - 0.008, height - 0.06, 0.065), body
            )
        )
        parts.append(bar((sx * 0.05, 0.5, z + 0.03), (sx * 0.05, 1.55, z + 0.03), 0.014, "chrome", 8))
    parts.append(box((-width / 4, 1.15, z + 0.0), (0.22, 0.34, 0.012), "black"))
    return [*parts, box((-width / 4, 1.04, z + 0.008), (0.16, 0.03, 0.02), "grey")]


def mixer(x, z, metal="chrome", lean=0.0) -> list[Part]:
    """A riser with a rain head and a valve."""
    return [
        bar((x, 0.9, z), (x, 2.02, z), 0.014, metal, 8),
        bar((x, 2.02, z), (x + lean, 2.02, z + 0.26), 0.014, metal, 8),
        pillar((x + lean, 1.98, z + 0.26), 0.025, 0.11, metal, 14),
        box((x, 1.05, z), (0.26, 0.05, 0.05), metal),
    ]


def shower_cabin(side=0.9, height=2.0, glass="glass", metal="chrome") -> list[Part]:
    h = side / 2
    parts = [block((0, 0, 0), (side, 0.05, side), "ceramic"), pillar((0, 0.045, 0), 0.01, 0.05, metal, 12)]
    parts += [block((h - 0.012, 0.04, 0), (0.012, height - 0.06, side - 0.02), glass)]
    parts += [
        block((sx * side / 4, 0.05, h - 0.012 - 0.012 * (sx > 0)), (side / 2, height - 0.07, 0.01), glass)
        for sx in (-1, 1)
    ]
    parts += [block((sx * (h - 0.015), 0, h - 0.015), (0.03, height, 0.03), metal) for sx in (-1, 1)]
    parts += [
        block((h - 0.015, 0, -h + 0.015), (0.03, height, 0.03), metal),
        block((0, height - 0.03, h - 0.015), (side, 0.03, 0.03), metal),
    ]
    parts += [block((h - 0.015, height - 0.03, 0), (0.03, 0.03, side), metal)]
    return [*parts, bar((0.06, 0.9, h + 0.01), (0.06, 1.2, h + 0.01), 0.01, metal, 6), *mixer(-0.1, -h + 0.04)]


def shower_quadrant(side=0.9, height=2.0, glass="glass", metal="chrome") -> list[Part]:
    h = side / 2
    bend = [(h, 0.0), (0.88 * h, 0.45 * h), (0.45 * h, 0.88 * h), (0.0, h)]
    outline = np.array([(h, -h), *bend, (-h, h), (-h, -h)])
    parts = [plate(outline, 0, 0.12, "ceramic")]
    curtain = shell(outline, 0.11, height, 0.012, glass)[:5]
    frame = shell(outline, height - 0.03, height + 0.01, 0.03, metal)[:5]
    posts = [
        pillar((x * 0.98, 0.1, z * 0.98), height - 0.1, 0.016, metal, 6) for x, z in ((h, -h), (h, 0), (0, h), (-h, h))
    ]
    return [*parts, *curtain, *frame, *posts, *mixer(-h + 0.1, -h + 0.05, metal)]


def shower_walkin(width=1.3, depth=0.85, height=2.0, glass="glass", metal="black") -> list[Part]:
    parts = [
        block((0, 0, 0), (width, 0.03, depth), "grey"),
        block((0.1, 0.025, depth / 2 - 0.02), (width - 0.25, height, 0.012), glass),
    ]
    parts += [
        block((0.1, height + 0.0, depth / 2 - 0.02), (width - 0.25, 0.03, 0.02), metal),
        block((0.35, 0.02, -depth / 2 + 0.02), (0.7, 0.012, 0.07), metal),
    ]
    parts.append(bar((0.1, height + 0.01, depth / 2 - 0.02), (0.1, height + 0.01, -depth / 2), 0.012, metal, 6))
    return [*parts, *mixer(0.35, -depth / 2 + 0.04, metal)]


def shower_curtain(side=0.85, height=2.0, cloth="teal", metal="chrome") -> list[Part]:
    """A raised tray with a rail and a curtain pushed aside."""
    h = side / 2
    parts = [
        *shell(rectangle(0, 0, side, side), 0, 0.16, 0.05, "ceramic"),
        block((0, 0, 0), (side, 0.08, side), "ceramic"),
    ]
    parts += [
        rail(h, height, h - 0.03, 0.012, metal, 6),
        bar((h - 0.03, height, h), (h - 0.03, height, -h), 0.012, metal, 6),
    ]
    parts += [
        cushion((h - 0.06 - 0.05 * k, 1.1, h - 0.03 - 0.02 * (k % 2)), (0.06, 1.78, 0.05), cloth, 0.02)
        for k in range(8)
    ]
    return [*parts, pillar((h - 0.03, 0.15, h - 0.03), height - 0.15, 0.014, metal, 8), *mixer(-0.1, -h + 0.04, metal)]


DRAWINGS = {
    "stove_ceramic": Drawing("stove", stove_ceramic),
    "stove_range": Drawing("stove", stove_range, held_out=True),
    "stove_hood": Drawing("stove", stove_hood, held_out=True),
    "fridge_combined": Drawing("fridge", fridge_doors),
    "fridge_freezer_above": Drawing("fridge", _f(fridge_doors, 0.7, 1.7, 0.68, "grey", 0.7, "black")),
    "fridge_american": Drawing("fridge", fridge_american),
    "shower_cabin": Drawing("shower", shower_cabin),
    "shower_quadrant": Drawing("shower", shower_quadrant),
    "shower_walkin": Drawing("shower", shower_walkin, held_out=True),
    "shower_curtain": Drawing("shower", shower_curtain, held_out=True),
}
"""Model name -> how it is drawn."""
