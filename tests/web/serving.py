"""A played capture behind a page, for tests that send it requests or open it."""

from __future__ import annotations

import threading
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass

from tests.web.capture import SAMPLING, PlayedCapture
from udccal.web.page import serve
from udccal.web.person import WebPerson


@dataclass(frozen=True)
class Served:
    """A capture that runs, and the address of its page."""

    address: str
    capture: PlayedCapture
    thread: threading.Thread

    @property
    def port(self) -> int:
        return int(self.address.split(":")[2].split("/")[0])

    @property
    def root(self) -> str:
        """The path that begins with the token and ends with a slash."""
        return "/" + self.address.split("/", 3)[3]

    def goes_on(self) -> bool:
        """Whether the capture takes three more frames while we wait."""
        until = self.capture.looked + 3
        for _ in range(200):
            if self.capture.looked >= until:
                return True
            self.thread.join(0.05)
        return False


@contextmanager
def played() -> Iterator[Served]:
    """Play a capture behind a page."""
    person = WebPerson(SAMPLING)
    capture = PlayedCapture(person)
    thread = threading.Thread(target=capture.run, daemon=True)
    with serve(person, 0) as address:
        thread.start()
        yield Served(address, capture, thread)
        capture.stop = True
        thread.join(10.0)
