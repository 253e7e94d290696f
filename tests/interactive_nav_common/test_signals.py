"""Signals that come where Python loses what their handlers raise."""

import gc
import os
import signal
import sys
import time

import pytest

from interactive_nav_common.signals import heard, interrupts_heard

DEAF = """
import os, signal, time
try:
    os.kill(os.getpid(), signal.SIGINT)
    time.sleep(0.01)
except BaseException:
    pass
"""


def test_an_interrupt_within_an_import_that_catches_all_comes_after_it(tmp_path, monkeypatch):
    (tmp_path / "deaf_to_interrupts.py").write_text(DEAF)
    monkeypatch.syspath_prepend(str(tmp_path))
    with pytest.raises(KeyboardInterrupt), interrupts_heard():
        import deaf_to_interrupts  # type: ignore[import-not-found]  # noqa: F401

        assert "deaf_to_interrupts" in sys.modules
        time.sleep(5)
    assert signal.getsignal(signal.SIGINT) is signal.default_int_handler


def test_one_within_a_callback_of_the_collector_comes_after_it():
    came = []

    def at_collection(phase: str, info: dict) -> None:
        if not came:
            came.append(phase)
            os.kill(os.getpid(), signal.SIGINT)
            time.sleep(0.01)

    try:
        with pytest.raises(KeyboardInterrupt), interrupts_heard():
            gc.callbacks.append(at_collection)
            gc.collect()
            time.sleep(5)
    finally:
        gc.callbacks.remove(at_collection)
    assert came


def test_elsewhere_a_handler_acts_at_once():
    seen = []
    heard(lambda number, frame: seen.append(number))(signal.SIGTERM, sys._getframe())
    assert seen == [signal.SIGTERM]


def test_who_handles_interrupts_goes_on_doing_so():
    usual = signal.signal(signal.SIGINT, signal.SIG_IGN)
    try:
        with interrupts_heard():
            assert signal.getsignal(signal.SIGINT) is signal.SIG_IGN
    finally:
        signal.signal(signal.SIGINT, usual)
