"""Run `map`, `navigate`, `evaluate` and `export`: build maps, play, draw and score episodes, export runs and maps."""

import argparse
import dataclasses
import sys
import time
from collections.abc import Iterator, Sequence
from contextlib import contextmanager, nullcontext
from pathlib import Path

from interactive_nav.scenes.scene import load_scene
from interactive_nav_common.config import overridden, refuse_unused
from interactive_nav_common.errors import ConfigError
from interactive_nav_common.files import write_text
from interactive_nav_common.jobs.progress import SafeConsole, progress_bar
from interactive_nav_common.rows import where
from interactive_nav_common.signals import stop_signals
from scenes_mjcf.sets import scene_folders
from topological_nav.config import PASSAGE_POLICY, RUNS, EvaluationConfig, ExportConfig, MapConfig, NavigatorConfig
from topological_nav.errors import Host, Progress, Stopped, say
from topological_nav.evaluate.contest import Contest, contest_scenes, play_contest, tracks_of
from topological_nav.evaluate.scores import console_table, differences, markdown, summary
from topological_nav.figures.learning import export_figure
from topological_nav.figures.maps import drive_episode, film, journeys_figure, map_figure, save
from topological_nav.maps.build import Built, build_map, forget
from topological_nav.maps.graph import save_map
from topological_nav.weights.export import choose, export, fitting_map, size_lines


@contextmanager
def terminal() -> Iterator[Host]:
    """Show lines on stdout, at once, and stop at a signal."""
    with stop_signals() as stops:
        yield Host(lambda line: print(line, flush=True), lambda: stops[0] if stops else 0)


@contextmanager
def bar(signals: list[int] | None = None) -> Iterator[Progress]:
    """Show a bar with the time left on a terminal, a line every tenth elsewhere; raise `Stopped` before the end.

    `signals` are those of a `stop_signals` around it; None: it collects them itself.
    """
    console = SafeConsole(stderr=True)
    collected = stop_signals() if signals is None else nullcontext(signals)
    with collected as stops, progress_bar(console, "starting") as update:
        tenths = 0
        # Neither compiling before the first step nor what an earlier run has done says how fast it goes.
        first: tuple[float, int] | None = None

        def report(what: str, done: int, total: int) -> None:
            nonlocal tenths, first
            first = first or (time.perf_counter(), done)
            update(description=what, completed=done, total=total)
            if not console.is_terminal and done * 10 // max(total, 1) > tenths:
                tenths, (began, before), left = done * 10 // total, first, ""
                if done > before:
                    left = f", {(time.perf_counter() - began) / (done - before) * (total - done):.0f} s left"
                console.print(f"{what}: {done:,} of {total:,}{left}", highlight=False, soft_wrap=True)
            if stops and done < total:
                raise Stopped(stops[0])

        yield report


def _contest(arguments: argparse.Namespace, scenes: Sequence[str], contenders: Sequence[str], out: Path):
    """Return the contest that is requested; choose networks and maps that are not named, and build missing maps."""
    contest = Contest(
        scenes=tuple(Path(scene) for scene in scene_folders(scenes)),
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
    chosen = choose(arguments.localiser, arguments.detector, arguments.policy)
    chosen.report()
    maps, files = arguments.maps or chosen.maps[0], {}
    for folder in contest.scenes if arguments.maps is None else ():
        scene = load_scene(folder)
        there = fitting_map(chosen, scene.name, scene.digest)
        default = maps / f"{scene.name}.npz"
        # One that was built by hand with other networks is refused later, in words, and not written over.
        if there is None and (chosen.renewed or not default.is_file()):
            say(f"{scene.name} has no map of these networks yet; it is made once and kept in {default}")
            build(folder, chosen.localiser, chosen.detector, MapConfig(), default)
        files[scene.name] = there or default
    runs = {"localiser": chosen.localiser, "detector": chosen.detector, "policy": chosen.policy}
    return dataclasses.replace(contest, maps=maps, map_files=files, **runs)


def _refuse_unused(arguments: argparse.Namespace, contest: Contest) -> None:
    """Refuse settings that change nothing for these contenders."""
    names = set(contest.contenders)
    who = f"without a contender that needs it (contenders: {', '.join(contest.contenders)})"
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


def navigate(arguments: argparse.Namespace) -> None:
    """Drive one episode and draw it."""
    if arguments.video and arguments.video.suffix != ".mp4":
        raise ConfigError(f"--video {arguments.video}: expected a name that ends in .mp4")
    refuse_unused(arguments, "batch", "in 'navigate', which drives one episode")
    contest = _contest(arguments, [arguments.scene], ["sparse" if arguments.sparse else "dense"], RUNS)
    name = Path(arguments.scene).resolve().name
    out = arguments.out or RUNS / "navigate" / f"{name}-{arguments.episode}.png"
    with bar() as report:
        limit_s = int(contest.config.limit_s)

        def on_time(time_s: float) -> None:
            report(f"{name}, simulated s", int(time_s), limit_s)

        driven = drive_episode(contest, arguments.episode, bool(arguments.video), on_time)
    for line in driven.log:
        print(line)
    save(driven.figure(), out)
    print(f"{out}: {driven.outcome}")
    if arguments.video:
        print(f"{arguments.video}: {film(driven, arguments.video)} frames")


def evaluate(arguments: argparse.Namespace) -> None:
    """Play episodes and score them."""
    names = ("dense", "sparse", "expert", *(["ppo"] if arguments.ppo else []))
    names = arguments.contenders.split(",") if arguments.contenders else names
    if "ppo" not in names:
        refuse_unused(arguments, "--ppo", f"without contender ppo (--contenders {arguments.contenders})")
    contest = _contest(arguments, arguments.scenes, names, arguments.out)
    with bar() as report:
        venues = contest_scenes(contest)
        rows = play_contest(contest, venues, report)
    for venue in venues:
        panels = {}
        for name in contest.contenders:
            played = where(rows, scene=venue.scene.name, contender=name).to_pylist()
            graph = venue.map_of(name) if name in ("dense", "sparse") else None
            panels[name] = (graph, tracks_of(contest, venue, name), {row["episode"]: row for row in played})
        figure = journeys_figure(venue.scene.name, venue.space, panels, contest.config.passable)
        save(figure, contest.out / f"{venue.scene.name}.png")
    lines, compared = summary(rows), differences(rows)
    write_text(contest.out / "summary.md", markdown(lines, compared))
    SafeConsole(width=None if sys.stdout.isatty() else 160).print(console_table(lines))
    for difference in compared:
        print(difference)
    print(f"{contest.out}: {len(rows)} episodes; tables in summary.md, a picture a scene")


def make_map(arguments: argparse.Namespace) -> None:
    """Build a map and draw it."""
    config = overridden(MapConfig(), arguments.settings)
    chosen = choose(arguments.localiser, arguments.detector, PASSAGE_POLICY)
    chosen.report(policy=False)
    out = arguments.out or chosen.maps[0] / f"{Path(arguments.scene).resolve().name}.npz"
    build(Path(arguments.scene), chosen.localiser, chosen.detector, config, out, arguments.route)


def build(
    scene: Path, localiser: Path, detector: Path, config: MapConfig, out: Path, ends: Sequence[int] | None = None
) -> None:
    """Build a map, draw and describe it."""
    parts = out.with_name(f"{out.name}.parts")
    with bar() as report:
        built = build_map(scene, localiser, detector, config, report, parts)
    keep_map(built, out, ends)
    forget(parts)


def keep_map(built: Built, out: Path, ends: Sequence[int] | None = None) -> None:
    """Write, draw and describe a map, with the path between two nodes if requested."""
    save_map(built.map, out)
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


def export_runs(arguments: argparse.Namespace) -> None:
    """Write finished runs as a small folder."""
    config = overridden(ExportConfig(), arguments.settings)
    with bar() as report:
        runs = (arguments.localiser, arguments.detector, arguments.policy, arguments.maps)
        sizes, compared = export(*runs, arguments.images, arguments.out, config, report)
    picture = arguments.picture or arguments.out.with_name(f"{arguments.out.name}.png")
    save(export_figure(sizes, compared, config.limit_mib), picture)
    for name, value in compared.scores.items():
        print(f"{name.replace('_', ' ')}: {value:.3g}")
    print(f"{arguments.out}: {size_lines(sizes, config.limit_mib)}; drawn in {picture}")
