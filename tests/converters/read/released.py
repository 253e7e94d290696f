"""Writes any raw scene in the layout of the released interactive Gibson set: the reader's counterpart in tests."""

from __future__ import annotations

from pathlib import Path

import numpy as np
from PIL import Image

from converters.geometry.faces import face_labels
from converters.records.raw import CEILING, DOOR, FLOOR, SYNSETS, WALL, Annotation, RawScene

SYNSET_OF = {category: synset for synset, category in SYNSETS.items()} | {"door": "00000001"}
MASS_KG, FRICTION = 7.5, 0.65
"""Written into every URDF."""
PLANE_COLOUR = (120, 90, 60)

URDF = """<robot name="{name}">
  <link name="base_link">
    <contact><lateral_friction value="{friction}"/><inertia_scaling value="3.0"/></contact>
    <inertial>
      <origin rpy="0 0 0" xyz="0 0 0"/><mass value="{mass}"/>
      <inertia ixx="1" ixy="0" ixz="0" iyy="1" iyz="0" izz="1"/>
    </inertial>
    <visual><origin rpy="0 0 0" xyz="0 0 0"/><geometry><mesh filename="{mesh}"/></geometry></visual>
    <collision><origin rpy="0 0 0" xyz="0 0 0"/><geometry><mesh filename="{mesh}"/></geometry></collision>
  </link>
</robot>
"""


def placed_vertices(raw: RawScene, annotation: Annotation) -> np.ndarray:
    """(n, 3) of an annotated object in the scan frame."""
    vertices = raw.cads[annotation.cad_id].vertices
    return vertices @ annotation.pose[:3, :3].T + annotation.pose[:3, 3]


def write_obj(path: Path, vertices: np.ndarray, faces: np.ndarray, corner_uv: np.ndarray | None, mtl: str) -> None:
    lines = [f"mtllib {mtl}", "usemtl paint"] + [f"v {x:.5f} {y:.5f} {z:.5f}" for x, y, z in vertices]
    if corner_uv is None:
        lines += [f"f {a} {b} {c}" for a, b, c in faces + 1]
    else:
        lines += [f"vt {u:.5f} {v:.5f}" for u, v in corner_uv.reshape(-1, 2)]
        lines += [f"f {a}/{3 * i + 1} {b}/{3 * i + 2} {c}/{3 * i + 3}" for i, (a, b, c) in enumerate(faces + 1)]
    path.write_text("\n".join(lines) + "\n")


def write_released(raw: RawScene, root: Path) -> Path:
    """Scan without furniture and without the floor under it, floor plane, URDFs with baked orientation, positions."""
    root.mkdir(parents=True)
    assert raw.floor_height_m is not None and raw.scan.corner_uv is not None and raw.scan.texture is not None
    label = face_labels(raw.scan.labels, raw.scan.faces)
    middle = raw.scan.vertices[raw.scan.faces].mean(axis=1)
    keep = np.isin(label, (0, WALL, FLOOR, CEILING, 3))
    for annotation in raw.annotations:
        at = placed_vertices(raw, annotation)
        low, high = at.min(axis=0), at.max(axis=0)
        keep &= ~((middle[:, :2] > low[:2]) & (middle[:, :2] < high[:2])).all(axis=1) | (label == WALL)
    keep &= label != DOOR
    Image.fromarray(raw.scan.texture).save(root / "scan.png")
    (root / "cleaned.mtl").write_text("newmtl paint\nKd 1 1 1\nmap_Kd scan.png\n")
    write_obj(
        root / "mesh_z_up_cleaned.obj",
        raw.scan.vertices,
        raw.scan.faces[keep],
        raw.scan.corner_uv[keep],
        "cleaned.mtl",
    )
    (root / "floors.txt").write_text(f"{raw.floor_height_m}\n")
    low, high = raw.scan.vertices.min(axis=0), raw.scan.vertices.max(axis=0)
    plane = np.array(
        [[x, y, raw.floor_height_m] for x, y in ((low[0], low[1]), (high[0], low[1]), high[:2], (low[0], high[1]))]
    )
    Image.fromarray(np.full((4, 4, 3), PLANE_COLOUR, np.uint8)).save(root / "plane.png")
    (root / "plane.mtl").write_text("newmtl paint\nmap_Kd plane.png\n")
    uv = np.array([[[0.1, 0.1], [0.9, 0.1], [0.9, 0.9]], [[0.1, 0.1], [0.9, 0.9], [0.1, 0.9]]])
    write_obj(root / "plane_z_up_0.obj", plane, np.array([[0, 1, 2], [0, 2, 3]]), uv, "plane.mtl")
    if raw.given_map is not None:
        Image.fromarray(raw.given_map.traversable.astype(np.uint8) * 255).save(root / "floor_trav_0.png")
    (root / "furniture.mtl").write_text("newmtl paint\nKd 0.2 0.4 0.6\n")
    for i, annotation in enumerate(raw.annotations):
        at = placed_vertices(raw, annotation)
        centre = (at.min(axis=0) + at.max(axis=0)) / 2
        stem = f"{i}_{SYNSET_OF[annotation.category]}"
        write_obj(root / f"{stem}.obj", at - centre, raw.cads[annotation.cad_id].faces, None, "furniture.mtl")
        text = URDF.format(name=f"object_{i}", mass=MASS_KG, friction=FRICTION, mesh=f"{stem}.obj")
        (root / f"alignment_centered_{stem}.urdf").write_text(text)
        (root / f"pos_{stem}.txt").write_text(" ".join(f"{v:.6f}" for v in centre) + "\n")
    return root
