"""What an installation without the extra `warp` says: the packaged networks see by MJX-Warp's renderer."""

import os
import subprocess
import sys
from pathlib import Path

import pytest

from topological_nav.weights.export import packaged_weights

ROOT = Path(__file__).parents[2]
HINT = "pip install -e '.[warp]'"
LINE = "engine=warp needs warp-lang, which is not installed; pip install 'interactive-nav[warp]'"
COMMANDS = """
import sys
from topological_nav.__main__ import main
cedar = sys.argv[1]
for words in (
    ["navigate", cedar],
    ["data", cedar, "-o", "data"],
    ["data", "--drives", cedar, "-o", "drives"],
    ["evaluate", cedar, "--contenders", "expert", "backend=warp", "-o", "rows"],
):
    print("exit", main(words))
"""


@pytest.mark.skipif(not packaged_weights().is_dir(), reason="topological_nav/weights/exported is not there")
def test_without_warp_the_extra_is_named_before_any_work(tmp_path):
    (tmp_path / "absent" / "warp").mkdir(parents=True)
    text = "raise ModuleNotFoundError(\"No module named 'warp'\", name='warp')\n"
    (tmp_path / "absent" / "warp" / "__init__.py").write_text(text)
    here = {**os.environ, "PYTHONPATH": f"{tmp_path / 'absent'}:{ROOT}"}
    command = [sys.executable, "-c", COMMANDS, str(ROOT / "scenes_mjcf" / "cedar")]
    done = subprocess.run(command, cwd=tmp_path, env=here, capture_output=True, text=True, check=False)
    assert done.stdout.count("exit 2\n") == 4, done.stderr
    told = [line for line in done.stderr.splitlines() if line.startswith("topological_nav: ")]
    assert len(told) == 4 and all(LINE in line for line in told)
    assert not any((tmp_path / made).exists() for made in ("data", "drives", "rows", "runs"))


def test_the_readme_installs_what_its_command_needs():
    text = (ROOT / "README.md").read_text()
    assert HINT in text[: text.index("python -m topological_nav navigate")]
    assert HINT in (ROOT / "docs" / "getting-started.md").read_text()
