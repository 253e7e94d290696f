"""Files of rows that two commands wrote into one folder at the same time."""

import types

import numpy as np
import pyarrow as pa
import pytest

from interactive_nav_common.rows import write_parquet
from topological_nav.evaluate import contest as rows

STEM = "cedar-dense-0123abcd"


@pytest.fixture
def twice(tmp_path):
    """Two commands, one with batch=2, one with batch=3: episode 2 was played by both."""
    (tmp_path / "tracks").mkdir()
    for first, path_m in ((0, [5.0, 6.0, 7.0]), (2, [9.0, 8.0])):
        episodes = np.arange(first, first + len(path_m))
        others = {name: ["a"] * len(episodes) for name in rows.COLUMNS.text}
        others |= {name: np.zeros(len(episodes), int) for name in rows.COLUMNS.whole}
        others |= {name: np.zeros(len(episodes)) for name in rows.COLUMNS.numbers}
        table = pa.table({**others, "episode": episodes, "path_m": path_m})
        write_parquet(table, tmp_path / "rows" / f"{STEM}-{first:04d}.parquet")
        tracks = {str(n): np.full((2, 2), value, np.float32) for n, value in zip(episodes, path_m, strict=True)}
        np.savez_compressed(tmp_path / "tracks" / f"{STEM}-{first:04d}.npz", **tracks)  # type: ignore[arg-type]
    return tmp_path


def test_an_episode_that_was_played_twice_counts_once_the_first_time(twice):
    found = rows._rows(twice, STEM, 4)
    assert found["episode"].to_pylist() == [0, 1, 2, 3]
    assert found["path_m"].to_pylist() == [5.0, 6.0, 7.0, 8.0]
    assert rows._missing(twice, STEM, 5).tolist() == [4]


def test_its_path_is_that_of_its_row(twice, monkeypatch):
    monkeypatch.setattr(rows, "_stem", lambda *_: STEM)
    tracks = rows.tracks_of(types.SimpleNamespace(out=twice), None, "dense")  # type: ignore[arg-type]
    assert {number: float(track[0, 0]) for number, track in tracks.items()} == {0: 5.0, 1: 6.0, 2: 7.0, 3: 8.0}
