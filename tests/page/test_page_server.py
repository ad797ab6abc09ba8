"""The page's server over real sockets: who is let in, and what hostile or slow clients can do, which is nothing."""

from __future__ import annotations

import itertools
import socket
import threading
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path

import msgspec
import pytest

from ortholoc_edge.adapters.page import server as server_module
from ortholoc_edge.adapters.page.http import Guard, RefusedError, Request, parse_request, response
from ortholoc_edge.adapters.page.options import Listen, PageOptions, checked
from ortholoc_edge.adapters.page.server import MAX_CONNECTIONS, MAX_PER_ADDRESS, MAX_STREAMS, PageServer
from ortholoc_edge.errors import ConfigError

TOKEN = b"0123456789abcdef-~._"
BODY = b"x" * 300_000


def listening(token: bytes | None = None, *hosts: str) -> Listen:
    return Listen("127.0.0.1", 0, False, token, frozenset(hosts))


class Running:
    """A server in a thread; events have the number of the last and a filling."""

    def __init__(self, listen: Listen, event_bytes: int = 200) -> None:
        self.server = PageServer(listen, self._answer)
        self.port = self.server.port
        self.told = itertools.count(1)
        self.latest = 0
        self.rounds = 0
        self.event_bytes = event_bytes
        self._stop = threading.Event()
        self._thread = threading.Thread(target=self._work)
        self._thread.start()

    @staticmethod
    def _answer(request: Request) -> bytes | None:
        if request.path == "/events":
            return None
        if request.path == "/defect":
            raise ZeroDivisionError
        if request.path in ("/", "/large"):
            return response(200, b"hello" if request.path == "/" else BODY, head_only=request.method == "HEAD")
        raise RefusedError(404, "no such thing")

    def _event(self, seen: int) -> tuple[int, bytes]:
        return self.latest, f"data: {seen}-{self.latest} {'y' * self.event_bytes}\n\n".encode()

    def _work(self) -> None:
        while not self._stop.is_set():
            self.server.step(0.01)
            self.latest = next(self.told)
            self.server.tell(self._event)
            self.rounds += 1

    def close(self) -> None:
        self._stop.set()
        self._thread.join(timeout=10.0)
        assert not self._thread.is_alive()
        self.server.close()


@contextmanager
def serving(listen: Listen | None = None, event_bytes: int = 200) -> Iterator[Running]:
    running = Running(listen or listening(), event_bytes)
    try:
        yield running
    finally:
        running.close()


def wait_for(condition: Callable[[], object], what: str, seconds: float = 20.0) -> None:
    deadline = time.monotonic() + seconds
    while not condition():
        assert time.monotonic() < deadline, f"{what}: did not happen in {seconds:g} s"
        time.sleep(0.005)


def connect(running: Running) -> socket.socket:
    return socket.create_connection(("127.0.0.1", running.port), timeout=20.0)


def read_all(sock: socket.socket) -> bytes:
    parts = []
    while data := sock.recv(65536):
        parts.append(data)
    return b"".join(parts)


def ask(running: Running, head: bytes) -> bytes:
    with connect(running) as sock:
        sock.sendall(head)
        return read_all(sock)


def get(path: str = "/", host: str = "127.0.0.1:8080", *headers: str, method: str = "GET") -> bytes:
    lines = [f"{method} {path} HTTP/1.1", f"Host: {host}", *headers, "", ""]
    return "\r\n".join(lines).encode("latin-1")


def status(answer: bytes) -> int:
    return int(answer.split(b" ", 2)[1])


@pytest.fixture(scope="module")
def open_page() -> Iterator[Running]:
    with serving() as running:
        yield running


# -- requests ------------------------------------------------------------------------------------------


def test_a_request_is_answered_and_the_connection_ends(open_page: Running) -> None:
    answer = ask(open_page, get())
    head, _, body = answer.partition(b"\r\n\r\n")
    assert status(answer) == 200 and body == b"hello"
    assert b"content-security-policy: default-src 'none'; script-src 'self'" in head.lower()
    assert b"access-control" not in head.lower()
    assert b"x-content-type-options: nosniff" in head.lower()
    assert ask(open_page, get(method="HEAD")).partition(b"\r\n\r\n")[2] == b""
    large = ask(open_page, get("/large")).partition(b"\r\n\r\n")[2]
    assert large == BODY


GARBAGE = {
    "nothing of HTTP": (b"\x16\x03\x01\x02\x00\x01\x00\x01\xfc\x03\x03\r\n\r\n", 400),
    "an older HTTP": (b"GET /\r\n\r\n", 400),
    "a proxy's request": (b"GET http://elsewhere/ HTTP/1.1\r\nHost: 127.0.0.1\r\n\r\n", 400),
    "no host": (b"GET / HTTP/1.1\r\n\r\n", 403),
    "two hosts": (b"GET / HTTP/1.1\r\nHost: 127.0.0.1\r\nHost: evil\r\n\r\n", 400),
    "a folded header": (b"GET / HTTP/1.1\r\nHost: 127.0.0.1\r\n folded: x\r\n\r\n", 400),
    "a bare line feed": (b"GET / HTTP/1.1\r\nHost: 127.0.0.1\nX: y\r\n\r\n", 400),
    "a null": (b"GET / HTTP/1.1\r\nHost: 127.0.0.1\r\nX: \x00\r\n\r\n", 400),
    "blanks without end": (b"GET / HTTP/1.1\r\nHost: 127.0.0.1\r\nX:" + b" " * 8000 + b"\x01\r\n\r\n", 400),
    "many headers": (b"GET / HTTP/1.1\r\nHost: 127.0.0.1\r\n" + b"X: y\r\n" * 100 + b"\r\n", 431),
    "a huge head": (b"GET / HTTP/1.1\r\nX: " + b"y" * 9000, 431),
    "a long path": (b"GET /" + b"a" * 2000 + b" HTTP/1.1\r\nHost: 127.0.0.1\r\n\r\n", 400),
    "a body": (b"GET / HTTP/1.1\r\nHost: 127.0.0.1\r\nContent-Length: 5\r\n\r\nhello", 413),
    "chunks": (b"GET / HTTP/1.1\r\nHost: 127.0.0.1\r\nTransfer-Encoding: chunked\r\n\r\n0\r\n\r\n", 413),
    "to change something": (get(method="POST"), 405),
    "a method of its own": (get(method="BREW"), 405),
    "a way up": (get("/../../etc/passwd"), 404),
    "a way up, escaped": (get("/%2e%2e/%2e%2e/etc/passwd"), 404),
    "a defect of ours": (get("/defect"), 500),
}


@pytest.mark.parametrize("name", GARBAGE)
def test_what_is_not_understood_is_refused(open_page: Running, name: str) -> None:
    sent, expected = GARBAGE[name]
    assert status(ask(open_page, sent)) == expected
    assert status(ask(open_page, get())) == 200, "others are served all the same"


def test_bytes_that_come_one_by_one_are_a_request_too(open_page: Running) -> None:
    with connect(open_page) as sock:
        for byte in get():
            sock.sendall(bytes([byte]))
        assert status(read_all(sock)) == 200


@pytest.mark.parametrize(
    ("headers", "expected"),
    [
        ({"host": "127.0.0.1:8080"}, 200),
        ({"host": "192.168.1.7"}, 200),
        ({"host": "[::1]:8080"}, 200),
        ({"host": "LOCALHOST:9"}, 200),
        ({"host": "drone.local"}, 200),
        ({"host": "evil.example:8080"}, 403),
        ({"host": "127.0.0.1.evil.example"}, 403),
        ({"host": "::1"}, 403),
        ({"host": "2130706433"}, 403),
        ({"host": "127.0.0.1@evil"}, 403),
        ({"host": "127.0.0.1", "origin": "http://127.0.0.1"}, 200),
        ({"host": "127.0.0.1:8080", "origin": "http://127.0.0.1:3000"}, 403),
        ({"host": "127.0.0.1", "origin": "http://evil.example"}, 403),
        ({"host": "127.0.0.1", "origin": "null"}, 403),
        ({"host": "127.0.0.1", "sec-fetch-site": "same-origin"}, 200),
        ({"host": "127.0.0.1", "sec-fetch-site": "cross-site", "sec-fetch-mode": "no-cors"}, 403),
        ({"host": "127.0.0.1", "sec-fetch-site": "same-site", "sec-fetch-mode": "cors"}, 403),
        ({"host": "127.0.0.1", "sec-fetch-site": "cross-site", "sec-fetch-mode": "navigate"}, 200),
    ],
)
def test_other_sites_do_not_read_the_page_through_a_browser(headers: dict[str, str], expected: int) -> None:
    guard = Guard(None, frozenset({"drone.local"}))
    try:
        found = 200 if guard.answer(Request("GET", "/state.json", "", headers)) is None else 401
    except RefusedError as refused:
        found = refused.status
    assert found == expected


# -- the token -----------------------------------------------------------------------------------------


def test_with_a_token_nothing_is_shown_without_it() -> None:
    with serving(listening(TOKEN)) as running:
        for path in ("/", "/large", "/events", "/nowhere", "/?token=", "/?token=0123456789abcdef-~.!"):
            answer = ask(running, get(path))
            assert status(answer) == 401, path
            assert b"hello" not in answer
        first = ask(running, get(f"/?token={TOKEN.decode()}"))
        assert status(first) == 303
        assert b"\r\nLocation: /\r\n" in first
        [cookie] = [line[12:] for line in first.split(b"\r\n") if line.startswith(b"Set-Cookie: ")]
        assert b"HttpOnly" in cookie and b"SameSite=Lax" in cookie
        assert TOKEN not in cookie, "other ports of the host see it, too"
        value = cookie.split(b";")[0].decode()
        assert ask(running, get("/", "127.0.0.1", f"Cookie: a=b; {value}")).endswith(b"hello")
        for wrong in (value[:-1], value + "0", value.replace("=", "=x"), "ortholoc_page=", "ortholoc_page=\xe9"):
            assert status(ask(running, get("/", "127.0.0.1", f"Cookie: {wrong}"))) == 401, wrong
        assert status(ask(running, get("/", "evil.example", f"Cookie: {value}"))) == 403


@pytest.mark.parametrize("address", ["0.0.0.0:8080", "192.168.1.7:80", "[::]:8080"])
def test_beyond_loopback_there_must_be_a_token(address: str, tmp_path: Path) -> None:
    with pytest.raises(ConfigError, match=r"\[page\] listen: .*token_file.*127\.0\.0\.1"):
        checked(PageOptions(enabled=True, listen=address), {})
    secret = tmp_path / "token"
    secret.write_bytes(TOKEN + b"\n")
    secret.chmod(0o600)
    assert checked(PageOptions(enabled=True, listen=address, token_file=str(secret)), {}).token == TOKEN
    secret.chmod(0o644)
    with pytest.raises(ConfigError, match="chmod 600"):
        checked(PageOptions(enabled=True, listen=address, token_file=str(secret)), {})


@pytest.mark.parametrize("content", [b"", b"short", b"with spaces in it, and long", b"0123456789abcdef/"])
def test_a_token_that_is_none_is_refused_and_not_shown(content: bytes, tmp_path: Path) -> None:
    secret = tmp_path / "token"
    secret.write_bytes(content)
    secret.chmod(0o600)
    with pytest.raises(ConfigError, match="16 to 256 letters") as refused:
        checked(PageOptions(token_file=str(secret)), {})
    assert not content or content.decode() not in str(refused.value)


@pytest.mark.parametrize("address", ["", "8080", "localhost:8080", "127.0.0.1", "127.0.0.1:", "127.0.0.1:65536",
                                     "127.0.0.1:-1", "::1:8080", "[127.0.0.1]:80", "127.0.0.1:٣"])  # fmt: skip
def test_listen_that_is_no_address(address: str) -> None:
    with pytest.raises(ConfigError, match=r"\[page\] listen: .* write 127\.0\.0\.1:8080 or \[::1\]:8080"):
        checked(PageOptions(listen=address), {})


def test_loopback_needs_no_token() -> None:
    assert str(checked(PageOptions(), {})) == "http://127.0.0.1:8080"
    assert str(checked(PageOptions(listen="[::1]:9"), {})) == "http://[::1]:9"


@pytest.mark.parametrize("host", ["a b", "evil/", "-", "*", ""])
def test_hosts_are_names(host: str) -> None:
    with pytest.raises(msgspec.ValidationError, match=r"\$\.hosts"):
        msgspec.convert({"hosts": [host]}, PageOptions)


# -- clients that mean no good -------------------------------------------------------------------------


def test_heads_that_never_end_are_given_up(monkeypatch: pytest.MonkeyPatch) -> None:
    """Slowloris: bytes now and then, so that the connection is never idle."""
    monkeypatch.setattr(server_module, "HEAD_TIMEOUT_S", 0.5)
    with serving() as running:
        slow = [connect(running) for _ in range(MAX_PER_ADDRESS - 1)]
        for sock in slow:
            sock.sendall(b"GET / HTTP/1.1\r\n")
        wait_for(lambda: running.server.clients == len(slow), "all connected")
        assert status(ask(running, get())) == 200, "one place was left"

        def trickle() -> bool:
            for sock in slow:
                try:
                    sock.sendall(b"X-a: b\r\n")
                except OSError:
                    continue
            return running.server.clients == 0

        wait_for(trickle, "the server gave them up")
        assert running.server.counts["dropped"] == len(slow)
        for sock in slow:
            sock.close()


def test_one_address_does_not_take_all_places(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(server_module, "HEAD_TIMEOUT_S", 60.0)
    with serving() as running:
        many = [connect(running) for _ in range(MAX_PER_ADDRESS + 6)]
        wait_for(lambda: running.server.counts["refused"] == 6, "six refused")
        assert running.server.clients == MAX_PER_ADDRESS < MAX_CONNECTIONS
        for sock in many:
            sock.close()
        wait_for(lambda: running.server.clients == 0, "all gone")
        assert status(ask(running, get())) == 200


def test_when_all_places_are_taken_the_next_waits(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(server_module, "MAX_CONNECTIONS", 4)
    monkeypatch.setattr(server_module, "HEAD_TIMEOUT_S", 2.0)
    with serving() as running:
        many = [connect(running) for _ in range(4)]
        wait_for(lambda: running.server.clients == 4, "full")
        assert status(ask(running, get())) == 200, "once the idle ones were given up"
        assert running.server.counts["dropped"] >= 1
        for sock in many:
            sock.close()


def test_an_answer_that_is_not_read_is_given_up(monkeypatch: pytest.MonkeyPatch) -> None:
    """Read byte by byte, so that there is always some progress."""
    monkeypatch.setattr(server_module, "ANSWER_TIMEOUT_S", 0.5)
    with serving() as running:
        # The kernel's buffers would take all of the answer.
        monkeypatch.setattr(f"{__name__}.BODY", b"x" * 20_000_000)
        with connect(running) as sock:
            sock.sendall(get("/large"))

            def sip() -> bool:
                sock.recv(1)
                return running.server.clients == 0

            wait_for(sip, "the server gave up")


def test_a_flood_leaves_the_interpreter_to_others(open_page: Running) -> None:
    """However much comes, the server rests between rounds."""
    stop = threading.Event()

    def flood() -> None:
        while not stop.is_set():
            try:
                ask(open_page, get("/nowhere"))
            except OSError:
                continue

    threads = [threading.Thread(target=flood) for _ in range(4)]
    for thread in threads:
        thread.start()
    before, since = open_page.rounds, time.monotonic()
    time.sleep(0.5)
    rounds, spent_s = open_page.rounds - before, time.monotonic() - since
    stop.set()
    for thread in threads:
        thread.join()
    assert 0 < rounds <= spent_s / server_module._REST_S


def test_clients_that_came_and_went_leave_nothing_open() -> None:
    with serving() as running:
        taken: list[socket.socket] = []
        accept = running.server._take

        def noted() -> None:
            accept()
            taken.extend(sock for sock in running.server._clients if sock not in taken)

        running.server._take = noted  # type: ignore[method-assign]
        for sent in (get(), get("/nowhere"), b"garbage\r\n\r\n", get("/events"), b"GET"):
            for _ in range(8):
                with connect(running) as sock:
                    sock.sendall(sent)
        wait_for(lambda: running.server.clients == 0, "all gone")
        assert len(taken) >= 20 and all(sock.fileno() < 0 for sock in taken)
        assert len(running.server._selector.get_map()) == 1, "the listener alone"


# -- events --------------------------------------------------------------------------------------------


def test_events_come_until_the_client_goes() -> None:
    with serving() as running:
        with connect(running) as sock:
            sock.sendall(get("/events"))
            text = b""
            while text.count(b"data: ") < 5:
                text += sock.recv(4096)
            assert b"text/event-stream" in text and text.count(b"\r\n\r\n") == 1
            assert b"data: -1-" in text, "the first has everything"
        wait_for(lambda: running.server.clients == 0, "the server noticed")


def test_who_does_not_read_misses_events_and_holds_up_nobody(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(server_module, "STALL_TIMEOUT_S", 1.5)
    with serving(event_bytes=100_000) as running, connect(running) as stalled, connect(running) as other:
        stalled.sendall(get("/events"))
        other.sendall(get("/events"))
        counted = [0]

        def read() -> int:
            counted[0] += len(other.recv(1 << 20))
            return running.server.counts["missed"]

        wait_for(read, "the stalled one missed something")
        before, rounds = counted[0], running.rounds
        wait_for(lambda: read() and counted[0] > before + 1_000_000, "the other goes on")
        assert running.rounds > rounds
        waiting = [client for client in running.server._clients.values() if client.out]
        assert all(len(client.out) < 200_000 for client in waiting), "nothing queues"
        wait_for(lambda: read() and running.server.viewers == 1, "the stalled one was given up")


def test_pages_beyond_the_limit_are_refused() -> None:
    with serving() as running:
        viewers = [connect(running) for _ in range(MAX_STREAMS)]
        for sock in viewers:
            sock.sendall(get("/events"))
        wait_for(lambda: running.server.viewers == MAX_STREAMS, "all view")
        assert status(ask(running, get("/events"))) == 503
        for sock in viewers:
            sock.close()
        wait_for(lambda: running.server.viewers == 0, "all gone")


def test_parsed_headers_are_by_lower_case_name() -> None:
    request = parse_request(b"GET /a?b=c HTTP/1.1\r\nHOST:  h \r\nX-Y: 1")
    assert (request.path, request.query, request.headers) == ("/a", "b=c", {"host": "h", "x-y": "1"})
