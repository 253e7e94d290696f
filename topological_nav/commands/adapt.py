"""`python -m topological_nav adapt features|passages|map`: words in, networks and maps of another domain out."""

import argparse
from pathlib import Path

from interactive_nav_common.config import field_docs, overridden, refuse_unused
from interactive_nav_common.errors import ConfigError
from interactive_nav_common.records import read_metrics
from topological_nav.adapt.adaptation import adapt_features, target_rooms
from topological_nav.adapt.config import AdaptConfig
from topological_nav.adapt.transfer import CONFIGURATIONS, collected_map, passage_configurations
from topological_nav.commands.maps import keep_map
from topological_nav.commands.progress import say, terminal
from topological_nav.config import ADAPTED, DATASET, PITCHES
from topological_nav.data.dataset import load_passages, load_rooms
from topological_nav.data.domains import as_seen, preset
from topological_nav.errors import Host
from topological_nav.figures.maps import save
from topological_nav.figures.transfer_figures import features_figure, passages_figure
from topological_nav.learn.networks import in_words
from topological_nav.weights.packaged import choose


def run(arguments: argparse.Namespace) -> None:
    """Runs the command."""
    config = overridden(AdaptConfig(), arguments.settings)
    if (arguments.what == "map") != bool(arguments.scene):
        raise ConfigError("adapt map takes a scene folder, adapt features and adapt passages none")
    _refuse_unused(arguments)
    arguments.data = arguments.data or DATASET
    arguments.target = arguments.target or arguments.data
    needs = _NEEDS[arguments.what]
    chosen = choose(arguments.localiser, arguments.detector, needs=needs)
    arguments.localiser, arguments.detector = chosen.localiser, chosen.detector
    if chosen.said:
        say(chosen.said)
    with terminal() as host:
        WHAT[arguments.what](arguments, config, host)


def _refuse_unused(arguments: argparse.Namespace) -> None:
    """Refuses what other adaptations look at; the settings' docstrings say whose they are."""
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
    rendered, seen = load_rooms(arguments.target).images, target_rooms(arguments.target, config).images
    level = PITCHES.index("level")
    figure = features_figure(rendered[:, level, 0], seen[:, level, 0], read_metrics(out / "metrics.jsonl"), results)
    save(figure, out / "adaptation.png")
    for name in ("source", "before", "statistics", "after"):
        print(f"{name:<11}{in_words(results[name]['mean'])}")
    print(f"{out}: {results['target_images']:,} target images, {results['before']['queries']} queries")


def _adapt_passages(arguments: argparse.Namespace, config: AdaptConfig, host: Host) -> None:
    out = arguments.out or ADAPTED / "passages"
    results = passage_configurations(arguments.detector, arguments.target, out, config, host)
    images = load_passages(arguments.target).images
    seen = as_seen(images, preset(config.domain))
    save(passages_figure(images, seen, read_metrics(out / "metrics.jsonl"), results), out / "configurations.png")
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
WHAT = {"features": _adapt_features, "passages": _adapt_passages, "map": _adapt_map}
