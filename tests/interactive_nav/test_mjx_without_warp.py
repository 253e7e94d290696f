"""What importing the package sets and silences for JAX and MJX, as a user's program sees it."""

from __future__ import annotations

import os
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


@pytest.mark.skipif(not hasattr(os, "sched_setaffinity"), reason="needs to choose its cores, as Linux does")
@pytest.mark.parametrize(("cores", "given", "expected"), [(1, None, "2"), (1, "3", "3"), (2, None, "None")])
def test_jax_has_two_threads_on_a_single_core(cores, given, expected):
    program = (
        f"import os; os.sched_setaffinity(0, sorted(os.sched_getaffinity(0))[:{cores}])\n"
        "import interactive_nav; print(os.environ.get('NPROC'))"
    )
    env = {name: value for name, value in os.environ.items() if name != "NPROC"} | ({"NPROC": given} if given else {})
    done = subprocess.run([sys.executable, "-c", program], capture_output=True, text=True, check=True, env=env)
    assert done.stdout.strip() == (expected if len(os.sched_getaffinity(0)) >= cores else "2")
