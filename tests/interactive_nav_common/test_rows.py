"""Tables for people; files of rows come back as they were written."""

import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq
import pytest

from interactive_nav_common.rows import markdown, read_notes, read_rows, write_parquet


def test_markdown_tables_by_hand():
    assert markdown(("a", "b"), [(1, "x")]) == "| a | b |\n| --- | --- |\n| 1 | x |\n"


@pytest.mark.parametrize("small", [False, True])
def test_files_hold_what_was_written(tmp_path, small):
    """Values, types, order, gaps and notes; and DuckDB reads the same as PyArrow."""
    draw, count = np.random.default_rng(0), 25_000  # more than a page holds by default
    entry = pa.struct({"category": pa.string(), "touched": pa.int32(), "force_sum_n": pa.float32()})
    entries = [{"category": "toy", "touched": i % 3, "force_sum_n": i / 2} for i in range(5)]
    table = pa.table(
        {
            "run": pa.array([f"run{i % 7}" if i % 11 else None for i in range(count)]),
            "seed": pa.array(draw.integers(-(2**60), 2**60, count)),
            "episode": pa.array(np.arange(count, dtype=np.int32)[::-1]),
            "success": pa.array(draw.random(count) < 0.5),
            "path_m": pa.array(draw.normal(size=count).astype(np.float32)),
            "wall_s": pa.array([None if i % 5 else i / 3 for i in range(count)], pa.float64()),
            "nothing": pa.nulls(count),
            "warnings": pa.array([["a", "b"][: i % 3] for i in range(count)]),
            "by_category": pa.array([entries[: i % 6] if i % 4 else None for i in range(count)], pa.list_(entry)),
        }
    )
    path = tmp_path / "rows.parquet"
    write_parquet(table, path, {"asked": "ä\nb"}, small)
    assert pq.read_table(path).replace_schema_metadata(None).equals(table) and read_notes(path) == {"asked": "ä\nb"}
    assert read_rows([path]).schema.equals(table.schema)
    duckdb = pytest.importorskip("duckdb")
    ((total, touched, runs),) = duckdb.sql(
        f"""select sum(path_m::double), sum(list_sum([x.touched for x in by_category])), count(run) from '{path}'"""
    ).fetchall()
    assert touched == sum(sum(x % 3 for x in range(i % 6)) for i in range(count) if i % 4)
    assert runs == count - len(range(0, count, 11))
    assert total == pytest.approx(table["path_m"].to_numpy().sum(dtype=float))
    write_parquet(table[:0], path, small=small)
    assert pq.read_table(path).equals(table[:0]) and read_notes(path) == {}
