"""Read a `TrainConfig` from YAML text and `key=value` words, and write it; every mistake is named in one line."""

import dataclasses
import json
import os
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import yaml

from interactive_nav_common.config import flatten, nearest, overlay, read_words, settings_help, to_dict
from interactive_nav_common.errors import ConfigError, readable, typed
from interactive_nav_common.records import Reader
from scenes_mjcf.sets import scene_folders
from train.config import AUTO as AUTO_SIZES
from train.config import TrainConfig, validate

PRESET_DIR = Path(__file__).parent / "configs"


def to_yaml(config: TrainConfig) -> str:
    """Return YAML text that `from_yaml` reads back to an equal config."""
    return yaml.safe_dump(to_dict(config), sort_keys=False)


def from_dict(plain: Any, base: TrainConfig | None = None, where: str = "config") -> TrainConfig:
    """Return `base` (None: the defaults) with nested plain values laid over it."""
    return overlay(base or TrainConfig(), plain, where, elsewhere=list(flatten(TrainConfig())))


def from_yaml(text: str, where: str = "config") -> TrainConfig:
    """Return the config that a run wrote as YAML, as `from_dict`."""
    return from_dict(parsed(text, where), where=where)


def parsed(text: str, where: str) -> Any:
    """Return the plain values of YAML text."""
    return Reader(ConfigError, "expected settings, see --help", finite=False).decoded(text, "YAML", where)


def preset_names(folder: Path = PRESET_DIR) -> list[str]:
    """Return the names of a folder's YAML files: the presets of `--config`, or in `SWEEP_DIR` those of sweeps."""
    return sorted(path.stem for path in folder.glob("*.yaml"))


def read_file(name_or_path: str, folder: Path, what: str, prefix: str = "") -> tuple[Path, Any]:
    """Return the nested plain values of a YAML file: a path ending in .yaml or .yml, or a name among a folder's."""
    path = Path(name_or_path)
    if path.suffix not in (".yaml", ".yml"):
        path = folder / f"{name_or_path}.yaml"
        if not os.path.isfile(path):
            names = preset_names(folder)
            raise ConfigError(
                f"{prefix}no {what} {name_or_path!r}{nearest(name_or_path, names)}; "
                f"expected one of {', '.join(names)}, or the path of a .yaml file"
            )
    with readable(path, ConfigError, f"{prefix}expected a YAML file"):
        return path, parsed(path.read_text(encoding="utf-8"), path.name)


def load_config(name_or_path: str, overrides: Sequence[str] = ()) -> TrainConfig:
    """Read a preset (by name) or a YAML file (by path) and apply `key=value` words to it."""
    path, plain = read_file(name_or_path, PRESET_DIR, "preset", "--config: ")
    if isinstance(plain, dict) and {"preset", "grid"} & plain.keys():
        raise ConfigError(
            f"--config: {path.name} is a sweep, expected one run; python -m train.sweep {typed(path)} trains all"
        )
    config = apply_overrides(from_dict(plain, where=path.name), overrides)
    if not config.run.name:
        run = dataclasses.replace(config.run, name=f"{path.stem}-seed{config.run.seed}")
        config = dataclasses.replace(config, run=run)
    config = with_scenes(config)
    validate(config)
    return config


def with_scenes(config: TrainConfig) -> TrainConfig:
    """Return the config with the scene folders of the sets that `env.scenes` names (`cluttered/train`)."""
    return dataclasses.replace(config, env=dataclasses.replace(config.env, scenes=scene_folders(config.env.scenes)))


def with_robot(words: Sequence[str], robot: str | None) -> list[str]:
    """Add the word that `--robot` stands for."""
    return [*words, f"env.robot={json.dumps(robot)}"] if robot else [*words]


def apply_overrides(config: TrainConfig, words: Sequence[str]) -> TrainConfig:
    """Return the config with `dotted.name=value` words laid over it; values are read as YAML."""
    return from_dict(read_words(words), config, "override")


def help_text() -> str:
    """Return one line for each setting: dotted name, default, meaning."""
    sizes: dict[str, list[str]] = {}
    for section, backends in AUTO_SIZES.items():
        for backend, auto in backends.items():
            for name, size in auto.items():
                sizes.setdefault(f"{section}.{name}", []).append(f"{backend}: {size}")
    return settings_help(TrainConfig(), {name: ", ".join(each) for name, each in sizes.items()})
