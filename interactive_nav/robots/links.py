"""Compute where a robot's bodies are, and how its joints move them, with NumPy or JAX."""

import dataclasses
import functools
from collections.abc import Sequence

import mujoco
import numpy as np

from interactive_nav_common.rotations import Array, apply_axes, compose, matrix_from_quat, namespace, swing

_ORIGIN = np.zeros(3)


@dataclasses.dataclass(frozen=True)
class Link:
    """A body of the robot's in its parent's frame at rest, and the joints that carry it."""

    parent: int
    """Its index among the links; 0 is the base."""
    pos: np.ndarray
    """(3,), m."""
    axes: np.ndarray
    """(3, 3), as columns."""
    joints: tuple[tuple[bool, int, float, np.ndarray, np.ndarray], ...]
    """(slides, address in qpos, qpos0, axis (3,), anchor (3,) in m), in order; both in the body's frame."""


@dataclasses.dataclass(frozen=True)
class Links:
    """The robot's bodies, its base first and parents before their children."""

    base_qpos: int
    """Address of the base's free joint in qpos."""
    rest: tuple[Link, ...]
    """All but the base."""

    def frames(self, qpos: Array) -> list[tuple[Array, Array]]:
        """Return world frames of the base and the rest, [..., 3], m, and [..., 3, 3], for `qpos` [..., nq]."""
        at, constant = self.base_qpos, functools.partial(repeated, qpos)
        frames = [(qpos[..., at : at + 3], matrix_from_quat(qpos[..., at + 3 : at + 7]))]
        for link in self.rest:
            pos, axes = frames[link.parent]
            pos, axes = pos + apply_axes(axes, constant(link.pos)), compose(axes, constant(link.axes))
            for slides, address, zero, axis, anchor in link.joints:
                value, axis = qpos[..., address] - zero, constant(axis)
                if slides:
                    pos = pos + apply_axes(axes, axis) * value[..., None]
                    continue
                arm, turn = swing(axis, constant(anchor), value)
                pos = pos + apply_axes(axes, arm)
                axes = compose(axes, turn)
            frames.append((pos, axes))
        return frames

    def jacobian(self, qpos: Array, link: int, joints: Sequence[int], point_b: np.ndarray = _ORIGIN) -> Array:
        """Return [..., 3, J]: how fast a link's point moves in the base's frame, m/rad or m/m, with each joint.

        `joints` are addresses in `qpos` [..., nq], of joints that carry the link; 0 is the base among the links. The
        point `point_b` (3,), m, is in the link's frame; by default, it is the origin.
        """
        xp, frames, columns = namespace(qpos), self.frames(qpos), {}
        base, place = frames[0][1], frames[link][0] + apply_axes(frames[link][1], repeated(qpos, point_b))
        for (pos, axes), carried in zip(frames[1:], self.rest, strict=True):
            for slides, address, _, axis, anchor in carried.joints:  # neither moves its own axis
                axis_w, anchor_w = (apply_axes(axes, repeated(qpos, each)) for each in (axis, anchor))
                columns[address] = axis_w if slides else xp.cross(axis_w, place - pos - anchor_w)
        return xp.stack([apply_axes(base.swapaxes(-1, -2), columns[at]) for at in joints], -1)


def repeated(qpos: Array, value: np.ndarray) -> Array:
    """Return a constant with the leading axes and the type of qpos [..., nq]."""
    xp = namespace(qpos)
    return xp.broadcast_to(xp.asarray(value, qpos.dtype), (*qpos.shape[:-1], *value.shape))


def make_links(model: mujoco.MjModel, bodies: Sequence[int], first_qpos: int = 0) -> Links:
    """Return the links of a model's bodies: the one with the free joint first, parents before children.

    Addresses count from `first_qpos`.
    """
    rest = []
    for body in bodies[1:]:
        joints = []
        for j in range(model.body_jntadr[body], model.body_jntadr[body] + model.body_jntnum[body]):
            slides = model.jnt_type[j] == mujoco.mjtJoint.mjJNT_SLIDE
            address = int(model.jnt_qposadr[j])
            zero, axis, anchor = float(model.qpos0[address]), model.jnt_axis[j], model.jnt_pos[j]
            joints.append((bool(slides), address - first_qpos, zero, axis, anchor))
        parent = list(bodies).index(model.body_parentid[body])
        rest.append(Link(parent, model.body_pos[body], matrix_from_quat(model.body_quat[body]), tuple(joints)))
    return Links(int(model.jnt_qposadr[model.body_jntadr[bodies[0]]]) - first_qpos, tuple(rest))
