"""Hostile requests, over bare sockets: each is refused, and the capture goes on."""

from __future__ import annotations

import json
import socket
import time

import pytest

from tests.web.serving import Served
from udccal.errors import UdccalError
from udccal.web import requests as requests_module
from udccal.web.page import serve
from udccal.web.requests import MOST_BODY
from udccal.web.server import MOST_CONNECTIONS

MINE, OTHER = "a" * 32, "b" * 32


def sent(port: int, request: bytes) -> tuple[int, bytes]:
    """Send bytes as they are; return the status (0 where there is none) and the body."""
    with socket.create_connection(("127.0.0.1", port), 10.0) as connection:
        connection.sendall(request)
        answer = b""
        try:
            while part := connection.recv(2**16):
                answer += part
        except ConnectionResetError:
            pass
    head, _, body = answer.partition(b"\r\n\r\n")
    return int(head.split()[1]) if head.startswith(b"HTTP/") else 0, body


def request(served: Served, method: str = "GET", path: str = "", body: bytes = b"", **headers: str) -> bytes:
    """A right request, but for what is given."""
    lines = {"Host": f"127.0.0.1:{served.port}", "Content-Length": str(len(body))} | headers
    head = "".join(f"{name.replace('_', '-')}: {value}\r\n" for name, value in lines.items())
    return f"{method} {served.root}{path} HTTP/1.1\r\n{head}\r\n".encode() + body


def news(served: Served, window: str = MINE, version: int = 0) -> dict:
    status, body = sent(served.port, request(served, path=f"news?window={window}&version={version}&view=0"))
    assert status == 200
    return json.loads(body)


def open_question(served: Served) -> int:
    """The number of the question that the capture waits at."""
    version = 0
    while True:
        found = news(served, version=version)
        if found["question"] is not None:
            return found["question"]["number"]
        version = found["version"]


def answer(served: Served, **said: object) -> tuple[int, bytes]:
    return sent(served.port, request(served, "POST", "answer", json.dumps(said).encode()))


def test_right_requests_are_answered(served: Served) -> None:
    status, page = sent(served.port, request(served))
    assert status == 200
    assert b"</html>" in page
    assert sent(served.port, request(served, Host=f"localhost:{served.port}"))[0] == 200
    assert sent(served.port, request(served, Origin=f"http://127.0.0.1:{served.port}"))[0] == 200
    assert answer(served, window=MINE, question=open_question(served), answer="go")[0] == 200
    assert served.goes_on()


def test_the_page_may_run_its_own_script_only_and_load_nothing_from_outside(waiting: Served) -> None:
    with socket.create_connection(("127.0.0.1", waiting.port), 10.0) as connection:
        connection.sendall(request(waiting))
        stream = connection.makefile("rb")
        whole = stream.read().decode()
    head, _, page = whole.partition("\r\n\r\n")
    policy = next(line for line in head.splitlines() if line.startswith("Content-Security-Policy"))
    nonce = policy.split("script-src 'nonce-")[1].split("'")[0]
    assert "default-src 'none'" in policy
    assert "unsafe" not in policy
    assert page.count(f'nonce="{nonce}"') == 2
    assert "innerHTML" not in page
    assert "http" not in page.replace("http://www.w3.org/2000/svg", "")


@pytest.mark.parametrize(
    ("headers", "why"),
    [
        ({"Host": "evil.example"}, "another name of this computer: DNS rebinding"),
        ({"Host": "127.0.0.1:1"}, "another port"),
        ({"Host": "127.0.0.1"}, "no port"),
        ({"Host": "evil.example\r\nHost: 127.0.0.1:{port}"}, "two names"),
        ({"Origin": "http://evil.example"}, "a foreign page"),
        ({"Origin": "http://127.0.0.1:1"}, "a page of another server here"),
        ({"Origin": "null"}, "a page without an origin"),
        ({"Origin": "http://localhost:{port}"}, "the other name than that of the host"),
    ],
)
@pytest.mark.parametrize("method", ["GET", "POST"])
def test_foreign_hosts_and_origins_are_refused(waiting: Served, headers: dict[str, str], why: str, method: str) -> None:
    own = {name: value.replace("{port}", str(waiting.port)) for name, value in headers.items()}
    path = "" if method == "GET" else "answer"
    assert sent(waiting.port, request(waiting, method, path, **own))[0] == 403, why
    assert waiting.goes_on()


def test_a_request_without_a_host_is_refused(waiting: Served) -> None:
    assert sent(waiting.port, f"GET {waiting.root} HTTP/1.0\r\n\r\n".encode())[0] == 403


@pytest.mark.parametrize("path", ["/", "/{wrong}/", "/{short}/", "/{root}", "/?t={root}", "/x/{root}/", "/\xff/"])
@pytest.mark.parametrize("rest", ["", "news?window=" + MINE + "&version=0&view=0"])
def test_wrong_tokens_are_refused(waiting: Served, path: str, rest: str) -> None:
    token = waiting.root.strip("/")
    wrong = token[:-1] + ("A" if token[-1] != "A" else "B")
    place = path.format(wrong=wrong, short=token[:-1], root=token)
    text = f"GET {place}{rest} HTTP/1.1\r\nHost: 127.0.0.1:{waiting.port}\r\n\r\n"
    assert sent(waiting.port, text.encode("latin-1"))[0] == 403
    assert waiting.goes_on()


@pytest.mark.parametrize("path", ["x", "news/", "../", "..%2f", "page.html", "answer"])
def test_unknown_addresses_are_not_found(waiting: Served, path: str) -> None:
    assert sent(waiting.port, request(waiting, path=path))[0] == 404


@pytest.mark.parametrize("method", ["PUT", "DELETE", "HEAD", "OPTIONS", "TRACE", "CONNECT", "PATCH", "get", "\x00"])
def test_other_methods_are_refused(waiting: Served, method: str) -> None:
    assert sent(waiting.port, request(waiting, method))[0] in (400, 501)
    assert waiting.goes_on()


@pytest.mark.parametrize(
    "query",
    [
        "",
        "?",
        "?window=" + MINE,
        f"?window={MINE}&version=0&view=x",
        f"?window={MINE}&version=-1&view=0",
        f"?window={MINE}&version={'9' * 5000}&view=0",
        f"?window={MINE}&version=nan&view=0",
        f"?window={MINE}&version=0&view=0&more=1",
        "?window=<script>&version=0&view=0",
        f"?window={'a' * 65}&version=0&view=0",
        "?" + "&".join(["a=b"] * 100),
    ],
)
def test_malformed_questions_for_news_are_refused(waiting: Served, query: str) -> None:
    assert sent(waiting.port, request(waiting, path=f"news{query}"))[0] == 400
    assert waiting.goes_on()


@pytest.mark.parametrize(
    "body",
    [
        b"",
        b"go",
        b"[" * MOST_BODY,
        b"\xff\xfe",
        b"null",
        b"[]",
        b'{"window": "' + MINE.encode() + b'"}',
        b'{"window": "x", "question": 1, "answer": "go"}',
        b'{"window": "' + MINE.encode() + b'", "question": "1", "answer": "go"}',
        b'{"window": "' + MINE.encode() + b'", "question": NaN, "answer": "go"}',
        b'{"window": "' + MINE.encode() + b'", "question": 1e999, "answer": "go"}',
        b'{"window": "' + MINE.encode() + b'", "question": 1, "answer": "format"}',
        b'{"window": "' + MINE.encode() + b'", "question": 1, "answer": "go", "more": 1}',
    ],
)
def test_malformed_answers_are_refused(waiting: Served, body: bytes) -> None:
    assert sent(waiting.port, request(waiting, "POST", "answer", body))[0] == 400
    assert waiting.capture.answered == []
    assert waiting.goes_on()


@pytest.mark.parametrize(
    ("headers", "status"),
    [
        ({"Content-Length": str(MOST_BODY + 1)}, 413),
        ({"Content-Length": "999999999"}, 413),
        ({"Content-Length": "9" * 4000}, 411),
        ({"Content-Length": "-1"}, 411),
        ({"Content-Length": "1\r\nContent-Length: 1"}, 411),
        ({"Transfer-Encoding": "chunked"}, 411),
    ],
)
def test_bodies_that_are_large_or_of_unknown_length_are_refused(
    waiting: Served, headers: dict[str, str], status: int
) -> None:
    assert sent(waiting.port, request(waiting, "POST", "answer", b"", **headers))[0] == status
    assert waiting.goes_on()


def test_a_large_body_is_not_read(waiting: Served) -> None:
    with socket.create_connection(("127.0.0.1", waiting.port), 10.0) as one:
        one.sendall(request(waiting, "POST", "answer", **{"Content-Length": "999999999"}))
        with pytest.raises(ConnectionError):
            one.sendall(b" " * 2**28)
    assert waiting.goes_on()


@pytest.mark.parametrize(
    "text",
    [
        b"\r\n\r\n",
        b"\x16\x03\x01\x02\x00\x01\x00\x01\xfc\x03\x03",  # TLS
        b"GET / HTTP/9.9\r\n\r\n",
        b"GET " + b"a" * 70000 + b" HTTP/1.1\r\n\r\n",
        b"GET / HTTP/1.1\r\n" + b"a: b\r\n" * 200 + b"\r\n",
        b"GET / HTTP/1.1\r\na: " + b"b" * 70000 + b"\r\n\r\n",
        b"GET http://evil.example/ HTTP/1.1\r\nHost: evil.example\r\n\r\n",
    ],
)
def test_broken_requests_are_refused(waiting: Served, text: bytes, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(requests_module, "PATIENCE_S", 0.5)  # one waits for the rest of a line
    assert sent(waiting.port, text)[0] in (0, 400, 403, 414, 431, 505)
    assert waiting.goes_on()


def test_answers_that_are_not_offered_any_more_are_refused(served: Served) -> None:
    number = open_question(served)
    assert answer(served, window=MINE, question=number, answer="again")[0] == 409
    assert answer(served, window=MINE, question=number + 1, answer="go")[0] == 409
    assert answer(served, window=MINE, question=number, answer="go")[0] == 200
    assert answer(served, window=MINE, question=number, answer="go")[0] == 409
    assert answer(served, window=OTHER, question=number, answer="go")[0] == 403
    assert served.goes_on()


def test_a_slow_writer_is_cut_off(served: Served, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(requests_module, "PATIENCE_S", 0.5)
    start_s = time.monotonic()
    with socket.create_connection(("127.0.0.1", served.port), 10.0) as slow:
        slow.settimeout(0.05)
        left = iter(request(served) * 10)
        while time.monotonic() - start_s < 10.0:
            try:
                slow.send(bytes([next(left)]))
                if slow.recv(1) == b"":
                    break
            except TimeoutError:
                pass
            except ConnectionError:
                break
    assert 0.4 < time.monotonic() - start_s < 5.0
    assert served.goes_on()


def test_a_reader_that_stalls_holds_up_nobody(waiting: Served) -> None:
    with socket.socket() as stalled:
        stalled.setsockopt(socket.SOL_SOCKET, socket.SO_RCVBUF, 1024)
        stalled.connect(("127.0.0.1", waiting.port))
        stalled.sendall(request(waiting, path=f"news?window={OTHER}&version=0&view=0"))
        assert waiting.goes_on()
        first = news(waiting)["view"]["number"]
        assert waiting.goes_on()
        time.sleep(0.3)
        assert news(waiting)["view"]["number"] > first


def test_connections_without_end_are_closed_and_others_come_through_later(
    served: Served, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(requests_module, "PATIENCE_S", 1.0)
    idle = [socket.create_connection(("127.0.0.1", served.port), 10.0) for _ in range(MOST_CONNECTIONS)]
    try:
        while sent_quietly(served) == 200:
            time.sleep(0.02)
        assert served.goes_on()
        end_s = time.monotonic() + 10.0
        while sent_quietly(served) != 200:
            assert time.monotonic() < end_s
            time.sleep(0.1)
    finally:
        for one in idle:
            one.close()


def sent_quietly(served: Served) -> int:
    """The status of a right request; 0 where the connection was closed before."""
    try:
        return sent(served.port, request(served))[0]
    except ConnectionError:
        return 0


def test_a_port_in_use_is_a_sentence(waiting: Served) -> None:
    with (
        pytest.raises(UdccalError, match=r"Expected port \d+ of this computer to be free"),
        serve(waiting.capture.person, waiting.port),
    ):
        pass


def test_it_listens_on_this_computer_alone(waiting: Served) -> None:
    # Whoever listens everywhere also answers at the other addresses of the loopback.
    with pytest.raises(OSError), socket.create_connection(("127.0.0.2", waiting.port), 2.0):
        pass
