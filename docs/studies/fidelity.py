"""How far physics settings are from a finely resolved reference, over scripted pushes: settings in, rows out.

    python -m docs.studies.fidelity --backend native
    python -m docs.studies.fidelity --backend warp --only environment
    python -m docs.studies.fidelity --report

The reference is C MuJoCo at 1/240 s with 100 solver iterations to a tolerance of 1e-12, once with convex hulls and
once with the boxes that batched scenes collide with. Every scenario is run from many offsets and turns of the object,
since a single stick-slip push says little. Rows are appended to `benchmarks/results/fidelity.jsonl`; `--report` draws
`docs/fidelity.webp` and prints the table of `docs/fidelity.md` from them.
"""

from __future__ import annotations

import dataclasses
import json
import math
import time
from pathlib import Path

import jax
import jax.numpy as jnp
import mujoco
import numpy as np
from rich.console import Console
from rich.table import Table

from benchmarks.steps_per_second import SCENE, append_row, origin
from docs.studies import command_line
from interactive_nav.config import NavConfig, PhysicsConfig
from interactive_nav.physics import PhysicsState, make_physics, resolve_backend
from interactive_nav.robots import get_robot
from interactive_nav.scenes.objects import SmallObject
from interactive_nav.scenes.scene import Movable, Scene, load_scene
from interactive_nav.scenes.world import World, build_world
from interactive_nav_common.errors import ConfigError
from interactive_nav_common.rows import markdown

REFERENCE = {"sim_dt_s": 1 / 240, "solver_iterations": 100}
TOLERANCE = 1e-12
GAP_M = 0.05
"""Between the robot's and the object's bounding circles at the start."""
SECONDS = 2.5
LIMIT = 0.10
"""Largest relative error of push displacement and force sum that a setting may have to become the default."""
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
    speed_m_s: float
    offsets_m: tuple[float, ...] = (-0.08, -0.06, -0.04, -0.02, 0.0, 0.02, 0.04, 0.06, 0.08)
    turns_rad: tuple[float, ...] = (0.0, 0.4, 0.8, 1.2)


SCENARIOS = (
    Scenario("TurtleBot pushes a basket", "turtlebot", "basket", 0.35),
    Scenario("TurtleBot pushes a chair", "turtlebot", "chair", 0.35),
    Scenario("TurtleBot fails to push a sofa", "turtlebot", "sofa", 0.35),
    Scenario("TurtleBot pushes a door", "turtlebot", "door", 0.35),
    Scenario("Fetch pushes a table", "fetch", "table", 0.35),
)
SWEEP = (
    {},
    *({"sim_dt_s": dt} for dt in (1 / 240, 0.005, 0.01, 0.025, 0.05)),
    *({"sim_dt_s": 0.02, "solver_iterations": n} for n in (2, 4, 6, 50)),
    {"sim_dt_s": 0.02, "cone": "elliptic"},
    {"sim_dt_s": 0.01, "cone": "elliptic"},
    {"contact_time_constant_s": 0.04},
)
"""Settings compared on `native`, beside the defaults."""


def _lone(source: Scene, movable: Movable | None) -> Scene:
    """The scene with nothing in it but one object at the world's origin."""
    walls = np.array([[0.0, 0.0, -9.0, 1.0, 0.0, 0.0, 0.0, 0.1, 0.1, 0.1]])
    return dataclasses.replace(source, walls=walls, movables=() if movable is None else (movable,))


def _movable(source: Scene, category: str) -> Movable:
    """An object of the category: the lightest chair, which a TurtleBot's traction can move, else the heaviest."""
    found = [m for m in source.movables if m.category == category]
    if not found:
        raise ConfigError(f"{source.path} has no {category}; choose another --scene")
    return (min if category == "chair" else max)(found, key=lambda m: m.mass_kg)


def _world(scenario: Scenario, source: Scene, config: NavConfig) -> tuple[World, int, float]:
    """World, the object's slot, and its radius."""
    robot = get_robot(scenario.robot, "twist")
    if scenario.category == "basket":
        world = build_world(robot, (_lone(source, None),), config)
        small: SmallObject = world.small_objects[0]
        return world, 0, small.radius_m
    movable = _movable(source, scenario.category)
    if movable.joint is None:
        movable = dataclasses.replace(movable, pos_w=np.array([0.0, 0.0, movable.pos_w[2]]))
    world = build_world(robot, (_lone(source, movable),), config)
    reach = np.linalg.norm(np.abs(movable.boxes[:, :2]) + movable.boxes[:, 7:9], axis=1).max()
    return world, 0, float(reach)


def _starts(scenario: Scenario, world: World, slot: int, radius_m: float) -> np.ndarray:
    """[N, nq] initial states: the object at the origin at several turns, the robot in front of it, offset."""
    robot, layout, rest = world.robot, world.layout, world.rest_qpos[0]
    states = []
    for turn in scenario.turns_rad:
        for offset in scenario.offsets_m:
            qpos = rest.copy()
            if layout.slot_kind[slot] == "hinge":
                model = world.models[0]
                body = layout.slot_body[slot]
                data = mujoco.MjData(model)
                data.qpos[:] = rest
                mujoco.mj_kinematics(model, data)
                anchor = data.xanchor[model.body_jntadr[body]][:2]
                leaf = data.xipos[body][:2] - anchor
                along = leaf / np.linalg.norm(leaf)
                low, high = model.jnt_range[model.body_jntadr[body]]
                across = np.array([-along[1], along[0]]) * (1.0 if high > -low else -1.0)
                target = anchor + (1.2 + 0.4 * turn) * leaf + offset * along
                place = target - across * (robot.footprint_radius_m + 0.1)
                heading = math.atan2(across[1], across[0])
            else:
                at = layout.slot_qpos[slot]
                qpos[at : at + 2] = 0.0
                half = turn / 2
                w, x, y, z = qpos[at + 3 : at + 7]
                c, s = math.cos(half), math.sin(half)
                qpos[at + 3 : at + 7] = [c * w - s * z, c * x - s * y, c * y + s * x, c * z + s * w]
                place = np.array([-(radius_m + robot.footprint_radius_m + GAP_M), offset])
                heading = 0.0
            q = layout.robot_qpos
            qpos[q : q + 7] = [*place, robot.spawn_height_m, math.cos(heading / 2), 0, 0, math.sin(heading / 2)]
            states.append(qpos)
    return np.asarray(states, np.float32)


def push(scenario: Scenario, source: Scene, settings: dict, tolerance: float | None = None) -> dict[str, np.ndarray]:
    """Runs one scenario from all its starts.

    Returns:
        `displacement_m` [N] of the object's centre of mass (a door's: along its arc), `force_sum_n` [N] over control
        steps, `robot_m` [N, T, 2] positions, `seconds` of stepping (compiling apart).
    """
    basket = scenario.category == "basket"
    config = NavConfig.of(**{"num_objects": 1 if basket else 0, "sleep": False, **settings})
    world, slot, radius_m = _world(scenario, source, config)
    if tolerance is not None:
        for model in world.models:
            model.opt.tolerance = tolerance
            model.opt.ls_tolerance = 1e-4
            model.opt.ls_iterations = 200
    physics = make_physics(world, config)
    qpos = _starts(scenario, world, slot, radius_m)
    still = jnp.zeros((len(qpos), world.models[0].nv), jnp.float32)
    state = PhysicsState(jnp.asarray(qpos), still, still)
    robot = world.robot
    action = robot.drive(np.float64(scenario.speed_m_s), np.float64(0.0))
    command = jnp.broadcast_to(jnp.asarray(robot.command(action), jnp.float32), (len(qpos), robot.action_size))
    step = jax.jit(jax.vmap(physics.step))
    scene = jnp.zeros(len(qpos), jnp.int32)
    jax.block_until_ready(step(scene, state, command))
    start = time.perf_counter()
    force, path = np.zeros(len(qpos)), []
    q = world.layout.robot_qpos
    for _ in range(round(SECONDS / config.control_dt_s)):
        state, signals = step(scene, state, command)
        force += np.asarray(signals.force_n)
        path.append(np.asarray(state.qpos[:, q : q + 2]))
    seconds = time.perf_counter() - start
    at = world.layout.slot_qpos[slot]
    end = np.asarray(state.qpos)
    if world.layout.slot_kind[slot] == "hinge":
        model = world.models[0]
        body = world.layout.slot_body[slot]
        arm = np.linalg.norm((model.body_ipos[body] - model.jnt_pos[model.body_jntadr[body]])[:2])
        moved = np.abs(end[:, at] - qpos[:, at]) * arm
    else:
        moved = np.linalg.norm(end[:, at : at + 2] - qpos[:, at : at + 2], axis=1)
    return {"displacement_m": moved, "force_sum_n": force, "robot_m": np.stack(path, 1), "seconds": np.array(seconds)}


def compare(run: dict[str, np.ndarray], reference: dict[str, np.ndarray]) -> dict[str, float]:
    """Errors of a run against the reference, over its starts.

    Relative errors are of the means; a displacement below 5 cm is compared with 5 cm (a sofa that stays).
    """
    moved, force = reference["displacement_m"].mean(), reference["force_sum_n"].mean()
    gap = np.linalg.norm(run["robot_m"] - reference["robot_m"], axis=-1)
    return {
        "displacement_m": round(float(run["displacement_m"].mean()), 4),
        "displacement_reference_m": round(float(moved), 4),
        "displacement_error": round(float((run["displacement_m"].mean() - moved) / max(moved, 0.05)), 4),
        "force_sum_n": round(float(run["force_sum_n"].mean()), 2),
        "force_reference_n": round(float(force), 2),
        "force_error": round(float((run["force_sum_n"].mean() - force) / max(force, 1.0)), 4),
        "path_rms_m": round(float(np.sqrt((gap**2).mean())), 4),
        "seconds": round(float(run["seconds"]), 3),
    }


def measure(
    backend: str, scenarios: list[Scenario], only: str, scene: str, console: Console, out: Path, commit: str | None
) -> list[dict]:
    """All rows of one backend, appended to a file."""
    source = load_scene(scene)
    base = {"backend": resolve_backend(backend), "scene": source.name, **origin(commit)}
    rows = []
    for scenario in scenarios:
        reference = push(scenario, source, {"backend": "native", "collision": "boxes", **REFERENCE}, TOLERANCE)
        truth = push(scenario, source, {"backend": "native", "collision": "hulls", **REFERENCE}, TOLERANCE)
        jobs = [("boxes", s) for s in (SWEEP if only == "sweep" and base["backend"] == "native" else ({},))]
        if base["backend"] == "native":
            stiff = {**REFERENCE, "contact_time_constant_s": 0.02}
            jobs += [("hulls", {}), ("hulls", dict(REFERENCE)), ("boxes", dict(REFERENCE)), ("boxes", stiff)]
        for collision, settings in jobs:
            run = push(scenario, source, {"backend": base["backend"], "collision": collision, **settings})
            row = {
                **base,
                "scenario": scenario.name,
                "collision": collision,
                "sim_dt_s": PhysicsConfig.sim_dt_s,
                "solver_iterations": PhysicsConfig.solver_iterations,
                "cone": PhysicsConfig.cone,
                "contact_time_constant_s": PhysicsConfig.contact_time_constant_s,
                **settings,
                "against_boxes": compare(run, reference),
                "against_hulls": compare(run, truth),
            }
            rows.append(row)
            console.print(
                f"{scenario.name}: {row['backend']} {collision} {settings or 'defaults'}: "
                f"displacement {row['against_boxes']['displacement_error']:+.1%}, "
                f"force {row['against_boxes']['force_error']:+.1%}, "
                f"path {100 * row['against_boxes']['path_rms_m']:.1f} cm",
                soft_wrap=True,
            )
            append_row(out, row, hidden=None)
    return rows


def _setting(row: dict) -> str:
    soft = f", {1000 * row['contact_time_constant_s']:.0f} ms contacts"
    return f"{1000 * row['sim_dt_s']:.3g} ms, {row['solver_iterations']} it., {row['cone']}{soft}"


def _draw(rows: list[dict], scenarios: list[str], figure: Path) -> None:
    """Bars of errors on C MuJoCo with boxes, a row for each setting."""
    import matplotlib

    matplotlib.use("Agg")
    from matplotlib import pyplot as plt

    boxes = [r for r in rows if r["collision"] == "boxes" and r["backend"] == "native"]
    names = sorted({_setting(r) for r in boxes}, key=lambda n: (float(n.split()[0]), n))
    fig, axes = plt.subplots(1, 2, figsize=(7.2, 6.6), sharey=True, layout="constrained")
    labels = [n.replace(", pyramidal", "").replace(" contacts", "") for n in names]
    for axis, key, title in zip(
        axes, ("displacement_error", "force_error"), ("push displacement", "force sum"), strict=True
    ):
        cut: list[list[str]] = [[] for _ in names]
        for i, scenario in enumerate(scenarios):
            found = {_setting(r): r["against_boxes"][key] for r in boxes if r["scenario"] == scenario}
            errors = np.array([100 * found.get(n, np.nan) for n in names], float)
            at = np.arange(len(names)) + 0.16 * (i - 2)
            axis.barh(at, errors, 0.15, label=scenario, color=COLOURS[i])
            for row in np.flatnonzero(np.abs(errors) > SHOWN_PERCENT):
                cut[row].append(f"{errors[row]:+,.0f}")
        for row, cut_errors in enumerate(cut):
            told = f"cut:\n{', '.join(cut_errors)}" if cut_errors else ""
            axis.text(-2, row, told, ha="right", va="center", fontsize=6)
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
    """Draws the figure and returns the tables in Markdown."""
    latest: dict[tuple, dict] = {}
    for row in rows:
        latest[(row["scenario"], row["backend"], row["collision"], _setting(row))] = row
    rows = list(latest.values())
    scenarios = list(dict.fromkeys(r["scenario"] for r in rows))
    lines = []
    for row in sorted(rows, key=lambda r: (scenarios.index(r["scenario"]), r["backend"], r["collision"], _setting(r))):
        e = row["against_boxes" if row["collision"] == "boxes" else "against_hulls"]
        moved, force = f"{e['displacement_m']:.3f} m", f"{e['force_sum_n']:.0f} N"
        errors = f"{e['displacement_error']:+.1%}", f"{e['force_error']:+.1%}", f"{100 * e['path_rms_m']:.1f} cm"
        where = row["scenario"], row["backend"], row["collision"], _setting(row)
        lines.append((*where, moved, errors[0], force, *errors[1:]))
    _draw(rows, scenarios, figure)
    header = ("scenario", "backend", "collision", "setting", "displacement", "error", "force sum", "error", "path rms")
    return markdown(header, lines)


def main(argv: list[str] | None = None) -> None:
    """Measures, or reports what was measured."""
    parser = command_line(__doc__, "fidelity")
    parser.add_argument("--backend", default="native")
    parser.add_argument("--only", choices=("sweep", "environment"), default="sweep", help="environment: the defaults")
    parser.add_argument("--scene", default=SCENE)
    parser.add_argument("--scenarios", nargs="*", type=int, default=None, help="by number, 0 to 4")
    parser.add_argument("--report", action="store_true")
    args = parser.parse_args(argv)
    console = Console()
    if args.report:
        rows = [json.loads(line) for line in args.out.read_text(encoding="utf-8").splitlines()]
        print(report(rows, Path("docs/fidelity.webp")), end="")
        return
    chosen = [s for i, s in enumerate(SCENARIOS) if args.scenarios is None or i in args.scenarios]
    rows = measure(args.backend, chosen, args.only, args.scene, console, args.out, args.commit)
    table = Table("setting", "worst displacement error", "worst force error")
    for name in dict.fromkeys((r["collision"], _setting(r)) for r in rows):
        own = [r["against_boxes"] for r in rows if (r["collision"], _setting(r)) == name]
        table.add_row(
            " ".join(name),
            f"{max((o['displacement_error'] for o in own), key=abs):+.1%}",
            f"{max((o['force_error'] for o in own), key=abs):+.1%}",
        )
    console.print(table)


if __name__ == "__main__":
    main()
