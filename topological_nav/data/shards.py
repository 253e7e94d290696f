"""Arrays of small images in, compact files out, and back: sheets of images as WebP, some sheets a file."""

from __future__ import annotations

import io
import math
from collections import deque
from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import Future, ThreadPoolExecutor
from pathlib import Path
from typing import Any

import numpy as np
from PIL import Image

from interactive_nav_common.errors import readable
from interactive_nav_common.files import whole_file
from interactive_nav_common.versions import usable_cores
from topological_nav.errors import DatasetError

COLUMNS = 18
"""Images a row of a sheet."""


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


def read_shard(path: Path) -> np.ndarray:
    """All images [N, H, W, 3] u8 of a file, in the order they were written.

    Raises:
        DatasetError: it is missing or damaged.
    """
    with readable(path, DatasetError, "delete it and run 'data' again"):
        with np.load(path, allow_pickle=False) as arrays:
            data, ends, counts = arrays["data"], arrays["ends"], arrays["counts"]
            height, width = (int(v) for v in arrays["size"])
        starts = np.concatenate([[0], ends[:-1]])
        return np.concatenate(
            [decode(data[a:b].tobytes(), int(n), height, width) for a, b, n in zip(starts, ends, counts, strict=True)]
        )


class ShardWriter:
    """Writes files in threads while the caller draws the next; `with` waits for all of them.

    Files end in any order, but are told in theirs. Where the block raises, files that are being written are finished
    and the others left out.
    """

    def __init__(self, quality: int):
        """Starts nothing yet.

        Args:
            quality: of WebP; 100 is without loss.
        """
        self._quality = quality
        self._pool = ThreadPoolExecutor(THREADS)
        self._waiting: deque[tuple[Future[Any] | None, Callable[[], None]]] = deque()

    def __enter__(self) -> ShardWriter:
        """Itself."""
        return self

    def put(self, path: Path, sheets: list[np.ndarray], told: Callable[[], None]) -> None:
        """Has a file written; see `write_shard`.

        Args:
            path: the file.
            sheets: groups of images.
            told: called in this thread once it and all before it are there; may raise.
        """
        self._waiting.append((self._pool.submit(write_shard, path, sheets, self._quality), told))
        self._tell(2 * THREADS)

    def skip(self, told: Callable[[], None]) -> None:
        """A file that is there already: `told` as in `put`."""
        self._waiting.append((None, told))
        self._tell(2 * THREADS)

    def _tell(self, most: int) -> None:
        """Tells of what is done, and waits until at most so many files are not."""
        while self._waiting and (len(self._waiting) > most or _done(self._waiting[0][0])):
            future, told = self._waiting.popleft()
            if future is not None:
                future.result()
            told()

    def __exit__(self, kind: Any, *_: Any) -> None:
        """Waits for what is being written, and tells of the rest."""
        try:
            if kind is None:
                self._tell(0)
        finally:
            self._pool.shutdown(wait=True, cancel_futures=True)


def _done(future: Future[Any] | None) -> bool:
    return future is None or future.done()


def read_shards(paths: Sequence[Path]) -> Iterator[np.ndarray]:
    """`read_shard` of each file, in order, some files ahead in threads.

    Raises:
        DatasetError: see `read_shard`.
    """
    with ThreadPoolExecutor(THREADS) as pool:
        ahead: deque[Future[np.ndarray]] = deque()
        try:
            for path in paths:
                ahead.append(pool.submit(read_shard, path))
                if len(ahead) > THREADS:
                    yield ahead.popleft().result()
            while ahead:
                yield ahead.popleft().result()
        finally:
            for future in ahead:
                future.cancel()
