"""Sizes and materials in, what stands in bedrooms out, of convex parts: beds, nightstands, dressers, wardrobes."""

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
    feet,
    four_legs,
    fronts,
    oval,
    pillar,
    plate,
    rail,
)  # fmt: skip

# -- beds: the head lies at -z -----------------------------------------


def bedding(width, length, under, cover="denim", z=0.0) -> list[Part]:
    """Mattress on a height `under`, pillows at its head, and a blanket over its lower part."""
    parts = [cushion((0, under + 0.1, z), (width, 0.2, length), "mattress", 0.03)]
    count = 2 if width > 1.2 else 1
    for k in range(count):
        x = width * ((k + 0.5) / count - 0.5)
        place = (x, under + 0.24, z - length / 2 + 0.24)
        parts.append(cushion(place, (min(0.66, 0.84 * width / count), 0.12, 0.38), "white", 0.045, -0.12))
    parts.append(cushion((0, under + 0.14, z + 0.16 * length), (width + 0.05, 0.18, 0.67 * length), cover, 0.03))
    return parts


def bed_panel(width=1.6, length=2.0, wood="oak", cover="denim") -> list[Part]:
    parts = [block((0, 0.0, -length / 2 - 0.03), (width + 0.1, 0.95, 0.05), wood)]
    parts.append(block((0, 0.78, -length / 2 + 0.002), (width - 0.1, 0.1, 0.025), wood))
    parts.append(block((0, 0.16, length / 2 + 0.02), (width + 0.08, 0.2, 0.03), wood))
    for sx in (-1, 1):
        parts.append(block((sx * (width / 2 + 0.025), 0.16, 0), (0.03, 0.18, length), wood))
        parts.append(block((sx * (width / 2), 0, length / 2 - 0.01), (0.07, 0.2, 0.07), wood))
    parts.append(block((0, 0.22, 0), (width, 0.06, length), "pine"))
    return parts + bedding(width, length, 0.28, cover)


def bed_divan(width=1.6, length=2.0, cloth="grey", cover="cream", panels=5) -> list[Part]:
    parts = feet(width - 0.1, length - 0.1, 0.08, 0.03, "black")
    parts.append(block((0, 0.07, 0), (width + 0.02, 0.29, length + 0.02), cloth))
    for k in range(panels):
        x = (width + 0.1) * ((k + 0.5) / panels - 0.5)
        parts.append(cushion((x, 0.63, -length / 2 - 0.05), ((width + 0.1) / panels - 0.004, 1.14, 0.11), cloth, 0.035))
    return parts + bedding(width, length, 0.36, cover)


def bed_iron(width=0.9, length=2.0, metal="black", cover="sage", rods=5) -> list[Part]:
    parts = [block((0, 0.27, 0), (width, 0.04, length), metal)]
    for z, top in ((-length / 2 - 0.02, 1.05), (length / 2 + 0.02, 0.72)):
        for sx in (-1, 1):
            parts.append(pillar((sx * width / 2, 0, z), top, 0.024, metal, 8))
            parts.append(cushion((sx * width / 2, top + 0.02, z), (0.07, 0.07, 0.07), metal, 0.02))
        for y in (0.42, top - 0.05):
            parts.append(rail(width / 2, y, z, 0.016, metal, 6))
        for k in range(rods):
            x = width * ((k + 1) / (rods + 1) - 0.5)
            parts.append(pillar((x, 0.42, z), top - 0.47, 0.011, metal, 6))
    return parts + bedding(width, length, 0.31, cover)


def bed_captain(width=0.94, length=2.0, paint="white", cover="mustard") -> list[Part]:
    parts = [block((0, 0.0, 0), (width, 0.06, length - 0.06), "charcoal")]
    parts.append(block((0, 0.05, 0), (width + 0.04, 0.37, length + 0.04), paint))
    parts.append(block((0, 0, -length / 2 - 0.16), (width + 0.04, 0.86, 0.28), paint))
    for k in range(3):
        z = (length - 0.1) * (k - 1) / 3
        for sx in (-1, 1):
            parts.append(box((sx * (width / 2 + 0.025), 0.2, z), (0.02, 0.24, length / 3 - 0.06), paint))
            parts.append(box((sx * (width / 2 + 0.04), 0.25, z), (0.024, 0.02, 0.16), "steel"))
    return parts + bedding(width, length, 0.42, cover)


def bed_canopy(width=1.6, length=2.0, wood="walnut", cover="white", height=1.95) -> list[Part]:
    parts = [block((0, 0.24, 0), (width, 0.06, length), wood)]
    x, z = width / 2 + 0.02, length / 2 + 0.02
    parts += [block((x, 0, z), (0.07, height, 0.07), wood) for x, z in corners(x, z)]
    for s in (-1, 1):
        parts.append(block((s * x, height - 0.06, 0), (0.05, 0.06, 2 * z), wood))
        parts.append(block((0, height - 0.06, s * z), (2 * x, 0.06, 0.05), wood))
        parts.append(block((s * x, 0.18, 0), (0.04, 0.16, 2 * z), wood))
    parts.append(block((0, 0.18, z), (2 * x, 0.16, 0.04), wood))
    parts += [box((0, y, -z), (2 * x, 0.14, 0.03), wood) for y in (0.45, 0.65, 0.85)]
    return parts + bedding(width, length, 0.3, cover)


def bed_sleigh(width=1.4, length=2.0, wood="cherry", cover="teal") -> list[Part]:
    parts = [block((0, 0.1, 0), (width, 0.18, length), wood)]
    for sz, top in ((-1, 1.02), (1, 0.66)):
        z = sz * (length / 2 + 0.05)
        parts.append(block((0, 0, z), (width + 0.08, 0.4, 0.05), wood))
        parts.append(box((0, (0.36 + top) / 2, z + sz * 0.04), (width + 0.08, top - 0.36, 0.045), wood, -0.16 * sz))
        parts.append(
            bar((-width / 2 - 0.05, top, z + sz * 0.09), (width / 2 + 0.05, top, z + sz * 0.09), 0.05, wood, 10)
        )
    parts += [block((sx * (width / 2 + 0.02), 0.14, 0), (0.04, 0.2, length), wood) for sx in (-1, 1)]
    return parts + bedding(width, length, 0.28, cover)


# -- nightstands and dressers ------------------------------------------


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


def nightstand_open(width=0.42, depth=0.38, height=0.5, wood="pine") -> list[Part]:
    parts = four_legs(width, depth, height - 0.02, 0.035, wood)
    parts.append(block((0, height - 0.025, 0), (width + 0.02, 0.025, depth + 0.02), wood))
    parts.append(block((0, height - 0.17, 0), (width - 0.04, 0.15, depth - 0.05), wood))
    parts.append(block((0, 0.12, 0), (width - 0.02, 0.02, depth - 0.02), wood))
    return parts + fronts((-width / 2 + 0.04, height - 0.16), (width / 2 - 0.04, height - 0.03), depth / 2 - 0.03,
                          1, 1, wood, "knob", "brass")  # fmt: skip


def nightstand_round(radius=0.21, height=0.52, wood="walnut", metal="brass") -> list[Part]:
    parts = [
        pillar((0, 0.32, 0), height - 0.34, 0.96 * radius, wood, 18),
        pillar((0, height - 0.025, 0), 0.025, radius, wood, 18),
    ]
    parts.append(box((0, 0.41, 0.94 * radius), (0.1, 0.02, 0.03), metal))
    for sx, sz in ((-1, -1), (1, -1), (-1, 1), (1, 1)):
        x, z = 0.55 * radius * sx, 0.55 * radius * sz
        parts.append(bar((1.2 * x, 0, 1.2 * z), (x, 0.33, z), (0.012, 0.018), metal, 8))
    return parts


def nightstand_cube(size=0.42, height=0.46, paint="white", inside="oak") -> list[Part]:
    parts = [block((0, y, 0), (size, 0.03, size - 0.04), paint) for y in (0, height - 0.03)]
    parts.append(block((0, 0.02, -size / 2 + 0.03), (size, height - 0.04, 0.02), inside))
    parts += [block((sx * (size / 2 - 0.015), 0.02, 0), (0.03, height - 0.04, size - 0.04), paint) for sx in (-1, 1)]
    parts.append(block((0, 0.22, 0), (size - 0.04, 0.02, size - 0.06), inside))
    parts.append(cushion((0.06, 0.27, 0.02), (0.22, 0.05, 0.16), "teal", 0.005))
    return parts


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


# -- wardrobes ---------------------------------------------------------


def wardrobe_doors(width=1.5, height=2.1, depth=0.6, paint="white", front="white", doors=3) -> list[Part]:
    parts = [block((0, 0, -0.02), (width - 0.02, 0.07, depth - 0.06), "charcoal")]
    parts.append(block((0, 0.06, -0.01), (width, height - 0.06, depth - 0.03), paint))
    return parts + fronts((-width / 2 + 0.01, 0.08), (width / 2 - 0.01, height - 0.02), depth / 2 - 0.025, doors, 1,
                          front, "pull", "black")  # fmt: skip


def wardrobe_sliding(width=1.8, height=2.2, depth=0.64, wood="oak", mirror="glass") -> list[Part]:
    parts = [block((0, 0, -0.03), (width, height, depth - 0.08), wood)]
    for k, material in enumerate((wood, mirror, wood)):
        x = width * (k - 1) / 3
        z = depth / 2 - (0.05 if k == 1 else 0.03)
        parts.append(box((x, height / 2, z), (width / 3 + 0.02, height - 0.1, 0.02), material))
        parts.append(box((x - width / 6 + 0.02, height / 2, z + 0.014), (0.03, height - 0.1, 0.01), "steel"))
    for y in (0.0, height - 0.06):
        parts.append(block((0, y, depth / 2 - 0.04), (width, 0.06, 0.08), "charcoal"))
    return parts


def wardrobe_farmhouse(width=1.2, height=1.95, depth=0.58, wood="pine") -> list[Part]:
    parts = feet(width, depth, 0.11, 0.05, wood)
    parts.append(block((0, 0.1, 0), (width, height - 0.16, depth - 0.02), wood))
    parts.append(block((0, height - 0.1, 0.01), (width + 0.1, 0.05, depth + 0.05), wood))
    parts.append(block((0, height - 0.05, 0.01), (width + 0.04, 0.05, depth), wood))
    parts += fronts((-width / 2 + 0.03, 0.12), (width / 2 - 0.03, 0.4), depth / 2 - 0.01, 2, 1, wood, "knob", "brass")
    parts += fronts(
        (-width / 2 + 0.03, 0.4), (width / 2 - 0.03, height - 0.12), depth / 2 - 0.01, 2, 1, wood, "pull", "brass"
    )
    for sx in (-1, 1):
        for y in (0.8, 1.42):
            parts.append(box((sx * width / 4, y, depth / 2 + 0.012), (width / 2 - 0.2, 0.48, 0.02), wood))
    return parts


def wardrobe_open(width=1.2, height=1.9, depth=0.5, metal="black", wood="oak") -> list[Part]:
    parts = [block((0, 0.12, 0), (width, 0.04, depth), wood), block((0, height - 0.3, 0), (width, 0.03, depth), wood)]
    for sx in (-1, 1):
        for sz in (-1, 1):
            parts.append(block((sx * (width / 2 - 0.015), 0, sz * (depth / 2 - 0.015)), (0.03, height, 0.03), metal))
        parts.append(box((sx * (width / 2 - 0.015), height - 0.015, 0), (0.03, 0.03, depth), metal))
    parts.append(rail(width / 2, height - 0.42, 0, 0.015, "steel", 8))
    for k, cloth in enumerate(("navy", "cream", "rust", "grey", "moss", "denim", "white")):
        x = -0.42 + 0.12 * k
        parts.append(cushion((x, height - 0.9 + 0.04 * (k % 3), 0), (0.07, 0.86 - 0.08 * (k % 3), 0.4), cloth, 0.03))
    parts += [block((-0.3 + 0.34 * k, 0.15, 0), (0.28, 0.24, 0.36), "cardboard") for k in range(3)]
    return parts


_f = functools.partial
DRAWINGS = {
    "bed_panel": Drawing("bed", bed_panel),
    "bed_divan": Drawing("bed", bed_divan, front=-1),
    "bed_single": Drawing("bed", _f(bed_panel, 0.9, 2.0, "pine", "rust")),
    "bed_captain": Drawing("bed", bed_captain),
    "bed_canopy": Drawing("bed", bed_canopy),
    "bed_iron": Drawing("bed", bed_iron, held_out=True),
    "bed_sleigh": Drawing("bed", bed_sleigh, held_out=True),
    "nightstand_drawers": Drawing("nightstand", _f(chest, 0.45, 0.55, 0.4, 1, 2, "white", legs=0.12, top="oak")),
    "nightstand_open": Drawing("nightstand", nightstand_open),
    "nightstand_round": Drawing("nightstand", nightstand_round, held_out=True),
    "nightstand_cube": Drawing("nightstand", nightstand_cube, held_out=True),
    "dresser_four": Drawing("dresser", _f(chest, 0.8, 1.0, 0.48, 1, 4, "birch")),
    "dresser_wide": Drawing("dresser", _f(chest, 1.4, 0.8, 0.48, 2, 3, "walnut", "knob", legs=0.14, metal="brass")),
    "dresser_tall": Drawing("dresser", dresser_tall, held_out=True),
    "dresser_nine": Drawing(
        "dresser", _f(chest, 1.1, 0.86, 0.42, 3, 3, "sage", "knob", "cream", top="oak"), held_out=True
    ),
    "wardrobe_doors": Drawing("wardrobe", wardrobe_doors),
    "wardrobe_sliding": Drawing("wardrobe", wardrobe_sliding),
    "wardrobe_double": Drawing("wardrobe", _f(wardrobe_doors, 1.0, 2.0, 0.58, "oak", "cream", 2)),
    "wardrobe_farmhouse": Drawing("wardrobe", wardrobe_farmhouse, held_out=True),
    "wardrobe_open": Drawing("wardrobe", wardrobe_open, held_out=True),
}
"""Model name -> how it is drawn."""
