"""`python -m topological_nav data|train|map|navigate|evaluate|adapt|export`: words in, files and pictures out.

Exit codes: 0 done, 2 on a user's error (one line on stderr), 128 + signal when asked to stop: the same command goes on.
"""

from __future__ import annotations

import argparse
import dataclasses
import re
import signal
import sys
import time
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import TYPE_CHECKING

from rich.console import Console
from rich.progress import BarColumn, Progress, TextColumn, TimeElapsedColumn, TimeRemainingColumn

from interactive_nav_common.config import overridden, refuse_unused, settings_help
from interactive_nav_common.errors import ConfigError, UserError
from scenes_mjcf.schema import SceneError
from topological_nav.commands import adapt
from topological_nav.config import (
    PASSAGE_POLICY,
    RUNS,
    DataConfig,
    DriveConfig,
    EvaluationConfig,
    ExportConfig,
    MapConfig,
    NavigatorConfig,
    PolicyConfig,
    passage_config,
    room_config,
)

if TYPE_CHECKING:
    from topological_nav.evaluate.contest import Contest

DATASET, DRIVES = RUNS / "data", RUNS / "drives"
TASKS = {"rooms": room_config, "passages": passage_config}


class Stopped(Exception):
    """A signal asked to stop; carries its number."""


def parser() -> argparse.ArgumentParser:
    """The command line."""
    made = argparse.ArgumentParser(
        prog="python -m topological_nav",
        description="Navigation by images and a graph. Words key=value change settings: COMMAND --help lists them.",
    )
    commands = made.add_subparsers(dest="command", required=True)

    def command(name: str, text: str, config: object, **more: object) -> argparse.ArgumentParser:
        listed = "".join(f"\n\nsettings of {what}:\n{settings_help(c)}" for what, c in more.items())
        sub = commands.add_parser(
            name,
            help=text,
            description=text,
            epilog=f"settings (key=default):\n{settings_help(config)}{listed}",
            formatter_class=argparse.RawDescriptionHelpFormatter,
        )
        return sub

    data = command(
        "data",
        "Renders room and passage images of scenes, or drives of the expert.",
        DataConfig(),
        drives=DriveConfig(),
    )
    data.add_argument("scenes", nargs="+", metavar="SCENE", help="scene folders")
    data.add_argument("--drives", action="store_true", help="drive through the scenes, and render what the robot sees")
    data.add_argument("-o", "--out", type=Path, metavar="DIR", help=f"dataset (default {DATASET}; drives: {DRIVES})")
    train = command(
        "train",
        "Trains the room classifier, the passage detector or the local policy.",
        room_config(),
        policy=PolicyConfig(),
    )
    train.add_argument("task", choices=[*TASKS, "policy"], help="passages differ in: batch=32 epochs=20")
    train.add_argument("--data", type=Path, metavar="DIR", help=f"dataset (default {DATASET}; policy: {DRIVES})")
    train.add_argument(
        "--localiser", type=Path, metavar="RUN", help=f"policy: embeds images (default {RUNS / 'rooms'})"
    )
    train.add_argument(
        "--detector", type=Path, metavar="RUN", help=f"policy: embeds them too (default {RUNS / 'passages'})"
    )
    train.add_argument("--grid", action="store_true", help="policy: train with every alpha and lambda of the report")
    train.add_argument("-o", "--out", type=Path, metavar="DIR", help=f"run folder (default {RUNS}/TASK)")
    plan = command("map", "Builds a scene's topological map and draws it.", MapConfig())
    plan.add_argument("scene", metavar="SCENE", help="scene folder")
    plan.add_argument("-o", "--out", type=Path, metavar="PATH", help=f"map (default {RUNS}/maps/SCENE.npz)")
    plan.add_argument("--route", nargs=2, type=int, metavar=("FROM", "TO"), help="draw the way between two nodes")
    one = command("navigate", "Drives one episode of a scene and draws it.", EvaluationConfig())
    one.add_argument("scene", metavar="SCENE", help="scene folder")
    one.add_argument("--episode", type=int, default=0, metavar="N", help="of the scene's (default 0)")
    one.add_argument("--sparse", action="store_true", help="on the map thinned out")
    one.add_argument("-o", "--out", type=Path, metavar="PATH", help=f"picture (default {RUNS}/navigate/SCENE-N.png)")
    one.add_argument("--video", type=Path, metavar="PATH", help="film it as well (.mp4), ten times as fast")
    several = command("evaluate", "Plays fixed episodes of scenes and scores them.", EvaluationConfig())
    several.add_argument("scenes", nargs="+", metavar="SCENE", help="scene folders")
    several.add_argument(
        "--contenders",
        metavar="NAMES",
        help="comma-separated choice from dense, sparse (the navigator on its map, and on the map thinned out), "
        "expert, ppo (default: all that can be played)",
    )
    several.add_argument("--ppo", type=Path, metavar="RUN", help="run folder of `python -m train`: told the goal")
    several.add_argument("-o", "--out", type=Path, default=RUNS / "evaluation", metavar="DIR", help="rows and figures")
    for sub in (one, several):
        sub.add_argument(
            "--maps",
            type=Path,
            metavar="DIR",
            help=f"of SCENE.npz (default {RUNS}/maps, made where missing)",
        )
        sub.add_argument(
            "--policy",
            metavar="RUN",
            help="local policy (default: with the networks, where none is named); passage: straight on while the "
            "detector agrees, else turn",
        )
        sub.add_argument(
            "--domain",
            default="clean",
            metavar="NAME",
            help="camera that the navigator sees by, goals included: clean (default), lens, light, noise, blur or "
            "camera; maps of its images: `adapt map`",
        )
        sub.add_argument(
            "--truth", action="store_true", help="maps from the plan, and the truth instead of both networks"
        )
    for sub in (plan, one, several):
        sub.add_argument(
            "--localiser", type=Path, metavar="RUN", help=f"embeds images (default {RUNS}, or the package's)"
        )
        sub.add_argument("--detector", type=Path, metavar="RUN", help="judges passages (default: as the localiser)")
    adapt.add_to(command, DATASET, RUNS)
    carry = command("export", "Writes finished runs as a small folder of weights in half precision.", ExportConfig())
    carry.add_argument("--localiser", type=Path, default=RUNS / "rooms", metavar="RUN", help="embeds images")
    carry.add_argument("--detector", type=Path, default=RUNS / "passages", metavar="RUN", help="judges passages")
    carry.add_argument("--policy", type=Path, metavar="RUN", help="local policy (default: none)")
    carry.add_argument("--maps", type=Path, metavar="DIR", help="of SCENE.npz, all of them (default: none)")
    carry.add_argument(
        "--images",
        type=Path,
        default=DATASET,
        metavar="PATH",
        help=f"to compare by: dataset, scene (default {DATASET})",
    )
    carry.add_argument("-o", "--out", type=Path, default=RUNS / "export", metavar="DIR", help=f"default {RUNS}/export")
    carry.add_argument("--picture", type=Path, metavar="PATH", help="default DIR.png")
    return made


def main(argv: Sequence[str] | None = None) -> int:
    """Runs a command."""
    words = list(sys.argv[1:] if argv is None else argv)
    settings = [word for word in words if re.match(r"\w+=", word)]
    arguments = parser().parse_args([word for word in words if word not in settings])
    arguments.settings = settings
    try:
        run = {
            "data": _data,
            "train": _train,
            "map": _map,
            "navigate": _navigate,
            "evaluate": _evaluate,
            "adapt": _adapt,
            "export": _export,
        }
        run[arguments.command](arguments)
    except (UserError, SceneError) as error:
        print(f"topological_nav: {error}", file=sys.stderr)
        return 2
    except (Stopped, KeyboardInterrupt) as stopped:  # the latter: before the work began, or at a second Ctrl-C
        print("topological_nav: stopped; the same command goes on", file=sys.stderr)
        return 128 + (stopped.args[0] if isinstance(stopped, Stopped) else signal.SIGINT)
    return 0


def _data(arguments: argparse.Namespace) -> None:
    if arguments.drives:
        return _drives(arguments)
    config = overridden(DataConfig(), arguments.settings)
    out = arguments.out or DATASET
    from topological_nav.data.dataset import dataset_bytes, make_dataset
    from topological_nav.figures.maps import dataset_figure, save

    with _stops() as stops, _bar() as tell:

        def progress(scene: str, done: int, total: int) -> None:
            tell(scene, done, total)
            if stops and done < total:
                raise Stopped(stops[0])

        header = make_dataset([Path(s) for s in arguments.scenes], out, config, progress)
    save(dataset_figure(out), out / "preview.png")
    images = sum(s["positions"] * 3 * config.headings + s["passages"] for s in header["scenes"])
    for s in header["scenes"]:
        rand = "" if s["rooms_agreement"] is None else f", adjusted Rand index {s['rooms_agreement']:.2f}"
        print(
            f"{s['name']}: {s['rooms']} rooms ({s['rooms_chosen_by']}{rand}), {s['positions']} positions "
            f"({s['test_positions']} for testing), {s['passages']} passages ({s['test_passages']})"
        )
    size = dataset_bytes(out)
    print(f"{out}: {images:,} images of {config.width} x {config.height}, {size / 2**20:.1f} MiB")


def _drives(arguments: argparse.Namespace) -> None:
    config = overridden(DriveConfig(), arguments.settings)
    out, scenes = arguments.out or DRIVES, [Path(s) for s in arguments.scenes]
    from topological_nav.drives.dataset import draw_drives, drives_bytes, simulate_drives, summary
    from topological_nav.figures.drive_figures import drives_figure
    from topological_nav.figures.maps import save

    with _stops() as stops:

        def ending(tell: Callable[[str, int, int], None]) -> Callable[[str, int, int], None]:
            def progress(what: str, done: int, total: int) -> None:
                tell(what, done, total)
                if stops and done < total:
                    raise Stopped(stops[0])

            return progress

        with _bar() as tell:
            drives = simulate_drives(scenes, out, config, ending(tell))
        with _bar() as tell:
            draw_drives(scenes, out, ending(tell))
    save(drives_figure(scenes, out), out / "preview.png")
    row = summary(drives)
    print(
        f"{row['drives']:,} drives: reached {row['reached']:.3f}, in contact {row['touched']:.3f} "
        f"({row['contact_s']:.2f} s a drive), kept {int(drives.kept.sum()):,}; {row['seconds']:.1f} s long, "
        f"{row['m_s']:.2f} m/s, turning in {row['turning']:.2f} of the steps"
    )
    images = int(drives.steps[drives.kept].sum())
    size = drives_bytes(out)
    print(f"{out}: {images:,} images of {config.width} x {config.height}, {size / 2**20:.1f} MiB")


def _train(arguments: argparse.Namespace) -> None:
    if arguments.task == "policy":
        return _policy(arguments)
    refuse_unused(arguments, "--localiser --detector --grid", f"in 'train {arguments.task}'")
    if arguments.task == "passages":
        refuse_unused(arguments, "hidden pitch label_smoothing", "in 'train passages'")
    config = overridden(TASKS[arguments.task](), arguments.settings)
    if config.init != "selfsup":
        refuse_unused(arguments, "selfsup_epochs selfsup_batch selfsup_learning_rate", f"with init={config.init}")
    out = arguments.out or RUNS / arguments.task
    from interactive_nav_common.metrics_file import read_metrics
    from topological_nav.figures.maps import curves_figure, save
    from topological_nav.learn.training import train

    with _stops() as stops:
        results = train(
            arguments.task,
            arguments.data or DATASET,
            out,
            config,
            lambda line: print(line, flush=True),
            lambda: bool(stops),
        )
        if results is None:
            raise Stopped(stops[0])
    save(curves_figure(read_metrics(out / "metrics.jsonl")), out / "curves.png")
    for name, row in results.get("groups", {}).items():
        print(f"{name:<8}{row['images']:>7} images  accuracy {row['accuracy']:.3f}  macro F1 {row['macro_f1']:.3f}")
    if rows := results.get("lengths"):
        print("ahead:  " + ",  ".join(f"{row['ahead_m']:g} m {row['accuracy']:.3f}" for row in rows) + "  right")
    if mean := results["localisation"].get("mean"):
        print(
            f"localisation: nearest node {mean['node']:.3f}, right room {mean['room']:.3f}, "
            f"median error {mean['error_m']:.2f} m (least possible {mean['least_error_m']:.2f} m)"
        )
    print(f"{out}: {results['parameters']:,} parameters")


def _policy(arguments: argparse.Namespace) -> None:
    config = overridden(PolicyConfig(), arguments.settings)
    if arguments.grid:
        refuse_unused(arguments, "alpha lam", "with --grid, which takes every pair of the report's")
    out = arguments.out or RUNS / ("policy-grid" if arguments.grid else "policy")
    from interactive_nav_common.metrics_file import read_metrics
    from topological_nav.drives.imitation import embed_drives, grid_table, train_grid, train_policy
    from topological_nav.figures.drive_figures import policy_figure
    from topological_nav.figures.maps import save

    def tell(line: str) -> None:
        print(line, flush=True)

    with _stops() as stops:
        halt = lambda: bool(stops)  # noqa: E731
        runs = arguments.localiser or RUNS / "rooms", arguments.detector or RUNS / "passages"
        frames = embed_drives(arguments.data or DRIVES, *runs, config.mirror, tell, halt)
        learn = train_grid if arguments.grid else train_policy
        results = None if frames is None else learn(frames, out, config, tell, halt)
        if results is None:
            raise Stopped(stops[0])
    if isinstance(results, list):
        for row in results:
            folder = out / f"alpha-{row['alpha']:g}-lambda-{row['lambda']:g}"
            save(policy_figure(read_metrics(folder / "metrics.jsonl"), row), folder / "curves.png")
        print(grid_table(results), end="")
        return
    save(policy_figure(read_metrics(out / "metrics.jsonl"), results), out / "curves.png")
    for name in ("linear", "angular") if "test" in results else ():
        row = results["test"][name]
        print(
            f"{name:<8} {results['test']['steps']:,} held-out steps  accuracy {row['accuracy']:.3f} "
            f"(the commonest class {row['commonest']:.3f})  macro F1 {row['macro_f1']:.3f}"
        )
    if "test" in results:
        test = results["test"]
        print(f"forward model: error {test['forward']:.4f}, of no change {test['no_change']:.4f}")
    print(
        f"{out}: {results['sequences']:,} sequences ({results['nearly_straight']:.2f} of all are nearly straight), "
        f"{results['parameters']:,} parameters"
    )


def _map(arguments: argparse.Namespace) -> None:
    config = overridden(MapConfig(), arguments.settings)
    from topological_nav.weights.packaged import choose

    chosen = choose(arguments.localiser, arguments.detector, PASSAGE_POLICY)
    if chosen.said:
        _say(chosen.said)
    out = arguments.out or chosen.maps[0] / f"{Path(arguments.scene).resolve().name}.npz"
    _build(Path(arguments.scene), chosen.localiser, chosen.detector, config, out, arguments.route)


def _build(
    scene: Path, localiser: Path, detector: Path, config: MapConfig, out: Path, ends: Sequence[int] | None = None
) -> None:
    """Makes a map, draws it and tells of it."""
    from topological_nav.figures.maps import map_figure, save
    from topological_nav.maps.build import build_map, forget
    from topological_nav.maps.graph import save_map

    parts = out.with_name(f"{out.name}.parts")
    with _stops() as stops, _bar() as tell:

        def progress(what: str, done: int, total: int) -> None:
            tell(what, done, total)
            if stops:
                raise Stopped(stops[0])

        built = build_map(scene, localiser, detector, config, progress, parts)
    save_map(built.map, out)
    forget(parts)
    route = None
    if ends:
        route = built.map.plan(*ends)
        print(f"{ends[0]} to {ends[1]}: {' '.join(map(str, route.nodes))}, cost {route.cost:.2f}")
    picture = out.with_suffix(".png")
    save(map_figure(built, route), picture)
    for name, value in built.scores.items():
        print(f"{name}: {value}")
    print(
        f"{out}: {len(built.map.xy_w)} nodes, {len(built.map.edges)} edges, {out.stat().st_size / 1024:.0f} KiB; "
        f"drawn in {picture}"
    )


def _contest(arguments: argparse.Namespace, scenes: Sequence[str], contenders: Sequence[str], out: Path):
    """The contest asked for; networks and maps that were not named are chosen, and maps that are nowhere made."""
    from topological_nav.evaluate.contest import Contest

    contest = Contest(
        scenes=tuple(Path(scene) for scene in scenes),
        contenders=tuple(contenders),
        out=out,
        config=overridden(EvaluationConfig(), arguments.settings),
        truth=arguments.truth,
        policy=arguments.policy or PASSAGE_POLICY,
        ppo=getattr(arguments, "ppo", None),
        domain=arguments.domain,
    )
    _refuse_unused(arguments, contest)
    if arguments.truth or not {"dense", "sparse"} & set(contenders):
        return contest
    from interactive_nav.scenes.scene import load_scene
    from topological_nav.weights.packaged import choose, fitting_map

    chosen = choose(arguments.localiser, arguments.detector, arguments.policy)
    if chosen.told:
        _say(chosen.told)
    maps, files = arguments.maps or chosen.maps[0], {}
    for folder in contest.scenes if arguments.maps is None else ():
        scene = load_scene(folder)
        there = fitting_map(chosen, scene.name, scene.digest)
        own = maps / f"{scene.name}.npz"
        # One that was made by hand with other networks is refused later, in words, and not written over.
        if there is None and (chosen.renewed or not own.is_file()):
            _say(f"{scene.name} has no map of these networks yet; it is made once and kept in {own}")
            _build(folder, chosen.localiser, chosen.detector, MapConfig(), own)
        files[scene.name] = there or own
    return dataclasses.replace(
        contest,
        maps=maps,
        map_files=files,
        localiser=chosen.localiser,
        detector=chosen.detector,
        policy=chosen.policy,
    )


def _refuse_unused(arguments: argparse.Namespace, contest: Contest) -> None:
    """Refuses what changes nothing for these contenders."""
    names, who = (
        set(contest.contenders),
        f"without a contender that needs it (contenders: {', '.join(contest.contenders)})",
    )
    if not names & {"dense", "sparse"}:
        navigators = {f.name for f in dataclasses.fields(NavigatorConfig)} - {"limit_s", "run_s"}
        refuse_unused(arguments, "--truth --maps --localiser --detector --policy supersample", who)
        if arguments.domain != "clean":
            refuse_unused(arguments, "--domain", who)
        refuse_unused(arguments, " ".join(sorted(navigators)), who)
    if "sparse" not in names:
        refuse_unused(arguments, "thinned", who)
    if arguments.truth:
        refuse_unused(arguments, "--maps --localiser --detector match supersample", "with --truth")
    if not contest.config.glance:
        refuse_unused(arguments, "watch_s", "with glance=false")


def _navigate(arguments: argparse.Namespace) -> None:
    from topological_nav.figures.journey import drive_episode, film
    from topological_nav.figures.maps import save

    if arguments.video and arguments.video.suffix != ".mp4":
        raise ConfigError(f"--video {arguments.video}: expected a name that ends in .mp4")
    refuse_unused(arguments, "batch", "in 'navigate', which drives one episode")
    contest = _contest(arguments, [arguments.scene], ["sparse" if arguments.sparse else "dense"], RUNS)
    name = Path(arguments.scene).resolve().name
    out = arguments.out or RUNS / "navigate" / f"{name}-{arguments.episode}.png"
    with _stops() as stops, _bar() as tell:

        def progress(time_s: float) -> None:
            tell(f"{name}, simulated s", int(time_s), int(contest.config.limit_s))
            if stops:
                raise Stopped(stops[0])

        driven = drive_episode(contest, arguments.episode, bool(arguments.video), progress)
    for line in driven.told:
        print(line)
    save(driven.figure(), out)
    print(f"{out}: {driven.outcome}")
    if arguments.video:
        print(f"{arguments.video}: {film(driven, arguments.video)} frames")


def _evaluate(arguments: argparse.Namespace) -> None:
    from interactive_nav_common.files import write_text
    from topological_nav.evaluate.contest import hold, tracks_of, venues_of
    from topological_nav.evaluate.scores import console_table, differences, markdown, summary, where
    from topological_nav.figures.episode_figures import journeys_figure
    from topological_nav.figures.maps import save

    names = ("dense", "sparse", "expert", *(["ppo"] if arguments.ppo else []))
    names = arguments.contenders.split(",") if arguments.contenders else names
    if "ppo" not in names:
        refuse_unused(arguments, "--ppo", f"without contender ppo (--contenders {arguments.contenders})")
    contest = _contest(arguments, arguments.scenes, names, arguments.out)
    with _stops() as stops, _bar() as tell:

        def progress(what: str, done: int, total: int) -> None:
            tell(what, done, total)
            if stops and done < total:
                raise Stopped(stops[0])

        venues = venues_of(contest)
        rows = hold(contest, venues, progress)
    for venue in venues:
        panels = {}
        for name in contest.contenders:
            mine = where(rows, scene=venue.scene.name, contender=name).to_pylist()
            made = venue.map_of(name) if name in ("dense", "sparse") else None
            panels[name] = (made, tracks_of(contest, venue, name), {row["episode"]: row for row in mine})
        save(
            journeys_figure(venue.scene.name, venue.space, panels, contest.config.passable),
            contest.out / f"{venue.scene.name}.png",
        )
    lines, compared = summary(rows), differences(rows)
    write_text(contest.out / "summary.md", markdown(lines, compared))
    Console(width=None if sys.stdout.isatty() else 160).print(console_table(lines))
    for difference in compared:
        print(f"{difference.compared}, {difference.score}: {difference}")
    print(f"{contest.out}: {len(rows)} episodes; tables in summary.md, a picture a scene")


def _adapt(arguments: argparse.Namespace) -> None:
    with _stops() as stops:
        if not adapt.run(arguments, lambda: bool(stops)):
            raise Stopped(stops[0])


def _export(arguments: argparse.Namespace) -> None:
    config = overridden(ExportConfig(), arguments.settings)
    from topological_nav.figures.export_figure import export_figure
    from topological_nav.figures.maps import save
    from topological_nav.learn.training import load_trained
    from topological_nav.weights.export import export, level_images, size_lines

    with _stops() as stops, _bar() as tell:

        def progress(what: str, done: int, total: int) -> None:
            tell(what, done, total)
            if stops and done < total:
                raise Stopped(stops[0])

        networks = load_trained(arguments.localiser), load_trained(arguments.detector)
        images = level_images(arguments.images, networks, config.places, progress)
        runs = (arguments.localiser, arguments.detector, arguments.policy, arguments.maps)
        made = export(*runs, images, arguments.out, config, progress)
    picture = arguments.picture or arguments.out.with_name(f"{arguments.out.name}.png")
    save(export_figure(made, config.limit_mib), picture)
    for name, value in made.compared.scores.items():
        print(f"{name.replace('_', ' ')}: {value:.3g}")
    print(f"{arguments.out}: {size_lines(made.sizes, config.limit_mib)}; drawn in {picture}")


def _say(line: str) -> None:
    print(line, file=sys.stderr, flush=True)


@contextmanager
def _stops() -> Iterator[list[int]]:
    from interactive_nav_common.signals import stop_signals

    with stop_signals() as seen:
        yield seen


@contextmanager
def _bar():
    """A bar with the time left on a terminal, a line every tenth elsewhere."""
    console = Console(stderr=True)
    columns = (
        TextColumn("{task.description:<14}"),
        BarColumn(),
        TimeElapsedColumn(),
        TextColumn("left"),
        TimeRemainingColumn(),
    )
    with Progress(*columns, console=console, disable=not console.is_terminal) as bar:
        task, tenths = bar.add_task("starting", total=None), 0
        # Neither compiling before the first step nor what an earlier run has done says how fast it goes.
        first: tuple[float, int] | None = None

        def tell(what: str, done: int, total: int) -> None:
            nonlocal tenths, first
            first = first or (time.perf_counter(), done)
            bar.update(task, description=what, completed=done, total=total)
            if not console.is_terminal and done * 10 // max(total, 1) > tenths:
                tenths, (began, before), left = done * 10 // total, first, ""
                if done > before:
                    left = f", {(time.perf_counter() - began) / (done - before) * (total - done):.0f} s left"
                console.print(f"{what}: {done:,} of {total:,}{left}", highlight=False, soft_wrap=True)

        yield tell


if __name__ == "__main__":
    sys.exit(main())
