"""What is written of equal objects: files once, compiled as each of them was."""

from __future__ import annotations

import dataclasses

import mujoco
import numpy as np
import trimesh
from PIL import Image

from converters.bodies.objects import PlacedObject
from converters.bodies.physical import physical_properties
from converters.check.surfaces import geom_mesh, geom_surface
from converters.geometry.boxes import convex_hull, fit_box
from converters.records.visual import VisualMesh
from converters.write.emit import SceneParts, write_scene

WIDE = np.array([1.1, 0.95, 1.0])
IMAGE = np.random.default_rng(0).integers(0, 255, (16, 8, 3), np.uint8)


def box(name: str, scale: np.ndarray, x_m: float) -> tuple[PlacedObject, VisualMesh]:
    mesh = trimesh.creation.icosphere(1, 0.2)
    vertices, faces = (np.asarray(mesh.vertices) + [0.0, 0.0, 0.2]) * scale, np.asarray(mesh.faces)
    hull = convex_hull(vertices)
    placed = PlacedObject(
        name, "box", "ball", vertices, faces, np.zeros((len(faces), 3), np.uint8), (hull,), (fit_box(hull, 0.0, 0.0),),
        np.array([x_m, 0.0, 0.0]), np.array([1.0, 0.0, 0.0, 0.0]), None,
    )  # fmt: skip
    uv = np.random.default_rng(1).random((len(vertices), 2))
    return placed, VisualMesh(vertices, faces, uv, faces, IMAGE, exact=True)


def test_equal_objects_share_their_files_and_keep_their_vertices(tmp_path):
    """Two equal bodies, a wider one, and one of the same shape in another colour."""
    one, wide = np.ones(3), WIDE
    made = [box(f"box_{k}", scale, 2.0 * k) for k, scale in enumerate((one, one, wide, one))]
    made[3] = made[3][0], dataclasses.replace(made[3][1], image=255 - IMAGE)
    objects, visuals = (tuple(v) for v in zip(*made, strict=True))
    physical = tuple(physical_properties("box", o.hulls_b) for o in objects)
    write_scene(SceneParts("four", objects, physical, (), None, visuals), tmp_path)

    names = sorted(p.name for p in (tmp_path / "assets").iterdir())
    assert names == ["box_0.png", "box_0_hull_0.obj", "box_0_visual.obj", "box_2_hull_0.obj", "box_3.png"]
    with Image.open(tmp_path / "assets" / "box_0.png") as image:
        assert (np.asarray(image.convert("RGB")) == IMAGE).all()
    model = mujoco.MjModel.from_xml_path(str(tmp_path / "scene.xml"))
    for placed, visual in made:
        drawn = geom_surface(model, model.geom(f"{placed.name}_visual").id)
        assert drawn.corner_uv is not None and drawn.texture is not None
        assert np.abs(drawn.vertices[drawn.faces] - visual.vertices[visual.faces]).max() < 1e-4
        assert np.abs(drawn.corner_uv - visual.uv[visual.uv_faces]).max() < 1e-4
        assert (drawn.texture == visual.image).all()
        hull = geom_mesh(model, model.geom(f"{placed.name}_hull_0").id)[0]
        assert np.abs(np.sort(hull, axis=0) - np.sort(placed.hulls_b[0].vertices, axis=0)).max() < 2e-5
