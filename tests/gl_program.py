"""Programs of their own that draw with GL: its libraries abort rather than raise, and MuJoCo chooses one at import."""

from __future__ import annotations

import os
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest

PLAIN = """
import mujoco
from mujoco.egl import GLContext
context = GLContext(16, 16)
context.make_current()
mujoco.MjrContext(mujoco.MjModel.from_xml_string("<mujoco/>"), mujoco.mjtFontScale.mjFONTSCALE_100.value)
"""


def drawn(program: str, folder: Path, *words: Path | str) -> dict[str, np.ndarray]:
    """What a program saves in the file that is its first word."""
    out = folder / "drawn.npz"
    env = {k: v for k, v in os.environ.items() if k not in ("MUJOCO_GL", "PYOPENGL_PLATFORM", "DISPLAY")}
    words = (sys.executable, "-c", program, str(out), *map(str, words))
    done = subprocess.run(words, env=env, capture_output=True, text=True, timeout=300)
    assert done.returncode == 0 and "Traceback" not in done.stderr, done.stderr
    with np.load(out) as made:
        return dict(made)


def need_gl() -> None:
    """Skips where MuJoCo itself, without our code, starts no EGL."""
    done = subprocess.run([sys.executable, "-c", PLAIN], capture_output=True, text=True, timeout=300)
    if done.returncode:
        pytest.skip(f"no GL here (exit code {done.returncode}): {done.stderr.strip()[-300:]}")
