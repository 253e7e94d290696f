"""How far physics settings are from a finely resolved reference, over scripted pushes: settings in, rows out.

    python -m docs.studies.fidelity --backend native
    python -m docs.studies.fidelity --backend warp --only environment
    python -m docs.studies.fidelity --backend warp --only sleep
    python -m docs.studies.fidelity --report

The reference is C MuJoCo at 1/240 s with 100 solver iterations to a tolerance of 1e-12, once with convex hulls and
once with the boxes that batched scenes collide with. Every scenario is run from many offsets and turns of the object,
since a single stick-slip push says little. Rows are appended to `benchmarks/results/fidelity.jsonl.gz`; `--report`
draws `docs/fidelity.webp` and prints the table of `docs/fidelity.md` from them.
"""

from __future__ import annotations

import dataclasses
import itertools
import math
from pathlib import Path
from typing import NamedTuple

import jax
import jax.numpy as jnp
import mujoco
import numpy as np

from benchmarks.steps_per_second import SCENE, append_row, origin
from docs.studies import command_line, read_rows
from interactive_nav.config import NavConfig, PhysicsConfig
from interactive_nav.physics import PhysicsState, make_physics, resolve_backend
from interactive_nav.robots import get_robot
from interactive_nav.scenes.objects import small_objects
from interactive_nav.scenes.scene import Movable, Scene, load_scene
from interactive_nav.scenes.world import World, build_world, foot_points
from interactive_nav_common.errors import ConfigError
from interactive_nav_common.rows import markdown

REFERENCE = {"sim_dt_s": 1 / 240, "solver_iterations": 100}
TOLERANCE = 1e-12
GAP_M = 0.05
"""Between the robot's and the object's bounding circles at the start."""
SMALL_GAP_M = 0.02
NUDGE_M = 1e-5
"""By which starts are shifted to see how far apart single pushes end that differ by nothing."""
ALL = {"active_furniture": 0, "active_small": 0, "active_doors": 0, "active_walls": 0}
"""Room for everything on MJX, since here no robot is at a random place of a home."""
LOST = ("overflow", "left_out", "crowded", "nonfinite")
SPEED_M_S = 0.35
OFFSETS_M = (-0.08, -0.06, -0.04, -0.02, 0.0, 0.02, 0.04, 0.06, 0.08)
TURNS_RAD = (0.0, 0.4, 0.8, 1.2)
LIMIT = 0.10
"""Largest relative error of push displacement and force sum that a setting may have to become the default."""
KEPT = ("sim_dt_s", "solver_iterations", "cone", "contact_time_constant_s")
CHOSEN = "20 ms, 10 it., pyramidal, 50 ms contacts"
SHOWN_PERCENT = 60
"""Longer bars are cut, and what they are is written beside them, from the lowest bar up."""
COLOURS = ("#0072b2", "#e69f00", "#009e73", "#cc79a7", "#d55e00")
"""Of the scenarios: those of `interactive_nav_common.figures`."""


@dataclasses.dataclass(frozen=True)
class Scenario:
    """A robot drives straight at an object."""

    name: str
    robot: str
    category: str
    behind: tuple[str, ...] = ()
    """Categories of the objects that it is pushed into; for a box, of the box on top of it."""
    seconds: float = 2.5
    drives_s: float = math.inf
    """After this the robot drives back."""


SCENARIOS = (
    Scenario("TurtleBot pushes a basket", "turtlebot", "basket"),
    Scenario("TurtleBot pushes a chair", "turtlebot", "chair"),
    Scenario("TurtleBot fails to push a sofa", "turtlebot", "sofa"),
    Scenario("TurtleBot pushes a door", "turtlebot", "door"),
    Scenario("Fetch pushes a table", "fetch", "table"),
    Scenario("Fetch pushes a chair into a table", "fetch", "chair", behind=("table",), seconds=4.0),
    Scenario("Fetch pushes a chair into a door", "fetch", "chair", behind=("door",), seconds=4.0),
    Scenario("Fetch pushes a box with a box on it", "fetch", "box", behind=("box",)),
    Scenario("TurtleBot bumps a door", "turtlebot", "door", seconds=6.0, drives_s=0.6),
    Scenario("TurtleBot pushes small objects in a row", "turtlebot", "basket", behind=("shoe", "pot", "toy")),
)
ALONE = 5
"""Scenarios of one object, which stand first: those of the sweep and the figure."""
SWEEP = (
    {},
    *({"sim_dt_s": dt} for dt in (1 / 240, 0.005, 0.01, 0.025, 0.05)),
    *({"sim_dt_s": 0.02, "solver_iterations": n} for n in (2, 4, 6, 50)),
    *({"sim_dt_s": dt, "cone": "elliptic"} for dt in (0.02, 0.01)),
    {"contact_time_constant_s": 0.04},
)
"""Settings compared on `native`, beside the defaults."""


def _lone(source: Scene, *movables: Movable) -> Scene:
    """Return the scene with nothing in it but these."""
    walls = np.array([[0.0, 0.0, -9.0, 1.0, 0.0, 0.0, 0.0, 0.1, 0.1, 0.1]])
    return dataclasses.replace(source, walls=walls, movables=movables)


def _movable(source: Scene, category: str) -> Movable:
    """An object of the category: the lightest chair, which a TurtleBot's traction can move, else the heaviest."""
    category = "chair" if category == "box" else category
    found = [m for m in source.movables if m.category == category]
    if not found:
        raise ConfigError(f"{source.path} has no {category}; choose another --scene")
    return (min if category == "chair" else max)(found, key=lambda m: m.mass_kg)


def _box(like: Movable, side_m: float, mass_kg: float, height_m: float) -> Movable:
    """Return a flat box, of these half sides and 0.12 m half its height, whose centre is at a height."""
    half, level = np.array([side_m, side_m, 0.12]), np.array([1.0, 0, 0, 0])
    inertia, boxes = mass_kg / 3 * ((half**2).sum() - half**2), np.array([[0, 0, 0, *level, *half]])
    frame = {"com_m": np.zeros(3), "inertia_quat": level, "pos_w": np.array([0, 0, height_m]), "quat_w": level}
    return dataclasses.replace(like, mass_kg=mass_kg, inertia=inertia, boxes=boxes, **frame)


class _Case(NamedTuple):
    """A scenario's objects: none where they are small, how far ahead of the first each stands, the first's radius."""

    movables: tuple[Movable, ...]
    ahead_m: tuple[float, ...]
    radius_m: float

    def slots(self, world: World, number: int) -> list[int]:
        """Return the slot of each in a scene of the world."""
        bodies = world.slots.bodies[number]
        return [next(i for i, b in enumerate(bodies) if b is m) for m in self.movables or bodies[: len(self.ahead_m)]]


def _case(scenario: Scenario, source: Scene) -> _Case:
    if scenario.category == "basket":
        radii = [small.radius_m for small in small_objects(1 + len(scenario.behind), NavConfig.small_objects, ())]
        gaps = [a + b + SMALL_GAP_M for a, b in itertools.pairwise(radii)]
        return _Case((), (0.0, *np.cumsum(gaps).tolist()), radii[0])
    pile = scenario.category == "box"
    movables = [_movable(source, category) for category in (scenario.category, *scenario.behind)]
    if pile:
        movables = [_box(movables[0], 0.2, 3.0, 0.12), _box(movables[1], 0.12, 1.5, 0.36)]
    first, matrix = movables[0].boxes, np.zeros(9)
    radius_m = float(np.linalg.norm(np.abs(first[:, :2]) + first[:, 7:9], axis=1).max())
    ahead = []
    for k, movable in enumerate(movables):
        mujoco.mju_quat2Mat(matrix, movable.quat_w)
        near_m = (foot_points(movable.boxes) @ matrix[:3]).min()
        ahead.append(0.0 if pile or k == 0 else radius_m + GAP_M - near_m)
        if movable.joint is None:
            movables[k] = dataclasses.replace(movable, pos_w=np.array([ahead[k], 0.0, movable.pos_w[2]]))
    return _Case(tuple(movables), tuple(ahead), radius_m)


def _leaf_m(world: World, number: int, slot: int) -> np.ndarray:
    """Return [2] from a door's hinge to its centre of mass, at rest."""
    slots = world.slots
    return (slots.axes_w[number, slot] @ (slots.com_b_m - slots.anchor_b_m)[number, slot])[:2]


def _leaf_line(world: World, number: int, slot: int, turn: float, offset_m: float) -> tuple[np.ndarray, float]:
    """Return where on a door's leaf a push aims, [2] m, and its heading."""
    slots, model, leaf = world.slots, world.models[number], _leaf_m(world, number, slot)
    anchor = slots.pos_w_m[number, slot] + slots.axes_w[number, slot] @ slots.anchor_b_m[number, slot]
    along = leaf / np.linalg.norm(leaf)
    low, high = model.jnt_range[model.body_jntadr[world.layout.slot_body[slot]]]
    across = np.array([-along[1], along[0]]) * (1.0 if high > -low else -1.0)
    return anchor[:2] + (1.2 + 0.4 * turn) * leaf + offset_m * along, math.atan2(across[1], across[0])


def _starts(case: _Case, world: World, number: int, nudge_m: float) -> np.ndarray:
    """Return [N, nq] states: the object at several turns, the others ahead of it, the robot behind it, offset."""
    robot, layout, states, slots = world.robot, world.layout, [], case.slots(world, number)
    doors = [slot for slot in slots if layout.slot_kind[slot] == "hinge"]
    alone = doors == slots
    for turn, offset in itertools.product(TURNS_RAD, OFFSETS_M):
        qpos, target, heading = world.rest_qpos[number].copy(), np.zeros(2), 0.0
        if doors:
            target, heading = _leaf_line(world, number, doors[0], turn, offset * alone)
        way = np.array([math.cos(heading), math.sin(heading)])
        target = target - way * (case.radius_m + GAP_M) * (bool(doors) and not alone)
        for slot, ahead in zip(slots, case.ahead_m, strict=True):
            at, half = layout.slot_qpos[slot], (turn + heading) / 2
            if slot not in doors:
                qpos[at : at + 2] = target + way * ahead
            if slot == slots[0] and not alone:
                quat = qpos[at + 3 : at + 7].copy()
                mujoco.mju_mulQuat(qpos[at + 3 : at + 7], [math.cos(half), 0, 0, math.sin(half)], quat)
        back = robot.footprint_radius_m + (0.1 if alone else case.radius_m + GAP_M)
        place = target - way * back + (0.0 if alone else offset) * np.array([-way[1], way[0]]) + nudge_m
        qpos[layout.robot_qpos :][:7] = [
            *place,
            robot.spawn_height_m,
            math.cos(heading / 2),
            0,
            0,
            math.sin(heading / 2),
        ]
        states.append(qpos)
    return np.asarray(states, np.float32)


def _displacement_m(world: World, number: int, slot: int, start: np.ndarray, end: np.ndarray) -> np.ndarray:
    """Return how far an object went from one [N, nq] to the other: a door's centre of mass along its arc."""
    at = world.layout.slot_qpos[slot]
    if world.layout.slot_kind[slot] != "hinge":
        return np.linalg.norm(end[:, at : at + 2] - start[:, at : at + 2], axis=1)
    return np.abs(end[:, at] - start[:, at]) * np.linalg.norm(_leaf_m(world, number, slot))


Push = dict[str, np.ndarray]
"""`displacement_m` [N, objects], `force_sum_n` [N] over control steps, `lost` [N] steps that lost something."""


def push(
    scenarios: list[Scenario], source: Scene, settings: dict, tolerance: float | None = None, nudge_m: float = 0.0
) -> list[Push]:
    """Run scenarios of one robot from all their starts in one batch, the robot `nudge_m` aside."""
    small = max((1 + len(s.behind) for s in scenarios if s.category == "basket"), default=0)
    room = {**ALL, "active_dofs": 63} if settings["backend"] == "warp" and settings.get("sleep") else ALL
    config = NavConfig.of(**{"num_objects": small, "sleep": False, **room, **settings})
    cases = [_case(scenario, source) for scenario in scenarios]
    scenes = [_lone(source, *case.movables) for case in cases]
    world = build_world(get_robot(scenarios[0].robot, "twist"), tuple(scenes), config)
    if tolerance is not None:
        for opt in (model.opt for model in world.models):
            opt.tolerance, opt.ls_tolerance, opt.ls_iterations = tolerance, 1e-4, 200
    starts = [_starts(case, world, i, nudge_m) for i, case in enumerate(cases)]
    scene, qpos = np.repeat(np.arange(len(cases)), [len(s) for s in starts]), np.concatenate(starts)
    state = PhysicsState(jnp.asarray(qpos), *jnp.zeros((2, len(qpos), world.models[0].nv)))
    ways = [world.robot.command(world.robot.drive(np.float64(s * SPEED_M_S), np.float64(0.0))) for s in (1, -1)]
    drives_s = np.array([s.drives_s for s in scenarios])[scene, None]
    step = jax.jit(jax.vmap(make_physics(world, config).step))
    path, told, out = [], [], []
    for k in range(round(max(s.seconds for s in scenarios) / config.control_dt_s)):
        command = np.where((k + 0.5) * config.control_dt_s < drives_s, *ways)
        state, signals = step(jnp.asarray(scene), state, jnp.asarray(command, jnp.float32))
        told.append([np.asarray(signals.force_n), sum(np.asarray(getattr(signals, name)) for name in LOST)])
        path.append(np.asarray(state.qpos))
    for i, (scenario, case) in enumerate(zip(scenarios, cases, strict=True)):
        at, count = scene == i, round(scenario.seconds / config.control_dt_s)
        moved = [_displacement_m(world, i, slot, starts[i], path[count - 1][at]) for slot in case.slots(world, i)]
        force, lost = np.asarray(told)[:count, :, at].sum(0)
        out.append({"displacement_m": np.stack(moved, 1), "force_sum_n": force, "lost": lost})
    return out


def _errors(values: np.ndarray, reference: np.ndarray, least: float) -> tuple[float, float, float]:
    """Return both means, and how far they are apart relative to the reference, or to `least` where that is more."""
    mean, right = float(values.mean()), float(reference.mean())
    return round(mean, 4), round(right, 4), round((mean - right) / max(right, least), 4)


def compare(run: Push, reference: Push) -> dict:
    """Return errors of a run against the reference, over its starts.

    Relative errors are of the means; a displacement below 5 cm is compared with 5 cm (a sofa that stays). Objects that
    others are pushed into follow as `behind`: mean displacement, the reference's, and the error of each.
    """
    pairs = zip(run["displacement_m"].T, reference["displacement_m"].T, strict=True)
    first, *behind = (_errors(a, b, 0.05) for a, b in pairs)
    force = _errors(run["force_sum_n"], reference["force_sum_n"], 1.0)
    return {
        **dict(zip(("displacement_m", "displacement_reference_m", "displacement_error"), first, strict=True)),
        **dict(zip(("force_sum_n", "force_reference_n", "force_error"), force, strict=True)),
        **({"behind": behind} if behind else {}),
    }


def _runs(scenarios: list[Scenario], source: Scene, settings: dict, **more: float) -> list[Push]:
    """Return `push` of scenarios of several robots, hulls one at a time, since only boxes can be batched."""
    keys = [s.name if settings["collision"] == "hulls" else s.robot for s in scenarios]
    runs: dict[str, Push] = {}
    for key in dict.fromkeys(keys):
        group = [s for s, k in zip(scenarios, keys, strict=True) if k == key]
        runs |= zip((s.name for s in group), push(group, source, settings, **more), strict=True)
    return [runs[s.name] for s in scenarios]


def measure(backend: str, scenarios: list[Scenario], only: str, scene: str, out: Path, commit: str | None) -> None:
    """Append all rows of one backend to a file."""
    source = load_scene(scene)
    base = {"backend": resolve_backend(backend), "scene": source.name, **origin(commit)}
    native = base["backend"] == "native"
    exact = {
        shape: _runs(scenarios, source, {"backend": "native", "collision": shape, **REFERENCE}, tolerance=TOLERANCE)
        for shape in (("boxes",) if only == "sleep" else ("boxes", "hulls"))
    }
    jobs: list[tuple[str, dict]] = [("boxes", s) for s in (SWEEP if only == "sweep" and native else ({},))]
    if only == "sleep":
        jobs = [("boxes", {"sleep": False}), ("boxes", {"sleep": True})]
    elif native:
        stiff = {**REFERENCE, "contact_time_constant_s": 0.02}
        jobs += [("hulls", {}), ("hulls", REFERENCE), ("boxes", REFERENCE), ("boxes", stiff)]
    rivals: list[Push] = []
    for collision, settings in jobs:
        settings = {"backend": base["backend"], "collision": collision, **settings}
        runs = _runs(scenarios, source, settings)
        rivals = rivals or (_runs(scenarios, source, settings, nudge_m=NUDGE_M) if only == "sleep" else [])
        for i, (scenario, run) in enumerate(zip(scenarios, runs, strict=True)):
            row = {
                **base,
                "scenario": scenario.name,
                **{name: getattr(PhysicsConfig, name) for name in KEPT},
                **settings,
                **{f"against_{shape}": compare(run, references[i]) for shape, references in exact.items()},
            }
            if only == "sleep":
                apart = np.abs(run["displacement_m"] - rivals[i]["displacement_m"]).max(0)
                row |= {"lost_steps": int(run["lost"].sum()), "apart_m": [round(float(a), 4) for a in apart]}
            append_row(out, row, hidden=[*base, *KEPT])
        rivals = runs


def _setting(row: dict) -> str:
    soft = f", {1000 * row['contact_time_constant_s']:.0f} ms contacts"
    slept = "" if "apart_m" not in row else ", asleep" if row["sleep"] else ", awake"
    return f"{1000 * row['sim_dt_s']:.3g} ms, {row['solver_iterations']} it., {row['cone']}{soft}{slept}"


def _draw(rows: list[dict], scenarios: list[str], figure: Path) -> None:
    """Bars of errors on C MuJoCo with boxes, a row for each setting."""
    import matplotlib

    matplotlib.use("Agg")
    from matplotlib import pyplot as plt

    boxes = [r for r in rows if r["collision"] == "boxes" and r["backend"] == "native"]
    names = sorted({_setting(r) for r in boxes}, key=lambda n: (float(n.split()[0]), n))
    fig, axes = plt.subplots(1, 2, figsize=(7.2, 6.6), sharey=True, layout="constrained")
    labels = [n.replace(", pyramidal", "").replace(" contacts", "") for n in names]
    titles = {"displacement_error": "push displacement", "force_error": "force sum"}
    for axis, (key, title) in zip(axes, titles.items(), strict=True):
        cut: list[list[str]] = [[] for _ in names]
        for i, scenario in enumerate(scenarios):
            found = {_setting(r): r["against_boxes"][key] for r in boxes if r["scenario"] == scenario}
            errors = np.array([100 * found.get(n, np.nan) for n in names], float)
            at = np.arange(len(names)) + 0.16 * (i - 2)
            axis.barh(at, errors, 0.15, label=scenario, color=COLOURS[i])
            for row in np.flatnonzero(np.abs(errors) > SHOWN_PERCENT):
                cut[row].append(f"{errors[row]:+,.0f}")
        for row, cut_errors in enumerate(cut):
            axis.text(
                -2, row, f"cut:\n{', '.join(cut_errors)}" if cut_errors else "", ha="right", va="center", fontsize=6
            )
        axis.axvspan(-100 * LIMIT, 100 * LIMIT, color="0.9", zorder=0)
        axis.axhspan(names.index(CHOSEN) - 0.5, names.index(CHOSEN) + 0.5, color="#f6e7b0", zorder=-1)
        axis.set_yticks(np.arange(len(names)), labels, fontsize=8)
        axis.set_xlabel(f"error of the {title}, %", fontsize=8)
        axis.set_xlim(-SHOWN_PERCENT, SHOWN_PERCENT)
        axis.tick_params(axis="x", labelsize=8)
        axis.spines[["top", "right"]].set_visible(False)
    axes[0].get_yticklabels()[names.index(CHOSEN)].set_fontweight("bold")
    fig.legend(*axes[0].get_legend_handles_labels(), fontsize=7, loc="outside lower center", ncols=3, frameon=False)
    fig.suptitle(
        "C MuJoCo, boxes on both sides, against 1/240 s and 100 iterations\n"
        "grey: within 10 %; yellow and bold: the default; pyramidal cones unless told; last: contacts' time constant",
        fontsize=8,
    )
    fig.savefig(figure, dpi=110, pil_kwargs={"lossless": True, "method": 6})


def report(rows: list[dict], figure: Path) -> str:
    """Draw the figure and return the tables in Markdown."""
    rows = list({(r["scenario"], r["backend"], r["collision"], _setting(r)): r for r in rows}.values())
    scenarios, lines = [s.name for s in SCENARIOS], []
    for row in sorted(rows, key=lambda r: (scenarios.index(r["scenario"]), r["backend"], r["collision"], _setting(r))):
        e = row["against_boxes" if row["collision"] == "boxes" else "against_hulls"]
        objects = [(e["displacement_m"], 0, e["displacement_error"]), *e.get("behind", ())]
        moved, errors = (", ".join(f"{o[i]:{spec}}" for o in objects) for i, spec in ((0, ".3f"), (2, "+.1%")))
        where, force = (row["scenario"], row["backend"], row["collision"], _setting(row)), f"{e['force_sum_n']:.0f} N"
        apart = ", ".join(f"{100 * a:.1f}" for a in row.get("apart_m", ()))
        lines.append((*where, moved, errors, force, f"{e['force_error']:+.1%}", apart))
    _draw([r for r in rows if "apart_m" not in r], scenarios[:ALONE], figure)
    header = "scenario", "backend", "collision", "setting", "displacements, m", "errors", "force sum", "error"
    return markdown((*header, "farthest apart, cm"), lines)


def main(argv: list[str] | None = None) -> None:
    """Measures, or reports what was measured."""
    parser = command_line(__doc__, "fidelity")
    parser.add_argument("--backend", default="native")
    only = {"choices": ("sweep", "environment", "sleep"), "default": "sweep"}
    parser.add_argument("--only", **only, help="environment: the defaults; sleep: these, awake and asleep")
    parser.add_argument("--scene", default=SCENE)
    parser.add_argument("--scenarios", nargs="*", type=int, default=None, help="by number, 0 to 9")
    parser.add_argument("--report", action="store_true")
    args = parser.parse_args(argv)
    if args.report:
        print(report(read_rows(args.out), Path("docs/fidelity.webp")), end="")
        return
    numbers = range(len(SCENARIOS) if args.only == "sleep" else ALONE) if args.scenarios is None else args.scenarios
    measure(args.backend, [SCENARIOS[i] for i in numbers], args.only, args.scene, args.out, args.commit)


if __name__ == "__main__":
    main()
