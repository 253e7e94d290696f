"""One room, however its file splits it into vertices: the same floor, walls and picture."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
import trimesh
from PIL import Image

from converters.pipeline import ConvertConfig, convert
from scenes_mjcf.schema import load_maps

TEXELS = 64
"""No test here looks at the picture."""
LEG_M = 0.04
"""A side of a leg, cut at 0.4 m, has 0.004 to 0.016 m2: less than what a cut may leave hanging."""


def room() -> trimesh.Trimesh:
    """A room of 4 x 3 x 2.4 m with a window-less shell, a table on four legs and a stool, finely meshed."""
    shell = trimesh.creation.box((4.0, 3.0, 2.4)).apply_translation((0, 0, 1.2))
    shell.invert()
    parts = [shell, trimesh.creation.box((1.2, 0.8, 0.05)).apply_translation((0.5, 0.3, 0.70))]
    for x in (-0.05, 1.05):
        for y in (-0.05, 0.65):
            parts.append(trimesh.creation.box((LEG_M, LEG_M, 0.68)).apply_translation((x, y, 0.34)))
    parts.append(trimesh.creation.box((0.35, 0.35, 0.45)).apply_translation((-1.2, -0.8, 0.225)))
    joined = trimesh.util.concatenate(parts)
    vertices, faces = trimesh.remesh.subdivide_to_size(  # pyright: ignore[reportAssignmentType]
        joined.vertices, joined.faces, 0.15
    )
    return trimesh.Trimesh(vertices, faces, process=True)


def split(mesh: trimesh.Trimesh, how: str) -> trimesh.Trimesh:
    """The mesh with shared vertices, with none shared, or with vertices of their own for charts of 0.4 m."""
    if how == "merged":
        return mesh
    of_face = np.arange(len(mesh.faces))
    if how == "charts":
        middle = np.floor(mesh.triangles_center / 0.4).astype(int)
        side = np.abs(mesh.face_normals).argmax(axis=1)
        of_face = np.unique(np.column_stack([middle, side]), axis=0, return_inverse=True)[1].reshape(-1)
    pairs, faces = np.unique(np.stack([np.repeat(of_face, 3), mesh.faces.ravel()], axis=1), axis=0, return_inverse=True)
    return trimesh.Trimesh(mesh.vertices[pairs[:, 1]], faces.reshape(-1, 3), process=False)


def written(mesh: trimesh.Trimesh, path: Path) -> Path:
    """The mesh as a file; a GLB has texture coordinates and an image, as apps write them."""
    if path.suffix == ".glb":
        uv = (mesh.vertices[:, :2] - mesh.vertices[:, :2].min(axis=0)) / np.ptp(mesh.vertices[:, :2], axis=0)
        image = Image.fromarray(np.full((8, 8, 3), (180, 120, 60), np.uint8))
        mesh = mesh.copy()
        mesh.visual = trimesh.visual.TextureVisuals(
            uv=uv, material=trimesh.visual.material.PBRMaterial(baseColorTexture=image)
        )
        mesh.apply_transform(trimesh.transformations.rotation_matrix(-np.pi / 2, (1, 0, 0)))  # glTF is y up
    mesh.export(path)
    return path


@pytest.fixture(scope="module")
def reference(tmp_path_factory):
    folder = tmp_path_factory.mktemp("room")
    result = convert(
        written(room(), folder / "merged.ply"),
        folder / "merged",
        ConvertConfig(up="z", structure_texture=TEXELS),
        cache=folder / "cache",
    )
    return result, load_maps(folder / "merged")


@pytest.mark.parametrize("how", ["soup", "charts", "merged"])
@pytest.mark.parametrize("ending", ["stl", "ply", "glb"])
def test_a_room_is_the_same_however_its_vertices_are_shared(reference, tmp_path, how, ending):
    result = convert(
        written(split(room(), how), tmp_path / f"room.{ending}"),
        tmp_path / "out",
        ConvertConfig(up="y" if ending == "glb" else "z", structure_texture=TEXELS),
    )
    maps = load_maps(tmp_path / "out")
    np.testing.assert_array_equal(maps.traversable, reference[1].traversable)
    np.testing.assert_allclose(maps.origin_w, reference[1].origin_w, atol=1e-6)
    assert result.n_walls == reference[0].n_walls
    gates = {g.name: g for g in result.gates}
    assert gates["scan_kept"].value == pytest.approx(1.0, abs=0.005) and gates["scan_kept"].passed
    # 4 x 3 m less the table of 1.2 x 0.8 m and the stool of 0.35 x 0.35 m; walls and sides take a cell or two each.
    assert 3.9 * 2.9 - 1.35 * 0.95 - 0.5**2 < result.manifest.floor_area_m2 < 4 * 3 - 1.2 * 0.8 - 0.35**2
