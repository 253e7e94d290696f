"""Counts of a small tree, by hand."""

from docs.studies.house import public_names, report, touched

FILES = {
    "train/a.py": "class A:\n    def inner(self): ...\n\n\ndef _b(): ...\n\n\ndef c(): 'ddpg'\n",
    "converters/d.py": "X = 1\n",
}


def test_lines_names_and_modules_by_hand():
    assert public_names(FILES["train/a.py"]) == ["A", "c"]
    assert touched(FILES, r"\bddpg\b") == ["train/a.py"] and touched(FILES, "scan2cad") == []
    lines = report(FILES)
    assert [line.split() for line in lines[:3]] == [
        ["converters", "1", "lines", "0", "public", "names"],
        ["train", "8", "lines", "2", "public", "names"],
        ["in", "all", "9", "lines", "2", "public", "names"],
    ]
    assert lines[-1] == "algorithm: 1 modules: train/a.py"
