"""The world's state in, how near each movable slot is to the robot and to what moves out.

A slot's body is the box that bounds it in its own frame, so a bed or a sofa is near where its side is near, at
whatever turn. Gaps are planar and never larger than the true ones: the largest of the gaps across the edges of
the boxes' shadows and between their centres (separating axes).
"""

from __future__ import annotations

import flax.struct
import jax
import jax.numpy as jnp
import mujoco
import numpy as np

from interactive_nav.physics.base import PhysicsState
from interactive_nav.scenes.spec import FEET
from interactive_nav.scenes.world import World
from interactive_nav_common.rotations import matrix_from_quat

REACH_M = 0.6
"""What is this near to the robot's footprint can be met, itself or behind something that is pushed."""
TOUCH_M = 0.15
"""What is this near to a moving object can be met by it: at 1 m/s it moves 0.1 m in a control step."""
MOVING_M_S = 0.02
_MOVERS = 2
"""Moving objects that others are measured against: the fastest."""
FAR_M = 1e6


@flax.struct.dataclass
class Boxes:
    """Bounding boxes in the world, seen from above."""

    centre: jax.Array
    """[M, 2] m"""
    axes: jax.Array
    """[M, 2, 3] planar parts of the box's three unit axes."""
    half: jax.Array
    """[M, 3] half sizes, m"""

    def gap_m(self, centre: jax.Array, axes: jax.Array, half: jax.Array) -> jax.Array:
        """[M] from each box to one other, whose `half` is 0 for a point; at most 0 where they overlap."""
        between = self.centre - centre[None]
        others = jnp.broadcast_to(axes[None], self.axes.shape)
        edges = jnp.concatenate([self.axes, others], -1)
        across = jnp.stack([-edges[:, 1], edges[:, 0]], 1)
        ways = jnp.concatenate([between[:, :, None], across], -1)
        ways = ways / jnp.maximum(jnp.linalg.norm(ways, axis=1, keepdims=True), 1e-6)
        apart = jnp.abs(jnp.einsum("mpw,mp->mw", ways, between))
        own = jnp.einsum("mwa,ma->mw", jnp.abs(jnp.einsum("mpw,mpa->mwa", ways, self.axes)), self.half)
        theirs = jnp.abs(jnp.einsum("mpw,pa->mwa", ways, axes)) @ half
        return (apart - own - theirs).max(-1)


class Nearness:
    """Where the world's movable slots are, in a scene and a state."""

    def __init__(self, world: World):
        layout = world.layout
        self.hinge = np.asarray(layout.slot_kind) == "hinge"
        self._qpos = layout.slot_qpos[:, None] + np.where(self.hinge[:, None], 0, np.arange(7))
        self._qvel = layout.slot_qvel[:, None] + np.where(self.hinge[:, None], 0, np.arange(6))
        self._robot = layout.robot_qpos
        self._occupied = jnp.asarray(world.occupied)
        made = [_rest(model, layout.slot_body, self.hinge) for model in world.models]
        tables = (jnp.asarray(np.stack(t), jnp.float32) for t in zip(*made, strict=True))
        self._offset_m, self._half_m, self._frame, self._anchor_m, self._sense = tables

    def boxes(self, scene: jax.Array, state: PhysicsState) -> Boxes:
        """Of all slots of one environment."""
        qpos = state.qpos[self._qpos]
        angle = qpos[:, 0] * self._sense[scene]
        half_angle = jnp.stack([jnp.cos(angle / 2), 0 * angle, 0 * angle, jnp.sin(angle / 2)], -1)
        turn = matrix_from_quat(half_angle)
        leaf = turn @ self._frame[scene]
        hung = self._anchor_m[scene] + jnp.einsum("mij,mj->mi", turn, self._offset_m[scene])
        free = matrix_from_quat(qpos[:, 3:] / jnp.maximum(jnp.linalg.norm(qpos[:, 3:], axis=-1, keepdims=True), 1e-6))
        placed = qpos[:, :3] + jnp.einsum("mij,mj->mi", free, self._offset_m[scene])
        hinge = jnp.asarray(self.hinge)
        axes = jnp.where(hinge[:, None, None], leaf, free)
        centre = jnp.where(hinge[:, None], hung, placed)
        return Boxes(centre[:, :2], axes[:, :2], self._half_m[scene])

    def measure(self, scene: jax.Array, state: PhysicsState, reach_m: float) -> tuple[jax.Array, jax.Array]:
        """How far each slot is from where it can be met: within `reach_m` of the robot, or `TOUCH_M` of what moves.

        Returns:
            [M] m, negative where it can be met, `FAR_M` for empty slots; [M] whether it moves.
        """
        boxes, occupied = self.boxes(scene, state), self._occupied[scene]
        robot = state.qpos[self._robot : self._robot + 2]
        gap = boxes.gap_m(robot, jnp.eye(2, 3), jnp.zeros(3)) - reach_m
        speed = jnp.where(occupied, jnp.abs(state.qvel[self._qvel]).max(-1), 0.0)
        moving = speed > MOVING_M_S
        fastest, movers = jax.lax.top_k(speed, min(_MOVERS, len(self.hinge)))
        for k in range(len(movers)):
            one = movers[k]
            behind = boxes.gap_m(boxes.centre[one], boxes.axes[one], boxes.half[one]) - TOUCH_M
            behind = jnp.where(jnp.arange(len(self.hinge)) == one, FAR_M, behind)
            gap = jnp.where(fastest[k] > MOVING_M_S, jnp.minimum(gap, behind), gap)
        return jnp.where(occupied, gap, FAR_M), moving


def _rest(model: mujoco.MjModel, bodies: np.ndarray, hinge: np.ndarray) -> tuple[np.ndarray, ...]:
    """Of each slot: the box's centre and half sizes in its body's frame; for hinges, from the joint's anchor in the
    world at rest, with the body's matrix, the anchor, and the joint's sense about the world's z."""
    data = mujoco.MjData(model)
    mujoco.mj_kinematics(model, data)
    count = len(bodies)
    offset, half, anchor = np.zeros((count, 3)), np.zeros((count, 3)), np.zeros((count, 3))
    frame, sense = np.tile(np.eye(3), (count, 1, 1)), np.zeros(count)
    for k, body in enumerate(bodies):
        geoms = slice(model.body_geomadr[body], model.body_geomadr[body] + model.body_geomnum[body] - FEET)
        if geoms.stop > geoms.start:
            turn = matrix_from_quat(model.geom_quat[geoms])
            middle = model.geom_pos[geoms] + np.einsum("gij,gj->gi", turn, model.geom_aabb[geoms, :3])
            extent = np.einsum("gij,gj->gi", np.abs(turn), model.geom_aabb[geoms, 3:])
            low, high = (middle - extent).min(0), (middle + extent).max(0)
            offset[k], half[k] = (low + high) / 2, (high - low) / 2
        if hinge[k]:
            joint = model.body_jntadr[body]
            frame[k], anchor[k] = data.xmat[body].reshape(3, 3), data.xanchor[joint]
            offset[k] = frame[k] @ offset[k] + data.xpos[body] - anchor[k]
            sense[k] = np.sign(data.xaxis[joint, 2])
    return offset, half, frame, anchor, sense
