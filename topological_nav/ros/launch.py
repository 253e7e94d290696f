"""A master where none is, and the processes of one episode: each node is its own, as ROS wants it."""

from __future__ import annotations

import contextlib
import os
import signal
import subprocess
import sys
import time
from collections.abc import Callable, Iterator, Sequence
from typing import Any
from urllib.parse import urlsplit

from topological_nav.ros.debian import RosError

DEFAULT_URI = "http://localhost:11311"
_LOOPBACK = ("localhost", "127.0.0.1", "::1")
_STARTS_S, _ENDS_S = 30.0, 20.0


def master_uri() -> str:
    """Where the environment says the master is."""
    return os.environ.get("ROS_MASTER_URI") or DEFAULT_URI


def stay_local() -> None:
    """Makes nodes of this process and its children meet on loopback only, where the master is there too.

    Whoever has set ROS_IP or ROS_HOSTNAME has chosen; with a master elsewhere nothing is changed.
    """
    if urlsplit(master_uri()).hostname in _LOOPBACK and not {"ROS_IP", "ROS_HOSTNAME"} & set(os.environ):
        os.environ["ROS_IP"] = "127.0.0.1"


def answers(ros: Any) -> bool:
    """Whether a master is there."""
    stay_local()
    try:
        ros.rosgraph.Master("/topological_nav", master_uri()).getPid()
    except Exception:  # noqa: BLE001  (sockets, HTTP and XML-RPC raise many kinds where no master is)
        return False
    return True


def need_master(ros: Any) -> None:
    """Raises RosError unless a master is there."""
    if not answers(ros):
        raise RosError(
            f"no master answers at {master_uri()}; start one (roscore, or rosmaster --core), or set ROS_MASTER_URI"
        )


@contextlib.contextmanager
def some_master(ros: Any, port: int | None) -> Iterator[str]:
    """The master that is there, or else one of our own on loopback, which ends with the block.

    Args:
        ros: of `debian.load`.
        port: of a master of our own, even if one is there already; 0: a free one; None: as ROS_MASTER_URI has it.

    Yields:
        Its URI, which ROS_MASTER_URI has too.

    Raises:
        RosError: none answers on another machine, or ours does not start.
    """
    if port is None and answers(ros):
        yield master_uri()
        return
    place = urlsplit(master_uri())
    if port is None and place.hostname not in _LOOPBACK:
        need_master(ros)
    os.environ["ROS_IP"] = "127.0.0.1"
    os.environ.pop("ROS_HOSTNAME", None)
    own = ros.rosmaster.Master(place.port or 11311 if port is None else port)
    own.start()
    until = time.monotonic() + _STARTS_S
    # An error such as a port in use ends the server's thread only; the URI then never answers with our own process.
    while True:
        uri = own.uri
        os.environ["ROS_MASTER_URI"] = uri
        with contextlib.suppress(Exception):  # sockets, HTTP and XML-RPC raise many kinds
            if ros.rosgraph.Master("/topological_nav", uri).getPid() == os.getpid():
                break
        if time.monotonic() > until:
            raise RosError(f"the master at {uri} does not answer; is the port taken? try --port 0")
        time.sleep(0.05)
    try:
        yield uri
    finally:
        own.stop()


class Nodes:
    """Processes of `python -m topological_nav.ros`; all of them end with the block."""

    def __init__(self) -> None:
        self._processes: list[tuple[str, subprocess.Popen[str]]] = []

    def __enter__(self) -> Nodes:
        return self

    def __exit__(self, *error: Any) -> None:
        for started in reversed(self._processes):
            end(started[1])

    def start(self, words: Sequence[str]) -> subprocess.Popen[str]:
        """Starts a command of this program; what it prints on stdout is for the caller."""
        # A session of its own: Ctrl-C reaches this program, which ends its nodes in order.
        process = subprocess.Popen(
            (sys.executable, "-m", "topological_nav.ros", *words),
            stdout=subprocess.PIPE,
            text=True,
            start_new_session=True,
        )
        self._processes.append((words[0], process))
        return process

    def wait(self, awaited: subprocess.Popen[str], stop: Callable[[], bool]) -> bool:
        """Waits until a process ends (True) or a stop is asked for.

        Raises:
            RosError: a node failed.
        """
        while not stop():
            for name, process in self._processes:
                if process.poll():
                    raise RosError(f"the {name} node failed (exit code {process.returncode}); its message stands above")
            if awaited.poll() is not None:
                return True
            time.sleep(0.05)
        return False


def end(process: subprocess.Popen[str]) -> None:
    """Asks a process to end, and waits; one that does not is killed."""
    if process.poll() is None:
        process.send_signal(signal.SIGINT)
        try:
            process.wait(_ENDS_S)
        except subprocess.TimeoutExpired:
            process.kill()
            process.wait()
