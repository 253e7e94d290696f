"""The collector and Warp's callbacks: suspended within, as before after; and what a capture does not survive."""

import gc
import os
import subprocess
import sys
import threading

import pytest

from interactive_nav.physics.warp_callbacks import without_collector

wp = pytest.importorskip("warp")


def test_the_collector_is_suspended_within_and_on_after():
    assert gc.isenabled()
    assert without_collector(lambda a, b: (a, b, gc.isenabled()))(1, b=2) == (1, 2, False)
    assert gc.isenabled()


def test_one_line_where_no_kernel_is_compiled_yet(tmp_path):
    """A process of its own: Warp reads its settings once."""
    program = """
import os, warp
warp.config.kernel_cache_dir = os.environ["CACHE"]
from interactive_nav.physics.warp_callbacks import quieten
quieten(); quieten()
@warp.kernel
def one(x: warp.array(dtype=float)):
    x[warp.tid()] = 1.0
warp.launch(one, 2, [warp.zeros(2, dtype=float, device="cpu")], device="cpu")
"""

    def said():
        (tmp_path / "program.py").write_text(program)
        told = {**os.environ, "CACHE": str(tmp_path), "PYTHONPATH": os.pathsep.join(sys.path)}
        words = [sys.executable, str(tmp_path / "program.py")]
        done = subprocess.run(words, env=told, capture_output=True, text=True, check=True)
        # Without a GPU Warp warns of that, and may.
        return [line for line in (done.stdout + done.stderr).splitlines() if "NVIDIA CUDA driver" not in line]

    first = said()
    assert len(first) == 1 and "about two minutes the first time" in first[0] and str(tmp_path) in first[0]
    (tmp_path / wp.config.version / "wp_mujoco.mjx.third_party.mujoco_warp._src.smooth_1").mkdir()
    assert said() == []


def test_it_comes_back_whatever_happens():
    def fails():
        raise ValueError("within")

    with pytest.raises(ValueError, match="within"):
        without_collector(fails)()
    assert gc.isenabled()


def test_who_had_switched_it_off_finds_it_off():
    inner = without_collector(gc.isenabled)
    gc.disable()
    try:
        assert not inner() and not gc.isenabled()
    finally:
        gc.enable()
    assert without_collector(lambda: (inner(), gc.isenabled()))() == (False, False)
    assert gc.isenabled()


def test_it_stays_away_until_the_last_of_several_threads_is_out():
    first_in, second_in, first_out = threading.Event(), threading.Event(), threading.Event()
    seen = []

    def short():
        first_in.set()
        assert second_in.wait(10)

    def long():
        second_in.set()
        assert first_out.wait(10)
        seen.append(gc.isenabled())

    def first():
        without_collector(short)()
        first_out.set()

    threads = [threading.Thread(target=first), threading.Thread(target=without_collector(long))]
    threads[0].start()
    assert first_in.wait(10)
    threads[1].start()
    for thread in threads:
        thread.join(10)
    assert seen == [False] and gc.isenabled()


CALLED = """
import gc, sys
import interactive_nav
import jax, jax.numpy as jnp
import warp as wp
from interactive_nav.physics.warp_callbacks import keep_collector_out

if sys.argv[1] == "suspended":
    keep_collector_out()
    keep_collector_out()
seen = []

def body(a: wp.array(dtype=float), out: wp.array(dtype=float)):
    seen.append(gc.isenabled())
    wp.copy(out, a)

called = wp.jax_callable(body, graph_mode=wp.JaxCallableGraphMode.NONE)
total = jax.jit(lambda x: called(x)[0].sum())(jnp.ones(8))
print(float(total), seen, gc.isenabled())
"""


def say(program: str, *words: str) -> subprocess.CompletedProcess[str]:
    return subprocess.run([sys.executable, "-c", program, *words], capture_output=True, text=True, timeout=300)


def test_callbacks_of_warps_run_without_it():
    done = say(CALLED, "suspended")
    assert done.stdout.splitlines()[-1:] == ["8.0 [False] True"], done.stdout + done.stderr


def test_upstream_warps_callbacks_still_let_the_collector_in():
    # Fails when Warp suspends it: then `interactive_nav/warp_callbacks.py` can go.
    done = say(CALLED, "let in")
    assert done.stdout.splitlines()[-1:] == ["8.0 [True] True"], done.stdout + done.stderr


DEATHS = """
import gc, sys
import interactive_nav
import jax, jax.numpy as jnp
import warp as wp
from interactive_nav.physics.warp_callbacks import keep_collector_out

dies, collector = sys.argv[1:]
if collector == "suspended":
    keep_collector_out()
gc.set_threshold(0)  # it is on, and comes only when called
kept = []

def first(a: wp.array(dtype=float), out: wp.array(dtype=float)):
    if dies == "stream":
        kept.append(wp.get_stream())  # as a frame does that somebody holds
    wp.copy(out, a)

def body(a: wp.array(dtype=float), out: wp.array(dtype=float)):
    kept.clear()
    if gc.isenabled():
        gc.collect()  # as it may come at any allocation
    room = wp.empty(1000, dtype=float, device=wp.get_stream().device)
    wp.copy(room, a, count=8)
    wp.copy(out, room, count=8)

class Ring:
    pass

plain = wp.jax_callable(first, graph_mode=wp.JaxCallableGraphMode.NONE)
captured = wp.jax_callable(body, graph_mode=wp.JaxCallableGraphMode.WARP)
x = jnp.ones(8)
jax.jit(lambda x: plain(x)[0])(x).block_until_ready()
if dies == "program":
    ring = Ring()
    ring.itself, ring.program = ring, jax.jit(lambda x: jnp.sin(x) @ x.T)
    ring.program(jnp.ones((64, 64))).block_until_ready()
    del ring  # dead, and found by the collector alone
print(float(jax.jit(lambda x: captured(x)[0])(x).sum()))
"""


@pytest.mark.gpu
@pytest.mark.skipif(not wp.is_cuda_available(), reason="needs an NVIDIA GPU")
@pytest.mark.parametrize(
    ("dies", "collector", "survives"),
    [
        ("nothing", "let in", True),
        ("program", "suspended", True),
        ("program", "let in", False),
        ("stream", "suspended", False),
    ],
)
def test_what_dies_within_a_capture_ends_it(dies, collector, survives):
    done = say(DEATHS, dies, collector)
    assert (done.returncode == 0 and done.stdout.splitlines()[-1:] == ["8.0"]) == survives, done.stdout + done.stderr


def test_a_program_that_calls_warp_is_found_again_and_calls_what_its_own_process_traced(tmp_path):
    """Programs name a call by its number in the process, so the order of tracing must not matter."""
    program = """
import sys
import jax, warp as wp
from jax._src import monitoring
from warp._src.jax.ffi import jax_callable

events = []
monitoring.register_event_listener(lambda name, **_: events.append(name.rpartition("/")[2]))

@wp.kernel
def times(x: wp.array(dtype=float), by: float, y: wp.array(dtype=float)):
    y[wp.tid()] = x[wp.tid()] * by

def scaled(x: wp.array(dtype=float), by: float, y: wp.array(dtype=float)):
    wp.launch(times, x.shape[0], [x, by], [y])

call = jax_callable(scaled, num_outputs=1)
for by in map(float, sys.argv[1:]):
    print(*jax.jit(lambda x: call(x, by)[0] + 1.0)(jax.numpy.array([1.0, 10.0])))
print(events.count("cache_hits") == events.count("compile_requests_use_cache") > 0)
"""
    (tmp_path / "program.py").write_text(program)
    kept = {"JAX_COMPILATION_CACHE_DIR": str(tmp_path / "kept"), "JAX_PERSISTENT_CACHE_MIN_COMPILE_TIME_SECS": "0"}

    def said(*factors):
        words = [sys.executable, str(tmp_path / "program.py"), *factors]
        done = subprocess.run(words, env={**os.environ, **kept}, capture_output=True, text=True, check=True)
        return done.stdout.split("\n")[-len(factors) - 2 : -1]

    assert said("2", "3") == ["3.0 21.0", "4.0 31.0", "False"]
    assert said("3", "2")[:2] == ["4.0 31.0", "3.0 21.0"]
    assert said("2", "3") == ["3.0 21.0", "4.0 31.0", "True"]
