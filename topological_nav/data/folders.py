"""A folder of images of scenes: its description, who may work in it, and how its files of images are drawn."""

import contextlib
import dataclasses
import functools
import json
from collections.abc import Callable, Iterable, Iterator, Sequence
from pathlib import Path
from typing import Any, Generic, TypeVar

import numpy as np

from interactive_nav.robots import RobotSpec, get_robot
from interactive_nav.scenes.scene import Scene, load_scene
from interactive_nav_common.config import overlay, to_dict
from interactive_nav_common.errors import readable
from interactive_nav_common.files import write_text
from interactive_nav_common.locks import alone_in
from scenes_mjcf.look import CameraPose, Lens
from topological_nav.config import CameraConfig
from topological_nav.data.shards import THREADS, in_order, write_shard
from topological_nav.errors import DatasetError, Progress
from topological_nav.scenes.rendering import SceneRenderer, need_engine

Config = TypeVar("Config", bound=CameraConfig)


@dataclasses.dataclass(frozen=True)
class Folder(Generic[Config]):
    """A kind of folder."""

    file: str
    """Of its description."""
    version: int
    """Of the folder; raised whenever older ones would be read wrongly."""
    base: Config
    """Settings where the description lacks one."""
    none: str
    """What to say of a folder that is none."""
    again: str
    """What to do about one that cannot be used."""

    def read(self, folder: Path) -> tuple[dict[str, Any], Config]:
        """The description of a folder, and the settings in it."""
        path = Path(folder) / self.file
        if not path.is_file():
            raise DatasetError(f"{folder}: {self.none}")
        with readable(path, DatasetError, f"delete the folder and {self.again}"):
            header = json.loads(path.read_text(encoding="utf-8"))
            found = header["format"]
            settings = header["settings"] if found == self.version else {}
        if found != self.version:
            raise DatasetError(f"{path}: format {found}, expected {self.version}; {self.again}")
        return header, overlay(self.base, settings, str(path))

    def describe(self, config: Config, scenes: Sequence[dict[str, Any]]) -> dict[str, Any]:
        """The description of a folder with these settings and of these scenes."""
        robot = get_robot(config.robot)
        return {
            "format": self.version,
            "settings": to_dict(config),
            "fov_deg": lens_of(config, robot).fov_deg,
            "camera_m": list(robot.camera.pos_m),
            "scenes": list(scenes),
        }

    @contextlib.contextmanager
    def claimed(self, out: Path, header: dict[str, Any]) -> Iterator[None]:
        """Describes a new folder, or checks that the one there is the same; nobody else works there for the block."""
        with alone_in(out):
            path = out / self.file
            if path.is_file():
                there, settings = self.read(out)
                for name, value in to_dict(settings).items():
                    if header["settings"][name] != value:
                        raise DatasetError(
                            f"{out}: was made with {name} = {value!r}, expected {header['settings'][name]!r}; "
                            "choose another folder or delete it"
                        )
                if there["scenes"] != header["scenes"]:
                    raise DatasetError(
                        f"{out}: is of {', '.join(s['name'] for s in there['scenes'])} as they were; "
                        "the scenes differ: choose another folder or delete it"
                    )
            else:
                write_text(path, json.dumps(header, indent=1) + "\n")
            yield


def load_scenes(folders: Sequence[Path], engine: str) -> list[Scene]:
    """The scenes to draw."""
    scenes = [load_scene(folder) for folder in folders]
    need_engine(engine)
    names = [scene.name for scene in scenes]
    if len(set(names)) != len(names) or not names:
        raise DatasetError(f"scenes are {', '.join(names) or 'none'}, expected one or more with different names")
    return scenes


def lens_of(config: CameraConfig, robot: RobotSpec) -> Lens:
    """The lens of stored images."""
    return Lens(config.width, config.height, config.fov_deg or robot.camera.fov_deg)


def draw_missing(
    scenes: Iterable[tuple[str, Callable[[], Scene], Iterable[tuple[Path, list[CameraPose]]]]],
    total: int,
    config: CameraConfig,
    progress: Progress,
) -> None:
    """Draws the files of images that are not there yet."""
    lens = lens_of(config, get_robot(config.robot))

    def missing() -> Iterator[Callable[[], tuple[str, int]]]:
        for name, load, files in scenes:
            renderer: SceneRenderer | None = None
            for path, poses in files:
                sheets = []
                if not path.is_file():
                    renderer = renderer or SceneRenderer(load(), lens, config.supersample, config.engine)
                    sheets = _draw_sheets(renderer, poses)
                told = name, sum(len(pose.pos_w) for pose in poses)
                yield functools.partial(_written, path, sheets, config.quality, told)

    done = 0
    with contextlib.closing(in_order(missing(), 2 * THREADS)) as written:
        for name, count in written:
            done += count
            progress(name, done, total)


def _written(path: Path, sheets: list[np.ndarray], quality: int, told: tuple[str, int]) -> tuple[str, int]:
    if sheets:
        write_shard(path, sheets, quality)
    return told


def _draw_sheets(renderer: SceneRenderer, poses: Sequence[CameraPose]) -> list[np.ndarray]:
    """Images [n_i, H, W, 3] of groups of cameras, drawn together: full batches."""
    together = CameraPose(*(np.concatenate([getattr(pose, name) for pose in poses]) for name in ("pos_w", "axes_w")))
    images = renderer.draw(together)
    return np.split(images, np.cumsum([len(pose.pos_w) for pose in poses])[:-1])


def folder_bytes(folder: Path) -> int:
    """Bytes of a folder's arrays and images."""
    return sum(path.stat().st_size for path in Path(folder).rglob("*.npz"))
