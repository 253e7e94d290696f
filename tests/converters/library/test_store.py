"""The packaged furniture: what is in it, that it is credited, solid and as large as it says, and made as it is."""

from __future__ import annotations

from collections import Counter

import numpy as np
import pytest
import trimesh

from converters.geometry.faces import distances, loose_parts, simplify_within
from converters.library.store import ATTRIBUTION, PACKED, attribution, read_index, read_shape
from interactive_nav_common.errors import FileError
from scenes_mjcf.categories import CATEGORIES

INDEX = read_index()


def test_the_library_has_the_categories_that_homes_need():
    assert len(INDEX) >= 150
    assert {m.category for m in INDEX.values()} <= set(CATEGORIES) and len({m.category for m in INDEX.values()}) == 31
    counts = Counter(m.category for m in INDEX.values())
    assert min(counts[c] for c in ("chair", "table", "sofa", "desk", "armchair", "stool", "counter")) >= 4
    assert PACKED.stat().st_size < 8 * 2**20


def test_no_creator_is_in_both_splits_and_all_are_credited():
    credits = [(m.split, credit) for m in INDEX.values() for credit in m.credits]
    by_split = {split: {c.creator for of, c in credits if of == split} for split in ("train", "test")}
    assert by_split["train"].isdisjoint(by_split["test"])
    assert {c.licence for _, c in credits} == {"CC0 1.0", "CC BY 3.0", "CC BY 3.0 US"}
    assert all(c.creator and c.title for _, c in credits if c.licence != "CC0 1.0")
    assert all("+".join(c.source for c in m.credits) == m.name for m in INDEX.values())
    assert ATTRIBUTION.read_text() == attribution(list(INDEX.values()))


@pytest.mark.parametrize("name", sorted(INDEX)[::23])
def test_a_model_is_as_large_as_it_says_and_its_hulls_hold_it(name):
    model, shape = INDEX[name], read_shape(name)
    visual = shape.visual
    assert len(visual.faces) == model.faces <= 3300 and len(shape.hulls) == model.hulls
    assert visual.image.shape == (256, 256, 3) and visual.uv.min() >= 0 and visual.uv.max() <= 1
    np.testing.assert_allclose(np.ptp(visual.vertices, axis=0), model.size_m, atol=0.05)
    assert abs(visual.vertices[:, 1].min()) < 0.02
    points = np.vstack([hull.vertices for hull in shape.hulls])
    np.testing.assert_allclose(np.ptp(points, axis=0), model.size_m, atol=0.08)
    for hull in shape.hulls:
        a, b, c = (hull.vertices[hull.faces[:, k]] for k in range(3))
        normal = np.cross(b - a, c - a)
        area = np.linalg.norm(normal, axis=1)
        above_m = np.einsum("fd,fvd->fv", normal, hull.vertices[None] - a[:, None]) / np.maximum(area, 1e-12)[:, None]
        assert above_m[area > 1e-5].max(initial=0) < 5e-3  # convex, faces outwards


def test_a_damaged_archive_is_one_line(tmp_path):
    name = sorted(INDEX)[0]
    (tmp_path / "c.zip").write_bytes(PACKED.read_bytes()[:500])
    for read in (read_index, lambda path: read_shape(name, path)):
        with pytest.raises(FileError, match="not readable"):
            read(tmp_path / "c.zip")
    with pytest.raises(FileError, match="not readable .*Nobody/nothing.arrays"):
        read_shape("Nobody/nothing")


def box_of_boxes() -> tuple[np.ndarray, np.ndarray]:
    """A finely cut ball of 0.4 m, and beside it a rod of 6 mm that a count alone would take away."""
    ball = trimesh.creation.icosphere(subdivisions=4, radius=0.4)
    rod = trimesh.creation.cylinder(radius=0.003, height=1.0, sections=48)
    whole = trimesh.util.concatenate([ball, rod.apply_translation([0.8, 0, 0])])
    return np.asarray(whole.vertices, float), np.asarray(whole.faces, np.int64)


def test_simplification_keeps_every_part_within_its_error():
    vertices, faces = box_of_boxes()
    low, kept = simplify_within(vertices, faces, 0.01)
    assert len(kept) < len(faces) / 8 and len(np.unique(loose_parts(low, kept))) == 2
    assert distances(vertices, low, kept).max() <= 0.0101
    assert distances(low, vertices, faces).max() <= 0.0101


def test_what_stands_on_a_model_is_part_of_it():
    composed = [m for m in INDEX.values() if "+" in m.name]
    assert len(composed) >= 10 and all(len(m.credits) == 2 for m in composed)
