"""The study of rendering writes a row for every stream, and for what fails."""

import json

import pytest

from docs.studies import rendering


@pytest.mark.heavy
@pytest.mark.slow
def test_rows_tell_rate_and_place_and_failures(room, tmp_path, monkeypatch):
    out = tmp_path / "rows.jsonl"

    def fail(*args):
        raise MemoryError("too large")

    common = ["--scenes", str(room), "--num-envs", "2", "--size", "12", "--seconds", "0", "--out", str(out)]
    assert rendering.main([*common, "--renderer", "rays", "--stream", "depth", "rgb_textured"]) == 0
    monkeypatch.setattr(rendering, "make_renderer", fail)
    assert rendering.main([*common, "--renderer", "rays", "--stream", "rgb", "--commit", "abc"]) == 0
    rows = [json.loads(line) for line in out.read_text().splitlines()]
    # Rays draw no textures: that combination is left out.
    assert [(r["stream"], r.get("frames_on")) for r in rows] == [("depth", "device"), ("depth", "host"), ("rgb", None)]
    assert all(r["frames_per_s"] > 0 and r["bytes_per_frame"] == 4 * 12 * 12 and r["calls"] >= 3 for r in rows[:2])
    assert rows[2]["error"] == "MemoryError: too large" and rows[2]["commit"] == "abc"
    # What would not fit is left out before it is tried.
    assert rendering.main([*common, "--renderer", "rays", "--stream", "depth", "--max-megapixels", "0.0001"]) == 0
    assert len(out.read_text().splitlines()) == 3
