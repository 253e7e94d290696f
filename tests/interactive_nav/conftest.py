"""Two toy scenes of different shape, with everything in them moved, tilted and swung at random."""

import numpy as np
import pytest

from interactive_nav.config import NavConfig
from interactive_nav.robots import get_robot
from interactive_nav.scenes.scene import load_scene
from interactive_nav.scenes.world import build_world
from interactive_nav.sensing import build_boxes

N = 6


@pytest.fixture(scope="package")
def world(room, two_rooms):
    return build_world(get_robot("turtlebot"), (load_scene(room), load_scene(two_rooms)), NavConfig.of(num_objects=4))


@pytest.fixture(scope="package")
def boxes(world):
    return build_boxes(world)


@pytest.fixture(scope="package")
def jumble(world):
    """scene [N], qpos [N, nq] f32, camera positions [N, 3] and directions [N, 3]."""
    rng = np.random.default_rng(0)
    scene = np.arange(N) % 2
    qpos = world.rest_qpos[scene].copy()
    layout = world.layout
    for i in range(N):
        for slot, kind in enumerate(layout.slot_kind):
            at = layout.slot_qpos[slot]
            if kind == "hinge":
                qpos[i, at] = rng.uniform(-1.2, 1.2)
            elif world.slots.occupied[scene[i], slot]:
                tilt = np.append(1.0, rng.normal(0, 0.3, 3))
                qpos[i, at : at + 7] = [*rng.uniform(-1.4, 1.4, 2), rng.uniform(0.0, 0.4), *tilt / np.linalg.norm(tilt)]
    eye = np.column_stack([rng.uniform(-1.8, -1.4, N), rng.uniform(-1, 1, N), rng.uniform(0.25, 0.6, N)])
    forward = np.column_stack([np.ones(N), rng.uniform(-0.5, 0.5, N), rng.uniform(-0.2, 0.2, N)])
    return scene.astype(np.int32), qpos.astype(np.float32), eye.astype(np.float32), forward.astype(np.float32)
