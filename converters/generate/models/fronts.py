"""Split models at their doors and drawers into a static carcass, and fronts that turn or slide.

A thin upright piece at the front is a panel and takes along the pieces within its outline. A handle off the middle
makes it a door, hinged at the opposite side; otherwise a low panel is a drawer's, an oven's is a flap, and a high one
that overlaps another slides.
"""

import dataclasses
import functools
import math

import numpy as np

from converters.generate.models.cad import CadModel, Instance, as_drawn, cad_model
from converters.generate.models.parts import Part, box
from converters.geometry.faces import compacted, loose_parts, stacked
from converters.records.raw import UP, ScannedHinge, VisualMesh
from interactive_nav_common.rotations import transformed
from scenes_mjcf.categories import CATEGORIES

PANEL_M = (0.18, 0.11, 0.08)
"""Least width and height, and greatest thickness of a panel."""
FRONT_M = 0.13
"""A panel begins no farther than this behind the foremost point of its model."""
WITHIN_M = (0.008, 0.05)
"""How far what belongs to a panel may reach beyond its outline, and behind its back."""
ASIDE = 0.2
"""From the middle of a panel to its handle, over its width: a door's is farther to the side."""
DRAWER_M = 0.38
"""Greatest height of a drawer's panel."""
DEEP_M, PULLED = 0.45, 0.75
"""Greatest depth of a drawer's box, and the share of it that a drawer is pulled out by."""
SIDE_M, WALL_M, BEHIND_M, LEAST_DEEP_M = 0.03, 0.012, 0.06, 0.15
"""From a panel's edge to its drawer's box, how thick that is, what is left behind it, and its least depth."""
LAPPED_M = 0.02
"""Sliding doors cover each other by more than this."""
PLAY_M = 0.001
"""Around a panel, at least."""
Bounds = np.ndarray
"""(2, 3) lowest and highest corner."""


@dataclasses.dataclass(frozen=True)
class Opening:
    """Hold a model's carcass when some of its fronts are cut out, and these."""

    pieces: tuple[int, ...]
    """Of the model, which go with the front."""
    model: CadModel
    """The front, in the model's CAD frame."""
    hinge: ScannedHinge
    recess: Part
    """A dark plate in the carcass where a drawn front was; models of the library are hollow."""


def _pieces(model: CadModel) -> tuple[np.ndarray, list[Bounds]]:
    """Return the piece of each face of the surface, or of each part, and each piece's bounds, m, front along +z."""
    scale = model.unit_m
    if model.surface is None:
        groups, of = [part.vertices for part in model.parts], np.arange(len(model.parts))
    else:
        vertices, faces = np.asarray(model.surface.vertices), model.surface.faces
        of = np.unique(loose_parts(vertices, faces), return_inverse=True)[1]
        groups = [vertices[faces[of == k]].reshape(-1, 3) for k in range(of.max() + 1)]
    ends = [np.sort(np.stack([(g * scale).min(axis=0), (g * scale).max(axis=0)]), axis=0) for g in groups]
    return of, ends


def _inside(piece: Bounds, panel: Bounds, slides: bool) -> bool:
    """Return whether a piece goes with a panel: also one that reaches far back, if it slides."""
    beyond, behind = WITHIN_M
    fits = (piece[0, :2] > panel[0, :2] - beyond).all() and (piece[1, :2] < panel[1, :2] + beyond).all()
    return bool(fits and piece[1, 2] > panel[0, 2] - behind and (slides or piece[0, 2] > panel[0, 2] - behind))


def _handle(panel: Bounds, with_it: list[Bounds]) -> float:
    """Return how far to the right of a panel's middle its handle is, over its width; 0 without one."""
    out = [p for p in with_it if p[1, 2] > panel[1, 2] + 0.01]
    if not out:
        return 0.0
    foremost = max(p[1, 2] for p in out)
    middles = [p[:, 0].mean() for p in out if p[1, 2] > foremost - 0.02]
    return float((np.mean(middles) - panel[:, 0].mean()) / np.ptp(panel[:, 0]))


def _hinge(panel: Bounds, handle: float, category: str, rear: float, panels: list[Bounds]) -> ScannedHinge | None:
    """Return how a panel opens, in metres, front along +z; None: it does not. `rear`: the model's back."""
    low, high = panel
    if abs(handle) > ASIDE:
        # About its front edge, so that it sweeps nothing but the room before it.
        x, turn = (low[0], -1.0) if handle > 0 else (high[0], 1.0)
        return ScannedHinge(np.array([x, low[1], high[2]]), np.array([0.0, turn, 0.0]), (0.0, math.pi / 2))
    middle = panel.mean(axis=0)
    depth = min(DEEP_M, low[2] - rear - BEHIND_M)
    if high[1] - low[1] <= DRAWER_M:
        deep = depth >= LEAST_DEEP_M and category != "shower"  # a curtain's valance is none
        pulled = 0.0, round(PULLED * float(depth), 3)
        return ScannedHinge(middle, UP, pulled, slides=True) if deep else None
    if category == "stove":
        return ScannedHinge(np.array([0.0, low[1], high[2]]), np.array([1.0, 0.0, 0.0]), (0.0, math.pi / 2))
    for other in panels if category == "wardrobe" else ():
        lapped = min(high[0], other[1, 0]) - max(low[0], other[0, 0])
        if other is not panel and lapped > LAPPED_M and np.ptp(other[:, 0]) > lapped + LAPPED_M:
            way = math.copysign(1.0, other[:, 0].mean() - panel[:, 0].mean())
            reach = 0.0, round(float(np.ptp(other[:, 0]) - lapped), 3)
            return ScannedHinge(middle, np.array([way, 0.0, 0.0]), reach, slides=True)
    return None


@functools.cache
def openings(name: str) -> tuple[Opening, ...]:
    """Return what opens of a model."""
    model = cad_model(name)
    of, bounds = _pieces(model)
    foremost, rear = max(b[1, 2] for b in bounds), min(b[0, 2] for b in bounds)
    width, height, thick = PANEL_M
    sizes = [np.ptp(b, axis=0) for b in bounds]
    panels = [
        k
        for k, (b, (w, h, t)) in enumerate(zip(bounds, sizes, strict=True))
        if w >= width and h >= height and t <= thick and b[0, 2] > foremost - FRONT_M
    ]
    panels.sort(key=lambda k: -sizes[k][0] * sizes[k][1])
    taken: set[int] = set()
    found: list[Opening] = []
    for k in panels:
        if k in taken:
            continue
        mine = [j for j in range(len(bounds)) if j not in taken | {k} and _inside(bounds[j], bounds[k], False)]
        handle = _handle(bounds[k], [bounds[j] for j in mine])
        hinge = _hinge(bounds[k], handle, model.category, rear, [bounds[j] for j in panels])
        if hinge is None:
            continue
        if hinge.slides and hinge.axis[2]:
            mine = [j for j in range(len(bounds)) if j not in taken | {k} and _inside(bounds[j], bounds[k], True)]
        taken |= {k, *mine}
        front, recess = _front(model, len(found), of, bounds, (k, *mine), hinge, rear), bounds[k].copy()
        if any(_overlap(p, q) for o in found for p in o.model.solids for q in front[0].solids):
            taken -= {k, *mine}  # such as two leaves with one handle
            continue
        recess[1, 2] = recess[0, 2] + 0.6 * np.ptp(recess[:, 2])  # hidden in the panel while it is shut
        recess[:, :2] += np.outer([1, -1], [SIDE_M, SIDE_M])
        found.append(Opening((k, *mine), *front, _normalised([_block(recess, "charcoal")], model)[0]))
    return tuple(found)


def _front(
    model: CadModel,
    k: int,
    of: np.ndarray,
    bounds: list[Bounds],
    pieces: tuple[int, ...],
    hinge: ScannedHinge,
    rear: float,
) -> tuple[CadModel, ScannedHinge]:
    """Return a front (its pieces, and where it is a drawer a box behind its panel) and its hinge, CAD frame."""
    panel = bounds[pieces[0]]
    out = [bounds[j] for j in pieces[1:] if bounds[j][1, 2] > panel[1, 2] + 0.004]
    # The inner edge of a door's free end comes out farther than its outer one: two doors side by side would jam.
    wide, high, thick = np.ptp(panel, axis=0)
    trimmed = panel + np.outer([1, -1], [1, 1, 0]) * (thick**2 / 2 / min(wide, high) + PLAY_M)
    solids = [_block(trimmed, "white")]
    if out:
        ends = np.stack([np.min([b[0] for b in out], axis=0), np.max([b[1] for b in out], axis=0)])
        ends[0, 2] = panel[0, 2]
        solids.append(_block(ends, "white"))
    tray: list[Part] = []
    if hinge.slides and hinge.axis[2]:
        (x0, y0, z), (x1, y1, _) = panel
        depth = min(DEEP_M, z - rear - BEHIND_M)
        ends = np.array([(x0 + SIDE_M, y0 + SIDE_M, z - depth), (x1 - SIDE_M, y1 - SIDE_M, z)])
        solids.append(_block(ends, "white"))
        tray = [_block(side, "birch") for side in _sides(ends)]
    name = f"{model.name}#{k}"
    category = "drawer" if tray else "cabinet_door"
    scale = 1 / model.unit_m
    surface, drawn = None, [model.parts[j] for j in pieces] if model.surface is None else []
    if model.surface is not None:
        surface = _with_tray(_cut(model.surface, np.isin(of, pieces)), _normalised(tray, model))
    about = {
        "name": name,
        "category": category,
        "catid": CATEGORIES[category].synset,
        "id_cad": f"{model.id_cad[:28]}{k:04d}",
        "parts": (*drawn, *_normalised(tray, model)) if surface is None else _normalised(solids, model),
        "solids": _normalised(solids, model),
        "look": surface and functools.partial(as_drawn, surface),
    }
    hinge = dataclasses.replace(hinge, axis=hinge.axis * scale * model.unit_m, origin=hinge.origin * scale)
    return dataclasses.replace(model, **about), hinge


def _normalised(parts: list[Part], model: CadModel) -> tuple[Part, ...]:
    """Return parts in the model's CAD frame."""
    scale = 1 / model.unit_m
    return tuple(dataclasses.replace(p, vertices=np.round(p.vertices * scale, 6)) for p in parts)


def _block(ends: Bounds, material: str) -> Part:
    return box(ends.mean(axis=0), np.ptp(ends, axis=0), material)


def _overlap(one: Part, other: Part) -> bool:
    """Return whether the bounds of two parts overlap."""
    low = np.maximum(one.vertices.min(axis=0), other.vertices.min(axis=0))
    return bool((np.minimum(one.vertices.max(axis=0), other.vertices.max(axis=0)) > low + 1e-3).all())


def _sides(ends: Bounds) -> list[Bounds]:
    """Return bottom, sides and back of a drawer's box that fills these bounds."""
    walls = []
    for axis, top in ((1, 0), (0, 0), (0, 1), (2, 0)):
        wall = ends.copy()
        wall[1 - top, axis] = wall[top, axis] + (WALL_M if top == 0 else -WALL_M)
        walls.append(np.sort(wall, axis=0))
    return walls


def _cut(surface: VisualMesh, faces: np.ndarray) -> VisualMesh:
    """Return some faces of a surface, with its image."""
    vertices, kept = compacted(surface.vertices, surface.faces[faces])
    uv, uv_kept = compacted(surface.uv, surface.uv_faces[faces])
    return dataclasses.replace(surface, vertices=vertices, faces=kept, uv=uv, uv_faces=uv_kept)


def _with_tray(surface: VisualMesh, tray: tuple[Part, ...]) -> VisualMesh:
    """Return a surface and parts in the colour of its first corner."""
    vertices, faces = stacked([(surface.vertices, surface.faces), *((part.vertices, part.faces) for part in tray)])
    corners = np.zeros((len(faces) - len(surface.faces), 3), np.int64)
    return dataclasses.replace(surface, vertices=vertices, faces=faces, uv_faces=np.vstack([surface.uv_faces, corners]))


def carcass(model: CadModel, cut: tuple[Opening, ...]) -> CadModel:
    """Return a model without these fronts; its outline stays."""
    gone = {piece for opening in cut for piece in opening.pieces}
    if model.surface is not None:
        of, _ = _pieces(model)
        rest = _cut(model.surface, ~np.isin(of, list(gone)))
        return dataclasses.replace(model, look=functools.partial(as_drawn, rest))
    parts = [p for k, p in enumerate(model.parts) if k not in gone]
    return dataclasses.replace(model, parts=(*parts, *(opening.recess for opening in cut)))


def opened(item: Instance, share: float) -> list[np.ndarray]:
    """Return the corners (n, 3) of a front's solids, scan x, y and height, with it open by a share of its range."""
    assert item.hinge is not None
    motion = item.hinge.moved(item.matrix).motion(share * item.hinge.range_rad[1])
    return [transformed(item.to_floor(part.vertices), motion) for part in item.model.solids]
