"""Arrays of small images in, compact files out, and back: sheets of images as WebP, some sheets a file."""

import functools
import io
import math
from collections import deque
from collections.abc import Callable, Generator, Iterable, Iterator, Sequence
from concurrent.futures import Future, ThreadPoolExecutor
from pathlib import Path
from typing import Any, TypeVar

import numpy as np
from PIL import Image

from interactive_nav_common.errors import readable
from interactive_nav_common.files import whole_file
from interactive_nav_common.untrusted.reading import read_npz
from interactive_nav_common.versions import usable_cores
from topological_nav.errors import DatasetError

COLUMNS = 18
"""Images a row of a sheet."""
Result = TypeVar("Result")
THREADS = min(usable_cores(), 16)
"""That encode and decode: WebP's library runs outside of Python's lock."""


def encode(images: np.ndarray, quality: int) -> bytes:
    """Images [N, H, W, 3] u8 as one WebP picture, row by row; quality 100 is without loss."""
    n, height, width, _ = images.shape
    columns = min(COLUMNS, n)
    rows = math.ceil(n / columns)
    padded = np.concatenate([images, np.zeros((rows * columns - n, height, width, 3), np.uint8)])
    sheet = padded.reshape(rows, columns, height, width, 3).swapaxes(1, 2).reshape(rows * height, columns * width, 3)
    out = io.BytesIO()
    Image.fromarray(sheet).save(out, "WEBP", quality=quality, lossless=quality == 100, method=4)
    return out.getvalue()


def decode(data: bytes, count: int, height: int, width: int) -> np.ndarray:
    """The `count` images [N, H, W, 3] u8 of a picture made by `encode`."""
    sheet = np.asarray(Image.open(io.BytesIO(data)).convert("RGB"))
    rows, columns = sheet.shape[0] // height, sheet.shape[1] // width
    tiles = sheet.reshape(rows, height, columns, width, 3).swapaxes(1, 2)
    return tiles.reshape(-1, height, width, 3)[:count]


def write_shard(path: Path, sheets: list[np.ndarray], quality: int) -> int:
    """Writes groups of images [n_i, H, W, 3] as sheets into one npz file, whole or not at all; returns its bytes."""
    coded = [np.frombuffer(encode(images, quality), np.uint8) for images in sheets]
    arrays = {
        "data": np.concatenate(coded),
        "ends": np.cumsum([len(c) for c in coded]),
        "counts": np.asarray([len(images) for images in sheets]),
        "size": np.asarray(sheets[0].shape[1:3]),
    }
    with whole_file(path) as partial, open(partial, "wb") as file:
        np.savez(file, **arrays)  # type: ignore[arg-type]
    return path.stat().st_size


def read_arrays(path: Path, command: str = "data") -> dict[str, np.ndarray]:
    """The arrays of an npz file that a command wrote."""
    need_files([path], command)
    remedy = f"delete it and run '{command}' again"
    with read_npz(path, DatasetError, remedy) as arrays:
        return dict(arrays)


def need_files(paths: Iterable[Path], command: str = "data") -> None:
    """Raises DatasetError where one is missing."""
    missing = next((path for path in paths if not path.is_file()), None)
    if missing:
        raise DatasetError(f"{missing} is missing; the same '{command}' command goes on where it stopped")


def read_shard(path: Path) -> np.ndarray:
    """All images [N, H, W, 3] u8 of a file, in the order they were written."""
    stored = read_arrays(path)
    with readable(path, DatasetError, "delete it and run 'data' again"):
        height, width = (int(v) for v in stored["size"])
        sheets = np.split(stored["data"], stored["ends"][:-1])
        pairs = zip(sheets, stored["counts"], strict=True)
        return np.concatenate([decode(sheet.tobytes(), int(count), height, width) for sheet, count in pairs])


def in_order(tasks: Iterable[Callable[[], Result]], ahead: int) -> Generator[Result, None, None]:
    """Results of tasks that threads run, in the tasks' order.

    Where a task or the caller raises, tasks that have begun are finished and the others left out.

    Args:
        tasks: taken one by one, in the caller's thread.
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
    """Return `read_shard` of each file that a command wrote, in order, some files ahead in threads."""
    need_files(paths, command)
    return in_order((functools.partial(read_shard, path) for path in paths), THREADS)


def numbered(folder: Path, kind: str, items: Sequence[Any] | np.ndarray, each: int) -> list[tuple[Path, Any]]:
    """Return the files that hold so many items each, and the items of each file."""
    firsts = range(0, len(items), each)
    return [(folder / f"{kind}-{i:03d}.npz", items[first : first + each]) for i, first in enumerate(firsts)]
