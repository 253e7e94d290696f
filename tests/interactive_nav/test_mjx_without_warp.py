"""What MJX prints at its import where the optional Warp is not installed, as a user's program sees it."""

from __future__ import annotations

import subprocess
import sys

import pytest

ABSENT = "import sys; sys.modules['warp'] = None\n"
BROKEN = (
    "import sys, types, pathlib, tempfile\n"
    "folder = pathlib.Path(tempfile.mkdtemp()); (folder / 'warp.py').write_text('raise ImportError(\"no driver\")')\n"
    "sys.path.insert(0, str(folder))\n"
)


def printed(prelude: str) -> str:
    program = prelude + "import interactive_nav, brax.envs\nfrom mujoco import mjx\nprint(mjx.Model.__name__)"
    done = subprocess.run([sys.executable, "-c", program], capture_output=True, text=True, check=True)
    return done.stdout


@pytest.mark.parametrize(
    ("prelude", "expected"),
    [
        (ABSENT, "Model\n"),
        (BROKEN, "Failed to import warp: no driver\nFailed to import mujoco_warp: no driver\nModel\n"),
    ],
)
def test_a_missing_extra_is_not_told_and_a_broken_one_is(prelude, expected):
    assert printed(prelude) == expected
