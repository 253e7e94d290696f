"""Judge a scene's model, surfaces, manifest and maps by acceptance values against one table of limits."""

import math
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import mujoco
import numpy as np
import shapely
from scipy import ndimage
from scipy.spatial import ConvexHull, KDTree
from scipy.spatial.distance import pdist

from converters.check.opening import blocked_fronts, held_bodies
from converters.geometry.faces import face_areas, sample_faces
from converters.records.errors import Gate, Limit
from converters.structure.walls import border_cells
from interactive_nav_common.grids import clearance, largest_component
from interactive_nav_common.records import read_packaged
from interactive_nav_common.rotations import matrix_from_quat
from scenes_mjcf.agreement import differences, sliding_friction
from scenes_mjcf.categories import ANY_MASS_KG, TABLE
from scenes_mjcf.look import geom_mesh
from scenes_mjcf.robot_facts import SMALLEST
from scenes_mjcf.schema import SceneError, SceneManifest, SceneMaps, SceneObject, load_manifest, load_maps

USUAL = {category.name: category.material.mass_range_kg for category in TABLE if category.material is not None}
GRAVITY = (0.0, 0.0, -9.81)
ROBOT_RADIUS_M = SMALLEST.radius_m
"""Free space is judged for a TurtleBot-sized disc."""
OFF_MAP_M = 1.0
"""An object with no free floor this near lies outside of what was mapped."""
DRIFT_S = 5.0
TIMESTEP_S = 0.02
"""The environments' physics timestep (`sim_dt_s`), for hulls and for boxes."""
LIMITS: dict[str, Limit] = read_packaged(Path(__file__).with_suffix(".yaml"), dict[str, Limit])
"""Gate -> what it demands."""


def judge(name: str, value: float, warnings: tuple[str, ...] = ()) -> Gate:
    """Judge a value by the table; a non-finite value fails."""
    limit = LIMITS[name]
    passed = math.isfinite(value)
    passed = passed and (limit.least is None or value >= limit.least) and (limit.most is None or value <= limit.most)
    return Gate(name, float(value) if math.isfinite(value) else -1.0, passed, limit, warnings)


def collide_with(spec: mujoco.MjSpec, shape: str) -> mujoco.MjModel:
    """Compile a scene with the movables colliding by their hulls or by their boxes.

    Set this in the spec: a compiled model's bounding-volume trees leave out geoms that did not collide.
    """
    for geom in spec.geoms:
        for kind in ("hull", "box"):
            if f"_{kind}_" in geom.name:
                geom.contype = geom.conaffinity = int(shape in (kind, "both"))
    return spec.compile()


def started_over(data: mujoco.MjData) -> bool:
    """Return whether MuJoCo reset the simulation after a bad position, velocity or acceleration."""
    bad = (mujoco.mjtWarning.mjWARN_BADQPOS, mujoco.mjtWarning.mjWARN_BADQVEL, mujoco.mjtWarning.mjWARN_BADQACC)
    return any(data.warning[int(w)].number for w in bad)


def movable_bodies(model: mujoco.MjModel) -> list[int]:
    """Return ids of the bodies that have a joint."""
    return [b for b in range(1, model.nbody) if model.body_jntnum[b] > 0]


def deepest_contact(model: mujoco.MjModel, data: mujoco.MjData) -> tuple[float, str]:
    """Return the largest penetration among the present contacts, m, and the two bodies; 0 without any."""
    if not data.ncon:
        return 0.0, ""
    contact = min(data.contact[: data.ncon], key=lambda c: c.dist)
    bodies = sorted(model.body(model.geom_bodyid[g]).name.replace("world", "floor") for g in contact.geom)
    return -float(contact.dist), " and ".join(bodies)


def physical_values(model: mujoco.MjModel, named: dict[str, str] | None = None) -> dict[str, float]:
    """Return drift (m), turn (deg), deepest penetration (m) and finiteness over `DRIFT_S` without a robot."""
    named = {} if named is None else named
    data = mujoco.MjData(model)
    mujoco.mj_forward(model, data)
    bodies = movable_bodies(model)
    start_com, start_quat = data.xipos[bodies].copy(), data.xquat[bodies].copy()
    start_pos, depth = data.xpos[bodies].copy(), deepest_contact(model, data)
    for _ in range(round(DRIFT_S / model.opt.timestep)):
        mujoco.mj_step(model, data)
    mujoco.mj_forward(model, data)
    moved = np.maximum(
        np.linalg.norm(data.xipos[bodies] - start_com, axis=1), np.linalg.norm(data.xpos[bodies] - start_pos, axis=1)
    )
    cosine = np.abs((data.xquat[bodies] * start_quat).sum(axis=1))
    turned = np.degrees(2 * np.arccos(np.clip(cosine, 0, 1)))
    depth, named["penetration"] = max(depth, deepest_contact(model, data))
    for quantity, values in (("drift", moved), ("turn", turned)) if bodies else ():
        named[quantity] = model.body(bodies[int(np.argmax(values))]).name
    return {
        "drift": float(moved.max(initial=0.0)),
        "turn": float(turned.max(initial=0.0)),
        "penetration": depth,
        "finite": float(np.isfinite(data.qpos).all() and np.isfinite(data.qvel).all() and not started_over(data)),
    }


def _largest_piece(maps: SceneMaps) -> tuple[np.ndarray, np.ndarray]:
    """Return connected cells where the disc's middle may be, and every cell's distance to them, m."""
    piece = largest_component(clearance(maps.traversable, maps.resolution_m) >= ROBOT_RADIUS_M)
    distance = ndimage.distance_transform_edt(~piece, sampling=maps.resolution_m)
    return piece, np.asarray(distance) if piece.any() else np.full(piece.shape, np.inf)


def free_space_values(maps: SceneMaps) -> dict[str, float]:
    """Return traversable area (m2), its share that the disc covers in one piece, and the piece's farthest pair (m)."""
    piece, distance = _largest_piece(maps)
    outline = shapely.get_coordinates(shapely.MultiPoint(np.argwhere(piece)).convex_hull)
    farthest = float(pdist(outline).max(initial=0.0)) * maps.resolution_m
    # The erosion rounds up to whole cells: a disc that touches a wall has its middle up to a cell nearer to it.
    covered = maps.traversable & (distance <= ROBOT_RADIUS_M + maps.resolution_m)
    return {
        "traversable_area": float(maps.traversable.sum()) * maps.resolution_m**2,
        "connected_share": float(covered.sum() / max(maps.traversable.sum(), 1)),
        "start_goal": farthest,
    }


def free_space_warnings(maps: SceneMaps) -> tuple[str, ...]:
    """Return warnings about free floor that the robot cannot reach, apart from corners, rims and small areas."""
    _, distance = _largest_piece(maps)
    cell_m2 = maps.resolution_m**2
    lost_m2 = float((maps.traversable & (distance > 2 * ROBOT_RADIUS_M)).sum()) * cell_m2
    if lost_m2 < math.pi * ROBOT_RADIUS_M**2:
        return ()
    return (
        f"{lost_m2:.1f} of {float(maps.traversable.sum()) * cell_m2:.1f} m2 of free floor cannot be reached by a robot "
        f"of {ROBOT_RADIUS_M} m radius from the largest piece: too narrow, or cut off; look at the map in the preview",
    )


def objects_off(model: mujoco.MjModel, maps: SceneMaps, distance: np.ndarray) -> tuple[str, ...]:
    """Return the names of the movable bodies that stand where a distance field [rows, columns] exceeds `OFF_MAP_M`."""
    data = mujoco.MjData(model)
    mujoco.mj_kinematics(model, data)
    off = []
    for body in movable_bodies(model) if maps.traversable.any() else []:
        at = (data.xpos[body, :2] - maps.origin_w) / maps.resolution_m
        inside = np.clip(np.floor(at).astype(int), 0, np.array(distance.shape)[::-1] - 1)
        beyond = float(np.abs(at - inside - 0.5).max()) * maps.resolution_m
        if max(beyond, float(distance[inside[1], inside[0]])) > OFF_MAP_M:
            off.append(model.body(body).name)
    return tuple(off)


def evaluate(
    spec: mujoco.MjSpec,
    maps: SceneMaps,
    objects: Sequence[SceneObject],
    kept: Mapping[str, float] | None = None,
    shares: Mapping[str, float | None] | None = None,
) -> tuple[Gate, ...]:
    """Return every gate in the table's order; `kept` is the drawn share of each object's model area, if known."""
    object_names = [o.name for o in objects]
    try:
        model = collide_with(spec, "hull")
        boxes = collide_with(spec, "box")
    except ValueError:
        return (judge("compiles", 0.0),)
    model.opt.timestep = boxes.opt.timestep = TIMESTEP_S
    bodies = {mujoco.mj_id2name(model, mujoco.mjtObj.mjOBJ_BODY, b) for b in movable_bodies(model)}
    names = [mujoco.mj_id2name(model, mujoco.mjtObj.mjOBJ_GEOM, g) or "" for g in range(model.ngeom)]
    hulls = [sum(n.startswith(f"{o}_hull_") for n in names) for o in object_names]
    beside = ndimage.distance_transform_edt(~maps.traversable, sampling=maps.resolution_m)
    off, apart = (objects_off(model, maps, np.asarray(field)) for field in (beside, _largest_piece(maps)[1]))
    who: dict[str, dict[str, str]] = {"hulls": {}, "boxes": {}}
    by_hull, by_box = physical_values(model, who["hulls"]), physical_values(boxes, who["boxes"])
    values = {
        "compiles": 1.0,
        "unmatched_objects": float(len(bodies ^ set(object_names)) + len(off)),
        "finite": min(by_hull["finite"], by_box["finite"]),
        "hulls_per_object": float(max(hulls, default=0)),
        "hulls": float(sum(hulls)),
        "walls": float(sum(n.startswith("wall_") for n in names)),
        "furniture_apart": len(apart) / max(len(bodies), 1),
    }
    values |= {name: share for name, share in (shares or {}).items() if share is not None}
    for exclude in spec.excludes:
        spec.delete(exclude)
    blocked = blocked_fronts(collide_with(spec, "box"))
    values |= {"blocked_fronts": float(len(blocked))} if held_bodies(model) else {}
    for quantity in ("drift", "turn", "penetration"):
        values |= {f"{quantity}_hulls": by_hull[quantity], f"{quantity}_boxes": by_box[quantity]}
    agreed, warnings = manifest_values(model, objects)
    surface, worst = surface_values(model, kept or {})
    values |= free_space_values(maps) | wall_values(model, maps) | agreed | surface
    blamed = {f"{what}_{shape}": (body,) for shape, of in who.items() for what, body in of.items()} | worst
    warnings |= {name: words for name, words in blamed.items() if not judge(name, (values | surface)[name]).passed}
    warnings["blocked_fronts"], warnings["connected_share"] = blocked, free_space_warnings(maps)
    if 2 * len(apart) > len(bodies):
        warnings["furniture_apart"] = (
            f"{len(apart)} of {len(bodies)} movable objects stand more than {OFF_MAP_M:g} m from the largest piece of "
            "floor, which is not the home's; look at the map in the preview",
        )
    if off:
        warnings["unmatched_objects"] = (f"{', '.join(off)}: more than {OFF_MAP_M:g} m from all free floor of the map",)
    return tuple(judge(name, values[name], warnings.get(name, ())) for name in LIMITS if name in values)


def drawn_shares(rows: Sequence[Mapping[str, Any]]) -> dict[str, float]:
    """Return object -> share of its model's area that is drawn, from a scene's rows of alignment."""
    return {str(row["name"]): float(row["drawn_area_share"]) for row in rows if "drawn_area_share" in row}


def check_folder(folder: Path) -> tuple[SceneManifest, tuple[Gate, ...]]:
    """Run the gates on a written scene folder."""
    manifest, maps = load_manifest(folder), load_maps(folder)
    path = folder / "scene.xml"
    if not path.is_file():
        raise SceneError(f"{path}: no such file; convert the scene again")
    try:
        spec = mujoco.MjSpec.from_file(str(path))
    except ValueError:
        return manifest, (judge("compiles", 0.0),)
    shares = {"scan_kept": manifest.scan_kept, "floor_open": manifest.floor_open}
    return manifest, evaluate(spec, maps, manifest.objects, drawn_shares(manifest.alignment), shares)


def wall_values(model: mujoco.MjModel, maps: SceneMaps) -> dict[str, float]:
    """Return the shares of the free floor's rim without a wall box beside it, and of the free floor inside a box.

    A box bounds a cell within a cell's diagonal of its middle, and contains it if the middle is one cell deep, because
    the map's grid is turned against the boxes. The rim near a hinge is exempt: no wall stands where a leaf turns.
    """
    side, pad = maps.resolution_m, 2
    free = np.pad(maps.traversable, pad)
    rows, columns = np.indices(free.shape)
    points = np.stack([columns, rows], axis=-1) + 0.5 - pad
    points = points * side + np.asarray(maps.origin_w)
    outside = np.full(free.shape, np.inf)
    structure = mujoco.mj_name2id(model, mujoco.mjtObj.mjOBJ_BODY, "structure")
    for geom in np.flatnonzero(model.geom_bodyid == structure):
        if model.geom_type[geom] == mujoco.mjtGeom.mjGEOM_BOX and model.geom_contype[geom]:
            turn = matrix_from_quat(model.geom_quat[geom])
            level, middle, size = turn[:2, :2], model.geom_pos[geom, :2], model.geom_size[geom, :2]
            # Only cells about the box; about a tilted one, all.
            reach = np.abs(level) @ (size + 2 * side) if turn[2, 2] > 1 - 1e-9 else np.inf
            ends = (np.stack([middle - reach, middle + reach]) - maps.origin_w) / side + pad
            (c0, r0), (c1, r1) = np.clip(ends + [[0], [1]], 0, free.shape[::-1]).astype(int)
            beyond = np.abs((points[r0:r1, c0:c1] - middle) @ level) - size
            outside[r0:r1, c0:c1] = np.minimum(outside[r0:r1, c0:c1], beyond.max(axis=-1))
    rim, fronts = border_cells(free), held_bodies(model)
    for joint in np.flatnonzero(model.jnt_type == mujoco.mjtJoint.mjJNT_HINGE):
        body = model.jnt_bodyid[joint]
        if body in fronts:
            continue
        far = np.linalg.norm(points - model.body_pos[body, :2], axis=-1)
        geoms = np.flatnonzero(model.geom_bodyid == body)
        leaf = max((float(np.linalg.norm(model.geom_pos[g]) + model.geom_rbound[g]) for g in geoms), default=0.0)
        rim &= far > leaf + side
    return {
        "rim_without_wall": float((rim & (outside > math.sqrt(2) * side)).sum() / max(rim.sum(), 1)),
        "walls_in_floor": float((free & (outside < -side)).sum() / max(free.sum(), 1)),
    }


def manifest_values(
    model: mujoco.MjModel, objects: Sequence[SceneObject]
) -> tuple[dict[str, float], dict[str, tuple[str, ...]]]:
    """Return values of the gates on masses, friction and physics, and for each gate the lines that name failures."""
    ratios, friction, differs = [1.0], [1.0], differences(model, objects)
    for item in objects:
        body = mujoco.mj_name2id(model, mujoco.mjtObj.mjOBJ_BODY, item.name)
        if body < 0:
            continue
        mass_kg = float(model.body_mass[body])
        low, high = USUAL.get(item.category, ANY_MASS_KG)
        ratios.append(max(mass_kg / high, low / max(mass_kg, 1e-9)))
        friction += sliding_friction(model, body) or [item.friction]
    floor = mujoco.mj_name2id(model, mujoco.mjtObj.mjOBJ_GEOM, "floor")
    solid = floor >= 0 and bool(model.geom_contype[floor]) and model.geom_pos[floor, 2] == 0
    physics = [
        ("gravity", tuple(np.round(model.opt.gravity, 6).tolist()), GRAVITY),
        ("wind", tuple(model.opt.wind.tolist()), (0.0, 0.0, 0.0)),
        *((name, float(getattr(model.opt, name)), 0.0) for name in ("density", "viscosity")),
        ("disableflags", int(model.opt.disableflags), 0),
        ("floor at z = 0", solid, True),
    ]
    changed = [f"{name} is {got}, expected {expected}" for name, got, expected in physics if got != expected]
    values = {
        "manifest_differs": float(len(differs)),
        "mass_ratio": max(ratios),
        "least_friction": min(friction),
        "physics_changed": float(len(changed)),
    }
    return values, {"manifest_differs": differs, "physics_changed": tuple(changed)}


SPACING_M = 0.04
"""Of the points on hulls and visuals."""
HIDDEN_M, BARE_M = 0.1, 0.05
"""A hull's side farther than the first from the drawn surface is hit unseen; drawn surface farther than the second
outside of all hulls is driven through."""
KEPT_M, POINTS = 0.15, 50_000
"""Scan points this near to the drawn structure are kept (floors move by up to 0.12 m); number of points compared."""
SIDE = 0.7
"""Largest vertical component of the normal of what counts as a side: robots come along the floor."""


def kept_share(vertices: np.ndarray, faces: np.ndarray, drawn: tuple[np.ndarray, np.ndarray]) -> float:
    """Return the share of a scan's area within `KEPT_M` of the drawn structure, without furniture that was cut out."""
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
            for some in np.array_split(np.flatnonzero(near), 1 + near.sum() // 1000):  # what fits the cache is faster
                free[some] = (s.equations[:, :3] @ points[some].T > by_m - s.equations[:, 3:]).any(axis=0)
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
    """Return the worst object's values of the gates on surfaces, and for each gate the line that names this object."""
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
