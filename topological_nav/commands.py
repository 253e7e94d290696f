"""Run the commands: make datasets, train and adapt networks, build maps, play and score episodes, export."""

import dataclasses
import sys
from collections.abc import Sequence
from pathlib import Path
from typing import Any

from interactive_nav import load_scene
from interactive_nav_common.config import field_docs, overridden, refuse_unused
from interactive_nav_common.errors import ConfigError
from interactive_nav_common.files import whole_folder, write_text
from interactive_nav_common.jobs.progress import SafeConsole, bar, say
from interactive_nav_common.records import read_metrics
from interactive_nav_common.rows import where
from interactive_nav_common.signals import stop_signals
from scenes_mjcf.sets import scene_folders
from topological_nav import adaptation
from topological_nav import config as configs
from topological_nav.config import ADAPTED, DATASET, DRIVES, PASSAGE_POLICY, RUNS, MapConfig
from topological_nav.data.dataset import load_rooms, make_dataset, read_header
from topological_nav.data.domains import AdaptConfig
from topological_nav.data.photographs import import_photographs, unpack_bag
from topological_nav.drives.dataset import draw_drives, simulate_drives, summary
from topological_nav.drives.driving import embed_drives, load_policy
from topological_nav.drives.imitation import grid_table, train_grid, train_policy
from topological_nav.evaluate import scores
from topological_nav.evaluate.contest import Contest, contest_scenes, play_contest, tracks_of
from topological_nav.figures import learning as figures
from topological_nav.figures.maps import dataset_figure, drive_episode, film, journeys_figure, map_figure, save
from topological_nav.figures.report import draw_report, transferred
from topological_nav.learn.networks import in_words
from topological_nav.learn.training import load_networks, train
from topological_nav.maps.build import Built, build_map
from topological_nav.maps.graph import save_map
from topological_nav.presets import configured, preset_of
from topological_nav.tables import tables
from topological_nav.weights.export import choose, export, fitting_map, level_images
from topological_nav.weights.onnx_files import onnx_models


def contest_of(arguments: Any, scenes: Sequence[str], contenders: Sequence[str], out: Path):
    """Return the contest that is requested; choose networks and maps that are not named, and build missing maps."""
    contest = Contest(
        scenes=tuple(Path(scene) for scene in scene_folders(scenes)),
        contenders=tuple(contenders),
        out=out,
        config=configured(configs.EvaluationConfig(), arguments.settings, "evaluate"),
        preset=preset_of(arguments.settings) or "default",
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


def _refuse_unused(arguments: Any, contest: Contest) -> None:
    """Refuse settings that do not affect these contenders."""
    names = set(contest.contenders)
    who = f"without a contender that needs it (contenders: {', '.join(contest.contenders)})"
    if not names & {"dense", "sparse"}:
        navigators = {f.name for of in (configs.NavigatorConfig, configs.GapConfig) for f in dataclasses.fields(of)}
        refuse_unused(arguments, "--truth --maps --localiser --detector --policy supersample", who)
        if arguments.domain != "clean":
            refuse_unused(arguments, "--domain", who)
        refuse_unused(arguments, " ".join(sorted(navigators - {"limit_s", "run_s"})), who)
    if "sparse" not in names:
        refuse_unused(arguments, "thinned", who)
    if arguments.truth:
        refuse_unused(arguments, "--maps --localiser --detector match supersample", "with --truth")
    if not contest.config.glance:
        refuse_unused(arguments, "watch_s", "with glance=false")


def run_navigate(arguments: Any) -> None:
    if arguments.video and arguments.video.suffix != ".mp4":
        raise ConfigError(f"--video {arguments.video}: expected a name that ends in .mp4")
    refuse_unused(arguments, "batch", "in 'navigate', which drives one episode")
    contest = contest_of(arguments, [arguments.scene], ["sparse" if arguments.sparse else "dense"], RUNS)
    name = Path(arguments.scene).resolve().name
    out = arguments.out or RUNS / "navigate" / f"{name}-{arguments.episode}.png"
    (venue,) = contest_scenes(contest)
    with bar() as report:
        camera = venue.film_camera if arguments.video else None
        driven = drive_episode(venue, contest.contenders[0], arguments.episode, camera, report)
    for line in driven.log:
        print(line)
    save(driven.figure(), out)
    print(f"{out}: {driven.outcome}")
    if arguments.video:
        print(f"{arguments.video}: {film(driven, arguments.video)} frames")


def run_evaluate(arguments: Any) -> None:
    names = ("dense", "sparse", "expert", *(["ppo"] if arguments.ppo else []))
    names = arguments.contenders.split(",") if arguments.contenders else names
    if "ppo" not in names:
        refuse_unused(arguments, "--ppo", f"without contender ppo (--contenders {arguments.contenders})")
    contest = contest_of(arguments, arguments.scenes, names, arguments.out)
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
    lines, compared = scores.summary(rows), scores.differences(rows)
    write_text(contest.out / "summary.md", scores.markdown(lines, compared))
    SafeConsole(width=None if sys.stdout.isatty() else 160).print(scores.console_table(lines))
    for what, name, result in compared:
        print(f"{what}, {name}: {scores.text(result)}")
    print(f"{contest.out}: {len(rows)} episodes; tables in summary.md, a picture a scene")


def run_map(arguments: Any) -> None:
    config = configured(MapConfig(), arguments.settings, "map")
    chosen = choose(arguments.localiser, arguments.detector, PASSAGE_POLICY)
    chosen.report(policy=False)
    out = arguments.out or chosen.maps[0] / f"{Path(arguments.scene).resolve().name}.npz"
    build(Path(arguments.scene), chosen.localiser, chosen.detector, config, out, arguments.route)


def build(
    scene: Path, localiser: Path, detector: Path, config: MapConfig, out: Path, ends: Sequence[int] | None = None
) -> None:
    """Build a map, draw and describe it."""
    with bar() as report:
        built = build_map(scene, localiser, detector, config, report)
    keep_map(built, out, ends)


def keep_map(built: Built, out: Path, ends: Sequence[int] | None = None) -> None:
    """Write, draw and describe a map, with the path between two nodes if requested."""
    save_map(built.map, out)
    route = []
    if ends:
        route, cost = built.map.plan(*ends)
        print(f"{ends[0]} to {ends[1]}: {' '.join(map(str, route))}, cost {cost:.2f}")
    picture = out.with_suffix(".png")
    save(map_figure(built.space, [built.map], route), picture)
    for name, value in built.scores.items():
        print(f"{name}: {value}")
    print(
        f"{out}: {len(built.map.xy_w)} nodes, {len(built.map.edges)} edges, {out.stat().st_size / 1024:.0f} KiB; "
        f"drawn in {picture}"
    )


def run_export(arguments: Any) -> None:
    config = overridden(configs.ExportConfig(), arguments.settings)
    if arguments.onnx:
        refuse_unused(arguments, "--maps tolerance commit", "with --onnx")
        networks = load_networks(arguments.localiser, arguments.detector)
        driver = arguments.policy and load_policy(arguments.policy, arguments.localiser, arguments.detector)
        with bar() as report, whole_folder(arguments.out) as part:
            images = level_images(arguments.images, networks, config.places, report)
            for name, content in onnx_models(networks, driver, images).items():
                (part / f"{name}.onnx").write_bytes(content)
        return print(f"{arguments.out}: as JAX over {len(images) * images.shape[1]:,} images")
    with bar() as report:
        runs = (arguments.localiser, arguments.detector, arguments.policy, arguments.maps)
        compared = export(*runs, arguments.images, arguments.out, config, report)
    for name, value in compared.items():
        print(f"{name.replace('_', ' ')}: {value:.3g}")
    size = sum(path.stat().st_size for path in arguments.out.rglob("*") if path.is_file())
    print(f"{arguments.out}: {size / 2**20:.2f} MiB")


def run_tables(arguments: Any) -> None:
    write_text(arguments.runs / "tables.md", tables(arguments.runs))
    print(arguments.runs / "tables.md")


def run_figures(arguments: Any) -> None:
    refuse_unused(arguments, "--truth batch", "in 'figures', which draws what networks see in one episode at a time")
    contest = contest_of(arguments, [arguments.scene], ["dense", "sparse"], arguments.out or arguments.runs / "figures")
    with bar() as report:
        draw_report(contest, arguments.runs, report)


def run_data(arguments: Any) -> None:
    if arguments.photographs:
        return _photographs(arguments)
    if arguments.drives:
        return _drives(arguments)
    config = configured(configs.DataConfig(), arguments.settings, "data")
    out = arguments.out or DATASET
    with bar() as report:
        header = make_dataset([Path(s) for s in scene_folders(arguments.scenes)], out, config, report)
    save(dataset_figure(out), out / "preview.png")
    images = sum(s["positions"] * 3 * config.headings + s["passages"] for s in header["scenes"])
    for s in header["scenes"]:
        rand = "" if s["rooms_agreement"] is None else f", adjusted Rand index {s['rooms_agreement']:.2f}"
        print(
            f"{s['name']}: {s['rooms']} rooms ({s['rooms_chosen_by']}{rand}), {s['positions']} positions "
            f"({s['test_positions']} for testing), {s['passages']} passages ({s['test_passages']})"
        )
    print(_size_line(out, images, config))


def _photographs(arguments: Any) -> None:
    refuse_unused(arguments, "--drives objects", "with --photographs")
    folder, out, scenes = arguments.photographs, arguments.out or DATASET, arguments.scenes
    if len(scenes) > 1:
        raise ConfigError(f"--photographs are of one building, got scenes {', '.join(scenes)}; name one or none")
    if (folder / "metadata.yaml").is_file() or folder.suffix in (".mcap", ".db3"):
        return print(unpack_bag(folder, out))
    config = configured(configs.DataConfig(), arguments.settings, "data")
    print(import_photographs(folder, out, config, Path(scenes[0]) if scenes else None))
    save(dataset_figure(out), out / "preview.png")


def _size_line(out: Path, images: int, config: configs.CameraConfig) -> str:
    size = sum(path.stat().st_size for path in out.rglob("*.npz"))
    return f"{out}: {images:,} images of {config.width} x {config.height}, {size / 2**20:.1f} MiB"


def _drives(arguments: Any) -> None:
    config = configured(configs.DriveConfig(), arguments.settings, "drives")
    out, scenes = arguments.out or DRIVES, [Path(s) for s in scene_folders(arguments.scenes)]
    with stop_signals() as stops:
        with bar(stops) as report:
            drives = simulate_drives(scenes, out, config, report)
        with bar(stops) as report:
            draw_drives(scenes, out, report)
    save(figures.drives_figure(scenes, out), out / "preview.png")
    row = summary(drives)
    print(
        f"{row['drives']:,} drives: reached {row['reached']:.3f}, in contact {row['touched']:.3f} "
        f"({row['contact_s']:.2f} s a drive), kept {int(drives.kept.sum()):,}; {row['seconds']:.1f} s long, "
        f"{row['m_s']:.2f} m/s, turning in {row['turning']:.2f} of the steps"
    )
    print(_size_line(out, int(drives.steps[drives.kept].sum()), config))


def run_train(arguments: Any) -> None:
    if arguments.task == "policy":
        return _policy(arguments)
    refuse_unused(arguments, "--localiser --detector --grid", f"in 'train {arguments.task}'")
    unused = "test_scenes" if arguments.task == "rooms" else "pitch label_smoothing test_headings"
    refuse_unused(arguments, unused, f"in 'train {arguments.task}'")
    config = configured(configs.TASKS[arguments.task], arguments.settings, arguments.task)
    if config.network == "alexnet":
        refuse_unused(arguments, "first_stage" + " hidden" * (arguments.task == "passages"), "with network=alexnet")
    out = arguments.out or RUNS / arguments.task
    folders = arguments.data or (DATASET,)
    if len(folders) > 1:
        raise ConfigError(f"--data names {len(folders)} folders, expected one in 'train {arguments.task}'")
    results = train(arguments.task, folders[0], out, config)
    save(figures.curves_figure(read_metrics(out / "metrics.jsonl")), out / "curves.png")
    for name, row in results.get("groups", {}).items():
        print(f"{name:<8}{row['images']:>7} images  accuracy {row['accuracy']:.3f}  macro F1 {row['macro_f1']:.3f}")
    if rows := results.get("lengths"):
        print("ahead:  " + ",  ".join(f"{row['ahead_m']:g} m {row['accuracy']:.3f}" for row in rows) + "  right")
    if mean := results["localisation"].get("mean"):
        print(f"localisation: {in_words(mean)}")
    print(f"{out}: {results['parameters']:,} parameters")


def _policy(arguments: Any) -> None:
    config = configured(configs.PolicyConfig(), arguments.settings, "policy")
    unused = ("alpha lam", "with --grid, which takes several") if arguments.grid else ("pairs", "without --grid")
    refuse_unused(arguments, *unused)
    out = arguments.out or RUNS / ("policy-grid" if arguments.grid else "policy")
    runs = arguments.localiser or RUNS / "rooms", arguments.detector or RUNS / "passages"
    frames = embed_drives(arguments.data or (DRIVES,), *runs, config.mirror)
    results = (train_grid if arguments.grid else train_policy)(frames, out, config)
    rows = results if isinstance(results, list) else [results]
    for row in rows:
        folder = out / f"alpha-{row['alpha']:g}-lambda-{row['lambda']:g}" if arguments.grid else out
        save(figures.policy_figure(read_metrics(folder / "metrics.jsonl"), row), folder / "curves.png")
    print(grid_table(rows), end="")
    print(
        f"{out}: {rows[0]['sequences']:,} sequences ({rows[0]['nearly_straight']:.2f} of all are nearly straight), "
        f"{rows[0]['parameters']:,} parameters"
    )


def run_adapt(arguments: Any) -> None:
    config = configured(AdaptConfig(), arguments.settings, "adapt")
    if arguments.what != "map" and arguments.scene:
        raise ConfigError(f"adapt {arguments.what} takes no scene folder; leave out {arguments.scene}")
    _refuse_unused_to_adapt(arguments)
    arguments.data = arguments.data or DATASET
    arguments.target = arguments.target or arguments.data
    needs = _NEEDS[arguments.what]
    chosen = choose(arguments.localiser, arguments.detector, needs=needs)
    if config.domain != "clean" and "by_hand" in read_header(arguments.target)[0]["scenes"][0]:
        raise ConfigError(f"{arguments.target}: is of photographs, which no camera is laid over; say domain=clean")
    arguments.localiser, arguments.detector = chosen.localiser, chosen.detector
    chosen.report(policy=False)
    ADAPTATIONS[arguments.what](arguments, config)


def _refuse_unused_to_adapt(arguments: Any) -> None:
    """Refuse settings of other adaptations, by the settings' docstrings."""
    what = arguments.what
    why = f"in 'adapt {what}'"
    docs = field_docs(AdaptConfig)
    others = [name for name, doc in docs.items() if doc.partition(":")[0] in _NEEDS and not doc.startswith(f"{what}:")]
    refuse_unused(arguments, " ".join(others), why)
    if what == "map":
        refuse_unused(arguments, "seed", why)
    if "rooms" not in _NEEDS[what]:
        refuse_unused(arguments, "--localiser", why)
    if "passages" not in _NEEDS[what]:
        refuse_unused(arguments, "--detector", why)
    elif arguments.target:
        refuse_unused(arguments, "--data", f"{why} with --target")


def _adapt_features(arguments: Any, config: AdaptConfig) -> None:
    out = arguments.out or ADAPTED / "features"
    results = adaptation.adapt_features(arguments.localiser, arguments.data, arguments.target, out, config)
    rendered, captured = load_rooms(arguments.target).images, adaptation.target_rooms(arguments.target, config).images
    level = configs.PITCHES.index("level")
    figure = figures.features_figure(
        rendered[:, level, 0], captured[:, level, 0], read_metrics(out / "metrics.jsonl"), results
    )
    save(figure, out / "adaptation.png")
    for name in ("source", "before", "statistics", "after"):
        print(f"{name:<11}{in_words(results[name]['mean'])}")
    print(f"{out}: {results['target_images']:,} target images, {results['before']['queries']} queries")


def _adapt_passages(arguments: Any, config: AdaptConfig) -> None:
    out = arguments.out or ADAPTED / "passages"
    results = adaptation.passage_configurations(arguments.detector, arguments.target, out, config)
    for _, figure in transferred(out, arguments.target, arguments.detector):
        save(figure, out / "configurations.png")
    for name, (from_source, tunes) in adaptation.CONFIGURATIONS.items():
        row, start = results[name], "the source's weights" if from_source else "fresh weights"
        how = f"{start}{', fine-tuned' if tunes else ''}"
        print(f"{name}  {how:<33}accuracy {row['accuracy']:.3f}  macro F1 {row['macro_f1']:.3f}")
    print(f"{out}: fine-tuned on {results['fine_tuned_on']} images, tested on {results['tested_on']}")


def _adapt_map(arguments: Any, config: AdaptConfig) -> None:
    runs = arguments.localiser, arguments.detector
    built = adaptation.collected_map(arguments.scene, arguments.target, *runs, config)
    keep_map(built, arguments.out or ADAPTED / f"{built.map.scene}.npz")


_NEEDS = {"features": ("rooms",), "passages": ("passages",), "map": ("rooms", "passages")}
ADAPTATIONS = {"features": _adapt_features, "passages": _adapt_passages, "map": _adapt_map}
