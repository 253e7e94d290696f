"""What C MuJoCo steps on CPU threads, beside the model that the other backends have."""

import mujoco
import numpy as np

from interactive_nav.config import NavConfig
from interactive_nav.physics.native import with_feet_apart
from interactive_nav.robots import get_robot
from interactive_nav.scenes.scene import load_scene
from interactive_nav.scenes.slots import find_slots
from interactive_nav.scenes.world import build_world
from tests.toys import write_room


def test_feet_on_bodies_of_their_own_change_nothing(tmp_path):
    # Scene 1 has an empty slot; the robot pushes the basket of scene 0, with objects asleep and awake about it.
    baskets = (("basket", 0.5, 0.0, 1.0, 0.4), ("basket", 1.5, 0.8, 2.0, 0.7))
    scenes = [load_scene(write_room(tmp_path / str(i), (5.0, 3.0), baskets[: 2 - i])) for i in range(2)]
    config = NavConfig.of(num_objects=2)
    world = build_world(get_robot("turtlebot"), tuple(scenes), config)
    names = [world.models[0].body(body).name for body in world.layout.slot_body]
    slots = find_slots(world.scenes, world.small_objects)
    for scene, spec in enumerate(world.specs):
        told = {}
        for name, model in (("plain", spec.compile()), ("apart", with_feet_apart(world, slots, scene, config))):
            feet = [model.body(b).name.endswith("_feet") for b in range(model.nbody)]
            assert sum(feet) == len(names) * (name == "apart") and not model.body_contype[feet].any()
            model.opt.enableflags |= mujoco.mjtEnableBit.mjENBL_SLEEP
            data = mujoco.MjData(model)
            data.qpos = world.rest_qpos[scene]
            data.qpos[:7] = [0, 0, 0, 1, 0, 0, 0]
            for slot in (0, 1):
                at = world.layout.slot_qpos[slot]
                data.qpos[at : at + 3] = [-0.8, slot - 0.5, 0.0]
            rows = []
            for step in range(150):
                data.ctrl[:] = [8.0, 8.0] if step < 100 else [9.0, 4.0]
                mujoco.mj_step(model, data)
                rows.append(
                    [data.ncon, data.ntree_awake, *data.qpos, *data.qvel, *data.qacc_warmstart, *data.sensordata]
                )
            told[name] = np.array(rows)
        np.testing.assert_array_equal(told["apart"], told["plain"])
        assert told["plain"][:, 0].max() > 8  # contacts
        assert told["plain"][:, 1].min() < told["plain"][:, 1].max()  # something fell asleep
    assert np.abs(told["plain"][-1, 2:4]).max() > 0.2  # the robot drove
