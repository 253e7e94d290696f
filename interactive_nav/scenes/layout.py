"""Find where bodies are in the state vectors of compiled models of equal layout."""

import dataclasses

import mujoco
import numpy as np

from interactive_nav.robots import RobotSpec


@dataclasses.dataclass(frozen=True)
class Layout:
    """Where things are in the models' state vectors; the same for every scene of a world."""

    robot_qpos: int
    """Address of the robot's free joint in qpos (7 numbers)."""
    robot_qvel: int
    robot_nq: int
    """Numbers of the robot in qpos, from its free joint on."""
    robot_nv: int
    slot_kind: tuple[str, ...]
    """Per movable slot: 'small', 'free' or 'hinge'."""
    slot_qpos: np.ndarray
    """[M] address in qpos: 7 numbers, or 1 for a hinge."""
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
