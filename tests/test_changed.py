"""Heavy tests run where their file or the module that it mirrors changed."""

import subprocess
from pathlib import Path

from tests.changed import AT_MOST, changed_files, chosen

WHO = ("-c", "user.name=a", "-c", "user.email=a@example.org")


def git(root: Path, *words: str, when: str = "2020-01-01T00:00:00Z") -> None:
    env = {"GIT_AUTHOR_DATE": when, "GIT_COMMITTER_DATE": when, "PATH": "/usr/bin:/bin", "HOME": str(root)}
    subprocess.run(("git", *WHO, *words), cwd=root, env=env, check=True, capture_output=True)


def test_what_is_new_changed_or_committed_of_late_counts(tmp_path):
    assert changed_files(tmp_path) == set()
    git(tmp_path, "init")
    for name in ("old.py", "edited.py", "late.py"):
        (tmp_path / name).write_text("")
    git(tmp_path, "add", "old.py", "edited.py")
    git(tmp_path, "commit", "-m", "old")
    git(tmp_path, "add", "late.py")
    git(tmp_path, "commit", "-m", "late", when="2099-01-01T00:00:00Z")
    (tmp_path / "edited.py").write_text("1")
    (tmp_path / "new.py").write_text("")
    assert changed_files(tmp_path) == {"edited.py", "late.py", "new.py"}


def test_tests_of_changed_files_and_of_the_modules_that_they_mirror_are_chosen():
    tests = ["tests/a/b/test_c.py::one", "tests/a/b/test_c.py::two[x]", "tests/a/test_c.py::three"]
    assert chosen(tests, {"a/b/c.py"}, 9) == tests[:2]
    assert chosen(tests, {"tests/a/test_c.py"}) == tests[2:]
    assert chosen(tests, {"c.py", "a/b/d.py"}) == []
    pages = ["tests/test_docs.py::test_it[a-b.md]", "tests/test_docs.py::test_it[c.md]"]
    assert chosen(pages, {"docs/c.md"}) == pages[1:]
    assert chosen(["tests/test_wheel.py::test_it"], {"pyproject.toml"}) == ["tests/test_wheel.py::test_it"]
    assert len(chosen([f"tests/a/test_c.py::t{k}" for k in range(9)], {"a/c.py"})) == AT_MOST
