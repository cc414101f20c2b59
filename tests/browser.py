"""A Chromium that a test drives by its own protocol (CDP): loads pages, presses keys, takes pictures."""

from __future__ import annotations

import base64
import contextlib
import itertools
import json
import shutil
import time
import urllib.request
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import pytest

from pneud import crew

PROGRAM = next(filter(None, map(shutil.which, ("chromium", "chromium-browser", "google-chrome"))), None)
_OPTIONS = (
    *("--headless", "--no-sandbox", "--disable-gpu", "--disable-quic", "--no-first-run", "--hide-scrollbars"),
    *("--disable-background-networking", "--disable-component-update", "--disable-sync"),
    *("--remote-debugging-port=0", "--remote-allow-origins=*"),
)
_KEYS = {"Escape": 27, " ": 32, "ArrowLeft": 37, "ArrowRight": 39, "Enter": 13}


class Tab:
    """One page of it."""

    def __init__(self, port: int) -> None:
        from websockets.sync.client import connect  # noqa: PLC0415

        request = urllib.request.Request(f"http://127.0.0.1:{port}/json/new?about:blank", method="PUT")
        with urllib.request.urlopen(request, timeout=30) as answer:
            self._target = json.load(answer)
        self._port = port
        self._until_closed = contextlib.ExitStack()
        line = connect(self._target["webSocketDebuggerUrl"], max_size=None, proxy=None)
        self._line = self._until_closed.enter_context(line)
        self._numbers = itertools.count(1)
        self.call("Page.enable")

    def call(self, method: str, **params: Any) -> Any:
        number = next(self._numbers)
        self._line.send(json.dumps({"id": number, "method": method, "params": params}))
        while True:
            found = json.loads(self._line.recv(timeout=30))
            if found.get("id") == number:
                assert "error" not in found, found
                return found["result"]

    def js(self, expression: str) -> Any:
        """What an expression comes to, when it does."""
        found = self.call("Runtime.evaluate", expression=expression, awaitPromise=True, returnByValue=True)
        assert "exceptionDetails" not in found, found["exceptionDetails"]
        return found["result"].get("value")

    def until(self, expression: str, timeout_s: float = 30.0) -> None:
        """Wait until an expression is true."""
        give_up_s = time.monotonic() + timeout_s
        while not self.js(f"Boolean({expression})"):
            assert time.monotonic() < give_up_s, (expression, self.js("document.body.innerText"))
            time.sleep(0.02)

    def open(self, url: str) -> None:
        self.call("Page.navigate", url=url)
        self.until("document.readyState === 'complete' && location.protocol !== 'about:'")

    def size(self, width: int, height: int, dark: bool) -> None:
        self.call(
            "Emulation.setDeviceMetricsOverride",
            width=width,
            height=height,
            deviceScaleFactor=1,
            mobile=False,
        )
        scheme = {"name": "prefers-color-scheme", "value": "dark" if dark else "light"}
        self.call("Emulation.setEmulatedMedia", features=[scheme])

    def key(self, key: str, *, up: bool = True) -> None:
        code = _KEYS.get(key, ord(key[0].upper()))
        text = {"text": key} if len(key) == 1 else {}
        self.call("Input.dispatchKeyEvent", type="keyDown", key=key, windowsVirtualKeyCode=code, **text)
        if up:
            self.call("Input.dispatchKeyEvent", type="keyUp", key=key, windowsVirtualKeyCode=code)

    def picture(self, path: Path) -> None:
        path.write_bytes(
            base64.b64decode(self.call("Page.captureScreenshot", captureBeyondViewport=True)["data"])
        )

    def close(self) -> None:
        self._until_closed.close()
        target = self._target["id"]
        with urllib.request.urlopen(f"http://127.0.0.1:{self._port}/json/close/{target}", timeout=30):
            pass


@contextmanager
def chromium(folder: Path) -> Iterator[int]:
    """A running one; its port."""
    if PROGRAM is None:
        pytest.skip("no Chromium here: apt install chromium")
    place = folder / "profile" / "DevToolsActivePort"
    with (folder / "chromium.err").open("w") as err:
        command = [PROGRAM, *_OPTIONS, f"--user-data-dir={folder / 'profile'}", "about:blank"]
        with crew.program(*command, out=err.fileno(), err=err.fileno()) as process:
            give_up_s = time.monotonic() + 60.0
            while not place.exists() or not place.read_text().strip():
                assert process.poll() is None
                assert time.monotonic() < give_up_s, "Chromium does not start"
                time.sleep(0.05)
            yield int(place.read_text().split()[0])
