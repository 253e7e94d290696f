"""What is drawn of a surface: itself where it is small, within 1 cm of it where it is not."""

from __future__ import annotations

import dataclasses
import io

import numpy as np
import pytest
import trimesh
from PIL import Image

from converters.bodies.objects import PlacedObject
from converters.geometry.faces import distances, sample_faces, simplify_to, surface_loss
from converters.records.raw import ColourCloud, TexturedMesh
from converters.write.texture import as_it_is, as_png, draw_objects

NOTHING = ColourCloud(np.zeros((0, 3)), np.zeros((0, 3)), np.zeros((0, 3)))


def chair(detail: int = 3) -> tuple[np.ndarray, np.ndarray]:
    """A round seat on four legs of 4 cm, 0.9 m high with its back; more faces with more detail."""
    parts = [trimesh.creation.icosphere(detail, 0.25).apply_scale((1, 1, 0.2)).apply_translation((0, 0, 0.45))]
    parts += [
        trimesh.creation.cylinder(0.02, 0.4, sections=4 * 2**detail).apply_translation((x, y, 0.2))
        for x in (-0.15, 0.15)
        for y in (-0.15, 0.15)
    ]
    parts.append(trimesh.creation.box((0.4, 0.03, 0.5)).apply_translation((0, 0.2, 0.65)))
    mesh = trimesh.util.concatenate(parts)
    return np.asarray(mesh.vertices), np.asarray(mesh.faces)


def painted(vertices: np.ndarray, faces: np.ndarray, size: int = 32) -> TexturedMesh:
    """Red below half of the height, blue above."""
    image = np.zeros((size, size, 3), np.uint8)
    image[: size // 2], image[size // 2 :] = (20, 30, 220), (220, 30, 20)
    height = vertices[faces][..., 2] / vertices[:, 2].max()
    return TexturedMesh(vertices, faces, np.stack([np.full_like(height, 0.5), np.clip(height, 0, 1)], axis=2), image)


def placed(surface: TexturedMesh, x_m: float = 0.0) -> PlacedObject:
    grey = np.full((len(surface.faces), 3), 90, np.uint8)
    pose = np.array([x_m, 0.0, 0.0]), np.array([1.0, 0.0, 0.0, 0.0])
    return PlacedObject("a", "chair", "a", surface.vertices, surface.faces, grey, (), (), *pose, None, surface)


def test_a_small_surface_is_drawn_with_its_own_vertices_and_image() -> None:
    surface = painted(*chair(1))
    drawn, again = draw_objects([placed(surface), placed(surface, 2.0)], [NOTHING, NOTHING], len(surface.faces), 32)
    assert drawn is again
    assert (drawn.shown_share, drawn.kept_share, drawn.off_m) == (0.0, 1.0, 0.0)
    assert (drawn.mesh.vertices[drawn.mesh.faces] == surface.vertices[surface.faces]).all()
    assert surface.corner_uv is not None
    assert np.allclose(drawn.mesh.uv[drawn.mesh.uv_faces], surface.corner_uv, atol=1e-12)
    assert (drawn.mesh.image == surface.texture).all() and drawn.mesh.exact


@pytest.mark.parametrize(("faces", "size", "shift"), [(-1, 32, 0.0), (0, 31, 0.0), (0, 32, 0.3)])
def test_no_other_surface_is(faces: int, size: int, shift: float) -> None:
    """Too many faces, too large an image, an image that repeats."""
    surface = painted(*chair(1))
    assert as_it_is(surface, len(surface.faces), 32) is not None
    assert surface.corner_uv is not None
    moved = dataclasses.replace(surface, corner_uv=surface.corner_uv + shift)
    assert as_it_is(moved, len(surface.faces) + faces, size) is None


def test_a_large_surface_stays_within_a_centimetre_and_keeps_its_own_colours() -> None:
    surface = painted(*chair(4))
    (drawn,) = draw_objects([placed(surface)], [NOTHING], 3000, 64)
    assert 100 < len(drawn.mesh.faces) < 0.4 * len(surface.faces) and len(surface.faces) > 3000
    assert drawn.kept_share >= 0.97 and drawn.off_m <= 0.01
    assert distances(surface.vertices[::7], drawn.mesh.vertices, drawn.mesh.faces).max() <= 0.011
    red = drawn.mesh.image[..., 0] > 150
    assert 0.2 < red.mean() < 0.9


def test_what_the_scan_shows_takes_the_scans_colours() -> None:
    surface = painted(*chair(1))
    points, index = sample_faces(*chair(1), 0.02)
    normals = trimesh.Trimesh(*chair(1), process=False).face_normals[index]
    green = ColourCloud(points + [2.0, 0, 0], normals, np.tile([0.0, 200.0, 0.0], (len(points), 1)))
    own, scanned = draw_objects([placed(surface), placed(surface, 2.0)], [NOTHING, green], 3000, 32)
    assert own.mesh.exact and not scanned.mesh.exact
    assert scanned.shown_share > 0.9 and (scanned.mesh.image == [0, 200, 0]).all(axis=2).mean() > 0.9


def test_a_ceiling_on_the_faces_costs_surface_and_says_how_much() -> None:
    vertices, faces = chair(3)
    kept, off_m = surface_loss(vertices, faces, *simplify_to(vertices, faces, 40))
    assert kept < 0.97 and off_m > 0.02
    within = surface_loss(vertices, faces, *simplify_to(vertices, faces, 1000))
    assert within[0] >= 0.97 and within[1] <= 0.01


@pytest.mark.parametrize(("colours", "mode"), [(256, "P"), (400, "RGB")])
def test_an_image_of_its_own_is_written_to_the_bit(colours: int, mode: str) -> None:
    image = np.random.default_rng(0).integers(0, 256, (colours, 3), np.uint8)[np.arange(40 * 50) % colours]
    made, file = as_png(image.reshape(40, 50, 3)), io.BytesIO()
    made.save(file, "PNG")
    assert made.mode == mode
    assert (np.asarray(Image.open(file).convert("RGB")) == image.reshape(40, 50, 3)).all()


def test_copies_in_other_proportions_have_the_same_faces() -> None:
    """Two corners 4 um apart in x, 2 um in the half-sized copy: sorted by place, they would change theirs."""
    vertices, faces = chair(0)
    vertices[:2, 0], vertices[:2, 1] = (0.100004, 0.100008), (0.2, -0.2)
    scale = np.array([0.5, 0.7, 1.1])
    surface = painted(vertices, faces)
    drawn, copy = (
        as_it_is(dataclasses.replace(surface, vertices=vertices * k), len(faces), 32) for k in (np.ones(3), scale)
    )
    assert drawn is not None and copy is not None
    assert (drawn.faces == copy.faces).all() and (drawn.uv_faces == copy.uv_faces).all()
    assert np.allclose(drawn.vertices * scale, copy.vertices, rtol=0, atol=1e-5)
