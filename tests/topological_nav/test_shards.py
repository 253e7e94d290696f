"""Images through files and back."""

import numpy as np
import pytest

from topological_nav import shards
from topological_nav.errors import DatasetError


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
    size = shards.write_shard(path, [images[:18], images[18:25], images[25:]], 100)
    assert (shards.read_shard(path) == images).all()
    assert size == path.stat().st_size
    assert [p.name for p in tmp_path.iterdir()] == ["rooms-000.npz"]


def test_a_damaged_file_is_refused_by_name(tmp_path):
    path = tmp_path / "rooms-000.npz"
    shards.write_shard(path, [smooth(4)], 100)
    path.write_bytes(path.read_bytes()[:-200])
    with pytest.raises(DatasetError, match="rooms-000.npz: not readable .* delete it and run 'data' again"):
        shards.read_shard(path)
