"""The study of rendering writes a row for every stream, and for what fails."""

import json

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from docs.studies import rendering
from interactive_nav.config import NavConfig
from interactive_nav.pictures.shading import FLOOR_COLOUR
from interactive_nav.robots import get_robot
from interactive_nav.scenes.scene import load_scene
from interactive_nav.scenes.world import build_world
from interactive_nav.sensing.base import Lens, look_along
from interactive_nav.sensing.boxes import build_boxes
from interactive_nav.sensing.rays import RayRenderer


@pytest.mark.heavy
@pytest.mark.slow
def test_rows_tell_rate_and_place_and_failures(room, tmp_path, monkeypatch):
    out = tmp_path / "rows.jsonl"

    def fail(*args):
        raise MemoryError("too large")

    common = ["--scenes", str(room), "--num-envs", "2", "--size", "12", "--seconds", "0", "--out", str(out)]
    assert rendering.main([*common, "--renderer", "rays", "--stream", "depth", "rgb_textured"]) == 0
    monkeypatch.setattr(rendering, "colours", fail)
    assert rendering.main([*common, "--renderer", "rays", "--stream", "rgb", "--commit", "abc"]) == 0
    rows = [json.loads(line) for line in out.read_text().splitlines()]
    # Rays draw no textures: that combination is left out.
    assert [(r["stream"], r.get("frames_on")) for r in rows] == [("depth", "device"), ("depth", "host"), ("rgb", None)]
    assert all(r["frames_per_s"] > 0 and r["bytes_per_frame"] == 4 * 12 * 12 and r["calls"] >= 3 for r in rows[:2])
    assert rows[2]["error"] == "MemoryError: too large" and rows[2]["commit"] == "abc"
    # What would not fit is left out before it is tried.
    assert rendering.main([*common, "--renderer", "rays", "--stream", "depth", "--max-megapixels", "0.0001"]) == 0
    assert len(out.read_text().splitlines()) == 3


def test_normals_and_colours_of_boxes(room):
    # Scene 0, from 0.5 m before the wall x = 2, looking at it: below the horizon the floor, above it the wall.
    world = build_world(get_robot("turtlebot"), (load_scene(room),), NavConfig.of(num_objects=4))
    boxes = build_boxes(world)
    lens, scene = Lens(40, 40, 100.0), jnp.zeros(1, jnp.int32)
    qpos = jnp.asarray(world.rest_qpos[:1], jnp.float32)
    camera = look_along(jnp.asarray([[1.5, 1.2, 0.3]]), jnp.asarray([[1.0, 0.0, 0.0]]))
    depth, index = jax.jit(RayRenderer(boxes, lens).trace_batch)(scene, qpos, camera)
    normal = np.asarray(rendering.normals(boxes, scene, qpos, camera, lens, depth, index))[0]
    # Floor where the ray falls by more than 0.3 m in 0.5 m: below -31 degrees.
    np.testing.assert_allclose(normal[-1, 20], [0, 0, 1], atol=1e-6)
    np.testing.assert_allclose(normal[20, 20], [-1, 0, 0], atol=1e-5)
    rgb = np.asarray(rendering.colours(boxes, scene, camera, jnp.asarray(normal)[None], index))[0]
    # The floor is lit fully by the sun (0.9 / |l| of 0.4) and not by the lamp.
    sun = 0.9 / np.linalg.norm([0.35, 0.25, 0.9])
    np.testing.assert_allclose(rgb[-1, 20], 255 * np.array(FLOOR_COLOUR) * (0.45 + 0.4 * sun), atol=1)
