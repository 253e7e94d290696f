"""YAML text and `key=value` words -> a `TrainConfig`, and back; every mistake named in one line."""

import dataclasses
import json
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import yaml

from interactive_nav_common.config import flatten, nearest, overlay, read_words, settings_help, to_dict
from interactive_nav_common.errors import ConfigError, regular
from interactive_nav_common.records import Reader
from scenes_mjcf.sets import scene_folders
from train.config import AUTO as AUTO_SIZES
from train.config import TrainConfig, validate

PRESET_DIR = Path(__file__).parent / "configs"


def to_yaml(config: TrainConfig) -> str:
    """YAML text that `from_yaml` reads back to an equal config."""
    return yaml.safe_dump(to_dict(config), sort_keys=False)


def from_dict(plain: Any, base: TrainConfig | None = None, where: str = "config") -> TrainConfig:
    """`base` with nested plain values laid over it.

    Args:
        base: what `plain` does not name; the defaults where None.
    """
    return overlay(base or TrainConfig(), plain, where, elsewhere=list(flatten(TrainConfig())))


def from_yaml(text: str, where: str = "config") -> TrainConfig:
    """As `from_dict`, from YAML text."""
    return from_dict(_parsed(text, where), where=where)


def _parsed(text: str, where: str) -> Any:
    return Reader(ConfigError, "expected settings, see --help", finite=False).decoded(text, "YAML", where)


def known_in(folder: Path = PRESET_DIR) -> list[str]:
    """Names of a folder's YAML files: those that `--config` knows, or of `SWEEP_DIR` those of sweeps."""
    return sorted(path.stem for path in folder.glob("*.yaml"))


def read_file(name_or_path: str, folder: Path, what: str, told: str = "") -> tuple[Path, Any]:
    """The nested plain values of a YAML file: a path that ends in .yaml or .yml, or a name among a folder's."""
    path = Path(name_or_path)
    if path.suffix not in (".yaml", ".yml"):
        path = folder / f"{name_or_path}.yaml"
        if not path.is_file():
            known = known_in(folder)
            raise ConfigError(
                f"{told}no {what} {name_or_path!r}{nearest(name_or_path, known)}; "
                f"expected one of {', '.join(known)}, or the path of a .yaml file"
            )
    try:
        return path, _parsed(regular(path).read_text(encoding="utf-8"), path.name)
    except (OSError, UnicodeDecodeError) as error:
        reason = error.strerror if isinstance(error, OSError) else "not a text file"
        raise ConfigError(f"{told}cannot read {path} ({reason}); expected a YAML file") from None


def load(name_or_path: str, overrides: Sequence[str] = ()) -> TrainConfig:
    """Reads a preset (by name) or a YAML file (by path) and applies `key=value` words to it."""
    path, plain = read_file(name_or_path, PRESET_DIR, "preset", "--config: ")
    if isinstance(plain, dict) and {"preset", "grid"} & plain.keys():
        raise ConfigError(
            f"--config: {path.name} is a sweep, expected one run; python -m train.sweep {path} trains all"
        )
    config = apply_overrides(from_dict(plain, where=path.name), overrides)
    if not config.run.name:
        run = dataclasses.replace(config.run, name=f"{path.stem}-seed{config.run.seed}")
        config = dataclasses.replace(config, run=run)
    config = with_scenes(config)
    validate(config)
    return config


def with_scenes(config: TrainConfig) -> TrainConfig:
    """The config with the scene folders of the sets that `env.scenes` names (`cluttered/train`)."""
    return dataclasses.replace(config, env=dataclasses.replace(config.env, scenes=scene_folders(config.env.scenes)))


def with_robot(words: Sequence[str], robot: str | None) -> list[str]:
    """Add the word that `--robot` stands for."""
    return [*words, f"env.robot={json.dumps(robot)}"] if robot else [*words]


def apply_overrides(config: TrainConfig, words: Sequence[str]) -> TrainConfig:
    """The config with `dotted.name=value` words laid over it; values are read as YAML."""
    return overlay(config, read_words(words), "override", elsewhere=list(flatten(TrainConfig())))


def help_text() -> str:
    """One line a setting: dotted name, default, meaning."""
    sizes: dict[str, list[str]] = {}
    for section, backends in AUTO_SIZES.items():
        for backend, auto in backends.items():
            for name, size in auto.items():
                sizes.setdefault(f"{section}.{name}", []).append(f"{backend}: {size}")
    return settings_help(TrainConfig(), {name: ", ".join(each) for name, each in sizes.items()})
