"""Generate a raw building folder from a seed: a synthetic home in the raw Gibson layout."""

import dataclasses
from pathlib import Path

import numpy as np

from converters.clock import Report
from converters.generate.homes.building import Building
from converters.generate.homes.config import GenerationError, HomeConfig
from converters.generate.homes.design import design_home
from converters.generate.homes.space import floor_maps
from converters.generate.models.cad import CLOTH, LOOKS, cad_model
from converters.generate.surface.modelled import model_building
from converters.generate.surface.scan import Scan, scan_building
from converters.generate.surface.texture import make_atlas
from converters.generate.surface.write import LICENCE, annotate_items, write_cad, write_png, write_scan
from converters.library.store import attribution, read_index
from converters.records.raw import ATTRIBUTION, WINDOWS, VisualMesh
from interactive_nav_common.files import part_folder, publish, write_json, write_text

__all__ = ["Building", "GenerationError", "HomeConfig", "design_building", "generate_building"]

GENERATOR_VERSION = 8
"""Raised whenever the same seed would give other bytes."""


def _streams(seed: int) -> list[np.random.Generator]:
    """Return a random stream per stage, so that a change in one stage leaves the others alone."""
    return [np.random.default_rng(s) for s in np.random.SeedSequence(seed).spawn(4)]


def _in_palette(home: Building, seed: int) -> Building:
    """Return a home with its cloth and coloured chairs in a palette; looks that differ still do."""
    palette = LOOKS.palettes[seed % len(LOOKS.palettes)]
    chairs = {"moss": palette[0], "teal": palette[0], "rust": palette[1]}
    worn = dict.fromkeys(CLOTH, dict(zip((*LOOKS.tints["sofa"], ""), palette, strict=True)))
    worn |= {"chair": chairs, "stool": chairs}
    items = []
    for item in home.items:
        plain, _, tint = item.model.name.partition("~")
        worn_tint = worn.get(item.model.category, {}).get(tint)
        items.append(dataclasses.replace(item, model=cad_model(f"{plain}~{worn_tint}")) if worn_tint else item)
    return dataclasses.replace(home, items=tuple(items))


def design_building(seed: int, config: HomeConfig | None = None) -> Building:
    """Draw plan and furniture; the same seed gives the same building."""
    if seed < 0:
        raise GenerationError(f"seed is {seed}: expected a whole number of 0 or more")
    try:
        return _in_palette(design_home(config or HomeConfig(), _streams(seed)[0]), seed)
    except GenerationError as error:
        raise GenerationError(f"seed {seed}: {error}") from error


def render_building(building: Building, seed: int, config: HomeConfig, progress: Report) -> tuple[Scan, VisualMesh]:
    """Scan and paint a building; without artefacts its exact structure."""
    streams = _streams(seed)
    if config.artefacts == "none":
        progress("painting", 0.1)
        palette = LOOKS.palettes[seed % len(LOOKS.palettes)]
        return model_building(building.plan, building.items, building.uses, streams[2], palette)
    progress("scanning", 0.1)
    scan = scan_building(building.plan, list(building.items), config, streams[1])
    progress("painting", 0.6)
    return scan, make_atlas(scan, building.plan.rooms, building.uses, config.texels_per_m, streams[2])


def generate_building(
    out_dir: Path, seed: int, progress: Report | None = None, config: HomeConfig | None = None
) -> None:
    """Write a raw building folder atomically and reproducibly; `progress` takes a stage and the share done, 0..1."""
    out_dir = Path(out_dir)
    if out_dir.exists() and (not out_dir.is_dir() or any(out_dir.iterdir())):
        raise GenerationError(f"{out_dir} exists and is not an empty folder: name a new folder or remove it")
    existing = next(p for p in out_dir.absolute().parents if p.exists())
    if not existing.is_dir():
        raise GenerationError(f"{out_dir}: {existing} is a file, expected a folder; name a place inside a folder")
    report = progress or (lambda stage, share: None)
    cfg = config or HomeConfig()
    with part_folder(out_dir, overwrite=True) as work:
        report("drawing the plan", 0.0)
        building = design_building(seed, cfg)
        scan, atlas = render_building(building, seed, cfg, report)
        report("writing", 0.85)
        _write(work, building, scan, atlas, seed, cfg)
        publish({work: out_dir}, overwrite=False)
    report("done", 1.0)


def _write(folder: Path, building: Building, scan: Scan, atlas: VisualMesh, seed: int, cfg: HomeConfig) -> None:
    write_scan(folder, scan, atlas, building.floor_height_m)
    (folder / "floors.txt").write_text(f"{building.floor_height_m}\n", encoding="ascii")
    if building.plan.windows:
        corners = np.array([(w.low, w.high) for w in building.plan.windows]) + [0.0, 0.0, building.floor_height_m]
        np.savetxt(folder / WINDOWS, corners.reshape(-1, 6), "%.4f")
    obstacles, traversable = floor_maps(building.plan)
    write_png(folder / "floor_0.png", obstacles)
    write_png(folder / "floor_trav_0.png", traversable)
    rng = _streams(seed)[3]
    write_json(
        folder / "alignments.json", annotate_items(list(building.items), scan, building.floor_height_m, cfg, seed, rng)
    )
    for model in {item.model.name: item.model for item in building.items}.values():
        write_cad(folder / "cad", model)
    about = {
        "generator": "converters.generate",
        "version": GENERATOR_VERSION,
        "seed": seed,
        "config": dataclasses.asdict(cfg),
        "rooms": list(building.uses),
        "measured": building.measured,
    }
    write_json(folder / "generator.json", about)
    names = {item.model.name.partition("~")[0] for item in (*building.items, *building.plan.built_in)}
    used = [model for name, model in read_index().items() if name in names]
    if used:
        write_text(folder / ATTRIBUTION, attribution(used))
    of_others = f"Of others, under their licences: the furniture that {ATTRIBUTION} lists.\n\n" if used else ""
    (folder / "LICENCE").write_text(of_others + LICENCE, encoding="ascii")
