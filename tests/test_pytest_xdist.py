"""The way round pytest-xdist's endless wait for a worker that died (its issues 1323 and 1378), and when it can go."""

import subprocess
import sys

import pytest

BUSY = "import time, pytest\n@pytest.mark.parametrize('i', range(6))\ndef test(i): time.sleep(0.1)\n"
DIES = "import os, time\ndef test_a(): os.abort()\ndef test_b(): time.sleep(0.2)\ndef test_c(): time.sleep(0.2)\n"


def run(folder, *words, timeout_s):
    for name, text in (("test_1.py", BUSY), ("test_2.py", BUSY), ("test_3.py", BUSY), ("test_4.py", DIES)):
        (folder / name).write_text(text)
    command = (sys.executable, "-m", "pytest", "-q", "-p", "no:cacheprovider", "-n", "2", "--dist", "loadfile", *words)
    return subprocess.run((*command, "."), cwd=folder, capture_output=True, text=True, timeout=timeout_s)


def test_a_run_ends_and_fails_when_a_worker_dies(tmp_path):
    done = run(tmp_path, "--max-worker-restart", "0", timeout_s=120)
    assert done.returncode == 1
    assert "crashed while running 'test_4.py::test_a'" in done.stdout and "18 passed" in done.stdout


@pytest.mark.heavy
def test_it_would_wait_for_ever_without_the_option(tmp_path):
    """When this fails, `--max-worker-restart 0` in the Makefile can go."""
    with pytest.raises(subprocess.TimeoutExpired):
        run(tmp_path, timeout_s=60)
