"""The collector and Warp's captures: suspended within, as before after; and what a capture does not survive."""

import gc
import subprocess
import sys

import pytest

from interactive_nav.warp_graphs import GRAPHS, keep_collector_out, keep_graphs, suspending

wp = pytest.importorskip("warp")


class Capture:
    """Notes whether the collector was on."""

    def __init__(self, begins: bool = True):
        self.begins, self.seen = begins, []

    def __enter__(self):
        self.seen.append(gc.isenabled())
        if not self.begins:
            raise RuntimeError("no capture")
        return self

    def __exit__(self, *raised):
        self.seen.append(gc.isenabled())


def test_the_collector_is_suspended_within_and_on_after():
    assert gc.isenabled()
    with suspending(Capture)() as capture:
        assert not gc.isenabled()
    assert capture.seen == [False, False] and gc.isenabled()


def test_it_comes_back_whatever_happens():
    with pytest.raises(RuntimeError, match="no capture"), suspending(Capture)(begins=False):
        pass
    assert gc.isenabled()
    with pytest.raises(ValueError, match="within"), suspending(Capture)():
        raise ValueError("within")
    assert gc.isenabled()


def test_who_had_switched_it_off_finds_it_off():
    gc.disable()
    try:
        with suspending(Capture)(), suspending(Capture)():
            pass
        assert not gc.isenabled()
    finally:
        gc.enable()
    with suspending(Capture)(), suspending(Capture)():
        assert not gc.isenabled()
    assert gc.isenabled()


def test_warps_captures_are_changed_once(monkeypatch):
    monkeypatch.setattr(wp, "ScopedCapture", Capture)
    keep_collector_out()
    changed = wp.ScopedCapture
    keep_collector_out()
    assert wp.ScopedCapture is changed and issubclass(changed, Capture) and changed is not Capture


def test_upstream_warps_captures_still_let_the_collector_in(monkeypatch):
    # Fails when Warp suspends it: then `interactive_nav/warp_graphs.py` can go.
    monkeypatch.setattr(wp, "capture_begin", lambda **_: None)
    monkeypatch.setattr(wp, "capture_end", lambda **_: None)
    own = next(c for c in wp.ScopedCapture.__mro__ if not hasattr(c, "suspends_collector"))
    with own():
        assert gc.isenabled()


def test_more_graphs_are_kept_of_what_is_called_from_now_on(monkeypatch):
    asked = []
    monkeypatch.setattr(wp, "jax_callable", lambda func, **options: asked.append((func, options)))
    keep_graphs()
    keep_graphs()
    wp.jax_callable("step", num_outputs=2)
    wp.jax_callable("draw", graph_cache_max=4)
    assert asked == [
        ("step", {"num_outputs": 2, "graph_cache_max": GRAPHS}),
        ("draw", {"graph_cache_max": 4}),
    ]


DEAD_PROGRAM = """
import gc, sys
import jax, jax.numpy as jnp
import warp as wp
from interactive_nav.warp_graphs import keep_collector_out

if sys.argv[1] == "suspended":
    keep_collector_out()

@wp.kernel
def twice(a: wp.array(dtype=float)):
    i = wp.tid()
    a[i] = a[i] * 2.0

def body(a: wp.array(dtype=float)):
    wp.launch(twice, dim=a.shape, inputs=[a])
    if gc.isenabled():
        gc.collect()  # as it may come at any allocation

class Ring:
    pass

called = wp.jax_callable(body, num_outputs=1, in_out_argnames=["a"], graph_mode=wp.JaxCallableGraphMode.WARP)
wp.load_module(device="cuda:0")
gc.disable()
ring = Ring()
ring.itself, ring.program = ring, jax.jit(lambda x: jnp.sin(x) @ x.T)
ring.program(jnp.ones((64, 64))).block_until_ready()
del ring  # dead, and found by the collector alone
gc.enable()
print(jax.jit(lambda x: called(x)[0])(jnp.ones(8)).sum())
"""


@pytest.mark.gpu
@pytest.mark.skipif(not wp.is_cuda_available(), reason="needs an NVIDIA GPU")
@pytest.mark.parametrize(("how", "survives"), [("suspended", True), ("as it comes", False)])
def test_a_program_that_dies_within_a_capture_ends_it(how, survives):
    done = subprocess.run([sys.executable, "-c", DEAD_PROGRAM, how], capture_output=True, text=True, timeout=300)
    assert (done.returncode == 0 and done.stdout.split()[-1] == "16.0") == survives, done.stdout + done.stderr
