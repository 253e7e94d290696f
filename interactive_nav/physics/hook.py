"""Pull or lift what a wheeled robot reaches by a hook: a spring and a damper of limited force, on any backend.

The hook is a point at the robot's front, or the grip of a hand that the control mode moves. It couples to a point that
is fixed in a body's frame, and in every physics substep pulls the two together. A hand also bears the weight of what it
holds. Functions take NumPy or JAX arrays with any leading axes.
"""

import jax.numpy as jnp
import numpy as np

from interactive_nav.config import NavConfig
from interactive_nav.physics.base import PhysicsState
from interactive_nav.robots.links import make_links
from interactive_nav.robots.spec import RobotState
from interactive_nav.scenes.slots import Layout
from interactive_nav.scenes.world import World
from interactive_nav_common.errors import ConfigError
from interactive_nav_common.rotations import Array, apply_axes, compose, matrix_from_quat, namespace, swing

COUPLING_M = 0.1
"""The hook couples to bodies within this distance, in the plane and in height."""
TORN = -2
"""Stands for a slot after a body was torn away in the last control step."""
NONE = np.array([-1, 0, 0, 0, 1, 0, 0, 0], np.float32)
"""`PhysicsState.hook` of a hook that holds nothing. Its numbers are the slot; the coupled point in the body's frame, m;
the inverse of the reduced mass of robot and body, 1/kg; and the coupled point in the world frame, m."""
TORN_M = 0.2
"""A body whose coupled point is farther than this from the hook is torn away."""
HEIGHT_M = 0.15
"""The hook's height above the floor: a bumper's."""
_STIFFNESS, _DAMPING = 0.25, 1.0
"""Shares of the force that would undo the stretch, and stop its growth, within one substep. This is critical damping,
and stable: semi-implicit steps are where stiffness + 2 damping < 4."""
_Motion = tuple[Array, Array, Array, Array]
"""A body's position [..., 3], axes [..., 3, 3] and velocity [..., 3], world frame, and angular velocity, body frame."""


def spring_force(
    stretch_m: Array, speed_m_s: Array, mobility: Array, step_s: float, most_n: float, borne_n: Array | float = 0.0
) -> Array:
    """Return the force [..., 3], N, along `stretch_m` [..., 3], of norm at most `most_n`, and 0 beyond `TORN_M`.

    `speed_m_s` [..., 3] is the rate at which the stretch grows. With `mobility` [...], 1/kg, the inverse of the reduced
    mass, light and heavy bodies follow in the same time. `borne_n` [..., 3] is added to what the spring wants.
    """
    xp = namespace(stretch_m, mobility)
    wanted = (_STIFFNESS * stretch_m / step_s**2 + _DAMPING * speed_m_s / step_s) / mobility[..., None] + borne_n
    share = most_n / xp.maximum(xp.sqrt((wanted**2).sum(-1)), most_n)
    near = (stretch_m**2).sum(-1) <= TORN_M**2
    return xp.where(near[..., None], wanted * share[..., None], 0.0)


def _point(motion: _Motion, point_b: Array) -> tuple[Array, Array]:
    """Return where a point [..., 3] of a body is, m, and its velocity, m/s, in the world frame."""
    (place, axes, velocity, spin), xp = motion, namespace(motion[0])
    return place + apply_axes(axes, point_b), velocity + apply_axes(axes, xp.cross(spin, point_b))


class Hook:
    """Couples a world's robot to movable bodies, and computes the forces between them."""

    def __init__(self, world: World, config: NavConfig):
        slots, robot, self.layout = world.slots, world.robot, world.layout
        self._most_n, self._step_s = config.hook_force_n, config.sim_dt_s
        self._held, self._slides = slots.held[:, None], slots.slides[:, None]
        if not slots.occupied.any():
            raise ConfigError(f"hook_force_n is {self._most_n}, expected 0 in scenes where nothing moves")
        length_m = robot.size_m[0] if robot.size_m else 2 * robot.footprint_radius_m
        self.point_b = np.array([length_m / 2, 0.0, HEIGHT_M - robot.spawn_height_m], np.float32)
        # A disc that is pulled sideways at its rim.
        self._mobility, self._link = 3.0 / world.robot_mass_kg, 0
        self.at_hand = bool(robot.hand) and robot.control_mode in ("hand", "whole_body")
        if self.at_hand:
            model, bodies = world.models[0], self.layout.robot_bodies.tolist()
            self._links = make_links(model, bodies, self.layout.robot_qpos)
            self._link, parents = bodies.index(model.body(robot.hand).id), (0, *(x.parent for x in self._links.rest))
            self.point_b = model.site_pos[model.site_bodyid == bodies[self._link]].sum(0).astype(np.float32)
            self._mobility, link, self._arm = 3.0 * float(model.body_invweight0[bodies[self._link], 0]), self._link, []
            while link:
                self._arm = [*(joint[1] for joint in self._links.rest[link - 1].joints), *self._arm]
                link = parents[link]
        com, axis, anchor = slots.com_b_m, slots.axis_b, slots.anchor_b_m
        inverse = np.stack([model.body_invweight0[self.layout.slot_body] for model in world.models])
        # Means of three directions, of which a hinge or a slide has one. Twice the mean is at least 2/3 of the largest.
        hinge, slides = self._held & ~self._slides, self._slides
        along = axis * ((com - anchor) * axis).sum(-1, keepdims=True)
        pivot, shift = np.where(self._held, anchor + along, com), np.where(slides, 3.0, ~hinge)[:, 0]
        tables = slots.pos_w_m, slots.axes_w, axis, anchor, com, pivot
        tables += shift * inverse[..., 0], np.where(hinge, 3.0, 2.0)[:, 0] * inverse[..., 1]
        self._tables = tuple(table.astype(np.float32) for table in tables)
        self._com_b = np.float32(world.models[0].body_ipos[self.layout.robot_bodies[self._link]])
        # A hand bears the weight in the scene's model: with a random mass, the spring takes up the difference.
        masses_kg = np.stack([model.body_mass[self.layout.slot_body] for model in world.models])
        weights_n = np.where(self._held[:, 0] | (self._link == 0), 0.0, -world.models[0].opt.gravity[2] * masses_kg)
        self._borne_n = (weights_n[..., None] * [0.0, 0.0, 1.0]).astype(np.float32)

    def _motions(
        self, scene: Array, slot: Array, layout: Layout, place: Array, qpos: Array, qvel: Array
    ) -> tuple[_Motion, _Motion]:
        """Return the motions of a slot's body, which `layout` has at `place` [...] in the states, and of the hook's."""
        xp, robot = namespace(qpos), layout.robot_state(qpos, qvel, 0.0)
        numbers = (qpos, layout.slot_qpos, 7), (qvel, layout.slot_qvel, 6)
        at = [(x, xp.asarray(first)[place][..., None] + xp.arange(n)) for x, first, n in numbers]
        q, v = (xp.take_along_axis(x, xp.minimum(i, x.shape[-1] - 1), -1) for x, i in at)
        rest, axes, axis, anchor, *_ = (xp.asarray(table)[scene, slot] for table in self._tables)
        held, slides = (xp.asarray(t)[slot] for t in (self._held, self._slides))
        arm, turned = swing(axis, anchor, xp.where(slides[..., 0], 0.0, q[..., 0]))
        hung = rest + apply_axes(axes, arm + xp.where(slides, axis * q[..., :1], 0.0))
        swung, rate = compose(axes, turned), axis * v[..., :1]
        drift = apply_axes(swung, xp.where(slides, rate, -xp.cross(rate, anchor)))
        free = q[..., :3], matrix_from_quat(q[..., 3:]), v[..., :3], v[..., 3:]
        tied = hung, swung, drift, xp.where(slides, 0.0, rate)
        body = zip((held, held[..., None], held, held), tied, free, strict=True)
        return tuple(xp.where(*parts) for parts in body), self._mine(robot)

    def _mine(self, robot: RobotState) -> _Motion:
        """Return the motion of the body with the hook.

        Of a hand, the velocity is its grip's and the angular velocity 0, so that `_point` returns the grip's velocity.
        """
        place, axes, xp = robot.qpos[..., :3], matrix_from_quat(robot.qpos[..., 3:7]), namespace(robot.qpos)
        velocity, spin = robot.qvel[..., :3], robot.qvel[..., 3:6]
        if not self._link:
            return place, axes, velocity, spin
        # In qvel, joints stand one place earlier than in qpos, as the base's free joint has one number less there.
        (hand, hand_axes), joints = self._links.frames(robot.qpos)[self._link], np.array(self._arm)
        lever = self._links.jacobian(robot.qpos, self._link, self._arm, self.point_b)
        grip_b = apply_axes(axes.swapaxes(-1, -2), _point((hand, hand_axes, velocity, spin), self.point_b)[0] - place)
        moves = xp.cross(spin, grip_b) + apply_axes(lever, robot.qvel[..., joints - 1])
        return hand, hand_axes, velocity + apply_axes(axes, moves), xp.zeros_like(spin)

    def point_w(self, state: PhysicsState) -> Array:
        """Return where the hook is, [3], m."""
        return _point(self._mine(self.layout.robot_state(state.qpos, state.qvel, 0.0)), self.point_b)[0]

    def grip(
        self, scene: Array, state: PhysicsState, wish: Array, slot: Array, gap_m2: Array, mass_scale: Array | float
    ) -> PhysicsState:
        """Return one environment's state after a command `wish` []: above 0 an empty hook couples to the nearest slot
        if that is within reach, below 0 it lets go. The body's mass is `mass_scale` times its scene's."""
        (place, axes, *_), _ = self._motions(scene, slot, self.layout, slot, state.qpos, state.qvel)
        here_w = self.point_w(state)
        point_b = apply_axes(axes.swapaxes(-1, -2), here_w - place)
        pivot, shift, turn = (jnp.asarray(table)[scene, slot] for table in self._tables[-3:])
        mobility = self._mobility + (shift + turn * ((point_b - pivot) ** 2).sum()) / mass_scale
        coupled = jnp.concatenate([slot[None].astype(np.float32), point_b, mobility[None], here_w])
        free = jnp.where((wish > 0) & (gap_m2 <= COUPLING_M**2), coupled, NONE)
        return state.replace(hook=jnp.where((wish < 0) | (state.hook[0] < 0), free, state.hook))

    def held(self, scene: Array, hook: Array, state: PhysicsState) -> PhysicsState:
        """Return a new state with what the hook still holds after a control step."""
        slot = hook[0].astype(np.int32)
        body, base = self._motions(scene, slot, self.layout, slot, state.qpos, state.qvel)
        there_w = _point(body, hook[1:4])[0]
        torn = (slot >= 0) & ~(((there_w - _point(base, self.point_b)[0]) ** 2).sum() <= TORN_M**2)
        return state.replace(hook=hook.at[0].set(jnp.where(torn, TORN, hook[0])).at[5:].set(there_w))

    def applied(
        self, scene: Array, hook: Array, layout: Layout, place: Array, qpos: Array, qvel: Array, old: Array
    ) -> Array:
        """Return MuJoCo's `xfrc_applied` [..., bodies, 6] like `old`: force and torque about the centre of mass.

        `layout` and `place` [...] locate the held slot in the states; a negative place is none.
        """
        xp, slot = namespace(qpos), hook[..., 0].astype(np.int32)
        motions = self._motions(scene, slot, layout, place, qpos, qvel)
        coms = xp.asarray(self._tables[4])[scene, slot], xp.asarray(self._com_b)
        (there_w, theirs), (here_w, mine) = map(_point, motions, (hook[..., 1:4], xp.asarray(self.point_b)))
        borne_n = xp.asarray(self._borne_n)[scene, slot]
        force = spring_force(here_w - there_w, mine - theirs, hook[..., 4], self._step_s, self._most_n, borne_n)
        force = xp.where((place >= 0)[..., None], force, 0.0)
        holder = layout.robot_bodies[self._link : self._link + 1]
        out, bodies = xp.zeros_like(old), (xp.asarray(layout.slot_body)[place][..., None], holder)
        for point, motion, com, body in zip((there_w, here_w), motions, coms, bodies, strict=True):
            wrench = xp.concatenate([force, xp.cross(point - _point(motion, com)[0], force)], -1)
            mine = xp.arange(old.shape[-2]) == body
            out, force = out + mine[..., None] * xp.nan_to_num(wrench)[..., None, :], -force
        return out
