"""The report's tables with ours beside them, by hand."""

import json
from pathlib import Path

import pytest

from interactive_nav_common.rows import write_parquet
from tests.topological_nav.evaluate.test_scores import FOUR, table
from topological_nav.__main__ import main
from topological_nav.tables import REPORT, beside, passage_scores


def write(path: Path, content) -> None:
    path.parent.mkdir(parents=True, exist_ok=True)
    path.write_text(json.dumps(content))


def lines_of(text: str, number: str) -> list[list[str]]:
    """The cells of a table, without its header."""
    (part,) = [part for part in text.split("## ") if part.startswith(f"{number}. ")]
    return [[cell.strip() for cell in line.split("|")[1:-1]] for line in part.splitlines() if line.startswith("|")][2:]


@pytest.fixture
def runs(tmp_path):
    pitches = {"rooms-up": ("up", 0.5, 0.25), "rooms": ("level", 0.75, 0.5), "rooms-down": ("down", 1.0, 1.0)}
    for run, (pitch, accuracy, macro_f1) in pitches.items():
        write(tmp_path / run / "results.json", {"groups": {pitch: {"accuracy": accuracy, "macro_f1": macro_f1}}})
    test = {
        "angular": {"accuracy": 0.625, "macro_f1": 0.375},
        "linear": {"accuracy": 0.875, "macro_f1": 0.125},
    }
    write(tmp_path / "policy-grid" / "grid.json", [{"alpha": 10.0, "lambda": 0.1, "test": test}])
    write(tmp_path / "passages" / "results.json", {"confusion": [[6, 2], [1, 7]]})
    write(tmp_path / "alexnet" / "results.json", {"confusion": [[8, 0], [8, 0]]})
    write(tmp_path / "adapted-passages" / "results.json", {name: {"confusion": [[6, 2], [1, 7]]} for name in "ABCD"})
    lost = {name: values[3:] for name, values in FOUR.items()}
    named = {"sight": "networks", "domain": "clean", "policy": "P"}
    for run, contender, scene, given in (
        ("evaluation", "dense", "cedar", FOUR),
        ("evaluation-policy", "dense", "cedar", FOUR),
        ("evaluation-policy", "dense", "alder", lost),
        ("evaluation-policy", "sparse", "cedar", lost),
    ):
        rows = table(contender, scene, **given)
        for name in ("runs", "contact_runs"):
            rows = rows.set_column(rows.column_names.index(name), name, rows[name].cast("int64"))
        for name, value in named.items():
            rows = rows.append_column(name, [[value] * len(rows)])
        path = tmp_path / run / "rows" / f"{scene}-{contender}.parquet"
        path.parent.mkdir(parents=True, exist_ok=True)
        write_parquet(rows, path)
    return tmp_path


def test_cells_by_hand(runs):
    assert main(["tables", str(runs)]) == 0
    text = (runs / "tables.md").read_text()
    assert lines_of(text, "I")[0] == ["Upward", "0.866", "0.500", "0.792", "0.250"]
    assert lines_of(text, "I")[2] == ["Downward", "0.850", "1.000", "0.773", "1.000"]
    second = lines_of(text, "II")
    assert second[1] == ["Angular", "10", "0.1", "0.430", "0.375", "0.490", "0.625"]
    assert second[4] == ["Linear", "10", "0.1", "0.390", "0.125", "0.630", "0.875"]
    assert second[0][4::2] == ["", ""]  # a pair that was not trained
    # 13 of 16 right, and 2 x 7 / (2 x 7 + 2 + 1); nothing taken for free: no F1.
    assert lines_of(text, "III") == [
        ["Resnet18", "0.861", "0.812", "0.856", "0.824"],
        ["Alexnet", "0.839", "0.500", "0.842", "0.000"],
    ]
    fourth = lines_of(text, "IV")
    assert [line[0] for line in fourth[6:]] == [
        "Sasakwa",
        "alder, learned policy",
        "cedar, learned policy",
        "cedar, baseline policy",
    ]
    assert fourth[0] == ["Aloha", "0.870", "", "0.650", "", "0.570", "", "63", "", "561", ""]
    # 3 of 4; 2.5 / 4; 2 of 3 with a contact; (10 + 0 + 5) / 3 s; (30 + 20 + 40 + 1800) / 4 s.
    assert fourth[8][2::2] == ["0.750", "0.625", "0.667", "5.0", "472.5"]
    assert fourth[7][2::2] == ["0.000", "0.000", "", "", "1800.0"]  # no success: neither RC nor AADC
    # Means over scenes: of successes over those that have any.
    assert lines_of(text, "V") == [
        ["bad", "0.550", "0.000", "0.360", "0.000", "0.870", "", "110", "", "817", "1800.0"],
        ["good", "0.750", "0.375", "0.560", "0.312", "0.760", "0.667", "96", "5.0", "720", "1136.2"],
    ]
    assert lines_of(text, "VI")[0] == [
        "A",
        "0.490",
        "0.812",
        "0.070",
        "0.824",
        "51",
        "6",
        "12",
        "2",
        "43",
        "1",
        "2",
        "7",
    ]


def test_the_f1_of_table_vi_is_that_of_free_passages():
    for _, accuracy, f1, tn, fp, fn, tp in REPORT["VI. Passage detector in another domain"]["rows"]:
        assert passage_scores([[tn, fp], [fn, tp]])[:2] == pytest.approx([accuracy, f1], abs=0.005)
        assert (tn + fp, fn + tp) == (63, 45)


def test_rows_of_either_side_alone_are_kept():
    assert beside([["a", 1, 0.5]], [["b", 2, 0.25]], 1) == [["a", "1", "", "0.500", ""], ["b", "", "2", "", "0.250"]]


def test_what_is_missing_is_named(tmp_path, capsys):
    assert main(["tables", str(tmp_path)]) == 2
    assert "rooms-up/results.json: cannot be read" in capsys.readouterr().err
