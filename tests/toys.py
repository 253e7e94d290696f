"""Toy scenes of fixed content, written through the same schema as the converters' output."""

from __future__ import annotations

from pathlib import Path

import mujoco
import numpy as np

from scenes_mjcf.schema import SceneManifest, SceneMaps, SceneObject, save_manifest, save_maps


def write_room(
    folder: Path,
    size_m: tuple[float, float] = (4.0, 3.0),
    blocks: tuple[tuple[str, float, float, float, float], ...] = (("chair", 0.7, 0.0, 5.0, 0.5),),
    door: bool = False,
    kitchen: bool = False,
    partition: bool = False,
    resolution_m: float = 0.05,
    split: str = "train",
    half_m: tuple[float, float, float] = (0.2, 0.2, 0.2),
    door_rad: tuple[float, float] = (-1.5, 1.5),
    door_y_m: float | None = None,
) -> Path:
    """A rectangular room centred on the origin, with cubes of 0.4 m as furniture.

    Args:
        folder: where to write; created.
        size_m: inner length along x and y.
        blocks: (category, x, y, mass_kg, friction) of each cube.
        door: adds a hinged leaf of 0.8 m at x = -1, opening over the room.
        kitchen: adds a drawer at x = 0 and a flap at x = 0.8, closed 0.4 m before the upper wall.
        partition: adds a wall along y at x = 0 with a gap of 1 m at its upper end.
        resolution_m: of the map.
        split: train or test.
        half_m: half sizes of the furniture, where it is no cube.
        door_rad: range of the leaf's hinge; at 0 it lies along the lower wall.
        door_y_m: puts the leaf into a wall along x at this y, with a gap that it fills; none: at the lower wall.
    """
    folder = Path(folder)
    (folder / "assets").mkdir(parents=True)
    spec = mujoco.MjSpec()
    spec.compiler.degree = False
    spec.worldbody.add_geom(name="floor", type=mujoco.mjtGeom.mjGEOM_PLANE, size=[0, 0, 0.1])
    structure = spec.worldbody.add_body(name="structure")
    lx, ly = size_m
    walls = [
        (lx / 2 + 0.05, 0, 0.05, ly / 2 + 0.1),
        (-lx / 2 - 0.05, 0, 0.05, ly / 2 + 0.1),
        (0, ly / 2 + 0.05, lx / 2, 0.05),
        (0, -ly / 2 - 0.05, lx / 2, 0.05),
    ]
    if partition:
        walls.append((0.0, -0.5, 0.05, (ly - 1.0) / 2))
    if door_y_m is not None:
        walls += [((a + b) / 2, door_y_m, (b - a) / 2, 0.05) for a, b in ((-lx / 2, -1.02), (-0.18, lx / 2))]
    for i, (x, y, hx, hy) in enumerate(walls):
        structure.add_geom(
            name=f"wall_{i}", type=mujoco.mjtGeom.mjGEOM_BOX, pos=[x, y, 0.6], size=[hx, hy, 0.6], group=3
        )
    objects, count = [], {}

    def movable(category: str, pos, boxes, mass: float, friction: float, reach=None, axis=(0, 0, 1)) -> None:
        k = count.setdefault(category, 0)
        count[category] += 1
        name = f"{category}_{k}"
        body = spec.worldbody.add_body(name=name, pos=pos)
        if reach is None:
            body.add_freejoint(name=f"{name}_free")
        else:
            body.add_joint(
                name=f"{name}_hinge",
                type=mujoco.mjtJoint.mjJNT_SLIDE if category == "drawer" else mujoco.mjtJoint.mjJNT_HINGE,
                axis=axis,
                range=reach,
                limited=True,
                damping=[0.5, 0, 0],
            )
        volume = sum(8 * s[0] * s[1] * s[2] for _, s in boxes)
        for i, (centre, half) in enumerate(boxes):
            body.add_geom(
                name=f"{name}_box_{i}",
                type=mujoco.mjtGeom.mjGEOM_BOX,
                pos=centre,
                size=half,
                density=mass / volume,
                friction=[friction, 0.005, 0.0001],
                contype=0,
                conaffinity=0,
                group=4,
            )
        objects.append(SceneObject(name, category, mass, friction, len(boxes), "toy"))

    for category, x, y, mass, friction in blocks:
        movable(category, [x, y, half_m[2]], [((0, 0, 0), half_m)], mass, friction)
    if door:
        leaf = [((0.4, 0, 0.5), (0.4, 0.02, 0.49))]
        movable("door", [-1.0, -ly / 2 + 0.1 if door_y_m is None else door_y_m, 0.0], leaf, 8.0, 0.4, reach=door_rad)
    if kitchen:
        front = [((0, 0, 0), (0.25, 0.01, 0.1)), ((0, 0.2, 0), (0.22, 0.18, 0.08))]
        movable("drawer", [0.0, ly / 2 - 0.39, 0.3], front, 5.0, 0.4, reach=(0, 0.35), axis=(0, -1, 0))
        flap = [((0, 0, 0.2), (0.25, 0.015, 0.2))]
        movable("cabinet_door", [0.8, ly / 2 - 0.39, 0.2], flap, 4.0, 0.4, reach=(0, 1.5), axis=(1, 0, 0))
    (folder / "scene.xml").write_text(_xml(spec), encoding="utf-8")
    rows, columns = round(ly / resolution_m) + 4, round(lx / resolution_m) + 4
    origin = (-columns * resolution_m / 2, -rows * resolution_m / 2)
    x = origin[0] + (np.arange(columns) + 0.5) * resolution_m
    y = origin[1] + (np.arange(rows) + 0.5) * resolution_m
    free = (np.abs(x)[None, :] < lx / 2) & (np.abs(y)[:, None] < ly / 2)
    for wx, wy, hx, hy in walls:
        free &= ~((np.abs(x - wx)[None, :] < hx) & (np.abs(y - wy)[:, None] < hy))
    save_maps(SceneMaps(free, resolution_m, origin, 0.0), folder)
    save_manifest(
        SceneManifest(
            name=folder.name,
            split=split,  # pyright: ignore[reportArgumentType]
            source={"format": "toy", "files": {}},
            licence="CC0-1.0",
            floor_area_m2=float(free.sum() * resolution_m**2),
            objects=tuple(objects),
            collision={},
            gates={},
            versions={},
        ),
        folder,
    )
    return folder


def _xml(spec: mujoco.MjSpec) -> str:
    spec.compile()
    return spec.to_xml()
