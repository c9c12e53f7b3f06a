"""The page of a guided capture, served while it lasts."""

from __future__ import annotations

import threading
import time
from collections.abc import Iterator
from contextlib import contextmanager
from typing import Final

from udccal.errors import UdccalError
from udccal.web.person import WebPerson
from udccal.web.requests import PageHandler
from udccal.web.server import PageServer

# How long the last state stays to be fetched: a window that was drawing asks again within a fraction of it.
_FAREWELL_S: Final = 1.0


@contextmanager
def serve(person: WebPerson, port: int) -> Iterator[str]:
    """Serve the page of a person while the context lasts; yield its address.

    Args:
        person: whom the page shows.
        port: to listen on; 0 for any that is free.

    Raises:
        UdccalError: when the port cannot be had.
    """
    try:
        server = PageServer(person, port, PageHandler)
    except OSError as error:
        raise UdccalError(
            f"Expected port {port} of this computer to be free, found: {error}. Choose another, or 0 for any."
        ) from error
    with server:
        thread = threading.Thread(target=server.serve_forever, args=(0.1,), name="page", daemon=True)
        thread.start()
        try:
            yield server.address
            if person.watched:
                time.sleep(_FAREWELL_S)
        finally:
            server.shutdown()
            thread.join()
