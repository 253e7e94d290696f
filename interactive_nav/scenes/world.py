"""Build a `World` from a robot, small objects and scenes: MuJoCo models of equal layout, one per scene.

All scenes are padded to common slots (movable bodies, boxes per body, walls), so that one compiled program steps any
mix of them. The body of an empty slot waits at its parking spot and never counts.
"""

import dataclasses
import itertools
import math
from collections.abc import Sequence

import mujoco
import numpy as np

from interactive_nav.config import NavConfig
from interactive_nav.robots import RobotSpec
from interactive_nav.scenes.contacts import add_contact_sensors, add_sensor
from interactive_nav.scenes.many import for_each_home
from interactive_nav.scenes.objects import ConvertedObject, SmallObject, add_box, add_boxes, small_objects, solid
from interactive_nav.scenes.scene import Joint, Movable, Scene
from interactive_nav.scenes.slots import (
    Layout,
    Slot,
    SlotTables,
    build_slot_tables,
    find_layout,
    find_slots,
    parking_spot,
)
from interactive_nav_common.errors import ConfigError
from scenes_mjcf.schema import SceneError

_SETTLE_TIME_S = 3.0
_EMPTY_BOX = np.array([0.0, 0.0, 0.0, 1.0, 0.0, 0.0, 0.0, 1e-3, 1e-3, 1e-3])
_TILTED = np.array([0.8, 0.36, 0.48, 0.0])
_LEAST_FRICTION = 1e-6
"""N m, or N: MJX-JAX makes a row of constraints for joints whose model has friction, and locks those where it is 0."""
_FLOATS = 1.0
"""Share of its weight that an empty slot's body is relieved of."""
FEET = 12
"""Points of each movable object that can touch the floor."""
_FOOT_RADIUS_M = 2e-3
_SOLID, _FLOOR, _CEILING = 1, 2, 4
"""Collision bits: bodies against each other, what can touch the floor, and flying robots against the ceiling."""
AT_END_RAD = 0.03
"""A door within this angle of an end of its range stands at that end."""
GOLDEN = (math.sqrt(5) - 1) / 2
"""Its multiples modulo 1 spread evenly over [0, 1). Door k of home i takes multiple i + 7 k."""
CEILING_M = 1.2
"""Height of the ceiling that flying robots meet: just below the tops of walls, which are cut above ground robots."""
FLOOR_FRICTION = 0.05
"""Below every object's: MuJoCo takes the larger of two friction coefficients, so the object's holds."""


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


def foot_points(boxes: np.ndarray) -> np.ndarray:
    """Return [at most `FEET`, 3] outermost corners, m, on which a body of boxes can rest, bottom ones first.

    Boxes would make four floor contacts each (16 for a chair that rests on 4), and the solver's cost grows with them.
    """
    corners, rotation, signs = [], np.zeros(9), np.array(list(itertools.product((-1, 1), repeat=3)))
    for row in boxes:
        mujoco.mju_quat2Mat(rotation, row[3:7])
        corners.append(row[:3] + (signs * row[7:10]) @ rotation.reshape(3, 3).T)
    points = np.concatenate(corners)
    azimuth = np.arange(8) * math.pi / 4 + math.pi / 4
    # Slightly more than level: of corners at (nearly) one height the outermost wins.
    level = np.stack([0.05 * np.cos(azimuth), 0.05 * np.sin(azimuth), np.ones(8)], -1)
    kept: list[np.ndarray] = []
    for direction in [*(level * [1, 1, -1])[::2], *(level * [1, 1, -1])[1::2], *level[::2], *level[1::2]]:
        point = points[np.argmax(points @ direction)]
        if len(kept) < FEET and all(np.linalg.norm(point - k) > 0.02 for k in kept):
            kept.append(point)
    return np.stack(kept)


def _add_feet(body: mujoco.MjsBody, name: str, boxes: np.ndarray, hidden_m: np.ndarray, friction: float) -> None:
    """Add `FEET` small spheres that alone touch the floor; those not needed hide inside the body."""
    points = foot_points(boxes) if len(boxes) else np.zeros((0, 3))
    if len(points):
        centre = 0.5 * (points.min(0) + points.max(0))
        points = points - _FOOT_RADIUS_M * np.sign(points - centre)
    for i in range(FEET):
        body.add_geom(
            name=f"{name}_foot_{i}",
            type=mujoco.mjtGeom.mjGEOM_SPHERE,
            pos=points[i] if i < len(points) else hidden_m,
            size=[_FOOT_RADIUS_M, 0, 0],
            contype=_FLOOR,
            conaffinity=0,
            **solid(friction, 4),
        )


def _nothing(slot: int, kind: str) -> Movable:
    """Return the body of an empty slot, at its parking spot.

    It is off-centre and turned, because a body frame equal to its inertia's would give a sparser mass matrix.
    """
    joint = Joint(np.array([0, 0, 1]), np.zeros(3), None, 0.1, frictionloss=0.0, slides=kind == "slide")
    joint = joint if kind in ("hinge", "slide") else None
    inertia, pos, level = np.array([0.01, 0.012, 0.014]), np.array([*parking_spot(slot), 2.0]), np.array([1, 0, 0, 0])
    return Movable("", "", 1.0, inertia, np.full(3, 1e-3), _TILTED, pos, level, 0.5, np.zeros((0, 10)), (), joint)


def _add_movable(
    spec: mujoco.MjSpec, name: str, movable: Movable, n_boxes: int, collision: str, gravcomp: float, feet: bool = True
) -> None:
    body = spec.worldbody.add_body(name=name, pos=movable.pos_w, quat=movable.quat_w, gravcomp=gravcomp)
    boxes, friction, com = movable.boxes, movable.friction, movable.com_m
    if np.abs(com).max() < 1e-6:
        com = com + 1e-6
    body.explicitinertial = True
    body.mass, body.inertia, body.ipos, body.iquat = movable.mass_kg, movable.inertia, com, movable.inertia_quat
    if tie := movable.joint:
        joint = body.add_joint(name=f"{name}_joint", type=getattr(mujoco.mjtJoint, f"mjJNT_{movable.kind.upper()}"))
        joint.axis, joint.pos, joint.frictionloss = tie.axis, tie.anchor_m, max(tie.frictionloss, _LEAST_FRICTION)
        joint.limited, joint.range = True, tie.range or (-math.pi, math.pi)
        joint.damping = [tie.damping, 0, 0]
    else:
        body.add_freejoint(name=f"{name}_joint")
    if collision == "hulls" and movable.hulls:
        for i, vertices in enumerate(movable.hulls):
            spec.add_mesh(name=f"{name}_mesh_{i}", uservert=np.asarray(vertices, float).ravel())
            body.add_geom(
                name=f"{name}_hull_{i}",
                type=mujoco.mjtGeom.mjGEOM_MESH,
                meshname=f"{name}_mesh_{i}",
                contype=_SOLID | _FLOOR,
                **solid(friction),
            )
        return
    # A padding box hides at the centre of mass, inside the body, and is too small to be met first.
    hidden = _EMPTY_BOX.copy()
    hidden[:3] = com
    for i in range(n_boxes):
        add_box(body, boxes[i] if i < len(boxes) else hidden, f"{name}_box_{i}", friction)
    if feet:
        _add_feet(body, name, boxes, com, friction)


def _add_small(spec: mujoco.MjSpec, name: str, obj: SmallObject, park: int, collision: str, feet: bool) -> None:
    x, y = parking_spot(park)
    if isinstance(obj, ConvertedObject):
        parked = dataclasses.replace(obj.movable, pos_w=np.array([x, y, 0.0]))
        _add_movable(spec, name, parked, len(obj.boxes), collision, 0.0, feet)
        return
    body = spec.worldbody.add_body(name=name, pos=[x, y, 0.0])
    body.add_freejoint(name=f"{name}_joint")
    add_boxes(body, obj, name)
    if feet:
        _add_feet(body, name, obj.rows, obj.rows[:, :3].mean(0), obj.friction)


def _empty_spec(robot: RobotSpec, config: NavConfig) -> mujoco.MjSpec:
    """Return a spec of physics options, the floor and the robot."""
    spec = mujoco.MjSpec()
    spec.modelname = "interactive_nav"
    spec.compiler.degree = False
    option = spec.option
    option.timestep = config.sim_dt_s
    option.integrator = mujoco.mjtIntegrator.mjINT_IMPLICITFAST
    option.cone = getattr(mujoco.mjtCone, f"mjCONE_{config.cone.upper()}")
    option.iterations = config.solver_iterations
    option.ls_iterations = 20
    plane = {"type": mujoco.mjtGeom.mjGEOM_PLANE, "size": [0, 0, 0.1], "friction": [FLOOR_FRICTION, 0.005, 0.0001]}
    spec.worldbody.add_geom(name="floor", contype=0, conaffinity=_FLOOR, **plane)
    robot.add_to(spec)
    if config.symmetric_actions:
        for actuator in spec.actuators:
            low, high = actuator.ctrlrange
            if actuator.ctrllimited and low < 0 < high:
                actuator.ctrlrange = [-max(-low, high), max(-low, high)]
    for geom in spec.geoms:
        if geom.name != "floor" and (geom.contype or geom.conaffinity):
            geom.contype |= _FLOOR | (_CEILING if robot.kind == "flying" else 0)
    if robot.kind == "flying":
        above = {"pos": [0, 0, CEILING_M], "quat": [0, 1, 0, 0], "group": 4}
        spec.worldbody.add_geom(name="ceiling", contype=0, conaffinity=_CEILING, **plane, **above)
    return spec


def build_empty_spec(
    robot: RobotSpec, slots: tuple[tuple[str, int], ...], n_walls: int, config: NavConfig
) -> tuple[mujoco.MjSpec, mujoco.MjModel, Layout]:
    """Return spec, model and layout with all movable slots and walls empty; each environment fills in numbers.

    `slots` are (kind, number of boxes) each; sensors are those of `build_world`.
    """
    spec = _empty_spec(robot, config)
    named = [(f"{kind}_{i}", kind) for i, (kind, _) in enumerate(slots)]
    for i, ((name, kind), (_, n_boxes)) in enumerate(zip(named, slots, strict=True)):
        _add_movable(spec, name, _nothing(i, kind), n_boxes, "boxes", _FLOATS)
    _finish(spec, robot, np.zeros((0, 10)), n_walls, named, config)
    model = spec.compile()
    return spec, model, find_layout(model, robot, named)


def build_spec(
    robot: RobotSpec, index: int, scenes: tuple[Scene, ...], slots: Sequence[Slot], config: NavConfig, feet: bool = True
) -> mujoco.MjSpec:
    """Return the padded spec of one scene; without `feet`, nothing movable touches the floor."""
    spec, collision = _empty_spec(robot, config), config.collision
    for i, slot in enumerate(slots):
        body = slot.bodies[index]
        if isinstance(body, SmallObject):
            _add_small(spec, slot.name, body, i, collision, feet)
            continue
        # The tiny value keeps the models' structure equal.
        floats = body is None or (body.joint and body.joint.balanced)
        gravcomp = _FLOATS if floats else 1e-9 if slot.any_floats else 0.0
        _add_movable(spec, slot.name, body or _nothing(i, slot.kind), slot.n_boxes, collision, gravcomp, feet)
    named, most = [(slot.name, slot.kind) for slot in slots], max(len(s.walls) for s in scenes)
    _finish(spec, robot, scenes[index].walls, most, named, config)
    return spec


def _finish(
    spec: mujoco.MjSpec,
    robot: RobotSpec,
    walls: np.ndarray,
    count: int,
    slots: list[tuple[str, str]],
    config: NavConfig,
) -> None:
    """Add `count` walls and the sensors of slots (name, kind), and make all contacts as soft as the settings say."""
    structure = spec.worldbody.add_body(name="structure")
    for i in range(count):
        row = walls[i] if i < len(walls) else _EMPTY_BOX + np.array([0, 0, -5.0 - 0.01 * i, 0, 0, 0, 0, 0, 0, 0])
        add_box(structure, row, f"wall_{i}", 0.5)
    # Net force of the robot's subtree on a body: 3 numbers, world frame.
    numbers, subtree = (1 << int(mujoco.mjtConDataField.mjCONDATA_FORCE), 3, 1), mujoco.mjtObj.mjOBJ_XBODY
    for i, (name, kind) in enumerate(slots):
        add_sensor(spec, f"force_{i}", subtree, robot.base_body, name, numbers)
        if kind in ("hinge", "slide"):
            # A door leaf hangs in its frame, a drawer in its cabinet: they touch by design.
            spec.add_exclude(bodyname1=name, bodyname2="structure")
    add_sensor(spec, "force_structure", subtree, robot.base_body, "structure", numbers)
    if config.needs_contacts:
        add_contact_sensors(spec, robot, [*(name for name, _ in slots), "structure"])
    for geom in spec.geoms:
        geom.solref = [config.contact_time_constant_s, 1.0]
    if robot.contact_time_constant_s is not None:
        for geom in spec.body(robot.base_body).find_all("geom"):
            geom.solref = [robot.contact_time_constant_s, 1.0]
            geom.solmix = 1e6  # a contact's is the mean of both geoms', weighted by this: the robot's holds


def _parked(model: mujoco.MjModel, layout: Layout, robot: RobotSpec) -> tuple[int, np.ndarray]:
    """Return where the robot's configuration begins, and what it is while the robot is parked."""
    first, qpos = layout.robot_qpos, model.qpos0.copy()
    qpos[first : first + 7] = [*parking_spot(layout.num_slots), robot.spawn_height_m, 1, 0, 0, 0]
    for name, value in robot.home_qpos:
        qpos[model.joint(name).qposadr[0]] = value
    return first, qpos[first : first + layout.robot_nq]


def _turned_doors(
    slots: Sequence[Slot], index: int, layout: Layout, shares: tuple[float, float]
) -> tuple[tuple[int, float], ...]:
    """Return address in qpos and angle of a scene's doors; see `NavConfig.doors_shut`."""
    placed = ((int(at), slot.bodies[index]) for at, slot in zip(layout.slot_qpos, slots, strict=True))
    doors = ((at, body.joint) for at, body in placed if isinstance(body, Movable) and body.category == "door")
    hinges = [(at, joint.range) for at, joint in doors if joint and joint.range and not joint.slides]
    turned = [(at, max(ends, key=abs)) for at, ends in hinges if min(map(abs, ends)) > AT_END_RAD]
    spread = np.interp(GOLDEN * (index + 7 * np.arange(len(turned))) % 1, (0, 1), shares)
    return tuple((at, float(share) * end) for (at, end), share in zip(turned, spread, strict=True))


def _settle(
    model: mujoco.MjModel, first: int, parked: np.ndarray, turned: tuple[tuple[int, float], ...] = ()
) -> np.ndarray:
    """Return the rest configuration [nq]: furniture falls and slides to rest, with the robot parked (`_parked`).

    `turned` has addresses in qpos and the positions that joints there start at.
    """
    data, robot = mujoco.MjData(model), slice(first, first + len(parked))
    data.qpos[robot] = parked
    for at, value in turned:
        data.qpos[at] = value
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
    qpos[robot] = parked
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
    parked = _parked(models[0], layout, robot)
    calls: list[tuple] = [(model, *parked) for model in models]
    if any(shares := (1.0, 1.0) if config.task in ("open", "clear") else config.doors_shut):
        calls = [(*call, _turned_doors(slots, i, layout, shares)) for i, call in enumerate(calls)]
    rest = for_each_home(_settle, calls, "settling homes")
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


def world_poses(world: World, scene: int, qpos: np.ndarray) -> tuple[tuple[str, ...], int, np.ndarray, np.ndarray]:
    """Return world poses of the robot's bodies and a scene's movable objects, for `qpos` [T, nq].

    These are names (B), the number of robot bodies, positions [T, B, 3] and orientations [T, B, 4]. A non-finite row of
    `qpos` repeats the one before it.
    """
    layout, slots, model = world.layout, world.slots, world.models[scene]
    data = mujoco.MjData(model)
    ids = np.concatenate([layout.robot_bodies, layout.slot_body[slots.occupied[scene]]])
    names = [*(model.body(int(b)).name for b in layout.robot_bodies), *filter(None, slots.names[scene])]
    pos, quat = np.zeros((len(qpos), len(ids), 3)), np.zeros((len(qpos), len(ids), 4))
    for t, row in enumerate(qpos):
        if np.isfinite(row).all():
            data.qpos[:] = row
        mujoco.mj_kinematics(model, data)
        pos[t], quat[t] = data.xpos[ids], data.xquat[ids]
    return tuple(names), len(layout.robot_bodies), pos, quat
