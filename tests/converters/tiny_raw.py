"""A tiny raw room in both layouts: 3 x 2.5 m, a table and a basket, floor at 0.3 m."""

from __future__ import annotations

import dataclasses
import json
import math
from pathlib import Path

import numpy as np
import trimesh
from PIL import Image

FLOOR_M = 0.3
ROOM_M = (3.0, 2.5)
WALL_M = 1.5
TABLE, BASKET = "04379243", "02747177"
COLOURS = {1: (200, 200, 210), 2: (150, 100, 60), 7: (20, 120, 20), 39: (30, 30, 160)}
"""NYU40 label -> colour of the scan."""


def table_cad() -> trimesh.Trimesh:
    """Y up, unit size: a top of 1 x 0.1 x 0.6 on four legs, 0.7 high, base at y = -0.35."""
    parts = [trimesh.creation.box((1.0, 0.1, 0.6)).apply_translation((0, 0.3, 0))]
    for x in (-0.45, 0.45):
        for z in (-0.25, 0.25):
            parts.append(trimesh.creation.box((0.08, 0.6, 0.08)).apply_translation((x, -0.05, z)))
    joined = trimesh.util.concatenate(parts)
    assert isinstance(joined, trimesh.Trimesh)
    return joined


def basket_cad() -> trimesh.Trimesh:
    """Y up: a solid box, 0.3 x 0.4 x 0.3."""
    return trimesh.creation.box((0.3, 0.4, 0.3))


@dataclasses.dataclass(frozen=True)
class Item:
    """One piece of furniture: CAD model, where its middle stands in the scan frame, yaw and uniform scale."""

    synset: str
    cad_id: str
    label: int
    position: tuple[float, float, float]
    yaw: float
    scale: float


ITEMS = (
    Item(TABLE, "table-a", 7, (0.9, 1.6, FLOOR_M + 0.35), math.radians(90), 1.0),
    Item(BASKET, "basket-a", 39, (2.4, 0.6, FLOOR_M + 0.2), 0.0, 1.0),
)
CAD = {"table-a": table_cad, "basket-a": basket_cad}
Y_UP_TO_Z_UP = np.array([[1.0, 0, 0], [0, 0, -1.0], [0, 1.0, 0]])


def _yaw_about_y(yaw: float) -> list[float]:
    """Quaternion w x y z of a turn about y (a yaw, seen in the y-up world)."""
    return [math.cos(yaw / 2), 0.0, math.sin(yaw / 2), 0.0]


def placed(item: Item) -> trimesh.Trimesh:
    """The item's surface in the scan frame."""
    mesh = CAD[item.cad_id]()
    c, s = math.cos(item.yaw), math.sin(item.yaw)
    turn = np.array([[c, -s, 0], [s, c, 0], [0, 0, 1.0]])
    mesh.vertices = (mesh.vertices * item.scale) @ Y_UP_TO_Z_UP.T @ turn.T + item.position
    return mesh


def scan() -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Vertices (n, 3), faces (m, 3) and NYU40 labels (n,) of the scanned room, edges of about 4 cm."""
    lx, ly = ROOM_M
    walls = [
        ((lx / 2, 0, WALL_M / 2), (lx, 0, WALL_M)),
        ((lx / 2, ly, WALL_M / 2), (lx, 0, WALL_M)),
        ((0, ly / 2, WALL_M / 2), (0, ly, WALL_M)),
        ((lx, ly / 2, WALL_M / 2), (0, ly, WALL_M)),
    ]
    pieces = [(_sheet((lx / 2, ly / 2, 0), (lx, ly, 0)), 2)] + [(_sheet(*w), 1) for w in walls]
    for item in ITEMS:
        fine = placed(item).subdivide_to_size(0.05)
        assert isinstance(fine, trimesh.Trimesh)
        pieces.append((fine, item.label))
    vertices, faces, labels = [], [], []
    count = 0
    for mesh, label in pieces:
        points = np.asarray(mesh.vertices) + ([0, 0, FLOOR_M] if label in (1, 2) else [0, 0, 0])
        vertices.append(points)
        faces.append(np.asarray(mesh.faces) + count)
        labels.append(np.full(len(points), label))
        count += len(points)
    return np.vstack(vertices), np.vstack(faces), np.concatenate(labels)


def _sheet(centre: tuple[float, ...], size: tuple[float, ...]) -> trimesh.Trimesh:
    """A flat rectangle of triangles of about 5 cm; one of the three sizes is 0."""
    flat = int(np.argmin(size))
    u, v = (k for k in range(3) if k != flat)
    n, m = int(size[u] / 0.05) + 1, int(size[v] / 0.05) + 1
    a, b = np.meshgrid(np.linspace(-0.5, 0.5, n), np.linspace(-0.5, 0.5, m), indexing="ij")
    points = np.zeros((n * m, 3))
    points[:, u], points[:, v] = a.ravel() * size[u], b.ravel() * size[v]
    i = (np.arange(n - 1)[:, None] * m + np.arange(m - 1)).ravel()
    faces = np.vstack([np.stack([i, i + m, i + 1], 1), np.stack([i + 1, i + m, i + m + 1], 1)])
    return trimesh.Trimesh(points + centre, faces, process=False)


def annotation() -> list[dict]:
    """Exact annotations in Scan2CAD's schema: the world is the scan turned to y up and moved by (1, 2, 3)."""
    shift = np.array([1.0, 2.0, 3.0])
    models = []
    for item in ITEMS:
        corners = trimesh.bounds.corners(CAD[item.cad_id]().bounds)
        c, s = math.cos(item.yaw), math.sin(item.yaw)
        about_y = np.array([[c, 0, s], [0, 1, 0], [-s, 0, c]])
        middle = Y_UP_TO_Z_UP.T @ np.array(item.position) + shift
        world = (corners * item.scale) @ about_y.T + middle
        models.append(
            {
                "trs": {
                    "translation": middle.tolist(),
                    "rotation": _yaw_about_y(item.yaw),
                    "scale": [item.scale] * 3,
                },
                "bbox": (np.ptp(corners, axis=0) / 2).tolist(),
                "center": [0, 0, 0],
                "sym": "__SYM_ROTATE_UP_2",
                "id_cad": item.cad_id,
                "catid_cad": item.synset,
                "keypoints_cad": {"n_keypoints": 8, "position": world.ravel().tolist()},
                "keypoints_scan": {"n_keypoints": 8, "position": world.ravel().tolist()},
            }
        )
    half = math.sqrt(0.5)
    return [
        {
            "id_scan": "scene_tiny",
            "trs": {"translation": shift.tolist(), "rotation": [-half, half, 0, 0], "scale": [1, 1, 1]},
            "n_aligned_models": len(models),
            "aligned_models": models,
        }
    ]


def _write_cads(root: Path) -> None:
    for item in ITEMS:
        folder = root / "cad" / item.synset / item.cad_id / "models"
        folder.mkdir(parents=True)
        mesh = CAD[item.cad_id]()
        lines = ["mtllib model_normalized.mtl", "usemtl paint"]
        lines += [f"v {x:.6f} {y:.6f} {z:.6f}" for x, y, z in mesh.vertices]
        lines += [f"f {a} {b} {c}" for a, b, c in mesh.faces + 1]
        (folder / "model_normalized.obj").write_text("\n".join(lines) + "\n")
        (folder / "model_normalized.mtl").write_text("newmtl paint\nKd 0.2 0.4 0.6\n")


def write_scan2cad(root: Path) -> Path:
    """Writes the room as a Scan2CAD folder."""
    (root / "scan").mkdir(parents=True)
    vertices, faces, labels = scan()
    colours = np.array([COLOURS[int(v)] for v in labels], np.uint8)
    stem = root / "scan" / "scene_tiny_vh_clean_2"
    trimesh.Trimesh(vertices, faces, vertex_colors=colours, process=False).export(f"{stem}.ply")
    write_label_ply(Path(f"{stem}.labels.ply"), vertices, faces, labels)
    (root / "full_annotations.json").write_text(json.dumps(annotation()))
    _write_cads(root)
    return root


def write_label_ply(path: Path, vertices: np.ndarray, faces: np.ndarray, labels: np.ndarray) -> None:
    """Binary PLY with the vertex property `label`, as ScanNet's."""
    header = (
        "ply\nformat binary_little_endian 1.0\n"
        f"element vertex {len(vertices)}\nproperty float x\nproperty float y\nproperty float z\n"
        f"property ushort label\nelement face {len(faces)}\nproperty list uchar int vertex_indices\n"
        "end_header\n"
    )
    rows = np.zeros(len(vertices), [("p", "<f4", 3), ("l", "<u2")])
    rows["p"], rows["l"] = vertices, labels
    triangles = np.zeros(len(faces), [("n", "u1"), ("v", "<i4", 3)])
    triangles["n"], triangles["v"] = 3, faces
    path.write_bytes(header.encode() + rows.tobytes() + triangles.tobytes())


def write_gibson(root: Path) -> Path:
    """Writes the room as a raw Gibson folder; the texture has one coloured column a label."""
    root.mkdir(parents=True)
    vertices, faces, labels = scan()
    order = sorted(COLOURS)
    texture = np.zeros((4, 4 * len(order), 3), np.uint8)
    for k, label in enumerate(order):
        texture[:, 4 * k : 4 * k + 4] = COLOURS[label]
    Image.fromarray(texture).save(root / "paint.png")
    lines = ["mtllib mesh_z_up.mtl", "usemtl scan"]
    lines += [f"v {x:.5f} {y:.5f} {z:.5f}" for x, y, z in vertices]
    lines += [f"vt {(k + 0.5) / len(order):.5f} 0.5" for k in range(len(order))]
    column = np.array([order.index(int(v)) for v in labels]) + 1
    lines += [f"f {a + 1}/{column[a]} {b + 1}/{column[b]} {c + 1}/{column[c]}" for a, b, c in faces]
    (root / "mesh_z_up.obj").write_text("\n".join(lines) + "\n")
    (root / "mesh_z_up.mtl").write_text("newmtl scan\nKd 1 1 1\nmap_Kd paint.png\n")
    np.savez_compressed(root / "mesh_z_up.labels.npz", label=labels.astype(np.uint8))
    (root / "floors.txt").write_text(f"{FLOOR_M}\n")
    (root / "alignments.json").write_text(json.dumps(annotation()))
    (root / "LICENCE").write_text("CC0: no rights reserved\n")
    _write_cads(root)
    return root


def write_two_floors(root: Path, storey_m: float = 3.0) -> Path:
    """The Gibson folder with the room twice, one above the other; a table and a basket below, a basket above."""
    write_gibson(root)
    vertices, faces, labels = scan()
    order = sorted(COLOURS)
    both = np.vstack([vertices, vertices + [0, 0, storey_m]])
    lines = ["mtllib mesh_z_up.mtl", "usemtl scan"]
    lines += [f"v {x:.5f} {y:.5f} {z:.5f}" for x, y, z in both]
    lines += [f"vt {(k + 0.5) / len(order):.5f} 0.5" for k in range(len(order))]
    column = np.array([order.index(int(v)) for v in labels] * 2) + 1
    twice = np.vstack([faces, faces + len(vertices)])
    lines += [f"f {a + 1}/{column[a]} {b + 1}/{column[b]} {c + 1}/{column[c]}" for a, b, c in twice]
    (root / "mesh_z_up.obj").write_text("\n".join(lines) + "\n")
    np.savez_compressed(root / "mesh_z_up.labels.npz", label=np.tile(labels, 2).astype(np.uint8))
    (root / "floors.txt").write_text(f"{FLOOR_M + storey_m}\n{FLOOR_M}\n")
    data = annotation()
    upper = json.loads(json.dumps(data[0]["aligned_models"][1]))  # a second basket, upstairs
    upper["trs"]["translation"][1] += storey_m  # the annotation's world is y up
    for key in ("keypoints_cad", "keypoints_scan"):
        points = np.array(upper[key]["position"]).reshape(-1, 3) + [0, storey_m, 0]
        upper[key]["position"] = points.ravel().tolist()
    data[0]["aligned_models"].append(upper)
    (root / "alignments.json").write_text(json.dumps(data))
    return root
