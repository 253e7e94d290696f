"""A real headless Chromium, told what to do by its DevTools protocol."""

from __future__ import annotations

import base64
import contextlib
import json
import shutil
import subprocess
import time
import urllib.request
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import pytest
from websockets.sync.client import connect

PROGRAMS = ("chromium", "chromium-browser", "google-chrome")
WIDTH, HEIGHT = 900, 640


def until(condition: Callable[[], Any], seconds: float = 60.0, what: str = "it") -> Any:
    """What the condition gives once it is true.

    Raises:
        TimeoutError: it was not for so long.
    """
    end = time.monotonic() + seconds
    while not (found := condition()):
        if time.monotonic() > end:
            raise TimeoutError(f"waited {seconds} s for {what}")
        time.sleep(0.05)
    return found


class Tab:
    """One page."""

    def __init__(self, connection: Any) -> None:
        """Of an open DevTools connection."""
        self._connection, self._number = connection, 0

    def send(self, method: str, **arguments: Any) -> dict[str, Any]:
        """Result of one command of the protocol."""
        self._number += 1
        self._connection.send(json.dumps({"id": self._number, "method": method, "params": arguments}))
        while True:
            answer = json.loads(self._connection.recv(60))
            if answer.get("id") == self._number:
                if "context was destroyed" in answer.get("error", {}).get("message", ""):  # the page was still loading
                    return self.send(method, **arguments)
                assert "error" not in answer, answer
                return answer["result"]

    def evaluate(self, script: str) -> Any:
        """Value of a JavaScript expression."""
        return self.send("Runtime.evaluate", expression=script, returnByValue=True)["result"].get("value")

    def click(self, x: float, y: float) -> None:
        """Moves the mouse to a pixel and clicks."""
        self.send("Input.dispatchMouseEvent", type="mouseMoved", x=x, y=y)
        for kind in ("mousePressed", "mouseReleased"):
            self.send("Input.dispatchMouseEvent", type=kind, x=x, y=y, button="left", clickCount=1)

    def press(self, word: str) -> None:
        """Clicks the button that has the text, as a person does, with the mouse."""
        found = f"[...document.querySelectorAll('button')].find(b => b.innerText.trim() === {json.dumps(word)})"
        until(lambda: self.evaluate(f"!!{found}"), what=word)
        self.evaluate(f"{found}.scrollIntoView({{block: 'center'}})")
        where = f"(b => [b.x + b.width / 2, b.y + b.height / 2])({found}.getBoundingClientRect())"
        boxes = [self.evaluate(where)]

        def rests() -> bool:  # what was just made still moves
            time.sleep(0.15)
            boxes.append(self.evaluate(where))
            return boxes[-1] == boxes[-2]

        until(rests, what=f"{word} to rest")
        self.click(*boxes[-1])

    def text(self) -> str:
        """What the page says."""
        return self.evaluate("document.body ? document.body.innerText : ''")

    def picture(self, path: Path) -> None:
        """Writes a PNG of the page."""
        path.write_bytes(base64.b64decode(self.send("Page.captureScreenshot")["data"]))


@contextlib.contextmanager
def tab(address: str, profile: Path) -> Iterator[Tab]:
    """The address in a new browser; the test is skipped where there is none."""
    program = next(filter(None, map(shutil.which, PROGRAMS)), None)
    if program is None:
        pytest.skip(f"no Chromium on this machine (one of {', '.join(PROGRAMS)}; Debian: apt install chromium)")
    words = ["--headless=new", "--no-sandbox", "--disable-dev-shm-usage", "--no-first-run", "--remote-debugging-port=0"]
    words += ["--use-angle=swiftshader", "--enable-unsafe-swiftshader", f"--window-size={WIDTH},{HEIGHT}"]
    words += ["--disable-background-networking", "--disable-component-update", "--disable-extensions", "--disable-sync"]
    with subprocess.Popen(
        [program, *words, f"--user-data-dir={profile}", address], stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL
    ) as running:
        try:
            port = until(lambda: (p := profile / "DevToolsActivePort").exists() and p.read_text().split())[0]

            def page() -> str | None:
                with urllib.request.urlopen(f"http://127.0.0.1:{port}/json") as answer:
                    found = [t for t in json.load(answer) if t["type"] == "page" and t["url"].startswith("http")]
                return found[0]["webSocketDebuggerUrl"] if found else None

            with connect(until(page, what="the page"), max_size=None) as connection:
                yield Tab(connection)
        finally:
            running.terminate()
