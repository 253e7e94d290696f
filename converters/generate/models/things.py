"""Sizes and materials in, what lies about homes out, of convex parts: boxes, bags, bins, suitcases."""

from __future__ import annotations

import functools
import math

import numpy as np

from converters.generate.models.parts import (
    Drawing,
    Part,
    ball,
    bar,
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
    turned,
)  # fmt: skip

# -- boxes -------------------------------------------------------------


def carton(base, size, material="cardboard", tape="tape") -> list[Part]:
    """A closed one with tape over its seam."""
    x, y, z = base
    w, h, d = size
    seam = [block((x, y + h - 0.002, z), (0.06, 0.008, d + 0.004), tape)]
    return [block(base, size, material), *seam, block((x, y + 0.7 * h, z), (0.06, 0.3 * h, d + 0.008), tape)]


def box_closed(width=0.5, height=0.4, depth=0.38) -> list[Part]:
    return carton((0, 0, 0), (width, height, depth))


def box_open(width=0.46, height=0.32, depth=0.36, flap=0.15, material="cardboard") -> list[Part]:
    """Its flaps hang outward; things stand in it."""
    parts = [
        *shell(rectangle(0, 0, width, depth), 0, height, 0.012, material),
        block((0, 0, 0), (width, 0.012, depth), material),
    ]
    for sx in (-1, 1):
        rim = [(sx * width / 2, height, sz * depth / 2) for sz in (-1, 1)]
        out = [(x + sx * flap * 0.75, y + 0.06, z) for x, y, z in rim]
        parts.append(hull([(x, y - k, z) for x, y, z in rim + out for k in (0, 0.01)], material))
        rim = [(sz * width / 2, height, sx * depth / 2) for sz in (-1, 1)]
        out = [(x, y - 0.07, z + sx * flap * 0.6) for x, y, z in rim]
        parts.append(hull([(x, y - k, z) for x, y, z in rim + out for k in (0, 0.01)], material))
    parts += [
        block((-0.1, 0.01, 0.02), (0.2, height - 0.03, 0.24), "rust"),
        block((0.12, 0.01, -0.03), (0.14, height + 0.04, 0.2), "navy"),
    ]
    return parts


def box_stack() -> list[Part]:
    parts = carton((0, 0, 0), (0.52, 0.36, 0.4)) + carton((-0.03, 0.36, 0.01), (0.42, 0.3, 0.34))
    return parts + carton((0.02, 0.66, -0.01), (0.3, 0.2, 0.26), "birch")


def box_crate(width=0.5, height=0.28, depth=0.36, material="teal") -> list[Part]:
    """Of plastic, with gaps in its walls."""
    parts = [block((0, 0, 0), (width - 0.02, 0.02, depth - 0.02), material)]
    for y0, y1 in ((0.015, 0.1), (0.17, height)):
        parts += shell(rectangle(0, 0, width - 0.02, depth - 0.02), y0, y1, 0.014, material)
    parts += [block((x, 0, z), (0.04, height, 0.04), material) for x, z in corners(width / 2 - 0.02, depth / 2 - 0.02)]
    return [
        *parts,
        pillar((-0.1, 0.015, 0.0), 0.3, (0.04, 0.03), "moss", 10),
        pillar((0.03, 0.015, 0.05), 0.3, (0.04, 0.03), "moss", 10),
    ]


def box_flat(width=0.9, height=0.16, depth=0.5) -> list[Part]:
    parts = carton((0, 0, 0), (width, height, depth))
    return [*parts, *(block((sx * 0.3, -0.0, 0), (0.03, height + 0.006, depth + 0.012), "black") for sx in (-1, 1))]


def box_lidded(width=0.58, height=0.36, depth=0.4, body="glass", lid="navy") -> list[Part]:
    """A storage box, wider above, with a lid that clips."""
    low, top = rectangle(0, 0, width - 0.1, depth - 0.08, 0.03), rectangle(0, 0, width - 0.03, depth - 0.03, 0.03)
    parts = [
        plate(low, 0, height - 0.05, body, top),
        plate(rectangle(0, 0, width, depth, 0.03), height - 0.055, height, lid),
    ]
    return [*parts, *(block((sx * (width / 2 - 0.01), height - 0.14, 0), (0.025, 0.1, 0.1), lid) for sx in (-1, 1))]


# -- bags --------------------------------------------------------------


def strap(points, radius, material) -> list[Part]:
    """Bars from point to point."""
    return [bar(a, b, radius, material, 6) for a, b in zip(points, points[1:], strict=False)]


def bag_tote(width=0.4, height=0.34, depth=0.18, cloth="cream") -> list[Part]:
    low, top = rectangle(0, 0, width, depth, 0.03), rectangle(0, 0, width + 0.02, 0.09, 0.02)
    parts = [plate(low, 0, height, cloth, top)]
    for sz in (-1, 1):
        arch = [
            (-0.1, height - 0.04, sz * 0.05),
            (-0.07, height + 0.14, sz * 0.035),
            (0.07, height + 0.14, sz * 0.035),
            (0.1, height - 0.04, sz * 0.05),
        ]
        parts += strap(arch, 0.012, "leather")
    return [*parts, cushion((0.02, height, 0), (0.24, 0.08, 0.07), "moss", 0.03)]


def bag_backpack(cloth="navy", trim="black") -> list[Part]:
    parts = [
        plate(oval(0, 0, 0.16, 0.12, 14), 0, 0.36, cloth, oval(0, -0.01, 0.15, 0.1, 14)),
        plate(oval(0, -0.01, 0.15, 0.1, 14), 0.355, 0.46, cloth, oval(0, -0.03, 0.08, 0.05, 14)),
    ]
    parts += [
        cushion((0, 0.14, 0.12), (0.22, 0.2, 0.08), cloth, 0.025),
        box((0, 0.21, 0.162), (0.18, 0.012, 0.012), trim),
    ]
    for sx in (-1, 1):
        parts += strap([(sx * 0.07, 0.42, -0.07), (sx * 0.1, 0.28, -0.14), (sx * 0.11, 0.06, -0.1)], 0.018, trim)
    return parts + strap([(-0.03, 0.455, -0.03), (0.0, 0.49, -0.03), (0.03, 0.455, -0.03)], 0.01, trim)


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


# -- bins --------------------------------------------------------------


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


def bin_swing(width=0.34, depth=0.26, height=0.6, body="grey", lid="charcoal") -> list[Part]:
    low, top = rectangle(0, 0, width - 0.07, depth - 0.05, 0.04), rectangle(0, 0, width, depth, 0.04)
    parts = [
        plate(low, 0, height - 0.14, body, top),
        plate(rectangle(0, 0, width + 0.01, depth + 0.01, 0.04), height - 0.15, height - 0.11, lid),
    ]
    return [
        *parts,
        plate(top, height - 0.12, height, lid, rectangle(0, 0, 0.6 * width, 0.2 * depth)),
        box((0, height - 0.06, 0.075), (0.2, 0.09, 0.012), body, 0.9),
    ]


def bin_open(radius=0.15, height=0.3, material="black", sides=12, waste="white") -> list[Part]:
    low, top = oval(0, 0, 0.75 * radius, 0.75 * radius, sides), oval(0, 0, radius, radius, sides)
    parts = [*shell(low, 0, height, 0.01, material, top), plate(low, 0, 0.012, material)]
    return [
        *parts,
        ball((0.03, 0.6 * height, 0), (0.07, 0.06, 0.07), waste),
        ball((-0.04, 0.5 * height, 0.03), (0.06, 0.06, 0.06), waste),
    ]


def bin_sorting(count=3, height=0.5) -> list[Part]:
    """Tubs for paper, glass and the rest, side by side in a frame."""
    parts = [block((0, 0, 0), (0.24 * count, 0.03, 0.32), "charcoal")]
    for k, colour in enumerate(("denim", "moss", "mustard")[:count]):
        x = 0.24 * (k - (count - 1) / 2)
        parts += [
            plate(rectangle(x, 0, 0.2, 0.27, 0.02), 0.02, height - 0.06, "grey", rectangle(x, 0, 0.225, 0.31, 0.02)),
            cushion((x, height - 0.035, 0), (0.23, 0.06, 0.32), colour, 0.015),
        ]
        parts.append(box((x, height - 0.06, 0.165), (0.09, 0.03, 0.02), "black"))
    return parts


# -- suitcases ---------------------------------------------------------


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


def suitcase_soft(width=0.44, height=0.66, depth=0.28, cloth="charcoal") -> list[Part]:
    parts = [
        cushion((0, 0.04 + height / 2, 0), (width, height, depth - 0.07), cloth, 0.03),
        cushion((0, 0.22, depth / 2 - 0.04), (width - 0.08, 0.28, 0.08), cloth, 0.025),
        cushion((0, 0.52, depth / 2 - 0.045), (width - 0.1, 0.22, 0.07), cloth, 0.02),
    ]
    parts += [
        bar((sx * 0.17 - 0.02, 0.045, -0.09), (sx * 0.17 + 0.02, 0.045, -0.09), 0.045, "black", 12) for sx in (-1, 1)
    ]
    parts += [block((sx * 0.16, 0, 0.09), (0.05, 0.06, 0.03), "black") for sx in (-1, 1)]
    return [
        *parts,
        box((0, 0.37, depth / 2), (0.2, 0.012, 0.014), "red"),
        cushion((0, height + 0.06, -0.02), (0.18, 0.035, 0.03), "black", 0.01),
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


def suitcase_trunk(width=0.7, height=0.42, depth=0.42, body="navy", metal="brass") -> list[Part]:
    """A domed one for the attic, with straps."""
    dome = [
        (x, 0.3 + 0.12 * math.sin(a), 0.5 * depth * math.cos(a))
        for x in (-width / 2, width / 2)
        for a in np.linspace(0, math.pi, 9)
    ]
    parts = [block((0, 0.0, 0), (width, 0.3, depth), body), hull(dome, body)]
    for sx in (-1, 1):
        x = sx * 0.2
        band = [
            (x + e, 0.31 + 0.125 * math.sin(a), 0.505 * depth * math.cos(a))
            for e in (-0.025, 0.025)
            for a in np.linspace(0, math.pi, 9)
        ]
        parts += [
            hull(band, "leather"),
            block((x, 0.0, 0), (0.05, 0.31, depth + 0.012), "leather"),
            block((sx * width / 2, 0.16, 0), (0.03, 0.05, 0.14), metal),
        ]
    return [
        *parts,
        block((0, 0.24, depth / 2), (0.09, 0.1, 0.02), metal),
        block((0, 0.29, 0), (width + 0.008, 0.014, depth + 0.01), metal),
    ]


_f = functools.partial
DRAWINGS = {
    "box_closed": Drawing("box", box_closed, "__SYM_ROTATE_UP_2"),
    "box_open": Drawing("box", box_open),
    "box_flat": Drawing("box", box_flat, "__SYM_ROTATE_UP_2"),
    "box_crate": Drawing("box", box_crate),
    "box_stack": Drawing("box", box_stack, held_out=True),
    "box_lidded": Drawing("box", box_lidded, "__SYM_ROTATE_UP_2", held_out=True),
    "bag_tote": Drawing("bag", bag_tote),
    "bag_backpack": Drawing("bag", bag_backpack),
    "bag_duffel": Drawing("bag", bag_duffel, held_out=True),
    "bag_paper": Drawing("bag", bag_paper, held_out=True),
    "bin_pedal": Drawing("bin", bin_pedal),
    "bin_open": Drawing("bin", bin_open),
    "bin_swing": Drawing("bin", bin_swing, held_out=True),
    "bin_sorting": Drawing("bin", bin_sorting, held_out=True),
    "suitcase_hard": Drawing("suitcase", suitcase_hard),
    "suitcase_vintage": Drawing("suitcase", suitcase_vintage),
    "suitcase_soft": Drawing("suitcase", suitcase_soft, held_out=True),
    "suitcase_trunk": Drawing("suitcase", suitcase_trunk, held_out=True),
}
"""Model name -> how it is drawn."""
