"""Locate bodies in the state vectors, and build the tables of what each slot of a scene holds."""

import dataclasses
import functools
import itertools
from collections.abc import Sequence
from typing import Any

import mujoco
import numpy as np

from interactive_nav.robots import RobotSpec
from interactive_nav.robots.spec import RobotState
from interactive_nav.scenes.objects import SmallObject, body_names
from interactive_nav.scenes.scene import Movable, Scene
from interactive_nav_common.rotations import matrix_from_quat
from scenes_mjcf.categories import MaskClasses

Body = Movable | SmallObject
_NO_BOX = (0.0, 0.0, 0.0, 1.0, 0.0, 0.0, 0.0, -1.0, -1.0, -1.0)
_PARKING_W, _PARKING_STEP_M = (200.0, 200.0), 3.0
"""The first parking spot, far outside any building, and how far apart they are."""


def parking_spot(index: int) -> tuple[float, float]:
    """Return world x, y of a slot's parking spot, or, with the number of slots for its index, of the robot's."""
    return _PARKING_W[0] + _PARKING_STEP_M * (index % 16), _PARKING_W[1] + _PARKING_STEP_M * (index // 16)


@dataclasses.dataclass(frozen=True)
class Slot:
    """A place that all scenes of a batch have for a movable body."""

    name: str
    kind: str
    """small, free, hinge or slide."""
    bodies: tuple[Body | None, ...]
    """[S] what each scene has there; None: nothing."""

    @functools.cached_property
    def n_boxes(self) -> int:
        """Return the largest number of boxes of a scene's body."""
        return max(len(body.boxes) for body in self.bodies if body is not None)

    @functools.cached_property
    def any_floats(self) -> bool:
        """Return whether some scene has nothing there, or a body that gravity does not move."""
        return any(body is None or bool(body.joint and body.joint.balanced) for body in self.bodies)


def find_slots(scenes: Sequence[Scene], small: Sequence[SmallObject]) -> list[Slot]:
    """Return slots for the small objects, then for each scene's bodies of each kind, most boxes first."""
    slots = [Slot(name, "small", (obj,) * len(scenes)) for name, obj in zip(body_names(small), small, strict=True)]
    for kind in ("free", "hinge", "slide"):
        movables = ([m for m in scene.movables if m.kind == kind] for scene in scenes)
        columns = itertools.zip_longest(*(sorted(bodies, key=lambda m: -len(m.boxes)) for bodies in movables))
        slots += [Slot(f"{kind}_{i}", kind, column) for i, column in enumerate(columns)]
    return slots


def bodies_by_name(scene: Scene, small: Sequence[SmallObject]) -> dict[str, Body]:
    """Return a scene's movable bodies and the small objects, by the names of their bodies in models."""
    return {m.name: m for m in scene.movables} | dict(zip(body_names(small), small, strict=True))


@dataclasses.dataclass(frozen=True)
class Layout:
    """Addresses in the models' state vectors; the same for every scene of a world."""

    robot_qpos: int
    """Address of the robot's free joint in qpos (7 numbers)."""
    robot_qvel: int
    robot_nq: int
    """Numbers of the robot in qpos, from its free joint on."""
    robot_nv: int
    slot_kind: tuple[str, ...]
    """Per movable slot: 'small', 'free', 'hinge' or 'slide'."""
    slot_qpos: np.ndarray
    """[M] address in qpos: 7 numbers, or 1 for a hinge or slide."""
    slot_qvel: np.ndarray
    """[M] address in qvel: 6 numbers, or 1."""
    slot_body: np.ndarray
    """[M] body ids."""
    robot_bodies: np.ndarray
    """Body ids of the robot's subtree."""
    structure_body: int
    wall_geoms: np.ndarray
    """[W] geom ids."""
    force_sensors: np.ndarray
    """[M + 1] addresses in sensordata of the net force (3) on each slot's body, then on the structure."""

    @property
    def num_slots(self) -> int:
        """Return M."""
        return len(self.slot_kind)

    def robot_state(self, qpos: Any, qvel: Any, time_s: Any) -> RobotState:
        """Return the robot's part of states [..., nq] and [..., nv]."""
        q, v = self.robot_qpos, self.robot_qvel
        return RobotState(qpos[..., q : q + self.robot_nq], qvel[..., v : v + self.robot_nv], time_s)


def find_layout(model: mujoco.MjModel, robot: RobotSpec, slots: list[tuple[str, str]]) -> Layout:
    def body(name: str) -> int:
        return mujoco.mj_name2id(model, mujoco.mjtObj.mjOBJ_BODY, name)

    joints = [model.body_jntadr[body(name)] for name, _ in slots]
    base = body(robot.base_body)
    joint = model.body_jntadr[base]
    subtree = [b for b in range(model.nbody) if b == base or model.body_rootid[b] == base]
    sensors = [model.sensor(f"force_{i}").adr[0] for i in range(len(slots))]
    width = {mujoco.mjtJoint.mjJNT_FREE: (7, 6), mujoco.mjtJoint.mjJNT_BALL: (4, 3)}
    joint_ids = [j for j in range(model.njnt) if model.jnt_bodyid[j] in subtree]
    assert joint_ids == list(range(joint, joint + len(joint_ids))), "a robot's joints must follow its free joint"
    sizes = [width.get(mujoco.mjtJoint(int(model.jnt_type[j])), (1, 1)) for j in joint_ids]
    return Layout(
        robot_qpos=int(model.jnt_qposadr[joint]),
        robot_qvel=int(model.jnt_dofadr[joint]),
        robot_nq=sum(q for q, _ in sizes),
        robot_nv=sum(v for _, v in sizes),
        slot_kind=tuple(kind for _, kind in slots),
        slot_qpos=np.asarray([model.jnt_qposadr[j] for j in joints], np.int32),
        slot_qvel=np.asarray([model.jnt_dofadr[j] for j in joints], np.int32),
        slot_body=np.asarray([body(name) for name, _ in slots], np.int32),
        robot_bodies=np.asarray(subtree, np.int32),
        structure_body=body("structure"),
        wall_geoms=np.flatnonzero(model.geom_bodyid == body("structure")),
        force_sensors=np.asarray([*sensors, model.sensor("force_structure").adr[0]], np.int32),
    )


@dataclasses.dataclass(frozen=True)
class SlotTables:
    """Holds the contents of the slots of a world: S scenes, M slots, B boxes; an empty slot has mass 0 and no boxes."""

    bodies: tuple[tuple[Body | None, ...], ...]
    """[S][M]"""
    names: tuple[tuple[str, ...], ...]
    """[S][M] names of the bodies, '' for an empty slot."""
    categories: tuple[tuple[str, ...], ...]
    """[S][M] categories of the same."""
    occupied: np.ndarray
    """[S, M] bool: the slot holds a body of the scene (small objects always do)."""
    mass_kg: np.ndarray
    """[S, M]"""
    friction: np.ndarray
    """[S, M] sliding friction."""
    com_b_m: np.ndarray
    """[S, M, 3] centres of mass."""
    box_slot: np.ndarray
    """[B] slot of each box; M: a wall."""
    boxes_b: np.ndarray
    """[S, B, 10] centre (3) in the body's frame, m, quaternion (4), half sizes (3), m, which are -1 for padding."""
    held: np.ndarray
    """[M] bool: a hinge or a slide ties it to the structure."""
    slides: np.ndarray
    """[M] bool: a slide does."""
    pos_w_m: np.ndarray
    """[S, M, 3] the bodies' frames at rest."""
    axes_w: np.ndarray
    """[S, M, 3, 3] axes of the same, as columns."""
    axis_b: np.ndarray
    """[S, M, 3] unit vector about which a held body turns, or along which it slides."""
    anchor_b_m: np.ndarray
    """[S, M, 3] a point of that axis."""

    def rows(self, scene: int, slot: int) -> np.ndarray:
        """Return the boxes [n, 10] of a slot in a scene, or of the scene's walls where `slot` is M."""
        rows = self.boxes_b[scene, self.box_slot == slot]
        return rows[rows[:, 7] > 0]

    def class_ids(self, classes: MaskClasses) -> np.ndarray:
        """Return segmentation ids [S, M + 1] u8 of what the slots hold, 0 for an empty one and for the walls."""
        ids = [[*(body.mask_id(classes) if body else 0 for body in row), 0] for row in self.bodies]
        return np.array(ids, np.uint8)


def build_slot_tables(
    slots: Sequence[Slot], scenes: Sequence[Scene], models: Sequence[mujoco.MjModel], layout: Layout
) -> SlotTables:
    """Build the tables of a world out of its scenes and their compiled models."""
    every = range(len(scenes))
    bodies = tuple(tuple(slot.bodies[s] for slot in slots) for s in every)
    boxes = [[*(b.rows if b else np.zeros((0, 10)) for b in bodies[s]), scenes[s].walls] for s in every]
    counts = [max(len(boxes[s][m]) for s in every) for m in range(len(slots) + 1)]
    box_slot = np.repeat(np.arange(len(counts)), counts)
    boxes_b = np.tile(np.array(_NO_BOX), (len(scenes), len(box_slot), 1))
    for s, m in itertools.product(every, range(len(counts))):
        boxes_b[s, np.flatnonzero(box_slot == m)[: len(boxes[s][m])]] = boxes[s][m]

    def values(of: str, empty: str | float) -> tuple:
        return tuple(tuple(getattr(body, of) if body else empty for body in row) for row in bodies)

    def field(name: str, rows: np.ndarray) -> np.ndarray:
        return np.stack([getattr(model, name)[rows] for model in models])

    def name(slot: Slot, s: int) -> str:
        return slot.name if slot.kind == "small" else getattr(slot.bodies[s], "name", "")

    occupied = np.array([[body is not None for body in row] for row in bodies], bool)
    body, joint = layout.slot_body, models[0].body_jntadr[layout.slot_body]
    return SlotTables(
        bodies=bodies,
        names=tuple(tuple(name(slot, s) for slot in slots) for s in every),
        categories=values("category", ""),
        occupied=occupied,
        mass_kg=occupied * field("body_mass", body),
        friction=np.array(values("friction", 0.0)),
        com_b_m=field("body_ipos", body),
        box_slot=box_slot,
        boxes_b=boxes_b,
        held=np.array([slot.kind in ("hinge", "slide") for slot in slots], bool),
        slides=np.array([slot.kind == "slide" for slot in slots], bool),
        pos_w_m=field("body_pos", body),
        axes_w=matrix_from_quat(field("body_quat", body)),
        axis_b=field("jnt_axis", joint),
        anchor_b_m=field("jnt_pos", joint),
    )
