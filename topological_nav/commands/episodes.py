"""`navigate` and `evaluate`: episodes played, drawn and scored; maps that are nowhere are made first."""

import argparse
import dataclasses
import sys
from collections.abc import Sequence
from pathlib import Path

from interactive_nav.scenes.scene import load_scene
from interactive_nav_common.config import overridden, refuse_unused
from interactive_nav_common.errors import ConfigError
from interactive_nav_common.files import write_text
from interactive_nav_common.jobs.progress import SafeConsole
from interactive_nav_common.rows import where
from scenes_mjcf.sets import scene_folders
from topological_nav.commands.maps import build
from topological_nav.commands.progress import bar, say
from topological_nav.config import PASSAGE_POLICY, RUNS, EvaluationConfig, MapConfig, NavigatorConfig
from topological_nav.evaluate.contest import Contest, contest_scenes, play_contest, tracks_of
from topological_nav.evaluate.scores import console_table, differences, markdown, summary
from topological_nav.figures.journey import drive_episode, film
from topological_nav.figures.maps import journeys_figure, save
from topological_nav.weights.packaged import choose, fitting_map


def _contest(arguments: argparse.Namespace, scenes: Sequence[str], contenders: Sequence[str], out: Path):
    """The contest asked for; networks and maps that were not named are chosen, and maps that are nowhere made."""
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
    if chosen.told:
        say(chosen.told)
    maps, files = arguments.maps or chosen.maps[0], {}
    for folder in contest.scenes if arguments.maps is None else ():
        scene = load_scene(folder)
        there = fitting_map(chosen, scene.name, scene.digest)
        own = maps / f"{scene.name}.npz"
        # One that was made by hand with other networks is refused later, in words, and not written over.
        if there is None and (chosen.renewed or not own.is_file()):
            say(f"{scene.name} has no map of these networks yet; it is made once and kept in {own}")
            build(folder, chosen.localiser, chosen.detector, MapConfig(), own)
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


def navigate(arguments: argparse.Namespace) -> None:
    """Drives one episode and draws it."""
    if arguments.video and arguments.video.suffix != ".mp4":
        raise ConfigError(f"--video {arguments.video}: expected a name that ends in .mp4")
    refuse_unused(arguments, "batch", "in 'navigate', which drives one episode")
    contest = _contest(arguments, [arguments.scene], ["sparse" if arguments.sparse else "dense"], RUNS)
    name = Path(arguments.scene).resolve().name
    out = arguments.out or RUNS / "navigate" / f"{name}-{arguments.episode}.png"
    with bar() as tell:
        limit_s = int(contest.config.limit_s)
        driven = drive_episode(
            contest,
            arguments.episode,
            bool(arguments.video),
            lambda time_s: tell(f"{name}, simulated s", int(time_s), limit_s),
        )
    for line in driven.told:
        print(line)
    save(driven.figure(), out)
    print(f"{out}: {driven.outcome}")
    if arguments.video:
        print(f"{arguments.video}: {film(driven, arguments.video)} frames")


def evaluate(arguments: argparse.Namespace) -> None:
    """Plays episodes and scores them."""
    names = ("dense", "sparse", "expert", *(["ppo"] if arguments.ppo else []))
    names = arguments.contenders.split(",") if arguments.contenders else names
    if "ppo" not in names:
        refuse_unused(arguments, "--ppo", f"without contender ppo (--contenders {arguments.contenders})")
    contest = _contest(arguments, arguments.scenes, names, arguments.out)
    with bar() as tell:
        venues = contest_scenes(contest)
        rows = play_contest(contest, venues, tell)
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
    SafeConsole(width=None if sys.stdout.isatty() else 160).print(console_table(lines))
    for difference in compared:
        print(difference)
    print(f"{contest.out}: {len(rows)} episodes; tables in summary.md, a picture a scene")
