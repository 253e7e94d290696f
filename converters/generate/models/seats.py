"""Sizes and materials in, seats of convex parts out: armchairs, stools, poufs, benches, more chairs and sofas."""

from __future__ import annotations

import functools
import math

from converters.generate.models.parts import (
    Drawing,
    Part,
    ball,
    bar,
    beam,
    block,
    box,
    cushion,
    feet,
    four_legs,
    oval,
    pillar,
    plate,
    rail,
    rectangle,
    shell,
    turned,
)  # fmt: skip

# -- armchairs ---------------------------------------------------------


def armchair_block(width=0.88, depth=0.86, seat=0.42, back=0.82, arm=0.2, cloth="slate", foot="walnut") -> list[Part]:
    parts = feet(width - 0.04, depth - 0.06, 0.09, 0.03, foot)
    parts.append(block((0, 0.08, 0), (width - 0.02, 0.22, depth - 0.04), cloth))
    parts.append(cushion((0, seat - 0.06, 0.08), (width - 2 * arm - 0.01, 0.18, depth - 0.22), cloth, 0.04))
    parts.append(cushion((0, (0.1 + back) / 2, 0.12 - depth / 2), (width - 0.01, back - 0.1, 0.23), cloth, 0.05, 0.06))
    for sx in (-1, 1):
        parts.append(cushion((sx * (width - arm) / 2, 0.36, 0.02), (arm, 0.54, depth - 0.06), cloth, 0.05))
    return parts


def armchair_wing(width=0.76, depth=0.82, seat=0.44, back=1.04, cloth="teal", wood="walnut") -> list[Part]:
    parts = four_legs(width - 0.04, depth - 0.1, 0.2, 0.045, wood, splay=0.03, square=False)
    parts.append(block((0, 0.19, 0.02), (width - 0.06, 0.16, depth - 0.14), cloth))
    parts.append(cushion((0, seat - 0.04, 0.05), (width - 0.2, 0.13, depth - 0.2), cloth, 0.03))
    parts.append(cushion((0, (0.3 + back) / 2, 0.1 - depth / 2), (width - 0.1, back - 0.3, 0.14), cloth, 0.04, 0.1))
    for sx in (-1, 1):
        x = sx * (width / 2 - 0.055)
        parts.append(cushion((x, 0.46, 0.03), (0.1, 0.3, depth - 0.16), cloth, 0.03))
        parts.append(cushion((x, 0.83, -depth / 2 + 0.16), (0.07, 0.4, 0.22), cloth, 0.03, 0.1))
    return parts


def armchair_lounge(width=0.68, depth=0.78, back=0.96, cloth="cream", wood="birch") -> list[Part]:
    parts = []
    for sx in (-1, 1):
        x = sx * (width / 2 - 0.025)
        parts.append(box((x, 0.02, -0.02), (0.05, 0.04, depth - 0.06), wood))
        parts.append(bar((x, 0.03, depth / 2 - 0.08), (x, 0.55, depth / 2 - 0.14), 0.028, wood, 4))
        parts.append(bar((x, 0.54, depth / 2 - 0.12), (x, 0.5, -depth / 2 + 0.12), 0.028, wood, 4))
        parts.append(bar((x, 0.03, -depth / 2 + 0.06), (x, 0.52, -depth / 2 + 0.16), 0.028, wood, 4))
    parts.append(box((0, 0.29, 0.26), (width - 0.06, 0.05, 0.04), wood))
    parts.append(box((0, 0.25, -0.2), (width - 0.06, 0.05, 0.04), wood))
    parts.append(cushion((0, 0.37, 0.06), (width - 0.11, 0.11, 0.56), cloth, 0.03, 0.14))
    parts.append(cushion((0, (0.32 + back) / 2, -0.28), (width - 0.11, back - 0.3, 0.11), cloth, 0.03, 0.4))
    parts.append(cushion((0, back - 0.11, -0.33), (width - 0.22, 0.15, 0.11), cloth, 0.03, 0.4))
    return parts


def armchair_barrel(radius=0.38, seat=0.42, back=0.74, cloth="mustard", leg="black") -> list[Part]:
    parts = four_legs(1.5 * radius, 1.5 * radius, 0.17, 0.04, leg, square=False)
    outline = oval(0, 0, radius, radius, 14)
    parts.append(plate(outline * 0.9, 0.15, seat - 0.1, cloth))
    parts.append(plate(outline * 0.8, seat - 0.11, seat + 0.03, cloth, outline * 0.76))
    around = shell(outline * 0.94, 0.18, back, 0.11, cloth, outline)
    parts += [p for p in around if p.vertices[:, 2].mean() < 0.45 * radius]
    return parts


def armchair_swivel(width=0.74, seat=0.42, back=0.98, cloth="leather", metal="chrome") -> list[Part]:
    parts = turned((0, 0, 0), [(0.31, 0), (0.30, 0.025), (0.05, 0.05), (0.035, 0.26)], metal)
    parts.append(cushion((0, 0.31, 0), (width - 0.14, 0.1, 0.56), cloth, 0.04))
    parts.append(cushion((0, seat, 0.02), (width - 0.2, 0.13, 0.54), cloth, 0.05))
    parts.append(cushion((0, (0.3 + back) / 2, -0.3), (width - 0.16, back - 0.3, 0.14), cloth, 0.05, 0.2))
    parts.append(cushion((0, back - 0.14, -0.3), (width - 0.34, 0.2, 0.1), cloth, 0.04, 0.2))
    for sx in (-1, 1):
        parts.append(cushion((sx * (width / 2 - 0.05), 0.5, -0.02), (0.1, 0.24, 0.5), cloth, 0.04, -0.1))
    return parts


# -- stools and poufs --------------------------------------------------


def stool_round(height=0.46, radius=0.17, legs=4, rung=0.2, wood="oak", top="oak", splay=0.05) -> list[Part]:
    parts = [pillar((0, height - 0.035, 0), 0.035, radius, top, 20)]
    feet_xz = []
    for i in range(legs):
        a = 2 * math.pi * (i + 0.5) / legs
        c, s = math.cos(a), math.sin(a)
        reach = 0.72 * radius
        parts.append(bar(((reach + splay) * c, 0, (reach + splay) * s), (reach * c, height - 0.02, reach * s),
                         (0.016, 0.02), wood, 8))  # fmt: skip
        at = reach + splay * (1 - rung / height)
        feet_xz.append((at * c, at * s))
    for (x0, z0), (x1, z1) in zip(feet_xz, feet_xz[1:] + feet_xz[:1], strict=True):
        parts.append(bar((x0, rung, z0), (x1, rung, z1), 0.011, wood, 6))
    return parts


def stool_bar(height=0.74, frame="black", cloth="charcoal", back=0.2) -> list[Part]:
    parts = four_legs(0.36, 0.36, height - 0.05, 0.03, frame, splay=0.05)
    for sx in (-1, 1):
        parts.append(beam(sx * 0.18, 0.26, 0.18, 0.012, frame, 6))
        parts.append(rail(0.18, 0.26, sx * 0.18, 0.012, frame, 6))
        parts.append(bar((sx * 0.15, height - 0.04, -0.16), (sx * 0.15, height + back, -0.2), 0.014, frame, 6))
    parts.append(cushion((0, height - 0.03, 0), (0.4, 0.07, 0.38), cloth, 0.02))
    parts.append(cushion((0, height + back - 0.05, -0.2), (0.38, 0.13, 0.04), cloth, 0.015, 0.14))
    return parts


def stool_steps(width=0.42, wood="pine") -> list[Part]:
    parts = [block((0, 0.47, -0.07), (width, 0.03, 0.26), wood), block((0, 0.23, 0.14), (width, 0.03, 0.2), wood)]
    for sx in (-1, 1):
        x = sx * (width / 2 - 0.03)
        parts.append(bar((x, 0, 0.24), (x, 0.47, 0.0), 0.024, wood, 4))
        parts.append(bar((x, 0, -0.24), (x, 0.47, -0.14), 0.024, wood, 4))
        parts.append(box((x, 0.22, 0.0), (0.024, 0.035, 0.42), wood))
    parts.append(box((0, 0.12, -0.2), (width - 0.06, 0.04, 0.024), wood))
    return parts


def stool_hourglass(height=0.45, radius=0.18, material="terracotta") -> list[Part]:
    waist = 0.62 * radius
    profile = [
        (radius, 0),
        (0.94 * radius, 0.06),
        (waist, 0.18),
        (waist, height - 0.18),
        (0.94 * radius, height - 0.06),
    ]
    return turned((0, 0, 0), [*profile, (radius, height)], material, 18)


def stool_saddle(height=0.62, wood="walnut", cloth="leather") -> list[Part]:
    parts = four_legs(0.4, 0.28, height - 0.04, 0.04, wood, splay=0.04)
    parts.append(cushion((0, height - 0.015, 0), (0.46, 0.07, 0.3), cloth, 0.025))
    for sx in (-1, 1):
        parts.append(cushion((sx * 0.19, height + 0.02, 0), (0.08, 0.045, 0.29), cloth, 0.015))
        parts.append(box((sx * 0.18, 0.2, 0), (0.03, 0.04, 0.22), wood))
    parts.append(box((0, 0.3, 0.11), (0.32, 0.03, 0.025), wood))
    parts.append(box((0, 0.3, -0.11), (0.32, 0.03, 0.025), wood))
    return parts


def pouf_cube(size=0.42, cloth="blush", band="cream") -> list[Part]:
    return [
        cushion((0, 0.21, 0), (size, 0.42, size), cloth, 0.04),
        plate(rectangle(0, 0, size + 0.012, size + 0.012, 0.045), 0.3, 0.325, band),
        cushion((0, 0.43, 0), (0.1, 0.03, 0.1), band, 0.014),
    ]


def pouf_drum(radius=0.27, height=0.38, cloth="sage", wood="oak") -> list[Part]:
    body = turned((0, 0, 0), [(0.95 * radius, 0), (0.95 * radius, 0.03)], wood, 20)
    return body + turned(
        (0, 0.03, 0), [(radius, 0), (radius, height - 0.09), (0.86 * radius, height - 0.03)], cloth, 20
    )


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


def pouf_ottoman(width=0.66, depth=0.48, cloth="teal", wood="walnut") -> list[Part]:
    parts = four_legs(width - 0.04, depth - 0.04, 0.15, 0.04, wood, splay=0.02, square=False)
    parts.append(block((0, 0.14, 0), (width, 0.15, depth), cloth))
    parts.append(cushion((0, 0.35, 0), (width + 0.02, 0.13, depth + 0.02), cloth, 0.03))
    for i in range(6):
        x, z = width * ((i % 3) / 3 - 1 / 3), depth * (0.5 * (i // 3) - 0.25)
        parts.append(cushion((x, 0.415, z), (0.035, 0.02, 0.035), wood, 0.008))
    return parts


# -- benches -----------------------------------------------------------


def bench_plain(width=1.1, depth=0.34, height=0.46, wood="oak") -> list[Part]:
    parts = [block((0, height - 0.035, sz * depth / 4), (width, 0.035, depth / 2 - 0.008), wood) for sz in (-1, 1)]
    for sx in (-1, 1):
        x = sx * (width / 2 - 0.12)
        parts += [bar((x, 0, sz * depth / 2.1), (x, height - 0.03, sz * 0.06), 0.03, wood, 4) for sz in (-1, 1)]
        parts.append(box((x, height - 0.06, 0), (0.05, 0.05, depth - 0.06), wood))
    parts.append(box((0, 0.16, 0), (width - 0.24, 0.06, 0.03), wood))
    return parts


def bench_chest(width=1.0, depth=0.42, height=0.46, paint="white", cloth="denim") -> list[Part]:
    parts = [block((0, 0.0, -0.02), (width - 0.04, 0.07, depth - 0.08), "charcoal")]
    parts.append(block((0, 0.06, 0), (width, height - 0.14, depth), paint))
    for k in range(3):
        x = width * (k - 1) / 3
        parts.append(box((x, 0.22, depth / 2 + 0.004), (width / 3 - 0.07, 0.2, 0.014), paint))
    parts.append(block((0, height - 0.085, 0.005), (width + 0.02, 0.025, depth + 0.02), "oak"))
    parts.append(cushion((0, height - 0.03, 0.005), (width, 0.07, depth), cloth, 0.02))
    return parts


def bench_settle(width=1.15, depth=0.46, seat=0.44, back=0.88, wood="pine") -> list[Part]:
    parts = four_legs(width, depth, seat - 0.03, 0.05, wood)
    parts += [block((0, seat - 0.03, -0.15 + 0.15 * i), (width - 0.02, 0.028, 0.13), wood) for i in range(3)]
    for sx in (-1, 1):
        x = sx * (width / 2 - 0.04)
        parts.append(bar((x, seat - 0.04, -depth / 2 + 0.05), (x, back, -depth / 2 - 0.02), 0.035, wood, 4))
        parts.append(block((x, seat + 0.17, 0), (0.06, 0.03, depth - 0.04), wood))
        parts.append(block((x, seat - 0.02, depth / 2 - 0.06), (0.045, 0.2, 0.045), wood))
    for y in (seat + 0.2, back - 0.05):
        parts.append(box((0, y, -depth / 2 + 0.01), (width - 0.1, 0.07, 0.025), wood, 0.15))
    for i in range(7):
        x = (width - 0.3) * (i / 6 - 0.5)
        parts.append(box((x, seat + 0.31, -depth / 2 + 0.005), (0.05, 0.24, 0.018), wood, 0.15))
    return parts


def bench_upholstered(width=1.2, depth=0.42, height=0.48, cloth="grey", metal="brass") -> list[Part]:
    parts = [cushion((0, height - 0.07, 0), (width, 0.14, depth), cloth, 0.03)]
    for sx in (-1, 1):
        x = sx * (width / 2 - 0.14)
        for sz in (-1, 1):
            parts.append(bar((x, 0.0, sz * (depth / 2 - 0.02)), (x, height - 0.12, -sz * (depth / 2 - 0.05)),
                             0.016, metal, 6))  # fmt: skip
        parts.append(box((x, 0.012, 0), (0.03, 0.024, depth), metal))
    parts.append(bar((-width / 2 + 0.14, 0.18, 0), (width / 2 - 0.14, 0.18, 0), 0.014, metal, 6))
    return parts


# -- chairs and sofas --------------------------------------------------


def chair_cross(width=0.45, depth=0.44, seat=0.46, back=0.42, wood="cherry", pad="wicker") -> list[Part]:
    parts = four_legs(width - 0.02, depth, seat - 0.02, 0.04, wood, splay=0.015, square=False)
    parts.append(cushion((0, seat, 0.01), (width, 0.04, depth), pad, 0.015))
    top = seat + back
    for sx in (-1, 1):
        x = sx * (width / 2 - 0.03)
        parts.append(bar((x, seat - 0.02, -depth / 2 + 0.03), (0.94 * x, top, -depth / 2 - 0.05), 0.018, wood, 8))
        parts.append(bar((-x, seat + 0.04, -depth / 2 + 0.02), (x, top - 0.05, -depth / 2 - 0.04), 0.013, wood, 6))
        parts.append(box((x, 0.2, 0), (0.02, 0.025, depth - 0.08), wood))
    parts.append(box((0, top - 0.02, -depth / 2 - 0.05), (width - 0.03, 0.05, 0.03), wood, 0.16))
    return parts


def chair_cantilever(width=0.47, depth=0.52, seat=0.45, back=0.40, cloth="wicker", metal="chrome") -> list[Part]:
    parts = [rail(width / 2, 0.014, -depth / 2, 0.014, metal, 6)]
    for sx in (-1, 1):
        x = sx * (width / 2 - 0.014)
        parts.append(beam(x, 0.014, depth / 2, 0.014, metal, 6))
        parts.append(bar((x, 0.01, depth / 2 - 0.01), (x, seat, depth / 2 - 0.03), 0.014, metal, 6))
        parts.append(bar((x, seat - 0.015, depth / 2 - 0.02), (x, seat - 0.015, -depth / 2 + 0.06), 0.014, metal, 6))
        parts.append(bar((x, seat - 0.02, -depth / 2 + 0.07), (x, seat + back, -depth / 2), 0.014, metal, 6))
    parts.append(cushion((0, seat, 0.02), (width - 0.03, 0.035, depth - 0.1), cloth, 0.012))
    parts.append(cushion((0, seat + back - 0.13, -depth / 2 + 0.02), (width - 0.03, 0.27, 0.03), cloth, 0.01, 0.17))
    return parts


def sofa_futon(width=1.7, depth=0.84, seat=0.4, back=0.78, cloth="charcoal", wood="pine") -> list[Part]:
    parts = []
    for sx in (-1, 1):
        x = sx * (width / 2 - 0.04)
        parts += [block((x, 0, sz * (depth / 2 - 0.08)), (0.07, 0.56, 0.07), wood) for sz in (-1, 1)]
        parts.append(block((x, 0.56, 0), (0.1, 0.03, depth), wood))
        parts.append(box((x, 0.2, 0), (0.05, 0.08, depth - 0.12), wood))
    parts.append(block((0, 0.17, depth / 2 - 0.1), (width - 0.1, 0.09, 0.035), wood))
    parts += [block((0, 0.22, -0.22 + 0.16 * i), (width - 0.1, 0.025, 0.09), wood) for i in range(4)]
    parts.append(cushion((0, seat - 0.08, 0.06), (width - 0.16, 0.17, depth - 0.16), cloth, 0.04, 0.06))
    parts.append(cushion((0, (seat + back) / 2, -0.3), (width - 0.16, back - seat + 0.1, 0.17), cloth, 0.04, 0.28))
    return parts


def sofa_tuxedo(width=1.85, depth=0.84, height=0.76, cloth="blush", metal="brass") -> list[Part]:
    parts = feet(width - 0.1, depth - 0.1, 0.15, 0.018, metal)
    parts.append(block((0, 0.14, 0), (width, 0.13, depth), cloth))
    parts.append(cushion((0, (0.2 + height) / 2, 0.06 - depth / 2), (width, height - 0.2, 0.12), cloth, 0.02))
    for sx in (-1, 1):
        parts.append(cushion((sx * (width / 2 - 0.05), (0.2 + height) / 2, 0), (0.1, height - 0.2, depth), cloth, 0.02))
        parts.append(cushion((sx * 0.62, 0.55, -0.18), (0.42, 0.36, 0.14), "cream", 0.05, 0.25))
    for i in range(3):
        x = (width - 0.22) * (i - 1) / 3
        parts.append(cushion((x, 0.35, 0.06), ((width - 0.22) / 3 - 0.006, 0.17, depth - 0.14), cloth, 0.03))
    return parts


_f = functools.partial
DRAWINGS = {
    "armchair_block": Drawing("armchair", armchair_block),
    "armchair_wing": Drawing("armchair", armchair_wing),
    "armchair_lounge": Drawing("armchair", armchair_lounge, held_out=True),
    "armchair_barrel": Drawing("armchair", armchair_barrel),
    "armchair_swivel": Drawing("armchair", armchair_swivel, front=-1, held_out=True),
    "stool_round": Drawing("stool", stool_round, "__SYM_ROTATE_UP_4"),
    "stool_tripod": Drawing("stool", _f(stool_round, 0.42, 0.16, 3, 0.14, "black", "birch", 0.07)),
    "stool_bar": Drawing("stool", stool_bar),
    "stool_steps": Drawing("stool", stool_steps),
    "stool_hourglass": Drawing("stool", stool_hourglass, "__SYM_ROTATE_UP_INF", held_out=True),
    "stool_saddle": Drawing("stool", stool_saddle, "__SYM_ROTATE_UP_2", held_out=True),
    "pouf_cube": Drawing("pouf", pouf_cube, "__SYM_ROTATE_UP_4"),
    "pouf_drum": Drawing("pouf", pouf_drum, "__SYM_ROTATE_UP_INF"),
    "pouf_ottoman": Drawing("pouf", pouf_ottoman, "__SYM_ROTATE_UP_2"),
    "pouf_beanbag": Drawing("pouf", pouf_beanbag, held_out=True),
    "pouf_moroccan": Drawing("pouf", pouf_moroccan, "__SYM_ROTATE_UP_INF", held_out=True),
    "bench_plain": Drawing("bench", bench_plain, "__SYM_ROTATE_UP_2"),
    "bench_chest": Drawing("bench", bench_chest),
    "bench_settle": Drawing("bench", bench_settle, held_out=True),
    "bench_upholstered": Drawing("bench", bench_upholstered, "__SYM_ROTATE_UP_2", held_out=True),
    "chair_cross": Drawing("chair", chair_cross),
    "chair_cantilever": Drawing("chair", chair_cantilever, held_out=True),
    "sofa_futon": Drawing("sofa", sofa_futon, held_out=True),
    "sofa_tuxedo": Drawing("sofa", sofa_tuxedo),
}
"""Model name -> how it is drawn."""
