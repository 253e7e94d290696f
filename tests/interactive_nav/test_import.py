"""What importing the package sets for JAX, as a user's program sees it."""

import os
import subprocess
import sys

import pytest


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
