"""Rows say where they come from; random driving is uniform, and counted step by step."""

import json

import jax
import jax.numpy as jnp
import pytest

from benchmarks.steps_per_second import append_row, origin, random_driving, timed
from docs.studies import command_line, read_rows


@pytest.mark.parametrize("name", ["rows.jsonl", "rows.jsonl.gz"])
def test_rows_say_where_they_come_from(tmp_path, capsys, name):
    rows = tmp_path / "new" / name
    row = {"rate": 2.0, **origin("abc", ("jax", "no-such-package"))}
    append_row(rows, row, hidden=("versions", "date", "device"))
    append_row(rows, row, hidden=None)
    assert (read_rows(rows) if name.endswith(".gz") else [json.loads(x) for x in rows.open()]) == [row, row]
    assert set(row) == {"rate", "device", "versions", "commit", "date"} and list(row["versions"]) == ["jax"]
    assert json.loads(capsys.readouterr().out) == {"rate": 2.0, "commit": "abc"}


def test_words_of_environments():
    args = command_line("", "x", settings=True).parse_args(["--set", "num_objects=0", 'observations=["goal"]'])
    assert dict(args.settings) == {"num_objects": 0, "observations": ["goal"]} and args.out.name == "x.jsonl.gz"
    assert vars(command_line("").parse_args([])) == {}


def test_random_driving_counts_every_step():
    drive = jax.jit(random_driving(lambda state, action: (state + 1, action), (3, 2), 5, 2.0, 4.0))
    (state, actions), seconds = timed(drive, jnp.zeros(()), jax.random.PRNGKey(0))
    assert state == 5 and actions.shape == (5, 3, 2) and seconds > 0
    assert 2.0 <= actions.min() < 2.5 and 3.5 < actions.max() <= 4.0
