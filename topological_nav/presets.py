"""Apply named settings, such as the report's, over the defaults of the commands."""

from collections.abc import Sequence
from pathlib import Path
from typing import Any, TypeVar

from interactive_nav_common.config import overlay, overridden
from interactive_nav_common.errors import ConfigError
from interactive_nav_common.records import read_packaged

PRESETS = read_packaged(Path(__file__).with_suffix(".yaml"), dict[str, dict[str, dict[str, Any]]])
"""Name -> part of the commands -> settings."""
Config = TypeVar("Config")


def preset_of(words: Sequence[str]) -> str:
    """Return the preset that settings name, or an empty string."""
    return next((word.partition("=")[2] for word in words if word.startswith("preset=")), "")


def configured(base: Config, words: Sequence[str], part: str) -> Config:
    """Return the settings of a part with `preset=NAME`, then the other words, applied."""
    if name := preset_of(words):
        if part not in PRESETS.get(name, {}):
            of_part = ", ".join(known for known, parts in PRESETS.items() if part in parts)
            raise ConfigError(f"preset is '{name}', expected one with settings of '{part}': {of_part or 'none'}")
        base = overlay(base, PRESETS[name][part], f"preset {name}")
    return overridden(base, [word for word in words if not word.startswith("preset=")])
