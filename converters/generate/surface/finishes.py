"""Colour floors and walls by a room's use: boards, tiles, carpet, paint, wallpaper, rugs, pictures."""

import dataclasses
from collections.abc import Callable, Sequence

import numpy as np

from converters.generate.homes.building import Rect

Colouring = Callable[[np.ndarray], np.ndarray]
"""(n, 3) places in the building -> (n, 3) colours in 0..1."""

PAINTS = np.array([[0.90, 0.88, 0.83], [0.80, 0.86, 0.84], [0.88, 0.82, 0.76], [0.82, 0.84, 0.90], [0.93, 0.92, 0.90]])
WOODS = np.array([[0.66, 0.48, 0.31], [0.50, 0.36, 0.25], [0.76, 0.62, 0.45]])
TILES = np.array([[0.72, 0.72, 0.70], [0.83, 0.81, 0.76], [0.46, 0.49, 0.52], [0.70, 0.58, 0.48]])
GLAZES = np.array([[0.90, 0.92, 0.92], [0.70, 0.82, 0.84], [0.84, 0.88, 0.80], [0.88, 0.82, 0.74]])
CARPETS = np.array([[0.62, 0.58, 0.52], [0.48, 0.50, 0.55], [0.66, 0.61, 0.58], [0.45, 0.50, 0.45]])
RUGS = np.array([[0.55, 0.22, 0.20], [0.22, 0.32, 0.46], [0.72, 0.64, 0.50], [0.33, 0.40, 0.33]])
FRAMES = np.array([[0.16, 0.15, 0.14], [0.45, 0.30, 0.19], [0.90, 0.90, 0.88]])
SKIES = np.array([[0.78, 0.84, 0.88], [0.92, 0.83, 0.70], [0.86, 0.80, 0.82], [0.70, 0.80, 0.82], [0.92, 0.90, 0.86]])
LANDS = np.array([[0.32, 0.42, 0.34], [0.52, 0.35, 0.26], [0.40, 0.34, 0.44], [0.20, 0.32, 0.42], [0.28, 0.28, 0.31]])
PRINTS = np.stack([SKIES, LANDS], axis=1)
"""Ground and ink of pictures, such as sky and land."""
ACCENTS = np.array([[0.80, 0.45, 0.25], [0.85, 0.66, 0.28], [0.62, 0.22, 0.24], [0.30, 0.50, 0.55], [0.78, 0.52, 0.50]])
SKIRTING_M = 0.09
"""Height of the white board along the foot of painted walls."""
BLUR_M = 0.0125
WET = ("bathroom", "kitchen")
SOFT = ("bedroom", "office")
"""Uses whose floors are carpets half of the time."""
WITH_RUG = ("living", "bedroom", "dining")


@dataclasses.dataclass(frozen=True)
class Finish:
    """Describe how one room is finished."""

    floor_colour: Colouring
    wall_colour: Colouring
    skirting: bool = True
    """A board runs along the foot of its walls."""


def hashed(*keys: np.ndarray) -> np.ndarray:
    """Turn integers into repeatable numbers in 0..1."""
    value = np.zeros(keys[0].shape)
    for i, k in enumerate(keys):
        value = value + k * (12.9898 + 65.133 * i)
    return np.mod(np.sin(value) * 43758.5453, 1.0)


def boards(p: np.ndarray, base: np.ndarray, along: int) -> np.ndarray:
    """Paint wooden boards, 0.14 m wide, about 1.1 m long."""
    across, length = p[:, 1 - along] / 0.14, p[:, along] / 1.1
    row = np.floor(across)
    board = np.floor(length + hashed(row))
    tone = 0.86 + 0.26 * hashed(row, board)
    grain = 1 + 0.04 * np.sin(40 * p[:, 1 - along] + 3 * np.sin(2.5 * p[:, along]))
    joint = np.where(np.mod(across, 1) < 0.07, 0.8, 1.0)
    return base * (tone * grain * joint)[:, None]


def tiles(u: np.ndarray, v: np.ndarray, base: np.ndarray, side_m: float, chequered: bool = False) -> np.ndarray:
    """Paint square tiles with grout, over a plane's two coordinates; a texel `BLUR_M` wide takes its share of grout."""
    i, j = np.floor(u / side_m), np.floor(v / side_m)
    off = np.minimum(*(np.minimum(np.mod(w, side_m), side_m - np.mod(w, side_m)) for w in (u, v)))
    grout = np.clip((0.0035 + BLUR_M / 2 - off) / BLUR_M, 0, 1)
    tone = 0.75 * grout + (1 - grout) * (0.96 + 0.06 * hashed(i, j))
    if chequered:
        tone = tone * np.where(np.mod(i + j, 2) < 1, 1.0, 0.62)
    return base * tone[:, None]


def _rug(room: Rect, colour: np.ndarray, rng: np.random.Generator) -> Callable[[np.ndarray, np.ndarray], np.ndarray]:
    """Return what lays a woven rug near the room's middle over the floor."""
    size = np.array(room.size)
    half = np.minimum(rng.uniform(0.24, 0.36) * size, [1.5, 1.1])
    middle = np.array(room.centre) + rng.uniform(-0.1, 0.1, 2) * size
    period = rng.uniform(0.18, 0.4)

    def lay(p: np.ndarray, under: np.ndarray) -> np.ndarray:
        inside = half - np.abs(p[:, :2] - middle)
        edge = inside.min(axis=1)
        weave = 0.94 + 0.1 * hashed(np.floor(p[:, 0] / 0.02), np.floor(p[:, 1] / 0.02))
        woven = np.mod(np.abs(p[:, :2] - middle).sum(axis=1), period) < period / 3
        tone = np.where((edge < 0.1) & (edge > 0.05), 1.3, np.where(woven, 1.12, 1.0)) * weave
        return np.where((edge > 0)[:, None], np.clip(colour * tone[:, None], 0, 1), under)

    return lay


INK, MID, ACCENT, LIGHT = 1, 2, 3, 4
"""Colours of a picture beside its ground, 0."""


def _motifs(x: np.ndarray, y: np.ndarray, r: np.ndarray) -> list[tuple[str, np.ndarray, int]]:
    """Return motifs, back first: name, a layer that is positive where the motif shows, and its colour.

    `x`, `y` are (n,) places in halves of the short side from the middle, `r` three numbers in -1..1.
    """
    slant, leaf = x + r[0] * y, 0.15 * np.sin(np.minimum(np.pi, abs(x) * 5 / (1 + 0.5 * r[1] * y)))
    word, line = hashed(np.floor(8 * x), np.floor(y / 0.17)), abs(np.mod(y, 0.17) - 0.06)
    return [
        ("hills", 0.13 - np.hypot(x - 0.6 * r[0], y - 0.5), LIGHT),
        *(("hills", 0.25 * r[1] + 0.15 * np.sin(5 * x + 2 * k * r[0]) - y - 0.35 / k, k) for k in (2, 1)),
        ("sea", 0.3 - np.hypot(x - 0.5 * r[0], y - 0.1), ACCENT),
        ("sea", -y, INK),
        ("sea", np.minimum(-0.06 - y, 0.025 - abs(np.mod(y + 0.02 * np.sin(9 * x), 0.17) - 0.085)), MID),
        ("sea", np.minimum(y + 0.1, 0.2 - 0.4 * y - abs(x + 0.6 * r[1])), LIGHT),
        *(("fields", np.minimum(s * (y - 0.4 * r[0]) - 0.06, 0.86 - s * y), k) for s, k in ((1, ACCENT), (-1, INK))),
        *(("stripes", 0.07 - abs(np.mod(slant, 0.32 * k) - 0.16), k) for k in (INK, ACCENT)),
        *(("discs", 0.45 + 0.15 * r[k] - np.hypot(x - 0.7 * r[k - 1], y - 0.5 * r[k - 2]), k + 1) for k in range(3)),
        ("twig", np.minimum(0.025 - abs(x), 0.9 - abs(y)), INK),
        ("twig", leaf - 0.02 - abs(np.mod(y - abs(x), 0.34) - 0.17), INK),
        ("skyline", 0.25 - np.hypot(x - 0.5 * r[0], y - 0.4), ACCENT),
        *(("skyline", 0.85 * hashed(np.floor((2 + k) * x + 9 * r[k])) + 0.4 * k - 1.15 - y, k) for k in (MID, INK)),
        ("poster", 0.02 + y, ACCENT),
        ("poster", 0.32 - np.hypot(x - 0.4 * r[0], y - 0.48), LIGHT),
        ("poster", 0.05 - line - (y > -0.1) - (word < 0.3), INK),
        ("vase", -0.55 - y, MID),
        *(("vase", 0.02 - abs(x - d * (y + 0.2)) - (abs(y) > 0.3), INK) for d in (-0.6, 0.1, 0.7)),
        *(("vase", 0.2 + 0.05 * r[0] - np.hypot(x - d, y - 0.35), ACCENT) for d in (-0.33, 0.05, 0.38)),
        ("vase", 0.2 - abs(y + 0.45) * (0.5 + 0.2 * r[1]) - 2.5 * x**2 - (y > -0.15), INK),
    ]


def framed(at: np.ndarray, half: np.ndarray, frame: np.ndarray, rng: np.random.Generator) -> np.ndarray:
    """Paint a motif behind a mount, at (n, 2) places -1..1; `half` (2,) is in m, `frame` (3,) the rim's colour."""
    sky, land = PRINTS[rng.integers(len(PRINTS))] + rng.uniform(-0.05, 0.05, (2, 3))
    colours = np.array([sky, land, 0.55 * land + 0.45 * sky, rng.choice(ACCENTS), (0.97, 0.92, 0.76)])
    (x, y), inner = (at * half / half.min()).T, sky
    layers = _motifs(x, y, rng.uniform(-1, 1, 3))
    motif = rng.choice(sorted({name for name, *_ in layers}))
    for level, k in ((level, k) for name, level, k in layers if name == motif):
        share = np.clip(level * half.min() / 0.008 + 0.5, 0, 1)[:, None]
        inner = inner * (1 - share) + share * colours[k]
    from_edge = ((1 - np.abs(at)) * half).min(axis=1)[:, None]
    return np.where(from_edge < 0.02, frame, np.where(from_edge < 0.055, [0.95, 0.94, 0.91], inner))


def _hang(p: np.ndarray, colour: np.ndarray, room: Rect, count: int, rng: np.random.Generator) -> np.ndarray:
    """Paint framed pictures over a wall's colours."""
    hung = []
    for _ in range(count):
        axis = int(rng.integers(2))
        wall = room.span(axis)[int(rng.random() >= 0.5)]
        low, high = room.span(1 - axis)
        half = rng.uniform([0.2, 0.16], [0.45, 0.34])
        if high - low < 2 * half[0] + 0.6:
            continue
        middle = np.array([rng.uniform(low + half[0] + 0.3, high - half[0] - 0.3), rng.uniform(1.45, 1.6)])
        hung.append((axis, wall, middle, half, FRAMES[rng.integers(len(FRAMES))]))
    for axis, wall, middle, half, frame in hung:
        at = (p[:, [1 - axis, 2]] - middle) / half
        on = (np.abs(p[:, axis] - wall) < 0.08) & (np.abs(at) < 1).all(axis=1)
        colour = np.where(on[:, None], framed(at, half, frame, rng), colour)
    return colour


def _wall(room: Rect, use: str, rng: np.random.Generator, pictured: bool) -> Colouring:
    """Choose paint or wallpaper over a skirting board; glazed tiles in wet rooms; pictures in dry ones."""
    base, glaze = PAINTS[rng.integers(len(PAINTS))], GLAZES[rng.integers(len(GLAZES))]
    tiled_to = {"bathroom": rng.choice([1.25, 2.0]), "kitchen": 1.45}.get(use, 0.0)
    tiled_from = 0.85 if use == "kitchen" else 0.0
    papered = use in ("bedroom", "living", "dining") and rng.random() < 0.4
    stripe, accent = rng.uniform(0.08, 0.2), base * rng.uniform(0.88, 0.96, 3)
    pictures = 0 if use in ("bathroom", "storage") else int(rng.integers(1, 4))
    pictures *= pictured
    seed = int(rng.integers(2**31))

    def colour(p: np.ndarray) -> np.ndarray:
        out = np.tile(base, (len(p), 1))
        off = np.minimum(np.abs(p[:, :2] - (room.x0, room.y0)), np.abs(p[:, :2] - (room.x1, room.y1)))
        along = np.where(off[:, 0] < off[:, 1], p[:, 1], p[:, 0])
        if papered:
            out[np.mod(along, 2 * stripe) < stripe] = accent
        tile = (p[:, 2] < tiled_to) & (p[:, 2] > tiled_from)
        out[tile] = tiles(along[tile], p[tile, 2], glaze, 0.15)
        if tiled_from or not tiled_to:
            out[p[:, 2] < SKIRTING_M] = [0.95, 0.95, 0.94]
        return _hang(p, out, room, pictures, np.random.default_rng(seed))

    return colour


def _floor(room: Rect, use: str, wood: np.ndarray, along: int, rugs: np.ndarray, rng: np.random.Generator) -> Colouring:
    """Choose tiles in wet rooms, carpet in some bedrooms, boards elsewhere; a rug in some."""
    tile, carpet = TILES[rng.integers(len(TILES))], CARPETS[rng.integers(len(CARPETS))]
    side_m, chequered = rng.choice([0.2, 0.3, 0.45]), bool(rng.random() < 0.3)
    soft = use in SOFT and rng.random() < 0.5
    rug = _rug(room, rugs[rng.integers(len(rugs))], rng) if use in WITH_RUG and not soft else None

    def colour(p: np.ndarray) -> np.ndarray:
        if use in WET:
            return tiles(p[:, 0], p[:, 1], tile, side_m, chequered)
        if soft:
            return carpet * (0.9 + 0.16 * hashed(np.floor(p[:, 0] / 0.015), np.floor(p[:, 1] / 0.015)))[:, None]
        under = boards(p, wood, along)
        return under if rug is None else rug(p, under)

    return colour


def finishes(
    rooms: Sequence[Rect], uses: Sequence[str], rng: np.random.Generator, pictures: bool = True, rugs: np.ndarray = RUGS
) -> list[Finish]:
    """Choose how each room is finished, which has one of the `uses`."""
    wood, along = WOODS[rng.integers(len(WOODS))], int(rng.integers(2))
    return [
        Finish(_floor(room, use, wood, along, rugs, rng), _wall(room, use, rng, pictures), use != "bathroom")
        for room, use in zip(rooms, uses, strict=True)
    ]
