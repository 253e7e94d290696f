"""Run `data`, `train` and `adapt`: make datasets of scenes, and networks and policies of datasets."""

import argparse
from pathlib import Path

from interactive_nav_common.config import field_docs, overridden, refuse_unused
from interactive_nav_common.errors import ConfigError
from interactive_nav_common.records import read_metrics
from interactive_nav_common.signals import stop_signals
from scenes_mjcf.sets import scene_folders
from topological_nav.adapt.adaptation import (
    CONFIGURATIONS,
    adapt_features,
    collected_map,
    passage_configurations,
    target_rooms,
)
from topological_nav.adapt.config import AdaptConfig
from topological_nav.commands.episodes import bar, keep_map, terminal
from topological_nav.config import (
    ADAPTED,
    DATASET,
    DRIVES,
    PITCHES,
    RUNS,
    TASKS,
    CameraConfig,
    DataConfig,
    DriveConfig,
    PolicyConfig,
)
from topological_nav.data.dataset import load_passages, load_rooms, make_dataset
from topological_nav.data.domains import as_seen, preset
from topological_nav.data.folders import folder_bytes
from topological_nav.drives.dataset import draw_drives, simulate_drives, summary
from topological_nav.drives.driving import embed_drives
from topological_nav.drives.imitation import grid_table, train_grid, train_policy
from topological_nav.errors import Host
from topological_nav.figures.learning import (
    curves_figure,
    drives_figure,
    features_figure,
    passages_figure,
    policy_figure,
)
from topological_nav.figures.maps import dataset_figure, save
from topological_nav.learn.networks import in_words
from topological_nav.learn.training import train as train_network
from topological_nav.weights.export import choose


def data(arguments: argparse.Namespace) -> None:
    """Render a dataset, or drives of the expert."""
    if arguments.drives:
        return _drives(arguments)
    config = overridden(DataConfig(), arguments.settings)
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


def _size_line(out: Path, images: int, config: CameraConfig) -> str:
    return f"{out}: {images:,} images of {config.width} x {config.height}, {folder_bytes(out) / 2**20:.1f} MiB"


def _drives(arguments: argparse.Namespace) -> None:
    config = overridden(DriveConfig(), arguments.settings)
    out, scenes = arguments.out or DRIVES, [Path(s) for s in scene_folders(arguments.scenes)]
    with stop_signals() as stops:
        with bar(stops) as report:
            drives = simulate_drives(scenes, out, config, report)
        with bar(stops) as report:
            draw_drives(scenes, out, report)
    save(drives_figure(scenes, out), out / "preview.png")
    row = summary(drives)
    print(
        f"{row['drives']:,} drives: reached {row['reached']:.3f}, in contact {row['touched']:.3f} "
        f"({row['contact_s']:.2f} s a drive), kept {int(drives.kept.sum()):,}; {row['seconds']:.1f} s long, "
        f"{row['m_s']:.2f} m/s, turning in {row['turning']:.2f} of the steps"
    )
    print(_size_line(out, int(drives.steps[drives.kept].sum()), config))


def train(arguments: argparse.Namespace) -> None:
    """Train a network or a local policy."""
    if arguments.task == "policy":
        return _policy(arguments)
    refuse_unused(arguments, "--localiser --detector --grid", f"in 'train {arguments.task}'")
    if arguments.task == "passages":
        refuse_unused(arguments, "hidden pitch label_smoothing", "in 'train passages'")
    config = overridden(TASKS[arguments.task], arguments.settings)
    if config.init != "selfsup":
        refuse_unused(arguments, "selfsup_epochs selfsup_batch selfsup_learning_rate", f"with init={config.init}")
    out = arguments.out or RUNS / arguments.task
    with terminal() as host:
        results = train_network(arguments.task, arguments.data or DATASET, out, config, host)
    save(curves_figure(read_metrics(out / "metrics.jsonl")), out / "curves.png")
    for name, row in results.get("groups", {}).items():
        print(f"{name:<8}{row['images']:>7} images  accuracy {row['accuracy']:.3f}  macro F1 {row['macro_f1']:.3f}")
    if rows := results.get("lengths"):
        print("ahead:  " + ",  ".join(f"{row['ahead_m']:g} m {row['accuracy']:.3f}" for row in rows) + "  right")
    if mean := results["localisation"].get("mean"):
        print(f"localisation: {in_words(mean)}")
    print(f"{out}: {results['parameters']:,} parameters")


def _policy(arguments: argparse.Namespace) -> None:
    config = overridden(PolicyConfig(), arguments.settings)
    if arguments.grid:
        refuse_unused(arguments, "alpha lam", "with --grid, which takes every pair of the report's")
    out = arguments.out or RUNS / ("policy-grid" if arguments.grid else "policy")
    with terminal() as host:
        runs = arguments.localiser or RUNS / "rooms", arguments.detector or RUNS / "passages"
        frames = embed_drives(arguments.data or DRIVES, *runs, config.mirror, host)
        learn = train_grid if arguments.grid else train_policy
        results = learn(frames, out, config, host)
    if isinstance(results, list):
        for row in results:
            folder = out / f"alpha-{row['alpha']:g}-lambda-{row['lambda']:g}"
            save(policy_figure(read_metrics(folder / "metrics.jsonl"), row), folder / "curves.png")
        print(grid_table(results), end="")
        return
    save(policy_figure(read_metrics(out / "metrics.jsonl"), results), out / "curves.png")
    if test := results.get("test"):
        for name in ("linear", "angular"):
            print(
                f"{name:<8} {test['steps']:,} held-out steps  accuracy {test[name]['accuracy']:.3f} "
                f"(the commonest class {test[name]['commonest']:.3f})  macro F1 {test[name]['macro_f1']:.3f}"
            )
        print(f"forward model: error {test['forward']:.4f}, of no change {test['no_change']:.4f}")
    print(
        f"{out}: {results['sequences']:,} sequences ({results['nearly_straight']:.2f} of all are nearly straight), "
        f"{results['parameters']:,} parameters"
    )


def adapt(arguments: argparse.Namespace) -> None:
    """Take networks, and a map, to another domain."""
    config = overridden(AdaptConfig(), arguments.settings)
    if (arguments.what == "map") != bool(arguments.scene):
        raise ConfigError("adapt map takes a scene folder, adapt features and adapt passages none")
    _refuse_unused(arguments)
    arguments.data = arguments.data or DATASET
    arguments.target = arguments.target or arguments.data
    needs = _NEEDS[arguments.what]
    chosen = choose(arguments.localiser, arguments.detector, needs=needs)
    arguments.localiser, arguments.detector = chosen.localiser, chosen.detector
    chosen.report(policy=False)
    with terminal() as host:
        ADAPTATIONS[arguments.what](arguments, config, host)


def _refuse_unused(arguments: argparse.Namespace) -> None:
    """Refuse settings of other adaptations; the settings' docstrings say whose they are."""
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


def _adapt_features(arguments: argparse.Namespace, config: AdaptConfig, host: Host) -> None:
    out = arguments.out or ADAPTED / "features"
    results = adapt_features(arguments.localiser, arguments.data, arguments.target, out, config, host)
    rendered, captured = load_rooms(arguments.target).images, target_rooms(arguments.target, config).images
    level = PITCHES.index("level")
    figure = features_figure(rendered[:, level, 0], captured[:, level, 0], read_metrics(out / "metrics.jsonl"), results)
    save(figure, out / "adaptation.png")
    for name in ("source", "before", "statistics", "after"):
        print(f"{name:<11}{in_words(results[name]['mean'])}")
    print(f"{out}: {results['target_images']:,} target images, {results['before']['queries']} queries")


def _adapt_passages(arguments: argparse.Namespace, config: AdaptConfig, host: Host) -> None:
    out = arguments.out or ADAPTED / "passages"
    results = passage_configurations(arguments.detector, arguments.target, out, config, host)
    images = load_passages(arguments.target).images
    captured = as_seen(images, preset(config.domain))
    save(passages_figure(images, captured, read_metrics(out / "metrics.jsonl"), results), out / "configurations.png")
    for name, (from_source, tunes) in CONFIGURATIONS.items():
        row, start = results[name], "the source's weights" if from_source else "fresh weights"
        how = f"{start}{', fine-tuned' if tunes else ''}"
        print(f"{name}  {how:<33}accuracy {row['accuracy']:.3f}  macro F1 {row['macro_f1']:.3f}")
    print(f"{out}: fine-tuned on {results['fine_tuned_on']} images, tested on {results['tested_on']}")


def _adapt_map(arguments: argparse.Namespace, config: AdaptConfig, host: Host) -> None:
    del host
    scene = Path(arguments.scene)
    out = arguments.out or ADAPTED / f"{scene.resolve().name}.npz"
    keep_map(collected_map(scene, arguments.target, arguments.localiser, arguments.detector, config), out)


_NEEDS = {"features": ("rooms",), "passages": ("passages",), "map": ("rooms", "passages")}
ADAPTATIONS = {"features": _adapt_features, "passages": _adapt_passages, "map": _adapt_map}
