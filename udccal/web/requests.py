"""Requests of windows: which are answered, with what, and which are refused."""

from __future__ import annotations

import hmac
import io
import re
import secrets
import socket
import time
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from http import HTTPStatus
from http.server import BaseHTTPRequestHandler
from pathlib import Path
from typing import Final, final
from urllib.parse import parse_qsl

from udccal.web.messages import AskedNews, PostedAnswer, news_json
from udccal.web.person import Reception
from udccal.web.server import PageServer

# A request has to be whole, and its response taken, within so long; browsers on the same computer need milliseconds.
PATIENCE_S: Final = 5.0
# How long a request for news waits for some. Shorter than what lets go of the lead, and than a reload may wait.
WAIT_S: Final = 5.0
MOST_BODY: Final = 500
_PAGE = Path(__file__).with_name("page.html")
_STATUS_OF: Final = {
    Reception.taken: HTTPStatus.OK,
    Reception.watches: HTTPStatus.FORBIDDEN,
    Reception.late: HTTPStatus.CONFLICT,
}


class _Refused(Exception):
    """A request that is not answered; the message says why."""

    def __init__(self, status: HTTPStatus, sentence: str) -> None:
        super().__init__(sentence)
        self.status = status


@final
@dataclass(frozen=True)
class _Response:
    status: HTTPStatus
    kind: str
    body: bytes
    policy: str = "default-src 'none'"


@final
class _Hurried(io.RawIOBase):
    """Bytes of a connection; raises TimeoutError when ``PATIENCE_S`` are over, however many came until then."""

    def __init__(self, connection: socket.socket) -> None:
        self._connection = connection
        self._end_s = time.monotonic() + PATIENCE_S

    def readable(self) -> bool:
        return True

    def readinto(self, buffer: memoryview) -> int:  # type: ignore[override]
        left_s = self._end_s - time.monotonic()
        if left_s <= 0.0:
            raise TimeoutError
        self._connection.settimeout(left_s)
        return self._connection.recv_into(buffer)


@final
class PageHandler(BaseHTTPRequestHandler):
    """One request, after which the connection is closed."""

    server: PageServer
    server_version, sys_version = "udccal", ""
    # Of what the base class refuses by itself: broken request lines, unknown methods, headers without end.
    error_content_type, error_message_format = "text/plain; charset=utf-8", "%(explain)s\n"

    def setup(self) -> None:
        """Read within a time limit."""
        super().setup()
        self.rfile = io.BufferedReader(_Hurried(self.connection))

    def do_GET(self) -> None:
        """Answer with the page or with news."""
        self._respond({"": self._page, "news": self._news})

    def do_POST(self) -> None:
        """Take an answer."""
        self._respond({"answer": self._answer})

    def log_message(self, format: str, *args: object) -> None:
        """Log nothing: the terminal belongs to the capture, and addresses hold the token."""

    def _respond(self, routes: Mapping[str, Callable[[str], _Response]]) -> None:
        try:
            self._check_sender()
            name, query = self._admit()
            if name not in routes:
                raise _Refused(HTTPStatus.NOT_FOUND, "There is nothing at this address.")
            response = routes[name](query)
        except _Refused as refused:
            response = _Response(refused.status, "text/plain", f"{refused}\n".encode())
        self._send(response)

    def _check_sender(self) -> None:
        """Refuse what a page of another origin sends, or gets sent to under another name of this computer."""
        port = self.server.server_port
        hosts, origins = self.headers.get_all("Host", []), self.headers.get_all("Origin", [])
        if len(hosts) != 1 or hosts[0] not in (f"127.0.0.1:{port}", f"localhost:{port}"):
            raise _Refused(HTTPStatus.FORBIDDEN, "This server answers to 127.0.0.1 and localhost only.")
        if origins not in ([], [f"http://{hosts[0]}"]):
            raise _Refused(HTTPStatus.FORBIDDEN, "This server answers to its own page only.")

    def _admit(self) -> tuple[str, str]:
        """Return what follows the token in the address, and the query; refuse any other token."""
        path, _, query = self.path.partition("?")
        token, slash, name = path.removeprefix("/").partition("/")
        right = hmac.compare_digest(token.encode(), self.server.token.encode())
        if not right or not slash:
            raise _Refused(HTTPStatus.FORBIDDEN, "Open the address that udccal printed: this one has another token.")
        return name, query

    def _page(self, query: str) -> _Response:
        nonce = secrets.token_urlsafe(16)
        own = f"'nonce-{nonce}'"
        policy = (
            f"default-src 'none'; script-src {own}; style-src {own}; img-src data:; connect-src 'self'; "
            "base-uri 'none'; form-action 'none'; frame-ancestors 'none'"
        )
        page = _PAGE.read_text(encoding="utf-8").replace("@nonce@", nonce)
        return _Response(HTTPStatus.OK, "text/html; charset=utf-8", page.encode(), policy)

    def _news(self, query: str) -> _Response:
        try:
            asked = AskedNews.model_validate(dict(parse_qsl(query, strict_parsing=True, max_num_fields=8)))
        except ValueError as error:
            raise _Refused(HTTPStatus.BAD_REQUEST, "Expected a window, a version and a view.") from error
        news = self.server.person.news(asked.window, asked.version, asked.view, WAIT_S)
        return _Response(HTTPStatus.OK, "application/json", news_json(news))

    def _answer(self, query: str) -> _Response:
        try:
            posted = PostedAnswer.model_validate_json(self._body())
        except ValueError as error:
            raise _Refused(HTTPStatus.BAD_REQUEST, "Expected a window, a question and an answer to it.") from error
        reception = self.server.person.give(posted.window, posted.question, posted.answer)
        return _Response(_STATUS_OF[reception], "text/plain", f"{reception}\n".encode())

    def _body(self) -> bytes:
        lengths = self.headers.get_all("Content-Length", [])
        if len(lengths) != 1 or not re.fullmatch("[0-9]{1,9}", lengths[0]) or "Transfer-Encoding" in self.headers:
            raise _Refused(HTTPStatus.LENGTH_REQUIRED, "Expected a body of a stated length.")
        if int(lengths[0]) > MOST_BODY:
            raise _Refused(HTTPStatus.REQUEST_ENTITY_TOO_LARGE, f"Expected at most {MOST_BODY} bytes.")
        return self.rfile.read(int(lengths[0]))

    def _send(self, response: _Response) -> None:
        self.connection.settimeout(PATIENCE_S)
        self.send_response(response.status)
        for name, value in (
            ("Content-Type", response.kind),
            ("Content-Length", str(len(response.body))),
            ("Content-Security-Policy", response.policy),
            ("Cache-Control", "no-store"),
            ("Cross-Origin-Resource-Policy", "same-origin"),
            ("Referrer-Policy", "no-referrer"),
            ("X-Content-Type-Options", "nosniff"),
        ):
            self.send_header(name, value)
        self.end_headers()
        self.wfile.write(response.body)
