"""Check whether what is drawn of an object is what a robot hits, and what its model shows."""

from collections.abc import Mapping

import mujoco
import numpy as np
from scipy.spatial import ConvexHull, KDTree

from converters.geometry.faces import face_areas, sample_faces
from converters.records.raw import TexturedMesh
from scenes_mjcf.look import geom_image, geom_mesh, mesh_of

SPACING_M = 0.04
"""Of the points on hulls and visuals."""
HIDDEN_M, BARE_M = 0.1, 0.05
"""A hull's side farther than the first from all that is drawn is hit unseen; what is drawn farther than the second
outside of all hulls is driven through."""
KEPT_M, POINTS = 0.15, 50_000
"""A scan's point so near to the drawn structure is kept: floors are levelled by up to 0.12 m. Points that are looked
at, about."""
SIDE = 0.7
"""Largest vertical component of the normal of what counts as a side: robots come along the floor."""


def geom_surface(model: mujoco.MjModel, geom: int) -> TexturedMesh:
    """Return a textured mesh geom as MuJoCo draws it, in the body's frame."""
    uv, image = mesh_of(model, model.geom_dataid[geom])[2], geom_image(model, geom)
    assert uv is not None and image is not None
    return TexturedMesh(*geom_mesh(model, geom), uv * [1.0, -1.0] + [0.0, 1.0], image[..., :3])


def geom_outline(model: mujoco.MjModel, data: mujoco.MjData, geom: int, axes_w: np.ndarray) -> np.ndarray:
    """Return (k, 2) m: outline of a mesh or box geom, viewed along the third of the axes."""
    if model.geom_type[geom] == mujoco.mjtGeom.mjGEOM_BOX:
        corners = np.array(np.meshgrid([-1, 1], [-1, 1], [-1, 1])).reshape(3, -1).T * model.geom_size[geom]
    else:
        corners = mesh_of(model, model.geom_dataid[geom])[0]
    points = (corners @ data.geom_xmat[geom].reshape(3, 3).T + data.geom_xpos[geom]) @ axes_w[:2].T
    return points[ConvexHull(points).vertices]


def kept_share(vertices: np.ndarray, faces: np.ndarray, drawn: tuple[np.ndarray, np.ndarray]) -> float:
    """Return the share of a scan's area, without furniture that was cut out, within `KEPT_M` of the drawn structure.

    `drawn`: vertices (k, 3) m and faces of the drawn structure.
    """
    area = face_areas(vertices, faces)
    if not area.sum():
        return 1.0
    spacing_m = max(SPACING_M, float(np.sqrt(area.sum() / POINTS)))
    points, face = sample_faces(vertices, faces, spacing_m)
    weight = area[face] / np.bincount(face, minlength=len(faces))[face]
    tree = KDTree(sample_faces(*drawn, KEPT_M / 2)[0])
    return float(weight[tree.query(points, distance_upper_bound=KEPT_M)[0] < KEPT_M].sum() / weight.sum())


def body_shares(drawn: tuple[np.ndarray, np.ndarray], hulls: list[np.ndarray]) -> tuple[float, float]:
    """Return the shares of the hulls' outer sides off the drawn mesh, and of the drawn mesh outside of the hulls."""
    solids = [ConvexHull(hull) for hull in hulls]

    def outside(points: np.ndarray, of: list[ConvexHull], by_m: float) -> np.ndarray:
        free = np.ones(len(points), bool)
        for s in of:
            near = free & ((points > s.min_bound - by_m) & (points < s.max_bound + by_m)).all(axis=1)
            free[near] = (points[near] @ s.equations[:, :3].T + s.equations[:, 3]).max(axis=1) > by_m
        return free

    sides = []
    for k, solid in enumerate(solids):
        points, face = sample_faces(hulls[k], solid.simplices.astype(np.int64), SPACING_M)
        points = points[np.abs(solid.equations[face, 2]) < SIDE]
        sides.append(points[outside(points, solids[:k] + solids[k + 1 :], 1e-3)])
    visible = sample_faces(*drawn, SPACING_M)[0]
    off = KDTree(visible).query(np.vstack(sides), distance_upper_bound=HIDDEN_M)[0] > HIDDEN_M
    bare = outside(visible, solids, BARE_M)
    return float(off.mean()) if len(off) else 0.0, float(bare.mean())


def surface_values(
    model: mujoco.MjModel, kept: Mapping[str, float]
) -> tuple[dict[str, float], dict[str, tuple[str, ...]]]:
    """Return the worst object's values of the gates on surfaces, and by gate the line that names it.

    `kept`: object -> share of its model's area that is drawn, where it is given.
    """
    worst: dict[str, tuple[float, str]] = {"unseen_hulls": (0.0, ""), "unsolid_surface": (0.0, "")}
    worst["surface_kept"] = min(((share, name) for name, share in kept.items()), default=(1.0, ""))
    shares: dict[bytes, tuple[float, float]] = {}
    names = [model.geom(g).name for g in range(model.ngeom)]
    for body in np.flatnonzero(model.body_jntnum[1:] > 0) + 1:
        geoms = np.flatnonzero(model.geom_bodyid == body).tolist()
        drawn = [geom_mesh(model, g) for g in geoms if names[g].endswith("_visual")]
        hulls = [geom_mesh(model, g)[0] for g in geoms if "_hull_" in names[g]]
        if drawn and hulls:
            key = b"".join(np.round(points, 4).tobytes() for points in (drawn[0][0], *hulls))
            if key not in shares:
                shares[key] = body_shares(drawn[0], hulls)
            for gate, share in zip(("unseen_hulls", "unsolid_surface"), shares[key], strict=True):
                worst[gate] = max(worst[gate], (share, model.body(body).name))
    values = {gate: share for gate, (share, _) in worst.items()}
    return values, {gate: (f"{gate}: {name} is worst",) for gate, (_, name) in worst.items() if name}
