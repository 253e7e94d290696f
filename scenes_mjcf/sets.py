"""Resolve names of sets of scenes to scene folders.

A set is a file that lists scenes, their splits and the digests of their tasks: `OUT/set.json`, which
`python -m converters generate-scenes OUT` writes, or a committed one of this package. Wherever scenes are listed,
`SET` stands for all of its scenes and `SET/train` or `SET/test` for those of a split. What is not in the current folder
is looked for beside the package and in the cache folder, by the same path (`scenes_mjcf/alder`).
"""

import dataclasses
import difflib
import hashlib
import json
import os
from collections.abc import Sequence
from pathlib import Path
from typing import Any, Literal
from xml.etree import ElementTree

import numpy as np

from interactive_nav_common.errors import typed
from interactive_nav_common.files import cache_folder, check_name, write_text
from interactive_nav_common.records import Reader
from scenes_mjcf.schema import SPLITS, SceneError, load_maps

FILE = "set.json"
HERE = Path(__file__).parent
COMMITTED = HERE / "sets"
"""Folder of the package's own sets, `<name>.json`."""
PACKAGED = {"sparse": HERE, "furnished": HERE / "furnished", "cluttered": HERE / "cluttered"}
"""The package's own sets, and the folders that their scenes belong into."""
_SETS = Reader(SceneError, "make the set again")


@dataclasses.dataclass(frozen=True)
class Member:
    """One scene of a set."""

    split: Literal["train", "test"]
    seed: int
    """Of the recipe."""
    digest: str = ""
    """`scene_digest` of the scene; empty: not yet made."""
    measures: dict[str, Any] = dataclasses.field(default_factory=dict)
    """What was measured of it, such as `furniture_share`."""


@dataclasses.dataclass(frozen=True)
class SceneSet:
    """A named set of scenes."""

    tier: str
    """How full its homes are: sparse, furnished or cluttered."""
    scenes: dict[str, Member]
    """Name of a scene -> what it is; folders of these names lie beside the set's file, or in `folder`."""
    folder: str = "."
    """Where the scene folders lie, relative to the file."""


def scene_digest(folder: Path) -> str:
    """Return the SHA-256 of what a scene is made of, the same on every machine that makes it: its map, and its bodies,
    joints and geoms, but no windows. Numbers are rounded to 0.1 mm: the last digits of boxes differ between processors.
    """
    try:
        tree = ElementTree.parse(folder / "scene.xml")
    except (OSError, ElementTree.ParseError) as error:
        raise SceneError(f"{folder / 'scene.xml'}: not readable ({error}); make the scene again") from None
    maps = load_maps(folder)
    parts: list[Any] = [maps.traversable.shape, np.packbits(maps.traversable).tobytes().hex()]
    parts += [[element.tag, {k: _rounded(v) for k, v in sorted(element.attrib.items())}]
              for body in tree.iter("worldbody") for element in body.iter()
              if not element.get("name", "").startswith("window_")]  # fmt: skip
    return hashlib.sha256(repr(parts).encode()).hexdigest()


def _rounded(text: str) -> str:
    """Return an attribute's numbers with four decimals, -0 as 0; other text unchanged."""
    try:
        return " ".join(f"{round(float(word), 4) + 0.0:.4f}" for word in text.split())
    except ValueError:
        return text


def read_set(path: Path) -> SceneSet:
    """Read and check a set's file; raise `SceneError` if it cannot be used."""
    scenes = _SETS.record(_SETS.json(path), SceneSet, str(path))
    for name in scenes.scenes:
        check_name(name, f"{path}: scenes: a name", SceneError)
    return scenes


def write_set(scenes: SceneSet, path: Path) -> None:
    """Write a set's file, whole or not at all."""
    write_text(path, json.dumps(dataclasses.asdict(scenes), indent=1, sort_keys=True) + "\n")


def packaged_set(name: str) -> SceneSet:
    """Return the set of a name in `PACKAGED`."""
    return read_set(next(p for p in (PACKAGED[name] / FILE, COMMITTED / f"{name}.json") if p.is_file()))


def in_cache(path: Path) -> Path:
    """Return the path in the cache folder that corresponds to a path of the package."""
    return cache_folder() / path.relative_to(HERE.parent)


def is_listed(folder: Path, member: Member) -> bool:
    """Return whether a folder holds the scene that a set lists; False if it cannot be read."""
    try:
        return scene_digest(folder) == member.digest
    except SceneError:
        return False


def installed(path: str | Path) -> Path:
    """Return a path, or that of its name in package or cache; raise `SceneError` if it is not what its set lists."""
    found = Path(path)
    roots = () if os.path.exists(found) or found.is_absolute() else (HERE.parent, cache_folder())
    place = next((root / found for root in roots if os.path.exists(root / found)), found)
    name = next((n for n, folder in PACKAGED.items() if place == in_cache(folder / place.name)), None)
    member = packaged_set(name).scenes.get(place.name) if name else None
    if member and not is_listed(place, member):
        raise SceneError(
            f"{place}: not the scene that the set {name} lists; make it again: python -m converters scenes make "
            f"{place.name}"
        )
    return place


def meant(word: str, or_set: bool) -> str:
    """`, did you mean 'X'?` for the package's scene, or set, that a wrong word looks like, or nothing."""
    names = [name for sets in PACKAGED for name in (sets, *(f"{sets}/{split}" for split in SPLITS))] if or_set else []
    places = dict(zip(names, names, strict=True))
    scenes = {HERE / name for name in os.listdir(HERE) if (HERE / name / "scene.json").is_file()}
    scenes |= {PACKAGED[name] / scene for name in PACKAGED for scene in packaged_set(name).scenes}
    places |= {scene.name: scene.relative_to(HERE.parent).as_posix() for scene in sorted(scenes)}
    near = difflib.get_close_matches(word, places, 1) or difflib.get_close_matches(Path(word).name, places, 1)
    return f", did you mean {places[near[0]]!r}?" if near else ""


def existing(word: str | Path, or_set: bool = False) -> Path:
    """Return the folder of a scene, as `installed` does; raise `SceneError` if there is none.

    `or_set`: a set could be named in its place.
    """
    folder = installed(word)
    if not folder.exists():
        of_set = f" or a set ({', '.join(PACKAGED)})" if or_set else ""
        raise SceneError(
            f"{folder}: no such file; expected a scene folder{of_set}{meant(str(word), or_set)}; "
            "'python -m converters scenes list' shows them, 'python -m converters convert SRC OUT' makes one"
        )
    return folder


def _members(word: str) -> list[str] | None:
    """Folders of a set or of a set's split; None where the word names neither."""
    head, _, last = word.rstrip("/").rpartition("/")
    for name, split in ((word.rstrip("/"), ""), (head, last)):
        if not name or (split and split not in SPLITS):
            continue
        files = (Path(name) / FILE, HERE / name / FILE, COMMITTED / f"{name}.json")  # in a folder, or in the package
        file = next((path for path in files if os.path.isfile(path)), None)
        if file is None:
            continue
        scenes = read_set(file)
        root = Path(os.path.normpath(file.parent / scenes.folder))
        names = [n for n, member in scenes.scenes.items() if split in ("", member.split)]
        places = {n: root / n for n in names}
        cached = {n: in_cache(p) for n, p in places.items() if not p.exists()} if root.is_relative_to(HERE) else {}
        places |= {n: p for n, p in cached.items() if is_listed(p, scenes.scenes[n])}
        missing = [n for n in names if not (places[n] / "scene.json").is_file()]
        what = f"the set has no scene to {split} in" if not names else None
        if missing:
            what = f"{len(missing)} of {len(names)} scenes are missing (the first is '{missing[0]}')"
            what += ", or not those that the set lists" * any(cached[n].exists() for n in missing if n in cached)
        if what:
            own = next((f"scenes make {name}" for name, folder in PACKAGED.items() if folder == root), None)
            command = own or f"generate-scenes {typed(os.path.relpath(root))}"
            raise SceneError(f"{word}: {what}; make them: python -m converters {command}")
        return [os.path.relpath(p) if Path.cwd() in p.absolute().parents else str(p) for p in places.values()]
    return None


def scene_folders(words: Sequence[str | Path]) -> tuple[str, ...]:
    """Return scene folders, those of a set for its name; raise `SceneError` where some are missing.

    Args:
        words: scene folders, relative to the current folder; sets (`cluttered`, or a folder with a `set.json`); their
            splits (`cluttered/train`).

    Returns:
        Scene folders, as written where a word names no set.
    """
    found: list[str] = []
    for word in map(str, words):
        is_scene = os.path.isfile(Path(word) / "scene.json")  # no error for names that are too long
        found += [word] if is_scene else _members(word) or [str(installed(word))]
    return tuple(found)
