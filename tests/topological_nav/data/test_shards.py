"""Images through files and back."""

import contextlib
import functools
import threading

import numpy as np
import pytest

from interactive_nav_common.errors import FileError, UserError
from topological_nav.data import folders as shards


def smooth(count: int, height: int = 16, width: int = 24) -> np.ndarray:
    """Images that differ: slanted ramps."""
    y, x = np.mgrid[:height, :width]
    ramps = [(k * 17 + 5 * x + 3 * y)[..., None] % 256 // np.array([1, 2, 3]) for k in range(count)]
    return np.asarray(ramps, np.uint8)


@pytest.mark.parametrize("count", [1, 17, 18, 19, 54])
def test_quality_100_keeps_every_pixel(count):
    images = smooth(count)
    assert (shards.decode(shards.encode(images, 100), count, 16, 24) == images).all()


def test_lossy_images_stay_near_and_in_order():
    flat = np.broadcast_to(np.arange(20, 220, 10, dtype=np.uint8)[:, None, None, None], (20, 48, 64, 3))
    back = shards.decode(shards.encode(flat, 90), 20, 48, 64).astype(float)
    # Neighbouring images of a sheet do not bleed into each other's middle.
    assert np.abs(back[:, 4:-4, 4:-4] - flat[:, 4:-4, 4:-4]).max() <= 3


def test_a_file_holds_sheets_of_different_lengths(tmp_path):
    path = tmp_path / "rooms-000.npz"
    images = smooth(30)
    shards.write_shard(path, [images[:18], images[18:25], images[25:]], 100)
    assert (shards.read_shard(path) == images).all()
    assert [p.name for p in tmp_path.iterdir()] == ["rooms-000.npz"]


def test_a_damaged_file_is_refused_by_name(tmp_path):
    path = tmp_path / "rooms-000.npz"
    shards.write_shard(path, [smooth(4)], 100)
    path.write_bytes(path.read_bytes()[:-200])
    with pytest.raises(FileError, match="rooms-000.npz: not readable .* delete it and run 'data' again"):
        shards.read_shard(path)


def test_tasks_run_in_threads_and_are_told_in_order(tmp_path, monkeypatch):
    monkeypatch.setattr(shards, "THREADS", 2)
    second_done = threading.Event()

    def write(k):
        if k == 0:
            assert second_done.wait(10)
        shards.write_shard(tmp_path / f"{k}.npz", [smooth(k + 1)], 100)
        if k == 1:
            second_done.set()
        return k

    assert list(shards.in_order((functools.partial(write, k) for k in range(4)), 4)) == [0, 1, 2, 3]
    back = list(shards.read_shards([tmp_path / f"{k}.npz" for k in range(4)]))
    assert all((images == smooth(k + 1)).all() for k, images in enumerate(back)) and len(back) == 4


def test_a_stop_leaves_whole_files_only(tmp_path, monkeypatch):
    monkeypatch.setattr(shards, "THREADS", 1)
    tasks = (functools.partial(shards.write_shard, tmp_path / f"{k}.npz", [smooth(20)], 100) for k in range(50))
    with contextlib.closing(shards.in_order(tasks, 2)) as written:
        next(written)
        next(written)
    there = sorted(tmp_path.iterdir())
    assert 2 <= len(there) < 10
    assert all(len(images) == 20 for images in shards.read_shards(there))


def test_what_a_thread_could_not_write_is_said(tmp_path):
    (tmp_path / "taken").write_text("")
    write = functools.partial(shards.write_shard, tmp_path / "taken" / "0.npz", [smooth(2)], 100)
    with pytest.raises(UserError, match="cannot be written"):
        list(shards.in_order([write], 1))
