"""Build a `World` from a robot, small objects and scenes: MuJoCo models of equal layout, one per scene.

All scenes are padded to common slots (movable bodies, boxes per body, walls), so that one compiled
program steps any mix of them: what differs between the models is numbers, never structure. An empty
slot is a body without a place: it waits at its parking spot and never counts.
"""

import dataclasses
import math

import mujoco
import numpy as np

from interactive_nav.config import NavConfig
from interactive_nav.robots import RobotSpec
from interactive_nav.scenes.objects import SmallObject, small_objects
from interactive_nav.scenes.scene import Scene
from interactive_nav.scenes.slots import Layout, SlotTables, build_slot_tables, find_layout, find_slots, parking_spot
from interactive_nav.scenes.spec import build_spec
from interactive_nav_common.errors import ConfigError
from scenes_mjcf.schema import SceneError

_SETTLE_TIME_S = 3.0


@dataclasses.dataclass(frozen=True)
class World:
    """Everything that is constant about a batch of environments, on the host."""

    robot: RobotSpec
    scenes: tuple[Scene, ...]
    small_objects: tuple[SmallObject, ...]
    specs: tuple[mujoco.MjSpec, ...]
    """One per scene."""
    models: tuple[mujoco.MjModel, ...]
    """Compiled specs, equal in structure."""
    layout: Layout
    rest_qpos: np.ndarray
    """[S, nq]: furniture settled, robot and small objects parked."""
    robot_mass_kg: float
    slots: SlotTables
    """The movable bodies of each scene."""


def _settle(model: mujoco.MjModel, layout: Layout, robot: RobotSpec) -> np.ndarray:
    """Return the rest configuration [nq]: furniture falls and slides to rest, with the robot parked."""
    data = mujoco.MjData(model)
    x, y = parking_spot(layout.num_slots)
    adr = layout.robot_qpos
    data.qpos[adr : adr + 7] = [x, y, robot.spawn_height_m, 1, 0, 0, 0]
    for name, value in robot.home_qpos:
        data.qpos[model.joint(name).qposadr[0]] = value
    start = data.qpos.copy()
    steps = math.ceil(_SETTLE_TIME_S / model.opt.timestep)
    iterations = model.opt.iterations
    model.opt.iterations = max(100, iterations)
    for step in range(steps):
        mujoco.mj_step(model, data)
        # Overlaps of the boxes are pushed apart slowly, not flung.
        if step < steps // 2:
            data.qvel *= 0.8
    model.opt.iterations = iterations
    qpos = data.qpos.copy()
    robots = slice(adr, adr + layout.robot_nq)
    qpos[robots] = start[robots]
    return qpos


def build_world(robot: RobotSpec, scenes: tuple[Scene, ...], config: NavConfig) -> World:
    """Compile one padded model per scene and settle its furniture under the environment's physics."""
    if not scenes:
        raise ConfigError("scenes is empty, expected at least one scene folder")
    if config.collision == "hulls" and len(scenes) > 1:
        raise ConfigError(
            f"collision='hulls' with {len(scenes)} scenes, expected one: batched scenes collide with boxes; "
            "use collision='boxes'"
        )
    small = small_objects(config.num_objects, config.small_objects, config.objects)
    slots = find_slots(scenes, small)
    specs = [build_spec(robot, i, scenes, slots, config) for i in range(len(scenes))]
    models = [spec.compile() for spec in specs]
    layout = find_layout(models[0], robot, [(slot.name, slot.kind) for slot in slots])
    rest = [_settle(model, layout, robot) for model in models]
    for scene, qpos in zip(scenes, rest, strict=True):
        if not np.isfinite(qpos).all():
            raise SceneError(f"{scene.path}: its furniture does not settle (non-finite); convert the scene again")
    return World(
        robot=robot,
        scenes=scenes,
        small_objects=small,
        specs=tuple(specs),
        models=tuple(models),
        layout=layout,
        rest_qpos=np.asarray(rest),
        robot_mass_kg=float(models[0].body_mass[layout.robot_bodies].sum()),
        slots=build_slot_tables(slots, scenes, models, layout),
    )
