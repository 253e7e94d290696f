"""Sizes and materials in, what is built into bathrooms out, of convex parts: tubs, toilets, basins; and radiators."""

from __future__ import annotations

import functools

import numpy as np

from converters.generate.models.kitchen import tap
from converters.generate.models.parts import (
    Drawing,
    Part,
    ball,
    bar,
    block,
    box,
    corners,
    cushion,
    fronts,
    hull,
    oval,
    pillar,
    plate,
    rail,
    rectangle,
    shell,
    turned,
)  # fmt: skip

# -- tubs and showers --------------------------------------------------


def tub_apron(width=1.7, depth=0.75, height=0.58, body="ceramic") -> list[Part]:
    """Built in: straight outside, sloping inside."""
    inner_top, inner_low = (
        rectangle(0, 0, width - 0.14, depth - 0.14, 0.12),
        rectangle(0, 0, width - 0.3, depth - 0.26, 0.1),
    )
    rim = np.array([rectangle(0, 0, width, depth, 0.06), inner_top])
    parts = shell(rim[0], 0, height, 0.05, body)
    for k in range(8):
        pair = [k, (k + 1) % 8]
        top = np.column_stack([rim[0][pair][:, 0], [height] * 2, rim[0][pair][:, 1]])
        edge = np.column_stack([inner_top[pair][:, 0], [height] * 2, inner_top[pair][:, 1]])
        low = np.column_stack([inner_low[pair][:, 0], [0.14] * 2, inner_low[pair][:, 1]])
        parts.append(_slab([*top, *edge], 0.04, body))
        parts.append(_slab([*edge, *low], 0.03, body))
    parts.append(plate(inner_low, 0.1, 0.15, body))
    return parts + tap(-width / 2 + 0.06, height - 0.01, 0, 0.0, 0.12)


def _slab(corners, thick, material) -> Part:
    """A plate under four corners."""
    points = np.asarray(corners, float)
    return hull(np.concatenate([points, points - [0, thick, 0]]), material)


def tub_oval(width=1.65, depth=0.78, height=0.6, body="ceramic", metal="chrome") -> list[Part]:
    low, top = oval(0, 0, 0.4 * width, 0.36 * depth, 16), oval(0, 0, width / 2, depth / 2, 16)
    parts = [*shell(low, 0, height, 0.06, body, top), plate(low, 0, 0.12, body)]
    return parts + [
        pillar((0.55 * width, 0, -0.1), 0.85, 0.02, metal),
        bar((0.55 * width, 0.83, -0.1), (0.4 * width, 0.8, -0.06), 0.016, metal, 8),
    ]


def tub_corner(side=1.35, height=0.56, body="ceramic") -> list[Part]:
    """Fits a corner: its front is cut."""
    h = side / 2
    outline = np.array([(h, -h), (h, -0.1), (0.3 * h, 0.75 * h), (-0.1, h), (-h, h), (-h, -h)])
    inner = outline * 0.62 + [-0.05, -0.05]
    parts = [*shell(outline, 0, height, 0.06, body), plate(inner, 0.1, 0.15, body)]
    for k in range(6):
        pair = [k, (k + 1) % 6]
        edge = np.column_stack([outline[pair][:, 0], [height] * 2, outline[pair][:, 1]])
        rim = np.column_stack([(0.85 * outline)[pair][:, 0], [height] * 2, (0.85 * outline)[pair][:, 1]])
        low = np.column_stack([inner[pair][:, 0], [0.14] * 2, inner[pair][:, 1]])
        parts += [_slab([*edge, *rim], 0.04, body), _slab([*rim, *low], 0.03, body)]
    return parts + tap(-h + 0.14, height - 0.01, -h + 0.1, 0.14, 0.14)


def tub_clawfoot(width=1.6, depth=0.74, height=0.62, body="ceramic", metal="brass") -> list[Part]:
    parts = [ball((x, 0.06, z), (0.06, 0.07, 0.05), metal) for x, z in corners(0.5, 0.22)]
    low, top = oval(0, 0, 0.4 * width, 0.32 * depth, 14), oval(0, 0, 0.47 * width, 0.46 * depth, 14)
    parts += [*shell(low, 0.1, height - 0.03, 0.04, body, top), plate(low, 0.1, 0.16, body)]
    parts += shell(oval(0, 0, width / 2, depth / 2, 14), height - 0.05, height, 0.07, body)
    return parts + tap(0, height - 0.02, -depth / 2 + 0.03, 0.12, 0.2, metal)


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


# -- toilets and basins ------------------------------------------------


def bowl(z, top, body="ceramic", seat="white", foot=0.0, long=0.27) -> list[Part]:
    """A bowl with its seat and a closed lid; `z` is its middle, `foot` where it begins above the floor."""
    low = oval(0, z - 0.06, 0.12, 0.18, 14) if foot == 0 else oval(0, z - 0.1, 0.11, 0.14, 14)
    rim = oval(0, z, 0.18, long, 16)
    middle = oval(0, z - 0.03, 0.13, 0.2, 14)
    parts = [
        plate(low, foot, foot + 0.5 * (top - foot), body, middle),
        plate(middle, foot + 0.48 * (top - foot), top, body, rim),
    ]
    return [
        *parts,
        plate(oval(0, z, 0.185, long + 0.005, 16), top, top + 0.025, seat),
        plate(oval(0, z - 0.01, 0.175, long - 0.01, 16), top + 0.024, top + 0.042, seat),
    ]


def toilet_coupled(depth=0.68, height=0.78, body="ceramic") -> list[Part]:
    parts = bowl(0.07, 0.4, body)
    parts.append(cushion((0, 0.57, -depth / 2 + 0.09), (0.38, 0.36, 0.18), body, 0.02))
    parts.append(cushion((0, height - 0.015, -depth / 2 + 0.09), (0.4, 0.04, 0.2), body, 0.012))
    parts.append(block((0, 0.15, -depth / 2 + 0.11), (0.22, 0.26, 0.2), body))
    return [*parts, pillar((0, height, -depth / 2 + 0.09), 0.015, 0.03, "chrome", 12)]


def toilet_hung(depth=0.7, height=1.12, body="ceramic", wall="white") -> list[Part]:
    """Hangs on a casing that hides its tank."""
    parts = [
        block((0, 0, -depth / 2 + 0.085), (0.6, height - 0.02, 0.17), wall),
        block((0, height - 0.02, -depth / 2 + 0.09), (0.64, 0.02, 0.2), "oak"),
    ]
    parts += bowl(0.1, 0.4, body, "white", 0.1, 0.25)
    parts.append(block((0, 0.2, -0.13), (0.24, 0.2, 0.12), body))
    return [
        *parts,
        box((0, 0.95, -depth / 2 + 0.175), (0.24, 0.16, 0.012), "chrome"),
        box((0.05, 0.95, -depth / 2 + 0.183), (0.09, 0.11, 0.01), "white"),
    ]


def toilet_square(depth=0.62, body="ceramic", seat="charcoal") -> list[Part]:
    shape = rectangle(0, 0.04, 0.36, 0.52, 0.07)
    parts = [plate(shape * [0.8, 0.9], 0, 0.4, body, shape), plate(shape, 0.4, 0.44, seat)]
    parts.append(cushion((0, 0.62, -depth / 2 + 0.08), (0.36, 0.46, 0.16), body, 0.012))
    return [
        *parts,
        block((0, 0.1, -depth / 2 + 0.08), (0.28, 0.3, 0.15), body),
        block((0, 0.85, -depth / 2 + 0.08), (0.07, 0.012, 0.04), "chrome"),
    ]


def toilet_cistern(depth=0.68, body="ceramic", wood="oak", metal="brass") -> list[Part]:
    """With a high cistern, a pipe and a chain."""
    parts = bowl(0.08, 0.4, body, wood)
    parts += [pillar((0, 0.3, -depth / 2 + 0.06), 1.35, 0.022, metal, 10), box((0, 0.33, -0.2), (0.1, 0.1, 0.18), body)]
    parts += [
        block((0, 1.6, -depth / 2 + 0.1), (0.46, 0.3, 0.19), body),
        block((0, 1.9, -depth / 2 + 0.1), (0.5, 0.03, 0.22), body),
    ]
    parts += [
        bar((0.2, 1.1, -depth / 2 + 0.12), (0.2, 1.65, -depth / 2 + 0.12), 0.005, metal, 4),
        pillar((0.2, 1.02, -depth / 2 + 0.12), 0.1, 0.014, wood, 8),
    ]
    return [*parts, *[block((sx * 0.17, 1.45, -depth / 2 + 0.06), (0.03, 0.16, 0.12), metal) for sx in (-1, 1)]]


def hand_basin(x, y, z, width, depth, high, body, sides=14) -> list[Part]:
    """An oval bowl, its rim at y + high."""
    low, top = oval(x, z, 0.3 * width, 0.28 * depth, sides), oval(x, z, width / 2, depth / 2, sides)
    return [*shell(low, y, y + high, 0.03, body, top), plate(low, y, y + 0.03, body)]


def washbasin_pedestal(width=0.58, depth=0.46, height=0.85, body="ceramic") -> list[Part]:
    parts = turned((0, 0, -0.06), [(0.13, 0), (0.1, 0.1), (0.08, 0.4), (0.12, height - 0.16)], body, 14)
    parts += hand_basin(0, height - 0.18, 0.01, width, depth, 0.18, body)
    parts.append(block((0, height - 0.1, -depth / 2 + 0.03), (0.4, 0.1, 0.08), body))
    return parts + tap(0, height, -depth / 2 + 0.04, 0.12, 0.1)


def washbasin_vanity(width=0.8, depth=0.48, height=0.86, paint="white", bowls=1, rows=2) -> list[Part]:
    parts = [
        block((0, 0.0, -0.02), (width - 0.04, 0.1, depth - 0.08), "charcoal"),
        block((0, 0.09, -0.01), (width, height - 0.25, depth - 0.03), paint),
    ]
    parts += fronts((-width / 2, 0.1), (width / 2, height - 0.17), depth / 2 - 0.03, bowls, rows, paint, "bar", "black")
    for k in range(bowls):
        x = width * ((k + 0.5) / bowls - 0.5)
        half = width / bowls
        parts += shell(rectangle(x, 0, half, depth), height - 0.17, height, 0.07, "ceramic")
        parts.append(block((x, height - 0.17, 0), (half - 0.02, 0.06, depth - 0.02), "ceramic"))
        parts += tap(x, height, -depth / 2 + 0.05, 0.13, 0.14)
    return parts


def washbasin_console(width=0.7, depth=0.46, height=0.84, metal="black", top="marble") -> list[Part]:
    parts = [
        block((x, 0, z), (0.03, height - 0.03, 0.03), metal) for x, z in corners(width / 2 - 0.02, depth / 2 - 0.02)
    ]
    parts += [
        block((0, height - 0.04, 0), (width, 0.04, depth), top),
        block((0, 0.2, 0), (width - 0.03, 0.02, depth - 0.03), metal),
    ]
    parts += hand_basin(0, height, 0.02, 0.42, 0.34, 0.12, "ceramic")
    parts += [block((-0.12 + 0.24 * k, 0.22, 0), (0.2, 0.12 + 0.05 * k, 0.28), ("white", "blush")[k]) for k in range(2)]
    return parts + tap(0, height, -depth / 2 + 0.06, 0.13, 0.24, metal)


def washbasin_wall(width=0.5, depth=0.4, height=0.85, wood="oak") -> list[Part]:
    """A square bowl on a slab, with a trap and a mirror cabinet over it."""
    parts = [
        block((0, height - 0.18, 0), (width + 0.2, 0.05, depth), wood),
        *shell(rectangle(0, 0.01, width, depth - 0.04, 0.04), height - 0.13, height, 0.03, "ceramic"),
    ]
    parts += [
        block((0, height - 0.135, 0.01), (width - 0.06, 0.03, depth - 0.08), "ceramic"),
        pillar((0, 0.35, -0.02), height - 0.5, 0.02, "chrome", 8),
    ]
    parts += [
        block((0, 0.0, -depth / 2 + 0.01), (0.16, height - 0.15, 0.02), "ceramic"),
        bar((0, 0.36, -0.02), (0, 0.4, -depth / 2), 0.02, "chrome", 8),
    ]
    parts += [
        block((0, 1.25, -depth / 2 + 0.07), (0.6, 0.65, 0.14), wood),
        block((0, 1.27, -depth / 2 + 0.14), (0.56, 0.61, 0.01), "glass"),
    ]
    return parts + tap(0, height - 0.02, -depth / 2 + 0.05, 0.12, 0.12)


# -- radiators ---------------------------------------------------------


def radiator_columns(columns=12, height=0.6, depth=0.14, paint="enamel", foot=0.1) -> list[Part]:
    pitch = 0.06
    width = columns * pitch
    parts = [
        cushion(
            (pitch * (k - (columns - 1) / 2), foot + (height - foot) / 2, 0), (0.05, height - foot, depth), paint, 0.02
        )
        for k in range(columns)
    ]
    parts += [
        bar((-width / 2 - 0.02, y, 0), (width / 2 + 0.02, y, 0), 0.02, paint, 8) for y in (foot + 0.05, height - 0.05)
    ]
    parts += [block((sx * (width / 2 - 0.05), 0, 0), (0.04, foot + 0.03, depth), paint) for sx in (-1, 1)]
    return [*parts, bar((width / 2 + 0.02, foot + 0.05, 0), (width / 2 + 0.07, foot + 0.05, 0), 0.028, "white", 10)]


def radiator_panel(width=1.0, height=0.62, depth=0.1, paint="white") -> list[Part]:
    parts = [block((0, 0.1, z), (width, height - 0.1, 0.02), paint) for z in (-depth / 2 + 0.03, depth / 2 - 0.01)]
    parts += [block((0, height - 0.02, 0), (width, 0.02, depth), paint)]
    parts += [
        block((sx * (width / 2 - 0.005), 0.1, 0.01), (0.012, height - 0.11, depth - 0.02), paint) for sx in (-1, 1)
    ]
    parts += [
        block((width * (k / 16 - 0.469), 0.13, depth / 2 - 0.002), (0.022, height - 0.18, 0.012), paint)
        for k in range(16)
    ]
    parts += [pillar((width / 2 - 0.1 - 0.06 * k, 0, 0), 0.12, 0.012, "chrome", 8) for k in range(2)]
    return [
        *parts,
        bar((width / 2 - 0.02, height - 0.1, 0.02), (width / 2 + 0.07, height - 0.1, 0.02), 0.025, "enamel", 10),
    ]


def radiator_ladder(width=0.5, height=1.7, paint="chrome", bars=16) -> list[Part]:
    parts = [block((sx * (width / 2 - 0.02), 0.0, 0), (0.04, height, 0.035), paint) for sx in (-1, 1)]
    heights = [0.25 + (height - 0.32) * k / (bars - 1) + 0.05 * (k // 5) - 0.1 for k in range(bars)]
    parts += [rail(width / 2, y, 0.02, 0.013, paint, 8) for y in heights]
    return [*parts, cushion((0, 1.1, 0.035), (0.36, 0.5, 0.03), "teal", 0.01)]


def radiator_plinth(width=1.2, height=0.28, depth=0.16, metal="grey") -> list[Part]:
    """A low convector under a window, with a grille on top."""
    parts = [block((0, 0.05, 0), (width, height - 0.06, depth), metal)] + [
        block((0.4 * width * sx, 0, 0), (0.05, 0.06, depth - 0.03), "charcoal") for sx in (-1, 1)
    ]
    parts += [
        block((width * (k / 20 - 0.475), height - 0.012, 0), (0.02, 0.012, depth - 0.02), "charcoal") for k in range(20)
    ]
    return [*parts, bar((width / 2, 0.14, 0), (width / 2 + 0.07, 0.14, 0), 0.025, "white", 10)]


_f = functools.partial
DRAWINGS = {
    "tub_apron": Drawing("tub", tub_apron),
    "tub_oval": Drawing("tub", tub_oval),
    "tub_corner": Drawing("tub", tub_corner, held_out=True),
    "tub_clawfoot": Drawing("tub", tub_clawfoot, held_out=True),
    "shower_cabin": Drawing("shower", shower_cabin),
    "shower_quadrant": Drawing("shower", shower_quadrant),
    "shower_walkin": Drawing("shower", shower_walkin, held_out=True),
    "shower_curtain": Drawing("shower", shower_curtain, held_out=True),
    "toilet_coupled": Drawing("toilet", toilet_coupled),
    "toilet_hung": Drawing("toilet", toilet_hung),
    "toilet_square": Drawing("toilet", toilet_square, held_out=True),
    "toilet_cistern": Drawing("toilet", toilet_cistern, held_out=True),
    "washbasin_pedestal": Drawing("washbasin", washbasin_pedestal),
    "washbasin_vanity": Drawing("washbasin", washbasin_vanity),
    "washbasin_double": Drawing("washbasin", _f(washbasin_vanity, 1.2, 0.5, 0.86, "oak", 2, 1)),
    "washbasin_console": Drawing("washbasin", washbasin_console, held_out=True),
    "washbasin_wall": Drawing("washbasin", washbasin_wall, held_out=True),
    "radiator_columns": Drawing("radiator", radiator_columns),
    "radiator_panel": Drawing("radiator", radiator_panel),
    "radiator_ladder": Drawing("radiator", radiator_ladder, held_out=True),
    "radiator_plinth": Drawing("radiator", radiator_plinth, held_out=True),
}
"""Model name -> how it is drawn."""
