"""`python -m topological_nav data|train|map|adapt`: words on the command line in, datasets, networks and maps out.

Exit codes: 0 done, 2 on a user's error (one line on stderr), 128 + signal when asked to stop: the same command goes on.
"""

from __future__ import annotations

import argparse
import re
import sys
import time
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path

from rich.console import Console
from rich.progress import BarColumn, Progress, TextColumn, TimeElapsedColumn, TimeRemainingColumn

from scenes_mjcf.schema import SceneError
from topological_nav.adapt_config import AdaptConfig
from topological_nav.config import PITCHES, DataConfig, MapConfig, passage_config, room_config
from topological_nav.errors import SettingsError, TopologicalError
from topological_nav.settings import overridden, settings_help
from train.errors import TrainError

DATASET, RUNS = Path("runs/topological/data"), Path("runs/topological")
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

    def command(name: str, text: str, config: object) -> argparse.ArgumentParser:
        sub = commands.add_parser(
            name,
            help=text,
            description=text,
            epilog=f"settings (key=default):\n{settings_help(config)}",
            formatter_class=argparse.RawDescriptionHelpFormatter,
        )
        return sub

    data = command("data", "Renders room and passage images of scenes.", DataConfig())
    data.add_argument("scenes", nargs="+", metavar="SCENE", help="scene folders")
    data.add_argument("-o", "--out", type=Path, default=DATASET, metavar="DIR", help=f"dataset (default {DATASET})")
    train = command("train", "Trains the room classifier or the passage detector.", room_config())
    train.add_argument("task", choices=list(TASKS), help="passages differ in: batch=32 epochs=20")
    train.add_argument("--data", type=Path, default=DATASET, metavar="DIR", help=f"dataset (default {DATASET})")
    train.add_argument("-o", "--out", type=Path, metavar="DIR", help=f"run folder (default {RUNS}/TASK)")
    plan = command("map", "Builds a scene's topological map and draws it.", MapConfig())
    plan.add_argument("scene", metavar="SCENE", help="scene folder")
    plan.add_argument("--localiser", type=Path, default=RUNS / "rooms", metavar="RUN", help="embeds images")
    plan.add_argument("--detector", type=Path, default=RUNS / "passages", metavar="RUN", help="judges passages")
    plan.add_argument("-o", "--out", type=Path, metavar="PATH", help=f"map (default {RUNS}/maps/SCENE.npz)")
    plan.add_argument("--route", nargs=2, type=int, metavar=("FROM", "TO"), help="draw the way between two nodes")
    adapt = command("adapt", "Takes networks and maps to another domain.", AdaptConfig())
    adapt.add_argument(
        "what",
        choices=list(ADAPTS),
        help="features: the embedding, adversarially; passages: the detector in configurations A to D; map: of images "
        "collected in the target domain",
    )
    adapt.add_argument("scene", nargs="?", metavar="SCENE", help="map: scene folder")
    adapt.add_argument("--data", type=Path, default=DATASET, metavar="DIR", help=f"source (default {DATASET})")
    adapt.add_argument("--target", type=Path, metavar="DIR", help="dataset of the target (default: the source's)")
    adapt.add_argument("--localiser", type=Path, default=RUNS / "rooms", metavar="RUN", help="embeds images")
    adapt.add_argument("--detector", type=Path, default=RUNS / "passages", metavar="RUN", help="judges passages")
    adapt.add_argument("-o", "--out", type=Path, metavar="PATH", help=f"default {RUNS}/adapted/WHAT, a map SCENE.npz")
    return made


def main(argv: Sequence[str] | None = None) -> int:
    """Runs a command."""
    words = list(sys.argv[1:] if argv is None else argv)
    settings = [word for word in words if re.match(r"\w+=", word)]
    arguments = parser().parse_args([word for word in words if word not in settings])
    arguments.settings = settings
    try:
        {"data": _data, "train": _train, "map": _map, "adapt": _adapt}[arguments.command](arguments)
    except (TopologicalError, SceneError, TrainError) as error:
        print(f"topological_nav: {error}", file=sys.stderr)
        return 2
    except Stopped as stopped:
        print("topological_nav: stopped; the same command goes on", file=sys.stderr)
        return 128 + stopped.args[0]
    return 0


def _data(arguments: argparse.Namespace) -> None:
    config = overridden(DataConfig(), arguments.settings)
    from topological_nav.data import dataset_bytes, make_dataset
    from topological_nav.figures import dataset_figure, save

    with _stops() as stops, _bar() as tell:

        def progress(scene: str, done: int, total: int) -> None:
            tell(scene, done, total)
            if stops and done < total:
                raise Stopped(stops[0])

        header = make_dataset([Path(s) for s in arguments.scenes], arguments.out, config, progress)
    save(dataset_figure(arguments.out), arguments.out / "preview.png")
    images = sum(s["positions"] * 3 * config.headings + s["passages"] for s in header["scenes"])
    for s in header["scenes"]:
        rand = "" if s["rooms_agreement"] is None else f", adjusted Rand index {s['rooms_agreement']:.2f}"
        print(
            f"{s['name']}: {s['rooms']} rooms ({s['rooms_chosen_by']}{rand}), {s['positions']} positions "
            f"({s['test_positions']} for testing), {s['passages']} passages ({s['test_passages']})"
        )
    size = dataset_bytes(arguments.out)
    print(f"{arguments.out}: {images:,} images of {config.width} x {config.height}, {size / 2**20:.1f} MiB")


def _train(arguments: argparse.Namespace) -> None:
    config = overridden(TASKS[arguments.task](), arguments.settings)
    out = arguments.out or RUNS / arguments.task
    from topological_nav.figures import curves_figure, save
    from topological_nav.training import train
    from train.run_folder import read_metrics

    with _stops() as stops:
        results = train(
            arguments.task, arguments.data, out, config, lambda line: print(line, flush=True), lambda: bool(stops)
        )
        if results is None:
            raise Stopped(stops[0])
    save(curves_figure(read_metrics(out / "metrics.jsonl")), out / "curves.png")
    for name, row in results.get("groups", {}).items():
        print(f"{name:<8}{row['images']:>7} images  accuracy {row['accuracy']:.3f}  macro F1 {row['macro_f1']:.3f}")
    if mean := results["localisation"].get("mean"):
        print(
            f"localisation: nearest node {mean['node']:.3f}, right room {mean['room']:.3f}, "
            f"median error {mean['error_m']:.2f} m (least possible {mean['least_error_m']:.2f} m)"
        )
    print(f"{out}: {results['parameters']:,} parameters")


def _map(arguments: argparse.Namespace) -> None:
    config = overridden(MapConfig(), arguments.settings)
    from topological_nav.build import build_map
    from topological_nav.figures import map_figure, save
    from topological_nav.graph import save_map

    out = arguments.out or RUNS / "maps" / f"{Path(arguments.scene).resolve().name}.npz"
    with _bar() as tell:
        built = build_map(Path(arguments.scene), arguments.localiser, arguments.detector, config, tell)
    save_map(built.map, out)
    route = None
    if arguments.route:
        route = built.map.plan(*arguments.route)
        print(f"{arguments.route[0]} to {arguments.route[1]}: {' '.join(map(str, route.nodes))}, cost {route.cost:.2f}")
    picture = out.with_suffix(".png")
    save(map_figure(built, route), picture)
    for name, value in built.scores.items():
        print(f"{name}: {value}")
    print(
        f"{out}: {len(built.map.xy_w)} nodes, {len(built.map.edges)} edges, {out.stat().st_size / 1024:.0f} KiB; "
        f"drawn in {picture}"
    )


def _adapt(arguments: argparse.Namespace) -> None:
    config = overridden(AdaptConfig(), arguments.settings)
    if (arguments.what == "map") != bool(arguments.scene):
        raise SettingsError("adapt map takes a scene folder, adapt features and adapt passages none")
    arguments.target = arguments.target or arguments.data
    ADAPTS[arguments.what](arguments, config)


def _adapt_features(arguments: argparse.Namespace, config: AdaptConfig) -> None:
    from topological_nav.adaptation import adapt_features, target_rooms
    from topological_nav.data import load_rooms
    from topological_nav.figures import save
    from topological_nav.transfer_figures import features_figure
    from train.run_folder import read_metrics

    out = arguments.out or RUNS / "adapted" / "features"
    with _stops() as stops:
        places = arguments.localiser, arguments.data, arguments.target, out
        results = adapt_features(*places, config, lambda line: print(line, flush=True), lambda: bool(stops))
        if results is None:
            raise Stopped(stops[0])
    rendered, seen = load_rooms(arguments.target).images, target_rooms(arguments.target, config).images
    level = PITCHES.index("level")
    figure = features_figure(rendered[:, level, 0], seen[:, level, 0], read_metrics(out / "metrics.jsonl"), results)
    save(figure, out / "adaptation.png")
    for name in ("source", "before", "statistics", "after"):
        mean = results[name]["mean"]
        print(
            f"{name:<11}nearest node {mean['node']:.3f}, right room {mean['room']:.3f}, "
            f"median error {mean['error_m']:.2f} m (least possible {mean['least_error_m']:.2f} m)"
        )
    print(f"{out}: {results['target_images']:,} target images, {results['before']['queries']} queries")


def _adapt_passages(arguments: argparse.Namespace, config: AdaptConfig) -> None:
    from topological_nav.data import load_passages
    from topological_nav.domains import as_seen, preset
    from topological_nav.figures import save
    from topological_nav.transfer import CONFIGURATIONS, passage_configurations
    from topological_nav.transfer_figures import passages_figure
    from train.run_folder import read_metrics

    out = arguments.out or RUNS / "adapted" / "passages"
    with _stops() as stops:
        places = arguments.detector, arguments.target, out
        results = passage_configurations(*places, config, lambda line: print(line, flush=True), lambda: bool(stops))
        if results is None:
            raise Stopped(stops[0])
    images = load_passages(arguments.target).images
    seen = as_seen(images, preset(config.domain))
    save(passages_figure(images, seen, read_metrics(out / "metrics.jsonl"), results), out / "configurations.png")
    for name, (from_source, tunes) in CONFIGURATIONS.items():
        row, start = results[name], "the source's weights" if from_source else "fresh weights"
        how = f"{start}{', fine-tuned' if tunes else ''}"
        print(f"{name}  {how:<33}accuracy {row['accuracy']:.3f}  macro F1 {row['macro_f1']:.3f}")
    print(f"{out}: fine-tuned on {results['fine_tuned_on']} images, tested on {results['tested_on']}")


def _adapt_map(arguments: argparse.Namespace, config: AdaptConfig) -> None:
    from topological_nav.figures import map_figure, save
    from topological_nav.graph import save_map
    from topological_nav.transfer import collected_map

    scene = Path(arguments.scene)
    out = arguments.out or RUNS / "adapted" / f"{scene.resolve().name}.npz"
    built = collected_map(scene, arguments.target, arguments.localiser, arguments.detector, config)
    save_map(built.map, out)
    save(map_figure(built), out.with_suffix(".png"))
    for name, value in built.scores.items():
        print(f"{name}: {value}")
    print(f"{out}: {len(built.map.xy_w)} nodes, {len(built.map.edges)} edges; drawn in {out.with_suffix('.png')}")


ADAPTS = {"features": _adapt_features, "passages": _adapt_passages, "map": _adapt_map}


@contextmanager
def _stops() -> Iterator[list[int]]:
    from train.signals import stop_signals

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
        task = bar.add_task("starting", total=None)
        began, told = time.perf_counter(), [0]

        def tell(what: str, done: int, total: int) -> None:
            bar.update(task, description=what, completed=done, total=total)
            if not console.is_terminal and done * 10 // max(total, 1) > told[0]:
                told[0] = done * 10 // total
                left = (time.perf_counter() - began) * (total - done) / max(done, 1)
                console.print(f"{what}: {done:,} of {total:,}, {left:.0f} s left", highlight=False, soft_wrap=True)

        yield tell


if __name__ == "__main__":
    sys.exit(main())
