"""`map` and `export`: networks in, a scene's map out; runs and maps in, a small folder of them out."""

import argparse
from collections.abc import Sequence
from pathlib import Path

from interactive_nav_common.config import overridden
from topological_nav.commands.progress import bar, say
from topological_nav.config import PASSAGE_POLICY, ExportConfig, MapConfig
from topological_nav.figures.maps import map_figure, save
from topological_nav.figures.transfer_figures import export_figure
from topological_nav.maps.build import Built, build_map, forget
from topological_nav.maps.graph import save_map
from topological_nav.weights.export import export, size_lines
from topological_nav.weights.packaged import choose


def make_map(arguments: argparse.Namespace) -> None:
    """Builds a map and draws it."""
    config = overridden(MapConfig(), arguments.settings)
    chosen = choose(arguments.localiser, arguments.detector, PASSAGE_POLICY)
    if chosen.said:
        say(chosen.said)
    out = arguments.out or chosen.maps[0] / f"{Path(arguments.scene).resolve().name}.npz"
    build(Path(arguments.scene), chosen.localiser, chosen.detector, config, out, arguments.route)


def build(
    scene: Path, localiser: Path, detector: Path, config: MapConfig, out: Path, ends: Sequence[int] | None = None
) -> None:
    """Makes a map, draws it and tells of it."""
    parts = out.with_name(f"{out.name}.parts")
    with bar() as tell:
        built = build_map(scene, localiser, detector, config, tell, parts)
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
    """Writes finished runs as a small folder."""
    config = overridden(ExportConfig(), arguments.settings)
    with bar() as tell:
        runs = (arguments.localiser, arguments.detector, arguments.policy, arguments.maps)
        sizes, compared = export(*runs, arguments.images, arguments.out, config, tell)
    picture = arguments.picture or arguments.out.with_name(f"{arguments.out.name}.png")
    save(export_figure(sizes, compared, config.limit_mib), picture)
    for name, value in compared.scores.items():
        print(f"{name.replace('_', ' ')}: {value:.3g}")
    print(f"{arguments.out}: {size_lines(sizes, config.limit_mib)}; drawn in {picture}")
