"""Pages in a Chromium without a screen, driven through its DevTools protocol."""

from __future__ import annotations

import base64
import json
import os
import select
import shutil
import subprocess
import time
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, Final, final

import pytest

CHROMIUM: Final = next(filter(None, map(shutil.which, ("chromium", "chromium-browser", "google-chrome"))), None)
PATIENCE_S = 60.0
_FLAGS = (
    *("--headless", "--no-sandbox", "--disable-gpu", "--disable-background-networking", "--no-first-run"),
    # A window behind another one works as if it were in front.
    *("--disable-renderer-backgrounding", "--disable-backgrounding-occluded-windows"),
)


@final
@dataclass
class Pipe:
    """Messages to and from the browser: JSON, each ended by a zero byte."""

    to: int
    back: int
    pages: dict[str, Page] = field(default_factory=dict)
    _rest: bytes = b""
    _sent: int = 0

    def call(self, method: str, session: str | None = None, **parameters: object) -> Any:
        """Call a method of the protocol, of a page or of the browser, and return its result."""
        self._sent += 1
        message = {"id": self._sent, "method": method, "params": parameters}
        os.write(self.to, json.dumps(message if session is None else message | {"sessionId": session}).encode() + b"\0")
        while (found := self._next()).get("id") != self._sent:
            if found.get("sessionId") in self.pages:
                self.pages[found["sessionId"]].hear(found["method"], found["params"])
        if "error" in found:
            raise AssertionError(f"{method}: {found['error']}")
        return found["result"]

    def _next(self) -> Any:
        while b"\0" not in self._rest:
            assert select.select([self.back], [], [], PATIENCE_S)[0], "Chromium does not answer"
            self._rest += os.read(self.back, 2**20)
        message, _, self._rest = self._rest.partition(b"\0")
        return json.loads(message)


@final
@dataclass
class Page:
    """A window's page; ``errors`` are what its console complained of, ``requests`` the addresses it asked for."""

    pipe: Pipe
    session: str
    errors: list[str] = field(default_factory=list)
    requests: list[str] = field(default_factory=list)

    def hear(self, event: str, found: Any) -> None:
        """Take an event of the protocol."""
        match event:
            case "Runtime.exceptionThrown":
                self.errors.append(json.dumps(found["exceptionDetails"]))
            case "Runtime.consoleAPICalled" if found["type"] in ("error", "warning", "assert"):
                self.errors.append(json.dumps(found["args"]))
            case "Log.entryAdded" if found["entry"]["level"] in ("error", "warning"):
                self.errors.append(json.dumps(found["entry"]))
            case "Network.requestWillBeSent":
                self.requests.append(found["request"]["url"])

    def call(self, method: str, **parameters: object) -> Any:
        """Call a method of the protocol for this page."""
        return self.pipe.call(method, self.session, **parameters)

    def run(self, script: str) -> Any:
        """Return the value of an expression in the page."""
        found = self.call("Runtime.evaluate", expression=script, returnByValue=True, awaitPromise=True)
        assert "exceptionDetails" not in found, found["exceptionDetails"]
        return found["result"].get("value")

    def wait(self, condition: str, patience_s: float = PATIENCE_S) -> None:
        """Wait until an expression in the page holds."""
        end_s = time.monotonic() + patience_s
        while not self.run(f"Boolean({condition})"):
            assert time.monotonic() < end_s, f"never held: {condition}; the page says: {self.text}"
            time.sleep(0.03)

    def tap(self, selector: str) -> None:
        """Touch the middle of an element, wherever the page shows it."""
        where = f"document.querySelector({json.dumps(selector)})"
        self.wait(f"{where} && !{where}.disabled")
        self.run(f"{where}.scrollIntoView({{block: 'nearest'}})")
        box = self.run(f"(b => [b.x + b.width / 2, b.y + b.height / 2])({where}.getBoundingClientRect())")
        self.call("Input.dispatchTouchEvent", type="touchStart", touchPoints=[{"x": box[0], "y": box[1]}])
        self.call("Input.dispatchTouchEvent", type="touchEnd", touchPoints=[])

    def reload(self) -> None:
        """Load the page anew, as a person does who pulls it down."""
        self.run("window.before = true")
        self.call("Page.reload")
        self.wait("!window.before && document.readyState === 'complete'")

    @property
    def text(self) -> str:
        """What a person can read."""
        return str(self.run("document.body.innerText"))

    @property
    def scrolls_sideways(self) -> bool:
        """Whether anything lies to the right of the window."""
        return bool(self.run("document.documentElement.scrollWidth > document.documentElement.clientWidth"))

    def screenshot(self, file: Path) -> None:
        """Write what the window shows."""
        file.write_bytes(base64.b64decode(self.call("Page.captureScreenshot", format="png")["data"]))


@final
@dataclass
class Browser:
    """A running Chromium."""

    pipe: Pipe

    def open(self, address: str, width: int, height: int = 900) -> Page:
        """Open a page in a window of its own; one that is less than 1000 px wide is a phone's or a tablet's."""
        target = self.pipe.call("Target.createTarget", url="about:blank", newWindow=True)["targetId"]
        session = self.pipe.call("Target.attachToTarget", targetId=target, flatten=True)["sessionId"]
        page = self.pipe.pages[session] = Page(self.pipe, session)
        for domain in ("Page", "Runtime", "Log", "Network"):
            page.call(f"{domain}.enable")
        size = {"width": width, "height": height, "deviceScaleFactor": 1, "mobile": width < 1000}
        page.call("Emulation.setDeviceMetricsOverride", **size)
        page.call("Emulation.setTouchEmulationEnabled", enabled=True)
        page.call("Page.navigate", url=address)
        page.wait(f"location.href === {json.dumps(address)} && document.readyState === 'complete'")
        return page


@contextmanager
def chromium(folder: Path) -> Iterator[Browser]:
    """Run Chromium with a profile in ``folder``; skip the test where there is none."""
    if CHROMIUM is None:
        pytest.skip("needs Chromium, which this machine lacks")
    (its_in, to), (back, its_out) = os.pipe(), os.pipe()
    # It reads from descriptor 3 and writes to descriptor 4.
    shell = ["bash", "-c", f'exec "$@" 3<&{its_in} 4>&{its_out}', "-", CHROMIUM, *_FLAGS]
    command = [*shell, "--remote-debugging-pipe", f"--user-data-dir={folder / 'chromium'}", "about:blank"]
    with subprocess.Popen(command, pass_fds=(its_in, its_out), stderr=subprocess.DEVNULL) as process:
        os.close(its_in)
        os.close(its_out)
        try:
            yield Browser(Pipe(to, back))
        finally:
            process.terminate()
            process.wait(PATIENCE_S)
            os.close(to)
            os.close(back)
