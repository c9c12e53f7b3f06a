"""The server of a page on this computer alone, for whoever has the address that holds its token."""

from __future__ import annotations

import secrets
import socket
import socketserver
import sys
import threading
from http.server import BaseHTTPRequestHandler, ThreadingHTTPServer
from typing import Final, final

from udccal.web.person import WebPerson

HOST: Final = "127.0.0.1"
MOST_CONNECTIONS: Final = 48


@final
class PageServer(ThreadingHTTPServer):
    """Answers each connection in a thread of its own; connections beyond ``MOST_CONNECTIONS`` are closed at once.

    Args:
        person: whom the page shows.
        port: to listen on; 0 for any that is free.
        handler: answers a request.
    """

    daemon_threads = True
    request_queue_size = MOST_CONNECTIONS

    def __init__(self, person: WebPerson, port: int, handler: type[BaseHTTPRequestHandler]) -> None:
        self.person = person
        self.token = secrets.token_urlsafe(24)
        self._free = threading.BoundedSemaphore(MOST_CONNECTIONS)
        super().__init__((HOST, port), handler)

    @property
    def address(self) -> str:
        """The page's, token and all."""
        return f"http://{HOST}:{self.server_port}/{self.token}/"

    def server_bind(self) -> None:
        """Bind without http.server's search for this computer's name, which may ask a name server."""
        socketserver.TCPServer.server_bind(self)
        self.server_name, self.server_port = HOST, self.server_address[1]

    def process_request(self, request: socket.socket | tuple[bytes, socket.socket], client_address: object) -> None:
        """Start the thread of a connection, or close it when there are too many."""
        if not self._free.acquire(blocking=False):
            self.shutdown_request(request)
            return
        try:
            super().process_request(request, client_address)
        except RuntimeError:  # no thread to be had
            self._free.release()
            raise

    def process_request_thread(
        self, request: socket.socket | tuple[bytes, socket.socket], client_address: object
    ) -> None:
        """Answer a connection."""
        try:
            super().process_request_thread(request, client_address)
        finally:
            self._free.release()

    def handle_error(self, request: socket.socket | tuple[bytes, socket.socket], client_address: object) -> None:
        """Say nothing of connections that broke or were too slow; print the traceback of anything else."""
        if not isinstance(sys.exc_info()[1], OSError):
            super().handle_error(request, client_address)
