"""Find which way is up in a scan in any frame and unit, how to turn it there, and its unit."""

import numpy as np

from converters.geometry.faces import face_areas, unit_normals
from converters.records.errors import SceneRejected

AXES = {word: sign * np.eye(3)[k] for k, axis in enumerate("xyz") for word, sign in ((axis, 1.0), (f"-{axis}", -1.0))}
"""`--up`: axis of the file that points up."""
UNITS_M = {"m": 1.0, "cm": 0.01, "mm": 0.001, "ft": 0.3048, "in": 0.0254}
HEIGHTS_M = (1.0, 6.0)
"""Plausible heights of one storey's scan; partial ones are low."""
DRAWS = 300
ALONG, ACROSS = np.cos(np.radians(8.0)), np.sin(np.radians(8.0))
"""Faces count as level or as steep within 8 degrees."""
SMALLER = 0.85
"""A storey is lower than this share of its shorter side; else its extents do not show its height."""
EDGE_SHARE = 0.12
"""Of the height: what lies this near to the lowest or highest level may be floor or ceiling."""
BIN_M, MAIN_SHARE, SLAB_M = 0.05, 0.5, 1.0
"""Of level surface: height of a bin, share of the largest that counts as floor or ceiling, thickest slab."""
SURE = 1.25
"""Ratio of evidence for one sense over the other."""


def _extent(values: np.ndarray, area: np.ndarray) -> tuple[float, float]:
    """Return the values that all but 1 % of the area lies between, on either side: strays do not count."""
    order = np.argsort(values)
    share = np.cumsum(area[order]) / area.sum()
    low, high = np.searchsorted(share, (0.01, 0.99))
    return float(values[order[low]]), float(values[order[min(high, len(values) - 1)]])


def find_up(vertices: np.ndarray, faces: np.ndarray, where: str) -> np.ndarray:
    """Return (3,) unit vector that points up in a room's scan of any unit, whose faces' front is to the room.

    Rooms are level and upright: nearly all area lies along or across three directions that are square to each other.
    Of these the storey's height is the shortest extent. What the scan shows of furniture are tops and not undersides,
    and a floor without a ceiling looks up: that shows the sense.
    """
    normal, area = unit_normals(vertices, faces), face_areas(vertices, faces)
    if not area.sum() > 0:
        raise SceneRejected(f"{where}: its faces enclose no area; fetch it again")
    middle = vertices[faces].mean(axis=1)
    rng = np.random.default_rng(0)
    drawn = normal[rng.choice(len(area), DRAWS, p=area / area.sum())]
    cosine = np.abs(drawn @ normal.T)
    score = ((cosine > ALONG) | (cosine < ACROSS)) @ area
    axes: list[np.ndarray] = []
    for k in np.argsort(-score, kind="stable"):
        if all(abs(drawn[k] @ axis) < 0.3 for axis in axes):
            axis = drawn[k]
            for _ in range(3):  # the principal direction of the normals near it
                near = np.abs(normal @ axis) > ALONG
                axis = np.linalg.eigh((normal[near] * area[near, None]).T @ normal[near])[1][:, 2]
            axes.append(axis)
    if len(axes) == 2:
        axes.append(np.cross(axes[0], axes[1]))
    if len(axes) < 2:
        raise SceneRejected(f"{where}: shows one direction of surface only; say which axis points up with --up")
    spans = [np.ptp(_extent(middle @ axis, area)) for axis in axes]
    order = np.argsort(spans)
    if spans[order[0]] > SMALLER * spans[order[1]]:
        extents = ", ".join(f"{span:.3g}" for span in sorted(spans))
        raise SceneRejected(
            f"{where}: its extents of {extents} do not tell which is its height; say which axis points up with --up"
        )
    up = axes[order[0]]
    height = middle @ up
    low, high = _extent(height, area)
    level = normal @ up
    edge = EDGE_SHARE * (high - low)
    inner = (height > low + edge) & (height < high - edge)
    top_up, top_down = (area[inner & (sign * level > ALONG)].sum() for sign in (1, -1))
    floors = (height <= low + edge) & (level > ALONG), (height >= high - edge) & (level < -ALONG)
    floor_up, floor_down = (area[floor].sum() for floor in floors)
    # A ceiling is about as large as the floor; then furniture's tops, though small, show the sense.
    if max(floor_up, floor_down) > SURE**2 * min(floor_up, floor_down):
        right = floor_up > floor_down
    elif max(top_up, top_down) > SURE * min(top_up, top_down):
        right = top_up > top_down
    else:
        raise SceneRejected(f"{where}: its floor and its ceiling look alike; say which axis points up with --up")
    floor = floors[0 if right else 1]
    if not floor.any():
        return up if right else -up
    up = area[floor] @ normal[floor]
    return up / np.linalg.norm(up)


def turn_upright(up: np.ndarray) -> np.ndarray:
    """Return (3, 3) the smallest turn that brings `up` to z; never a mirror image."""
    x, y, z = up
    if z < -1 + 1e-12:
        return np.diag([1.0, -1.0, -1.0])
    return np.array(
        [[1 - x * x / (1 + z), -x * y / (1 + z), -x], [-x * y / (1 + z), 1 - y * y / (1 + z), -y], [x, y, z]]
    )


def faces_away(vertices: np.ndarray, faces: np.ndarray) -> bool:
    """Return whether a room's floor faces down, or its ceiling up: it is mirrored, or its faces' order is wrong.

    The outer sides of slabs do so too, but have another side near them that does not. `vertices`: m, z up or down.
    """
    normal, area = unit_normals(vertices, faces), face_areas(vertices, faces)
    height = vertices[faces, 2].mean(axis=1)
    middle = np.mean(_extent(height, area))
    level = np.abs(normal[:, 2]) > ALONG
    bins, index = np.unique(np.round(height[level] / BIN_M), return_inverse=True)
    total = np.bincount(index, area[level])
    for z in BIN_M * bins[total >= MAIN_SHARE * total.max(initial=0.0)]:
        inwards = 1.0 if z < middle else -1.0
        from_m = (height - z) * inwards
        away = area[level & (normal[:, 2] * inwards < 0) & (np.abs(from_m) < 2 * BIN_M)].sum()
        if away > 2 * area[level & (normal[:, 2] * inwards > 0) & (from_m > -2 * BIN_M) & (from_m < SLAB_M)].sum():
            return True
    return False


def find_unit(vertices: np.ndarray, faces: np.ndarray, where: str) -> str:
    """Return the word of `UNITS_M` in which a storey's height (z up) is plausible, of m, cm and mm."""
    low, high = _extent(vertices[faces, 2].mean(axis=1), face_areas(vertices, faces))
    fits = [word for word in ("m", "cm", "mm") if HEIGHTS_M[0] <= (high - low) * UNITS_M[word] <= HEIGHTS_M[1]]
    if len(fits) == 1:
        return fits[0]
    raise SceneRejected(
        f"{where}: is {high - low:.3g} units high, expected a storey of {HEIGHTS_M[0]:g} to {HEIGHTS_M[1]:g} m in "
        "m, cm or mm; say its unit with --unit"
    )
