"""The original's engine on the same scene and cores: settings in, one JSON row with the ratio out.

    python -m docs.studies.pybullet_peer --scene scenes_mjcf/apartment_0

PyBullet steps one environment at a time, as Interactive Gibson did: four substeps of 1/40 s per control step of
0.1 s, velocity motors without a torque limit, one query of the robot's contacts per substep, new random wheel
commands at every control step. Furniture, walls and small objects are the same boxes, masses and friction
coefficients; doors hang on hinges. Beside it, in the same run and without observation, reward or reset on either
side, the project's `native` backend steps 64 environments, with one thread and with all. Needs the extra `pybullet`.
"""

from __future__ import annotations

import math
import os
import time
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

import interactive_nav
from benchmarks.steps_per_second import SCENE, append_row, origin, random_driving, timed
from docs.studies import command_line
from interactive_nav.config import NavConfig
from interactive_nav.physics import PhysicsState, make_physics
from interactive_nav.robots import get_robot
from interactive_nav.scenes.scene import load_scene
from interactive_nav.scenes.world import build_world
from interactive_nav_common.errors import missing, optional

WHEEL_RADIUS_M, HALF_TRACK_M, BODY_RADIUS_M = 0.0352, 0.115, 0.176


def _xyzw(quat_wxyz: np.ndarray) -> list[float]:
    return [*quat_wxyz[1:], quat_wxyz[0]]


class BulletScene:
    """A scene, small objects and a TurtleBot in PyBullet."""

    def __init__(self, world, qpos: np.ndarray):
        """Builds everything from the world's first scene at a given state [nq]."""
        bullet = self.bullet = optional("pybullet", missing("the peer", "pybullet", "pybullet"))
        bullet.connect(bullet.DIRECT)
        bullet.setGravity(0, 0, -9.81)
        plane = bullet.createCollisionShape(bullet.GEOM_PLANE)
        floor = bullet.createMultiBody(0, plane)
        bullet.changeDynamics(floor, -1, lateralFriction=1.0)
        scene, layout = world.scenes[0], world.layout
        for row in scene.walls:
            shape = bullet.createCollisionShape(bullet.GEOM_BOX, halfExtents=list(row[7:10]))
            bullet.createMultiBody(0, shape, basePosition=list(row[:3]), baseOrientation=_xyzw(row[3:7]))
        furniture = {m.name: m for m in scene.movables}
        for k, (name, kind, at) in enumerate(
            zip(world.slots.names[0], layout.slot_kind, layout.slot_qpos, strict=True)
        ):
            if kind == "small":
                obj = world.small_objects[k]
                boxes = obj.rows
                mass, friction = obj.mass_kg, obj.friction
                pos, quat = qpos[at : at + 3], qpos[at + 3 : at + 7]
            elif name:
                movable = furniture[name]
                boxes, mass, friction = movable.boxes, movable.mass_kg, movable.friction
                pos, quat = movable.pos_w, movable.quat_w
                if kind == "free":
                    pos, quat = qpos[at : at + 3], qpos[at + 3 : at + 7]
            else:
                continue
            shape = bullet.createCollisionShapeArray(
                shapeTypes=[bullet.GEOM_BOX] * len(boxes),
                halfExtents=[list(b[7:10]) for b in boxes],
                collisionFramePositions=[list(b[:3]) for b in boxes],
                collisionFrameOrientations=[_xyzw(b[3:7]) for b in boxes],
            )
            if kind == "hinge":
                hinge = furniture[name].joint
                body = bullet.createMultiBody(
                    0,
                    basePosition=list(pos),
                    baseOrientation=_xyzw(quat),
                    linkMasses=[mass],
                    linkCollisionShapeIndices=[shape],
                    linkVisualShapeIndices=[-1],
                    linkPositions=[list(hinge.anchor_m)],
                    linkOrientations=[[0, 0, 0, 1]],
                    linkInertialFramePositions=[[0, 0, 0]],
                    linkInertialFrameOrientations=[[0, 0, 0, 1]],
                    linkParentIndices=[0],
                    linkJointTypes=[bullet.JOINT_REVOLUTE],
                    linkJointAxis=[list(hinge.axis)],
                )
                bullet.setJointMotorControl2(body, 0, bullet.VELOCITY_CONTROL, force=hinge.frictionloss)
            else:
                body = bullet.createMultiBody(mass, shape, basePosition=list(pos), baseOrientation=_xyzw(quat))
                bullet.changeDynamics(body, -1, lateralFriction=friction)
        self.robot = self._turtlebot()

    def _turtlebot(self) -> int:
        bullet = self.bullet
        disc = bullet.createCollisionShapeArray(
            shapeTypes=[bullet.GEOM_CYLINDER, bullet.GEOM_BOX, bullet.GEOM_SPHERE, bullet.GEOM_SPHERE],
            radii=[BODY_RADIUS_M, 0, 0.017, 0.017],
            lengths=[0.1094, 0, 0, 0],
            halfExtents=[[0, 0, 0], [0.12, 0.12, 0.1428], [0, 0, 0], [0, 0, 0]],
            collisionFramePositions=[[0, 0, 0.0697], [0, 0, 0.2672], [0.115, 0, 0.0172], [-0.135, 0, 0.0192]],
        )
        wheel = bullet.createCollisionShape(bullet.GEOM_CYLINDER, radius=WHEEL_RADIUS_M, height=0.02)
        turned = bullet.getQuaternionFromEuler([math.pi / 2, 0, 0])
        robot = bullet.createMultiBody(
            2.473,
            disc,
            linkMasses=[0.1, 0.1],
            linkCollisionShapeIndices=[wheel, wheel],
            linkVisualShapeIndices=[-1, -1],
            linkPositions=[[0, HALF_TRACK_M, WHEEL_RADIUS_M], [0, -HALF_TRACK_M, WHEEL_RADIUS_M]],
            linkOrientations=[turned, turned],
            linkInertialFramePositions=[[0, 0, 0]] * 2,
            linkInertialFrameOrientations=[[0, 0, 0, 1]] * 2,
            linkParentIndices=[0, 0],
            linkJointTypes=[bullet.JOINT_REVOLUTE] * 2,
            linkJointAxis=[[0, 0, -1]] * 2,
        )
        bullet.changeDynamics(robot, -1, lateralFriction=0.0)
        for link in (0, 1):
            bullet.changeDynamics(robot, link, lateralFriction=1.0)
        return robot

    def place(self, xy: np.ndarray, yaw: float) -> None:
        """Puts the robot at a pose."""
        turned = self.bullet.getQuaternionFromEuler([0, 0, yaw])
        self.bullet.resetBasePositionAndOrientation(self.robot, [*xy, 0.002], turned)

    def rate(self, steps: int, substeps: int, rng: np.random.Generator) -> tuple[float, float]:
        """Environment steps per second of random driving, and the distance that the robot went, m."""
        bullet = self.bullet
        bullet.setTimeStep(0.1 / substeps)
        travelled, before = 0.0, np.array(bullet.getBasePositionAndOrientation(self.robot)[0])
        clock = time.perf_counter()
        for _ in range(steps):
            for link, speed in enumerate(rng.uniform(-12.5, 25.0, 2)):
                bullet.setJointMotorControl2(self.robot, link, bullet.VELOCITY_CONTROL, targetVelocity=speed)
            for _ in range(substeps):
                bullet.stepSimulation()
                bullet.getContactPoints(self.robot)
            now = np.array(bullet.getBasePositionAndOrientation(self.robot)[0])
            travelled, before = travelled + float(np.linalg.norm(now - before)), now
        return steps / (time.perf_counter() - clock), travelled


def _starts(world, env, count: int) -> tuple[np.ndarray, Any]:
    keys = jax.random.split(jax.random.PRNGKey(0), count)
    state = jax.jit(jax.vmap(env.reset))(keys)
    return np.asarray(state.pipeline_state.qpos), state


def native_rate(world, config: NavConfig, qpos: np.ndarray, steps: int) -> float:
    """Environment steps per second of the native backend alone, 20 control steps a program."""
    physics = make_physics(world, config)
    still = jnp.zeros((len(qpos), world.models[0].nv), jnp.float32)
    state = PhysicsState(jnp.asarray(qpos, jnp.float32), still, still)
    scene = jnp.zeros(len(qpos), jnp.int32)

    def step(state, command):
        return jax.vmap(physics.step)(scene, state, command)[0], None

    program, seconds = jax.jit(random_driving(step, (len(qpos), 2), 20, -12.5, 25.0)), []
    for i in range(1 + max(1, steps // 20)):
        (state, _), took_s = timed(program, state, jax.random.PRNGKey(i))
        seconds.append(took_s)
    return float(np.median([20 * len(qpos) / s for s in seconds[1:]]))  # the first call compiles


def main() -> None:
    """Measures and appends a row."""
    parser = command_line(__doc__, "pybullet_peer")
    parser.add_argument("--scene", default=SCENE)
    parser.add_argument("--steps", type=int, default=400, help="control steps of PyBullet, and of each environment")
    parser.add_argument("--num-envs", type=int, default=64, help="of the native backend")
    args = parser.parse_args()
    scene = load_scene(args.scene)
    env = interactive_nav.make("turtlebot", [args.scene], backend="native")
    world = build_world(get_robot("turtlebot"), (scene,), NavConfig())
    qpos, state = _starts(world, env, args.num_envs)
    bullet = BulletScene(world, qpos[0])
    nav = state.info["nav"]
    rng = np.random.default_rng(0)
    peers: dict[str, list[float]] = {"4x1/40": [], "24x1/240": []}
    travelled = 0.0
    for i in range(4):
        bullet.place(np.asarray(nav.start_xy_w[i]), float(nav.yaw_rad[i]))
        for name, substeps in (("4x1/40", 4), ("24x1/240", 24)):
            rate, went = bullet.rate(args.steps // (1 if substeps == 4 else 4), substeps, rng)
            peers[name].append(rate)
            travelled += went
    cores = os.cpu_count() or 1
    native = {
        f"native_{threads}_threads": native_rate(world, NavConfig.of(threads=threads), qpos, args.steps)
        for threads in sorted({1, cores})
    }
    row = {
        "scene": args.scene,
        "movables": int(world.slots.occupied[0].sum()),
        "walls": len(scene.walls),
        "pybullet_env_steps_per_s": {k: round(float(np.median(v))) for k, v in peers.items()},
        "pybullet_travelled_m": round(travelled, 1),
        **{k: round(v) for k, v in native.items()},
        "ratio_same_cores": round(native[f"native_{cores}_threads"] / (cores * float(np.median(peers["4x1/40"]))), 2),
        "ratio_one_thread": round(native["native_1_threads"] / float(np.median(peers["4x1/40"])), 2),
        "cores": cores,
        "load_before": os.getloadavg()[0],
        **origin(args.commit),
    }
    append_row(args.out, row)


if __name__ == "__main__":
    main()
