"""Describe folders of images of scenes, claim and fill them; store images as sheets of WebP, several per file."""

import contextlib
import dataclasses
import functools
import io
import json
import math
from collections import deque
from collections.abc import Callable, Generator, Iterable, Iterator, Sequence
from concurrent.futures import Future, ThreadPoolExecutor
from pathlib import Path
from typing import Any, Generic, TypeVar

import numpy as np
from PIL import Image

from interactive_nav import get_robot, load_scene
from interactive_nav.robots import RobotSpec
from interactive_nav.scenes.objects import SmallObject
from interactive_nav.scenes.scene import Scene
from interactive_nav_common.config import overlay, to_dict
from interactive_nav_common.errors import FileError, readable
from interactive_nav_common.files import alone_in, whole_file, write_json
from interactive_nav_common.jobs.progress import Progress
from interactive_nav_common.runs.folder import refuse_changes
from interactive_nav_common.untrusted.reading import read_npz
from interactive_nav_common.versions import usable_cores
from scenes_mjcf.look import CameraPose, Lens
from topological_nav.config import CameraConfig
from topological_nav.scenes.rendering import Bodies, SceneRenderer, need_engine

Config = TypeVar("Config", bound=CameraConfig)


@dataclasses.dataclass(frozen=True)
class Folder(Generic[Config]):
    """Describe a kind of folder."""

    file: str
    """Name of its description."""
    version: int
    """Version of the folder; raised when older ones would be misread."""
    base: Config
    """Settings that the description may lack."""
    none: str
    """Error if a folder is not of this kind."""
    again: str
    """Remedy for a folder that cannot be used."""

    def read(self, folder: Path) -> tuple[dict[str, Any], Config]:
        """Return a folder's description and its settings."""
        path = Path(folder) / self.file
        if not path.is_file():
            raise FileError(f"{folder}: {self.none}")
        with readable(path, FileError, f"delete the folder and {self.again}"):
            header = json.loads(path.read_text(encoding="utf-8"))
            version = header["format"]
            settings = header["settings"] if version == self.version else {}
        if version != self.version:
            raise FileError(f"{path}: format {version}, expected {self.version}; {self.again}")
        return header, overlay(self.base, settings, str(path))

    def describe(self, config: Config, scenes: Sequence[dict[str, Any]]) -> dict[str, Any]:
        """Return the description of a folder with these settings and scenes."""
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
        """Describe a new folder, or check that an existing one agrees, and lock it for the block."""
        with alone_in(out):
            path = out / self.file
            if path.is_file():
                there, settings = self.read(out)
                remedy = "choose another folder or delete it"
                refuse_changes(out, to_dict(settings), header["settings"], remedy, "dataset")
                if there["scenes"] != header["scenes"]:
                    raise FileError(
                        f"{out}: is of {', '.join(s['name'] for s in there['scenes'])} as they were; "
                        f"the scenes differ: {remedy}"
                    )
            else:
                write_json(path, header)
            yield


def load_scenes(folders: Sequence[Path], engine: str) -> list[Scene]:
    """Load the scenes to render."""
    scenes = [load_scene(folder) for folder in folders]
    need_engine(engine)
    names = [scene.name for scene in scenes]
    if len(set(names)) != len(names) or not names:
        raise FileError(f"SCENE is {', '.join(names) or 'missing'}, expected one or more scenes with different names")
    return scenes


def lens_of(config: CameraConfig, robot: RobotSpec) -> Lens:
    """Return the lens of stored images."""
    return Lens(config.width, config.height, config.fov_deg or robot.camera.fov_deg)


def renderer_of(scene: Scene, data: CameraConfig, small: Sequence[SmallObject] = ()) -> SceneRenderer:
    """Return a renderer of a scene, and small objects, with a folder's settings."""
    return SceneRenderer(scene, lens_of(data, get_robot(data.robot)), data.supersample, data.engine, small)


def draw_missing(
    scenes: Iterable[tuple[str, Callable[[], Scene], Iterable[tuple[Path, list[CameraPose], Bodies | None]]]],
    total: int,
    config: CameraConfig,
    progress: Progress,
    small: Sequence[SmallObject] = (),
) -> None:
    """Render the files of images that do not exist yet; a file's bodies are where its small objects lie."""

    def missing() -> Iterator[Callable[[], tuple[str, int]]]:
        for name, load, files in scenes:
            renderer = functools.cache(lambda load=load: renderer_of(load(), config, small))
            for path, poses, bodies in files:
                ends, sheets = np.cumsum([len(pose.pos_w) for pose in poses]), []
                if not path.is_file():  # drawn together, in full batches
                    every = (np.concatenate([getattr(p, leaf) for p in poses]) for leaf in ("pos_w", "axes_w"))
                    sheets = np.split(renderer().draw(CameraPose(*every), bodies), ends[:-1])
                yield functools.partial(_write, path, sheets, config.quality, name, int(ends[-1]))

    done = 0
    with contextlib.closing(in_order(missing(), 2 * THREADS)) as written:
        for name, count in written:
            done += count
            progress(name, done, total)


def _write(path: Path, sheets: list[np.ndarray], quality: int, name: str, count: int) -> tuple[str, int]:
    if sheets:
        write_shard(path, sheets, quality)
    return name, count


COLUMNS = 18
"""Images per row of a sheet."""
Result = TypeVar("Result")
THREADS = min(usable_cores(), 16)
"""Threads that encode and decode; WebP's library releases Python's lock."""


def encode(images: np.ndarray, quality: int) -> bytes:
    """Encode images [N, H, W, 3] u8 as one WebP image, row by row; quality 100 is lossless."""
    n, height, width, _ = images.shape
    columns = min(COLUMNS, n)
    rows = math.ceil(n / columns)
    padded = np.concatenate([images, np.zeros((rows * columns - n, height, width, 3), np.uint8)])
    sheet = padded.reshape(rows, columns, height, width, 3).swapaxes(1, 2).reshape(rows * height, columns * width, 3)
    out = io.BytesIO()
    Image.fromarray(sheet).save(out, "WEBP", quality=quality, lossless=quality == 100, method=2)
    return out.getvalue()


def decode(data: bytes, count: int, height: int, width: int) -> np.ndarray:
    """Decode `count` images [N, H, W, 3] u8 written by `encode`."""
    sheet = np.asarray(Image.open(io.BytesIO(data)).convert("RGB"))
    rows, columns = sheet.shape[0] // height, sheet.shape[1] // width
    tiles = sheet.reshape(rows, height, columns, width, 3).swapaxes(1, 2)
    return tiles.reshape(-1, height, width, 3)[:count]


def write_shard(path: Path, sheets: list[np.ndarray], quality: int) -> None:
    """Write groups of images [n_i, H, W, 3] atomically as sheets of one npz file."""
    coded = [np.frombuffer(encode(images, quality), np.uint8) for images in sheets]
    arrays = {
        "data": np.concatenate(coded),
        "ends": np.cumsum([len(c) for c in coded]),
        "counts": np.asarray([len(images) for images in sheets]),
        "size": np.asarray(sheets[0].shape[1:3]),
    }
    with whole_file(path) as partial, open(partial, "wb") as file:
        np.savez(file, **arrays)  # type: ignore[arg-type]


def read_arrays(path: Path, command: str = "data") -> dict[str, np.ndarray]:
    """Read the arrays of an npz file that a command wrote."""
    need_files([path], command)
    remedy = f"delete it and run '{command}' again"
    with read_npz(path, FileError, remedy) as arrays:
        return dict(arrays)


def need_files(paths: Iterable[Path], command: str = "data") -> None:
    """Raise `FileError` if one is missing."""
    missing = next((path for path in paths if not path.is_file()), None)
    if missing:
        raise FileError(f"{missing} is missing; the same '{command}' command goes on where it stopped")


def read_shard(path: Path) -> np.ndarray:
    """Read all images [N, H, W, 3] u8 of a file in order."""
    stored = read_arrays(path)
    with readable(path, FileError, "delete it and run 'data' again"):
        height, width = (int(v) for v in stored["size"])
        sheets = np.split(stored["data"], stored["ends"][:-1])
        pairs = zip(sheets, stored["counts"], strict=True)
        return np.concatenate([decode(sheet.tobytes(), int(count), height, width) for sheet, count in pairs])


def in_order(tasks: Iterable[Callable[[], Result]], ahead: int) -> Generator[Result, None, None]:
    """Yield the results of tasks in order, computed by threads.

    Tasks are taken in the caller's thread. If one or the caller raises, started tasks finish and others are skipped.
    """
    waiting: deque[Future[Result]] = deque()
    with ThreadPoolExecutor(THREADS) as pool:
        try:
            for task in tasks:
                waiting.append(pool.submit(task))
                while waiting and (len(waiting) > ahead or waiting[0].done()):
                    yield waiting.popleft().result()
            while waiting:
                yield waiting.popleft().result()
        finally:
            pool.shutdown(cancel_futures=True)


def read_shards(paths: Sequence[Path], command: str = "data") -> Iterator[np.ndarray]:
    """Return `read_shard` of each file of a command, in order; threads read some files ahead."""
    need_files(paths, command)
    return in_order((functools.partial(read_shard, path) for path in paths), THREADS)


def numbered(folder: Path, kind: str, items: Sequence[Any] | np.ndarray, each: int) -> list[tuple[Path, Any]]:
    """Return the files with `each` items, and the items of each file."""
    firsts = range(0, len(items), each)
    return [(folder / f"{kind}-{i:03d}.npz", items[first : first + each]) for i, first in enumerate(firsts)]
