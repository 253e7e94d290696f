"""Measure how near each movable slot and wall is to the robot and to moving objects.

A slot's body is its oriented bounding box. Gaps are planar lower bounds of the true ones, by separating axes: the
largest of the gaps across the edges of the boxes' shadows and between their centres.
"""

import functools
from collections.abc import Mapping
from typing import Any

import flax.struct
import jax
import jax.numpy as jnp
import numpy as np

from interactive_nav.physics.base import PhysicsState
from interactive_nav.scenes.slots import SlotTables
from interactive_nav.scenes.world import World
from interactive_nav_common.rotations import Array, matrix_from_quat, namespace

REACH_M = 0.6
"""What is this near to the robot's footprint can be met, itself or behind something that is pushed."""
TOUCH_M = 0.15
"""What is this near to a moving object can be met by it: at 1 m/s it moves 0.1 m in a control step."""
MOVING_M_S = 0.05
"""Or rad/s. What rests in the solver's tolerance turns by up to 0.02."""
_COASTING_M_S = 0.005
"""Or rad/s, of what a hinge or slide holds: at 0.05 rad/s a door of 30 kg still turns by 3 degrees."""
_TIPPING_M_S2 = 1.0
"""Or rad/s2, of free bodies: what tips or falls stands still where it turns round, but is not at rest."""
_PUSH_M = 0.3
"""Objects this near to the robot's footprint may be pushed before the window is chosen again."""
_PUSHED = 4
"""Objects that walls are measured against: the nearest that move or may be pushed."""
_MOVERS = 2
"""Moving objects that others are measured against: the fastest."""
FAR_M = 1e6
_PLACES = 4000
"""Of the robot, at which a window's size is measured: of all scenes together, but at least 200 in each."""
_AT_ONCE = 100
"""Places that are measured in one go."""
SHARE = 0.999
"""Of these places a window has room for what stands near."""
Measured = tuple[Any, Any, Any]
"""What `Nearness.measure` returns."""


@flax.struct.dataclass
class Boxes:
    """Bounding boxes in the world, from above; leading axes may stand before these."""

    centre: Array
    """[M, 2] m"""
    axes: Array
    """[M, 2, 3] planar parts of the box's three unit axes, or of the two that are not vertical."""
    half: Array
    """[M, 3] half sizes along these, m"""

    def gap_m(self, centre: Array, axes: Array, half: Array) -> Array:
        """Return [..., M] m from each box to one other, whose `half` is 0 for a point; at most 0 where they overlap."""
        xp = namespace(self.centre, centre)
        x_m, y_m = (self.centre[..., i] - centre[..., i, None] for i in range(2))
        mine = [(*(self.axes[..., i, k] for i in range(2)), self.half[..., k]) for k in range(self.axes.shape[-1])]
        mine += [(*(axes[..., i, k, None] for i in range(2)), half[..., k, None]) for k in range(axes.shape[-1])]
        gaps = []
        for x, y in ((x_m, y_m), *((-y, x) for x, y, _ in mine)):
            sizes = (xp.abs(x * side_x + y * side_y) * size for side_x, side_y, size in mine)
            gaps.append((xp.abs(x * x_m + y * y_m) - sum(sizes)) / xp.maximum(xp.sqrt(x * x + y * y), 1e-6))
        # Nothing is less than 0 away from what is upright: its third axis, whose shadow is a point, parts nothing.
        return functools.reduce(xp.maximum, gaps, 0.0 if min(self.axes.shape[-1], axes.shape[-1]) < 3 else -xp.inf)


class Nearness:
    """Where the world's movable slots and walls are, in a scene and a state."""

    def __init__(self, world: World):
        self.world, layout, slots = world, world.layout, world.slots
        self.held, self._slides = slots.held, slots.slides[:, None]
        self._qpos = layout.slot_qpos[:, None] + np.where(self.held[:, None], 0, np.arange(7))
        self._qvel = layout.slot_qvel[:, None] + np.where(self.held[:, None], 0, np.arange(6))
        self._robot = layout.robot_qpos + np.arange(2)
        self._moving = np.where(self.held, _COASTING_M_S, MOVING_M_S)
        (offset, half), arm = _bounds(slots), slots.anchor_b_m
        # A hinge's angle turns the box's axes, and the way to its centre: a part stays, two go with cosine and sine.
        turned = np.concatenate([slots.axes_w, slots.axes_w @ (offset - arm)[..., None]], -1)
        anchor, axis = (slots.axes_w @ v[..., None] for v in (arm, slots.axis_b))
        stays = np.where(self._slides[..., None], turned, axis * (axis * turned).sum(-2, keepdims=True))
        parts = [stays, turned - stays, np.where(self._slides[..., None], 0.0, np.cross(axis, turned, axis=-2))]
        parts[0][..., 3:] += slots.pos_w_m[..., None] + anchor
        tables = (offset, half, *(part[..., :2, :] for part in parts), (axis[..., 0] * self._slides)[..., :2])
        self._tables = tuple(t.astype(np.float32) for t in tables)
        walls = slots.boxes_b[:, slots.box_slot == layout.num_slots]
        axes = matrix_from_quat(walls[..., 3:7])[..., :2, :2]
        self._walls = tuple(t.astype(np.float32) for t in (walls[..., :2], axes, walls[..., 7:9], walls[..., 7] > 0))

    def boxes(self, scene: Array, state: PhysicsState) -> Boxes:
        """Return those of all slots of one environment, or, in NumPy, of many of one scene."""
        xp = namespace(state.qpos)
        offset, half, stays, cosine, sine, slide = (xp.asarray(t)[scene] for t in self._tables)
        qpos = state.qpos[..., self._qpos]
        angle, quat = qpos[..., :1], qpos[..., 3:]
        turned = stays + xp.cos(angle)[..., None] * cosine + xp.sin(angle)[..., None] * sine
        quat = quat / xp.maximum(xp.linalg.norm(quat, axis=-1, keepdims=True), 1e-6)
        free, held = matrix_from_quat(quat)[..., :2, :], xp.asarray(self.held)[:, None]
        placed = qpos[..., :2] + sum(free[..., k] * offset[..., k, None] for k in range(3))
        centre = xp.where(held, turned[..., 3] + angle * slide, placed)
        return Boxes(centre, xp.where(held[..., None], turned[..., :3], free), half)

    def _walls_gap_m(self, scene: Array, state: PhysicsState, reach_m: float, boxes: Boxes, push_m: Array) -> Array:
        """Return [..., W] m to where walls are met: within `reach_m` of the robot, or `TOUCH_M` of what it may push."""
        xp = namespace(state.qpos)
        xpos, xmat, half, used = (xp.asarray(t)[scene] for t in self._walls)
        away = state.qpos[..., None, self._robot] - xpos
        offset = sum(away[..., k, None] * xmat[..., k, :] for k in range(2))
        outside = xp.maximum(xp.abs(offset) - half, 0.0)
        gap = xp.where(used > 0, xp.linalg.norm(outside, axis=-1), FAR_M) - reach_m
        walls, count = Boxes(xpos, xmat, half), min(_PUSHED, push_m.shape[-1])
        nearest = np.argsort(push_m) if xp is np else jax.lax.top_k(-push_m, count)[1]
        for k in range(count):
            one = nearest[..., k]
            at = (np.arange(len(one)), one) if one.ndim else one
            if xp is np and (push_m[at] >= 0).all():
                break
            behind = walls.gap_m(boxes.centre[at], boxes.axes[at], boxes.half[one]) - TOUCH_M
            gap = xp.where((push_m[at] < 0)[..., None] & (used > 0), xp.minimum(gap, behind), gap)
        return gap

    def measure(self, scene: Array, state: PhysicsState, reach_m: float) -> Measured:
        """Return each slot's distance beyond its range: `reach_m` of the robot or `TOUCH_M` of moving objects.

        This is [M] m, negative within range, `FAR_M` for empty slots; then [M] whether it moves, and [W] m of the
        walls, see `_walls_gap_m`.
        """
        boxes, occupied = self.boxes(scene, state), jnp.asarray(self.world.slots.occupied)[scene]
        gap = boxes.gap_m(state.qpos[self._robot], jnp.eye(2), jnp.zeros(2)) - reach_m
        speed = jnp.where(occupied, jnp.abs(state.qvel[self._qvel]).max(-1), 0.0)
        turning = jnp.abs(state.qacc_warmstart[self._qvel]).max(-1) > jnp.where(self.held, jnp.inf, _TIPPING_M_S2)
        moving = (speed > self._moving) | (turning & occupied)
        push = jnp.where(moving, -FAR_M, gap + (REACH_M - _PUSH_M))
        _, movers = jax.lax.top_k(speed, min(_MOVERS, len(self.held)))
        for k in range(len(movers)):
            one = movers[k]
            behind = boxes.gap_m(boxes.centre[one], boxes.axes[one], boxes.half[one]) - TOUCH_M
            behind = jnp.where(jnp.arange(len(self.held)) == one, FAR_M, behind)
            behind = jnp.where(moving[one], behind, FAR_M)
            gap, push = jnp.minimum(gap, behind), jnp.minimum(push, behind)
        walls = self._walls_gap_m(scene, state, reach_m, boxes, jnp.where(occupied, push, FAR_M))
        # XLA would measure again in each kernel that reads the result.
        return jax.lax.optimization_barrier((jnp.where(occupied, gap, FAR_M), moving, walls))

    def counts(self, reach_m: float) -> dict[str, np.ndarray]:
        """Return [P] how many of each kind of slot, and of walls, are near at rest, the robot and the small objects
        anywhere on free floor."""
        world, rng, kinds = self.world, np.random.default_rng(0), np.asarray(self.world.layout.slot_kind)
        small, most = np.flatnonzero(kinds == "small"), max(200, _PLACES // len(self.world.scenes))
        counts: dict[str, list[np.ndarray]] = {kind: [] for kind in ("small", "free", "hinge", "slide", "walls")}
        for scene, (source, rest) in enumerate(zip(world.scenes, world.rest_qpos, strict=True)):
            maps, cells, shape = source.maps, np.argwhere(source.maps.traversable)[:, ::-1], (1 + len(small), 2)
            for first in range(0, most, _AT_ONCE):
                many = range(first, min(first + _AT_ONCE, most))
                drawn = [cells[rng.integers(len(cells), size=shape[0])] + rng.random(shape) for _ in many]
                places = (np.asarray(maps.origin_w) + maps.resolution_m * np.stack(drawn)).astype(np.float32)
                qpos = np.tile(np.asarray(rest, np.float32), (len(places), 1))
                qpos[:, self._robot], qpos[:, self._qpos[small, :2]] = places[:, 0], places[:, 1:]
                state = PhysicsState(qpos, np.zeros(0), np.zeros(0))
                boxes = self.boxes(scene, state)
                gap = np.where(world.slots.occupied[scene], boxes.gap_m(places[:, 0], np.eye(2), np.zeros(2)), FAR_M)
                walls = self._walls_gap_m(scene, state, reach_m, boxes, gap - reach_m + (REACH_M - _PUSH_M)) < 0
                for kind, values in counts.items():
                    values.append((walls if kind == "walls" else (gap < reach_m)[:, kinds == kind]).sum(-1))
        return {kind: np.concatenate(values) for kind, values in counts.items()}


def widths_at(counts: Mapping[str, np.ndarray]) -> dict[str, int]:
    """Return, of each kind, what suffices in `SHARE` of the counts; at least one, since 0 stands for all."""
    return {k: max(1, int(np.quantile(c, SHARE, method="higher"))) for k, c in counts.items()}


def _bounds(slots: SlotTables) -> tuple[np.ndarray, np.ndarray]:
    """Return centres and half sizes [S, M, 3], m, of the boxes around each slot's in its body's frame, 0 where none."""
    bounds = np.zeros((2, *slots.occupied.shape, 3))
    for s, m in np.argwhere(slots.occupied):
        rows = slots.rows(s, m)
        extent = np.einsum("gij,gj->gi", np.abs(matrix_from_quat(rows[:, 3:7])), rows[:, 7:])
        low, high = (rows[:, :3] - extent).min(0), (rows[:, :3] + extent).max(0)
        bounds[:, s, m] = (low + high) / 2, (high - low) / 2
    return bounds[0], bounds[1]
