"""Sizes and materials in, the convex parts of one piece of furniture out: metres, base at y = 0, front +z."""

from __future__ import annotations

import math

from converters.generate.models.parts import Part, bar, box, cushion, four_legs

# -- chairs ------------------------------------------------------------


def chair_slat(width=0.44, depth=0.43, seat=0.45, back=0.46, slats=3, wood="oak") -> list[Part]:
    parts = four_legs(width, depth, seat - 0.02, 0.045, wood)
    parts.append(box((0, seat, 0), (width, 0.04, depth), wood))
    for sx in (-1, 1):
        foot = (sx * (width / 2 - 0.03), seat, -depth / 2 + 0.025)
        parts.append(bar(foot, (foot[0], seat + back, -depth / 2 - 0.05), 0.028, wood, 4))
    for i in range(slats):
        y = seat + back * (i + 1) / slats - 0.05
        z = -depth / 2 + 0.02 - 0.07 * (y - seat) / back
        parts.append(box((0, y, z), (width - 0.06, 0.075, 0.024), wood, tilt_rad=0.15))
    return parts


def chair_panel(width=0.47, depth=0.46, seat=0.46, back=0.38, shell="white", leg="oak") -> list[Part]:
    parts = four_legs(width - 0.06, depth - 0.06, seat - 0.02, 0.045, leg, splay=0.05, square=False)
    parts.append(cushion((0, seat, 0.01), (width, 0.05, depth), shell, 0.015))
    parts.append(cushion((0, seat + back / 2, -depth / 2 - 0.02), (width - 0.02, back, 0.045), shell, 0.015, 0.2))
    return parts


def chair_arm(width=0.58, depth=0.54, seat=0.42, back=0.44, cloth="moss", wood="walnut") -> list[Part]:
    parts = four_legs(width, depth, seat - 0.04, 0.05, wood)
    parts.append(cushion((0, seat, 0.02), (width - 0.1, 0.11, depth - 0.06), cloth, 0.03))
    parts.append(cushion((0, seat + back / 2, -depth / 2 + 0.04), (width - 0.1, back, 0.09), cloth, 0.03, 0.16))
    for sx in (-1, 1):
        x = sx * (width / 2 - 0.03)
        parts.append(box((x, seat + 0.2, 0), (0.055, 0.04, depth - 0.04), wood))
        parts.append(box((x, seat + 0.08, depth / 2 - 0.05), (0.045, 0.24, 0.045), wood))
        parts.append(box((x, seat + 0.08, -depth / 2 + 0.05), (0.045, 0.24, 0.045), wood))
    return parts


def chair_office(seat=0.47, arms=5, cloth="slate", frame="black") -> list[Part]:
    parts = [bar((0, 0.07, 0), (0, seat - 0.03, 0), 0.035, frame, 10)]
    for i in range(arms):
        a = 2 * math.pi * i / arms + math.pi / 2
        tip = (0.29 * math.cos(a), 0.055, 0.29 * math.sin(a))
        parts.append(bar((0, 0.10, 0), tip, (0.034, 0.024), frame, 6))
        parts.append(bar((tip[0], 0.0, tip[2]), (tip[0], 0.07, tip[2]), 0.028, frame, 8))
    parts.append(cushion((0, seat, 0.02), (0.50, 0.09, 0.49), cloth, 0.03))
    parts.append(box((0, seat + 0.06, -0.235), (0.07, 0.22, 0.035), frame, tilt_rad=0.1))
    parts.append(cushion((0, seat + 0.36, -0.27), (0.45, 0.44, 0.07), cloth, 0.025, 0.12))
    return parts


def chair_sled(width=0.50, depth=0.50, seat=0.45, back=0.40, cloth="navy", frame="steel") -> list[Part]:
    parts = []
    for sx in (-1, 1):
        x = sx * (width / 2 - 0.02)
        parts.append(bar((x, 0.02, -depth / 2), (x, 0.02, depth / 2), 0.022, frame, 6))
        parts.append(bar((x, 0.02, depth / 2 - 0.02), (x, seat, depth / 2 - 0.05), 0.022, frame, 6))
        parts.append(bar((x, 0.02, -depth / 2 + 0.02), (x, seat + 0.1, -depth / 2 + 0.02), 0.022, frame, 6))
    parts.append(cushion((0, seat, 0), (width, 0.06, depth - 0.04), cloth, 0.02))
    parts.append(cushion((0, seat + 0.08 + back / 2, -depth / 2), (width, back, 0.05), cloth, 0.02, 0.14))
    return parts


def chair_tub(width=0.64, depth=0.62, seat=0.40, back=0.33, cloth="rust", leg="black") -> list[Part]:
    parts = four_legs(width - 0.08, depth - 0.08, 0.16, 0.04, leg, square=False)
    parts.append(box((0, 0.15 + (seat - 0.15) / 2, 0.02), (width - 0.12, seat - 0.15, depth - 0.08), cloth, open=True))
    parts.append(
        cushion((0, 0.15 + (seat + back - 0.15) / 2, -depth / 2 + 0.06), (width, seat + back - 0.15, 0.12), cloth)
    )
    for sx in (-1, 1):
        height = seat + 0.6 * back - 0.15
        parts.append(cushion((sx * (width / 2 - 0.05), 0.15 + height / 2, 0.02), (0.1, height, depth - 0.06), cloth))
    return parts


def chair_spindle(width=0.43, depth=0.42, seat=0.45, back=0.47, spindles=5, wood="oak") -> list[Part]:
    parts = four_legs(width - 0.08, depth - 0.08, seat - 0.01, 0.042, wood, splay=0.045, square=False)
    parts.append(bar((0, seat - 0.02, 0), (0, seat + 0.02, 0), 0.56 * width, wood, 10))
    for i in range(spindles):
        x = (width - 0.12) * (i / (spindles - 1) - 0.5)
        parts.append(
            bar((x, seat, -depth / 2 + 0.05), (1.1 * x, seat + back - 0.03, -depth / 2 - 0.04), 0.013, wood, 6)
        )
    parts.append(box((0, seat + back - 0.03, -depth / 2 - 0.04), (width - 0.02, 0.07, 0.03), wood, tilt_rad=0.18))
    return parts


# -- tables and desks --------------------------------------------------


def table_legs(width=1.2, depth=0.75, height=0.74, top="oak", leg="oak", apron=0.08) -> list[Part]:
    parts = four_legs(width, depth, height - 0.03, 0.06, leg)
    parts.append(box((0, height - 0.018, 0), (width, 0.036, depth), top))
    if apron:
        for sz in (-1, 1):
            parts.append(
                box((0, height - 0.036 - apron / 2, sz * (depth / 2 - 0.07)), (width - 0.14, apron, 0.03), leg)
            )
        for sx in (-1, 1):
            parts.append(
                box((sx * (width / 2 - 0.07), height - 0.036 - apron / 2, 0), (0.03, apron, depth - 0.14), leg)
            )
    return parts


def table_round(diameter=0.95, height=0.73, top="white", leg="black") -> list[Part]:
    r = diameter / 2
    parts = [
        bar((0, height - 0.036, 0), (0, height, 0), r, top, 24),
        bar((0, 0.03, 0), (0, height - 0.03, 0), (0.06, 0.045), leg, 12),
        bar((0, 0.0, 0), (0, 0.04, 0), (0.58 * r, 0.54 * r), leg, 16),
    ]
    return parts


def table_trestle(width=1.3, depth=0.75, height=0.74, top="walnut", leg="black") -> list[Part]:
    parts = [box((0, height - 0.02, 0), (width, 0.04, depth), top)]
    for sx in (-1, 1):
        x = sx * (width / 2 - 0.18)
        for sz in (-1, 1):
            foot = (x, 0, sz * (depth / 2 - 0.06))
            parts.append(bar(foot, (x, height - 0.03, sz * 0.08), 0.032, leg, 4))
        parts.append(box((x, 0.28, 0), (0.045, 0.05, depth * 0.62), leg))
    parts.append(box((0, 0.28, 0), (width - 0.36, 0.05, 0.045), leg))
    return parts


def table_tripod(diameter=0.85, height=0.72, top="oak", leg="white") -> list[Part]:
    r = diameter / 2
    parts = [bar((0, height - 0.03, 0), (0, height, 0), r, top, 20)]
    parts.append(bar((0, 0.30, 0), (0, height - 0.02, 0), 0.045, leg, 8))
    for i in range(3):
        a = 2 * math.pi * i / 3 + math.pi / 2
        foot = (0.8 * r * math.cos(a), 0.0, 0.8 * r * math.sin(a))
        parts.append(bar((0, 0.36, 0), foot, (0.035, 0.028), leg, 6))
    return parts


def table_coffee(width=0.95, depth=0.55, height=0.42, top="oak", leg="white") -> list[Part]:
    parts = four_legs(width, depth, height - 0.03, 0.05, leg)
    parts.append(box((0, height - 0.02, 0), (width, 0.04, depth), top))
    parts.append(box((0, 0.15, 0), (width - 0.09, 0.025, depth - 0.09), leg))
    return parts


def table_panel(width=1.1, depth=0.7, height=0.73, top="linen", side="linen") -> list[Part]:
    parts = [box((0, height - 0.02, 0), (width, 0.04, depth), top)]
    for sx in (-1, 1):
        parts.append(box((sx * (width / 2 - 0.06), (height - 0.03) / 2, 0), (0.05, height - 0.03, depth - 0.08), side))
    return parts


def desk_panel(width=1.2, depth=0.62, height=0.74, wood="oak") -> list[Part]:
    parts = [box((0, height - 0.015, 0), (width, 0.03, depth), wood)]
    for sx in (-1, 1):
        parts.append(box((sx * (width / 2 - 0.02), (height - 0.02) / 2, 0), (0.035, height - 0.02, depth - 0.03), wood))
    parts.append(box((0, height - 0.22, -depth / 2 + 0.06), (width - 0.05, 0.4, 0.025), wood))
    return parts


def desk_drawers(width=1.3, depth=0.65, height=0.75, wood="walnut", leg="black") -> list[Part]:
    parts = [box((0, height - 0.018, 0), (width, 0.036, depth), wood)]
    x = width / 2 - 0.23
    parts.append(box((x, (height - 0.02) / 2 + 0.02, 0), (0.4, height - 0.06, depth - 0.06), wood, open=True))
    for i in range(3):
        y = 0.16 + 0.2 * i
        parts.append(box((x, y, depth / 2 - 0.03), (0.36, 0.18, 0.03), wood))
        parts.append(box((x, y + 0.04, depth / 2 - 0.005), (0.12, 0.02, 0.025), "steel"))
    parts.append(box((-width / 2 + 0.03, (height - 0.02) / 2, 0), (0.04, height - 0.02, depth - 0.04), wood))
    for sz in (-1, 1):
        parts.append(box((x, 0.02, sz * (depth / 2 - 0.08)), (0.34, 0.04, 0.04), leg))
    return parts


def desk_frame(width=1.25, depth=0.62, height=0.74, top="white", frame="steel") -> list[Part]:
    parts = [box((0, height - 0.015, 0), (width, 0.03, depth), top)]
    for sx in (-1, 1):
        x = sx * (width / 2 - 0.07)
        parts.append(box((x, 0.02, 0), (0.06, 0.04, depth - 0.04), frame))
        parts.append(box((x, height / 2, -0.04), (0.07, height - 0.03, 0.05), frame))
        parts.append(box((x, height - 0.045, 0), (0.05, 0.03, depth - 0.1), frame))
    parts.append(box((0, height - 0.06, -0.04), (width - 0.14, 0.05, 0.04), frame))
    return parts


def desk_hutch(width=1.15, depth=0.6, height=0.75, wood="linen", leg="oak") -> list[Part]:
    parts = table_legs(width, depth, height, wood, leg, apron=0.12)
    for sx in (-1, 1):
        parts.append(box((sx * (width / 2 - 0.02), height + 0.14, -depth / 2 + 0.12), (0.03, 0.3, 0.22), wood))
    parts.append(box((0, height + 0.28, -depth / 2 + 0.12), (width, 0.025, 0.23), wood))
    return parts


def desk_pedestals(width=1.35, depth=0.66, height=0.75, wood="linen", front="white") -> list[Part]:
    parts = [box((0, height - 0.016, 0), (width, 0.032, depth), wood)]
    for sx in (-1, 1):
        x = sx * (width / 2 - 0.20)
        parts.append(box((x, (height - 0.02) / 2, -0.01), (0.38, height - 0.02, depth - 0.06), wood, open=True))
        for i in range(2):
            y = height * (0.28 + 0.42 * i)
            parts.append(box((x, y, depth / 2 - 0.03), (0.34, 0.36 * height, 0.025), front))
            parts.append(box((x, y + 0.1, depth / 2 - 0.01), (0.14, 0.02, 0.02), "steel"))
    parts.append(box((0, height - 0.18, -depth / 2 + 0.05), (width - 0.76, 0.3, 0.02), wood))
    return parts


# -- sofas ------------------------------------------------------------


def sofa(width=1.6, depth=0.82, seat=0.42, back=0.42, arm=0.16, seats=2, cloth="slate", legs=0.1) -> list[Part]:
    inner = width - 2 * arm
    parts = [
        box(
            (0, legs + (seat - 0.14 - legs) / 2, 0),
            (width - 0.02, seat - 0.14 - legs, depth - 0.04),
            cloth,
            open=True,
        )
    ]
    if legs > 0:
        parts += four_legs(width - 0.04, depth - 0.06, legs + 0.01, 0.06, "walnut")
    top = seat + back
    parts.append(
        cushion((0, legs + (top - legs) / 2, -depth / 2 + 0.1), (width - 0.02, top - legs, 0.2), cloth, 0.04, 0.06)
    )
    for i in range(seats):
        x = inner * ((i + 0.5) / seats - 0.5)
        parts.append(cushion((x, seat - 0.08, 0.08), (inner / seats - 0.006, 0.17, depth - 0.2), cloth, 0.03))
    if arm > 0.05:
        for sx in (-1, 1):
            height = seat + 0.18 - legs
            parts.append(
                cushion(
                    (sx * (width - arm) / 2, legs + height / 2, 0.01),
                    (arm, height, depth - 0.02),
                    cloth,
                    0.04,
                )
            )
    return parts


def sofa_chaise(width=1.75, depth=0.80, reach=1.25, seat=0.42, back=0.40, cloth="navy", legs=0.08) -> list[Part]:
    low = seat - 0.14
    long_w = 0.36 * width
    x = (width - long_w) / 2
    front = depth / 2 + (reach - depth)
    parts = [
        box((0, legs + (low - legs) / 2, 0), (width - 0.02, low - legs, depth - 0.04), cloth, open=True),
        box(
            (x, legs + (low - legs) / 2, (front - depth / 2) / 2), (long_w, low - legs, reach - 0.04), cloth, open=True
        ),
        cushion((0, legs + (seat + back - legs) / 2, -depth / 2 + 0.1), (width, seat + back - legs, 0.2), cloth, 0.04),
        cushion((-long_w / 2, seat - 0.08, 0.08), (width - long_w - 0.02, 0.17, depth - 0.2), cloth, 0.03),
        cushion((x, seat - 0.08, (front - depth / 2) / 2 + 0.08), (long_w - 0.02, 0.17, reach - 0.2), cloth, 0.03),
        cushion((-width / 2 + 0.08, legs + 0.25, 0.01), (0.16, 0.5, depth - 0.02), cloth, 0.04),
    ]
    for sx in (-1, 1):
        parts.append(box((sx * (width / 2 - 0.07), legs / 2, -depth / 2 + 0.07), (0.06, legs + 0.01, 0.06), "black"))
    parts.append(box((-width / 2 + 0.07, legs / 2, depth / 2 - 0.07), (0.06, legs + 0.01, 0.06), "black"))
    for sx in (-1, 1):
        foot = (x + sx * (long_w / 2 - 0.07), legs / 2, front - 0.07)
        parts.append(box(foot, (0.06, legs + 0.01, 0.06), "black"))
    return parts


# -- doors: leaf from x = 0 (hinge edge) to x = width, handle near the other edge


def door(width=0.88, height=2.0, thick=0.04, paint="white", panels=2, knob=False, metal="steel") -> list[Part]:
    parts = [box((width / 2, height / 2, 0), (width, height, thick), paint)]
    for i in range(panels):
        y = height * (i + 0.5) / panels
        for sz in (-1, 1):
            parts.append(box((width / 2, y, sz * thick / 2), (width - 0.26, height / panels - 0.2, 0.012), paint))
    # Handles lie flat: a lever that stands off makes the leaf's convex hull as thick as it reaches.
    x = width - 0.07
    for sz in (-1, 1):
        z = sz * (thick / 2 + 0.006)
        parts.append(box((x, 1.02, z), (0.05, 0.2, 0.012), metal))
        if knob:
            parts.append(cushion((x, 1.02, z + sz * 0.006), (0.05, 0.05, 0.02), metal, 0.006))
        else:
            parts.append(box((x - 0.04, 1.05, z + sz * 0.006), (0.12, 0.02, 0.018), metal))
    return parts


def door_battens(width=0.86, height=2.0, thick=0.038, wood="moss", metal="black") -> list[Part]:
    parts = [box((width / 2, height / 2, 0), (width, height, thick), wood)]
    for y in (0.25, 1.0, 1.75):
        for sz in (-1, 1):
            parts.append(box((width / 2, y, sz * thick / 2), (width - 0.08, 0.12, 0.016), wood))
    for sz in (-1, 1):
        parts.append(box((width - 0.06, 1.12, sz * (thick / 2 + 0.006)), (0.04, 0.18, 0.012), metal))
    return parts
