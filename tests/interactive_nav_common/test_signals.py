"""Signals are raised, recorded, or held back; the next piece of work raises those that had no effect."""

import contextlib
import gc
import os
import signal
import sys
import threading
import weakref

import jax
import pytest
from rich.console import Console

from interactive_nav_common.jobs.progress import progress_bar
from interactive_nav_common.signals import interrupts_heard, number_of, raise_stop, signals_wait, stop_signals

DEAF = """
import signal
try:
    signal.raise_signal(signal.SIGINT)
except BaseException:
    pass
"""


def test_an_interrupt_within_an_import_that_catches_all_comes_after_it(tmp_path, monkeypatch):
    (tmp_path / "deaf_to_interrupts.py").write_text(DEAF)
    monkeypatch.syspath_prepend(str(tmp_path))
    with pytest.raises(KeyboardInterrupt), interrupts_heard():
        import deaf_to_interrupts  # type: ignore[import-not-found]  # noqa: F401

        assert "deaf_to_interrupts" in sys.modules
        raise_stop()
    assert signal.getsignal(signal.SIGINT) is signal.default_int_handler


def interrupted(*_: object) -> None:
    signal.raise_signal(signal.SIGINT)


class Interrupted(set):
    __del__ = interrupted


def collected() -> None:
    gc.callbacks.append(lambda phase, _: interrupted() if phase == "stop" else None)
    try:
        gc.collect()
    finally:
        gc.callbacks.pop()


def unreferenced() -> None:
    held = type("Held", (), {})()
    reference = weakref.ref(held, interrupted)
    del held
    assert reference() is None


@pytest.mark.filterwarnings("ignore::pytest.PytestUnraisableExceptionWarning")
@pytest.mark.parametrize("lose", [collected, unreferenced, Interrupted], ids=["collector", "weak reference", "__del__"])
def test_one_where_nothing_can_be_raised_comes_after_it(lose):
    reached = []
    with pytest.raises(KeyboardInterrupt), interrupts_heard():
        lose()
        reached.append(lose)
        raise_stop()
    assert reached


def compiled() -> None:
    """Takes half a second; 0.2 s into it the signal comes."""

    def long(x):
        for k in range(400):
            x = jax.numpy.sin(x @ x) + k
        return x

    lowered = jax.jit(long).lower(jax.numpy.ones((8, 8)))
    signalling = threading.Timer(0.2, os.kill, (os.getpid(), signal.SIGINT))
    signalling.start()
    lowered.compile()
    signalling.join()


def called_back() -> None:
    def on_host(x):
        interrupted()
        return x

    jax.block_until_ready(jax.jit(lambda x: jax.pure_callback(on_host, x, x))(jax.numpy.ones(2)))


@pytest.mark.parametrize("run", [compiled, called_back])
@pytest.mark.parametrize("waits", [True, False])
def test_one_within_jax_comes_after_it(run, waits):
    """A compilation left behind crashes the interpreter at its end; in a callback what is raised is JAX's error."""
    reached = []
    jax.clear_caches()
    with pytest.raises(KeyboardInterrupt), interrupts_heard(at_once=waits):
        with signals_wait() if waits else contextlib.nullcontext():
            run()
            reached.append(run)
        assert not waits
        raise_stop()
    assert reached == [run]


def test_one_that_is_only_recorded_is_raised_once_and_the_second_at_once():
    with interrupts_heard(signal.SIGTERM, at_once=False):
        signal.raise_signal(signal.SIGTERM)
        with pytest.raises(KeyboardInterrupt) as first:
            raise_stop()
        raise_stop()
        signal.raise_signal(signal.SIGTERM)
        with pytest.raises(KeyboardInterrupt) as second:
            signal.raise_signal(signal.SIGINT)
    assert [number_of(stop.value) for stop in (first, second)] == [signal.SIGTERM, signal.SIGINT]
    raise_stop()  # none of a block that is over


def test_progress_raises_it():
    reached = []
    raises = pytest.raises(KeyboardInterrupt)
    with raises, interrupts_heard(at_once=False), progress_bar(Console(), "work", 3) as update:
        for done in range(3):
            update(completed=done)
            reached.append(done)
            if done == 1:
                signal.raise_signal(signal.SIGINT)
    assert reached == [0, 1]


def test_others_raise_it_too_and_are_told_apart():
    usual = signal.signal(signal.SIGTERM, lambda *_: pytest.fail("replaced"))
    try:
        with pytest.raises(KeyboardInterrupt) as stop, interrupts_heard(signal.SIGTERM):
            signal.raise_signal(signal.SIGTERM)
        assert number_of(stop.value) == signal.SIGTERM and number_of(KeyboardInterrupt()) == signal.SIGINT
        mine = signal.signal(signal.SIGTERM, signal.SIG_IGN)
        with interrupts_heard(signal.SIGTERM):
            signal.raise_signal(signal.SIGTERM)
        assert mine is not signal.SIG_DFL and signal.getsignal(signal.SIGTERM) is signal.SIG_IGN
    finally:
        signal.signal(signal.SIGTERM, usual)


def test_who_handles_interrupts_goes_on_doing_so():
    usual = signal.signal(signal.SIGINT, signal.SIG_IGN)
    try:
        with interrupts_heard():
            assert signal.getsignal(signal.SIGINT) is signal.SIG_IGN
    finally:
        signal.signal(signal.SIGINT, usual)


@pytest.mark.parametrize("number", [signal.SIGTERM, signal.SIGHUP])
def test_what_would_end_the_process_at_once_lets_it_clean_up(number):
    usual = signal.signal(number, signal.SIG_DFL)
    try:
        with pytest.raises(SystemExit) as stop, interrupts_heard():
            signal.raise_signal(number)
        assert stop.value.code == 128 + number and signal.getsignal(number) is signal.SIG_DFL
    finally:
        signal.signal(number, usual)


def test_a_closed_terminal_stops_as_sigterm_does_unless_nohup_ignores_it():
    usual = signal.getsignal(signal.SIGHUP)
    try:
        for handler, seen in ((signal.SIG_DFL, [signal.SIGHUP, signal.SIGHUP]), (signal.SIG_IGN, [])):
            signal.signal(signal.SIGHUP, handler)
            with stop_signals(second_ends=False) as stops, interrupts_heard():
                signal.raise_signal(signal.SIGHUP)
                signal.raise_signal(signal.SIGHUP)
            assert stops == seen and signal.getsignal(signal.SIGHUP) is handler
    finally:
        signal.signal(signal.SIGHUP, usual)
