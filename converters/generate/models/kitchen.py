"""Sizes and materials in, what is built into kitchens out, of convex parts: counters, sinks, stoves, fridges."""

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
    fronts,
    pillar,
    plate,
    rectangle,
    shell,
)  # fmt: skip

TOP_M = 0.9
"""Height of every worktop, so that modules make a row."""
DEPTH_M = 0.6


def base_unit(width, paint, columns, rows, handle="bar", front="") -> list[Part]:
    """Plinth, carcass and fronts below a worktop."""
    parts = [block((0, 0, -0.03), (width, 0.11, DEPTH_M - 0.1), "charcoal")]
    parts.append(block((0, 0.1, -0.015), (width, TOP_M - 0.14, DEPTH_M - 0.03), paint))
    low, high = (-width / 2, 0.11), (width / 2, TOP_M - 0.05)
    return parts + fronts(low, high, DEPTH_M / 2 - 0.03, columns, rows, front or paint, handle)


def worktop(width, material, thick=0.04) -> Part:
    """The slab over a module."""
    return block((0, TOP_M - thick, 0), (width, thick, DEPTH_M), material)


def counter_unit(width=0.6, paint="white", top="oak", columns=1, rows=1, handle="bar", front="") -> list[Part]:
    return [*base_unit(width, paint, columns, rows, handle, front), worktop(width, top)]


def counter_open(width=0.8, paint="birch", top="granite") -> list[Part]:
    parts = [block((0, 0, -0.02), (width, 0.1, DEPTH_M - 0.1), "charcoal"), worktop(width, top)]
    parts += [
        block((sx * (width / 2 - 0.01), 0.1, -0.015), (0.02, TOP_M - 0.13, DEPTH_M - 0.03), paint) for sx in (-1, 1)
    ]
    parts += [block((0, y, -0.015), (width - 0.03, 0.02, DEPTH_M - 0.04), paint) for y in (0.1, 0.48)]
    parts.append(block((0, 0.1, -DEPTH_M / 2 + 0.02), (width - 0.03, TOP_M - 0.14, 0.015), paint))
    parts += [pillar((-0.2 + 0.2 * k, 0.5, 0.03), 0.16 + 0.04 * k, 0.075, "steel", 14) for k in range(3)]
    return [
        *parts,
        block((-0.15, 0.12, 0.05), (0.34, 0.2, 0.3), "wicker"),
        pillar((0.2, 0.12, 0.05), 0.09, 0.12, "ceramic", 14),
    ]


def counter_tall(width=0.6, paint="sage", top="oak", wall=0.7) -> list[Part]:
    """With a wall cupboard over it, and a splash back between them."""
    parts = counter_unit(width, paint, top, 1, 3)
    parts.append(block((0, TOP_M, -DEPTH_M / 2 + 0.01), (width, 0.55, 0.02), "ceramic"))
    y = TOP_M + 0.54
    parts.append(block((0, y, -DEPTH_M / 2 + 0.175), (width, wall, 0.35), paint))
    return parts + fronts((-width / 2, y), (width / 2, y + wall), -DEPTH_M / 2 + 0.35, 1, 1, paint, "pull")


def sink_unit(width, paint, handle) -> list[Part]:
    """A base unit with two doors and room for a basin: below it a carcass, round it sides and a back."""
    parts = base_unit(width, paint, 2, 1, handle)
    y, high = TOP_M - 0.24, 0.22
    parts[1] = block((0, 0.1, -0.015), (width, y - 0.09, DEPTH_M - 0.03), paint)
    parts += [block((sx * (width / 2 - 0.01), y, -0.015), (0.02, high, DEPTH_M - 0.03), paint) for sx in (-1, 1)]
    return [*parts, block((0, y, -DEPTH_M / 2 + 0.01), (width, high, 0.02), paint)]


# -- sinks: the worktop is built round the basin -----------------------


def basin(x, z, width, depth, deep, material) -> list[Part]:
    """Four walls and a floor below the worktop's surface."""
    y = TOP_M - deep
    walls = shell(rectangle(x, z, width, depth), y, TOP_M + 0.004, 0.02, material)
    return [
        *walls,
        block((x, y, z), (width, 0.015, depth), material),
        pillar((x, y + 0.012, z), 0.008, 0.03, "charcoal", 10),
    ]


def framed(width, x, z, hole_w, hole_d, material, thick=0.04) -> list[Part]:
    """A worktop with a rectangular hole."""
    y, half = TOP_M - thick, width / 2
    left, right = x - hole_w / 2 + half, half - x - hole_w / 2
    back, front = z - hole_d / 2 + DEPTH_M / 2, DEPTH_M / 2 - z - hole_d / 2
    return [
        block((-half + left / 2, y, 0), (left, thick, DEPTH_M), material),
        block((half - right / 2, y, 0), (right, thick, DEPTH_M), material),
        block((x, y, -DEPTH_M / 2 + back / 2), (hole_w + 0.01, thick, back), material),
        block((x, y, DEPTH_M / 2 - front / 2), (hole_w + 0.01, thick, front), material),
    ]


def tap(x, y, z, reach=0.16, height=0.25, metal="chrome") -> list[Part]:
    """An upright, an arm that points to the front, and a lever."""
    return [
        pillar((x, y, z), height, (0.022, 0.014), metal, 10),
        bar((x, y + height - 0.01, z - 0.008), (x, y + height - 0.03, z + reach), 0.013, metal, 8),
        bar((x, y + height - 0.02, z + reach - 0.01), (x, y + height - 0.07, z + reach - 0.01), 0.013, metal, 8),
        bar((x + 0.015, y + 0.07, z), (x + 0.08, y + 0.1, z), 0.009, metal, 6),
    ]


def sink_bowls(width=0.8, paint="white", top="oak", bowls=1, metal="steel") -> list[Part]:
    hole = 0.4 if bowls == 1 else 0.74
    parts = sink_unit(width, paint, "pull") + framed(width, 0, 0.03, hole, 0.4, top)
    for k in range(bowls):
        parts += basin(hole * ((k + 0.5) / bowls - 0.5), 0.03, hole / bowls, 0.4, 0.19, metal)
    return parts + tap(0, TOP_M - 0.005, -0.22)


def sink_drainer(width=1.0, paint="birch", metal="steel") -> list[Part]:
    parts = sink_unit(width, paint, "bar")
    parts += framed(width, -0.24, 0.02, 0.38, 0.42, metal) + basin(-0.24, 0.02, 0.38, 0.42, 0.18, metal)
    parts += [block((0.24, TOP_M - 0.002, -0.18 + 0.07 * k), (0.4, 0.012, 0.02), metal) for k in range(6)]
    parts += [block((x, TOP_M, 0.08), (0.012, 0.2, 0.2), "ceramic") for x in (0.14, 0.2, 0.26)]
    return parts + tap(-0.02, TOP_M - 0.005, -0.24)


def sink_farmhouse(width=0.9, paint="navy", top="marble", bowl="ceramic") -> list[Part]:
    """Its apron takes the upper part of the doors' place."""
    parts = [*base_unit(width, paint, 2, 1)[:1], block((0, 0.1, -0.015), (width, 0.5, DEPTH_M - 0.03), paint)]
    parts += fronts((-width / 2, 0.11), (width / 2, 0.6), DEPTH_M / 2 - 0.03, 2, 1, paint, "knob")
    parts += shell(rectangle(0, 0.03, 0.76, 0.5), TOP_M - 0.27, TOP_M, 0.035, bowl)
    parts += [block((0, TOP_M - 0.27, 0.03), (0.74, 0.05, 0.48), bowl)]
    parts += [block((sx * 0.415, 0.6, 0), (0.07, TOP_M - 0.6, DEPTH_M - 0.02), paint) for sx in (-1, 1)]
    parts += [block((sx * 0.415, TOP_M - 0.035, 0), (0.07, 0.04, DEPTH_M), top) for sx in (-1, 1)]
    parts.append(block((0, TOP_M - 0.035, -0.26), (0.77, 0.04, 0.08), top))
    return parts + tap(0, TOP_M, -0.26, 0.2, 0.32, "brass")


# -- stoves ------------------------------------------------------------


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


def stove_electric(width=0.6, body="enamel", plates=4) -> list[Part]:
    z = DEPTH_M / 2
    parts = [block((0, 0, -0.02), (width - 0.02, 0.07, DEPTH_M - 0.1), "charcoal")]
    parts.append(block((0, 0.06, -0.015), (width, TOP_M - 0.08, DEPTH_M - 0.03), body))
    parts.append(block((0, TOP_M - 0.03, 0), (width, 0.03, DEPTH_M), body))
    for k in range(plates):
        x, dz = 0.14 * (2 * (k % 2) - 1), 0.13 * (2 * (k // 2) - 1)
        parts.append(pillar((x, TOP_M - 0.002, dz), 0.016, 0.085 if (k + k // 2) % 2 else 0.1, "black", 16))
    parts += oven(width, 0.28, 0.74, body, z - 0.02) + knobs(6, 0.4, 0.8, z - 0.03)
    return [*parts, box((0, 0.17, z - 0.02), (width - 0.03, 0.16, 0.03), body)]


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


# -- fridges -----------------------------------------------------------


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


def fridge_retro(width=0.6, height=1.5, depth=0.66, body="sage") -> list[Part]:
    round_box = rectangle(0, -0.02, width, depth - 0.05, 0.09)
    parts = [pillar((x, 0, z), 0.1, 0.025, "chrome", 8) for x, z in corners(0.2, 0.2)]
    parts.append(plate(round_box, 0.08, height - 0.12, body))
    parts.append(plate(round_box, height - 0.12, height, body, rectangle(0, -0.04, 0.7 * width, 0.6 * depth, 0.08)))
    parts.append(cushion((0, 0.79, depth / 2 - 0.04), (width - 0.06, 1.16, 0.07), body, 0.03))
    parts.append(bar((-0.2, 0.98, depth / 2 + 0.02), (-0.2, 1.2, depth / 2 + 0.02), 0.016, "chrome", 8))
    return [
        *parts,
        box((0, 1.26, depth / 2), (0.24, 0.03, 0.02), "chrome"),
        box((0, 0.15, depth / 2 - 0.02), (0.4, 0.06, 0.05), "chrome"),
    ]


def fridge_under(width=0.55, height=0.85, depth=0.58, body="enamel", top="grey") -> list[Part]:
    parts = fridge_doors(width, height - 0.03, depth, body, 0.98)[:4]
    parts.append(block((0, height - 0.035, 0), (width + 0.01, 0.035, depth), top))
    return [
        *parts,
        box((0, 0.42, depth / 2 + 0.0), (0.02, 0.02, 0.01), top),
        box((0.2, height - 0.1, depth / 2), (0.08, 0.025, 0.02), "black"),
    ]


_f = functools.partial
DRAWINGS = {
    "counter_door": Drawing("counter", counter_unit),
    "counter_drawers": Drawing("counter", _f(counter_unit, 0.8, "white", "oak", 1, 3)),
    "counter_doors": Drawing("counter", _f(counter_unit, 1.0, "grey", "granite", 2, 1, "pull")),
    "counter_wall": Drawing("counter", counter_tall),
    "counter_open": Drawing("counter", counter_open, held_out=True),
    "counter_panels": Drawing("counter", _f(counter_unit, 0.9, "navy", "marble", 3, 2, "knob"), held_out=True),
    "sink_single": Drawing("sink", sink_bowls),
    "sink_double": Drawing("sink", _f(sink_bowls, 1.0, "grey", "granite", 2)),
    "sink_drainer": Drawing("sink", sink_drainer, held_out=True),
    "sink_farmhouse": Drawing("sink", sink_farmhouse, held_out=True),
    "stove_electric": Drawing("stove", stove_electric),
    "stove_ceramic": Drawing("stove", stove_ceramic),
    "stove_range": Drawing("stove", stove_range, held_out=True),
    "stove_hood": Drawing("stove", stove_hood, held_out=True),
    "fridge_combined": Drawing("fridge", fridge_doors),
    "fridge_freezer_above": Drawing("fridge", _f(fridge_doors, 0.7, 1.7, 0.68, "grey", 0.7, "black")),
    "fridge_american": Drawing("fridge", fridge_american),
    "fridge_retro": Drawing("fridge", fridge_retro, held_out=True),
    "fridge_under": Drawing("fridge", fridge_under, held_out=True),
}
"""Model name -> how it is drawn."""
