"""Sockets of the page, in one thread: bounded in clients, bytes and time, so that the worst a client can do is to see
nothing.

Each connection asks once. Those that ask for the events get what is new whenever all of the last was taken: who reads
slowly misses events, and nothing queues for it.
"""

from __future__ import annotations

import contextlib
import logging
import selectors
import socket
import time
from collections import Counter
from collections.abc import Callable
from dataclasses import dataclass, field, replace

from ortholoc_edge.adapters.page.http import (
    MAX_HEAD_BYTES,
    Guard,
    RefusedError,
    Request,
    parse_request,
    response,
    stream_head,
)
from ortholoc_edge.adapters.page.options import Listen

logger = logging.getLogger(__name__)

MAX_CONNECTIONS, MAX_PER_ADDRESS, MAX_STREAMS = 32, 16, 8
# For the request; for the whole answer, also where it is read byte by byte; and for events, without any progress.
HEAD_TIMEOUT_S, ANSWER_TIMEOUT_S, STALL_TIMEOUT_S = 5.0, 30.0, 10.0
# In one round, so that a flood leaves the interpreter to others: rounds are this far apart at least.
_ACCEPTS, _READ_BYTES, _SEND_BYTES = 4, 4096, 65536
_REST_S = 0.005
# Of the kernel's, per client: more would hold events that are long past.
_SEND_BUFFER_BYTES = 131_072
# What a client that has gone away still sends is read for so long, or the answer would be lost with a reset.
_LINGER_S = 1.0

# An answer that is not there yet: None until it is.
Later = Callable[[], "bytes | None"]
# What a request gets; None for who asked for the events.
Answer = Callable[[Request], "bytes | Later | None"]


@dataclass(slots=True, eq=False)
class _Client:
    """A connection.

    Attributes:
        head: of the request, as far as it came. out: what is still to be sent.
        until_s: when it is given up, on `time.monotonic`.
        streams: whether it gets events; seen: the last outcome that it was sent, and picture.
        later: gives the answer, where it is not there yet.
        answered: whether the answer is in ``out`` or sent, or comes later; done: whether it was sent.
    """

    sock: socket.socket
    address: str
    until_s: float
    head: bytearray = field(default_factory=bytearray)
    out: memoryview = field(default_factory=lambda: memoryview(b""))
    streams: bool = False
    later: Later | None = None
    answered: bool = False
    done: bool = False
    seen: int = -1
    watched: int = selectors.EVENT_READ


class PageServer:
    """Used by one thread. `step` does what there is to do, `tell` sends events.

    Attributes:
        counts: ``requests``, ``refused``, ``dropped`` clients, ``missed`` events.
    """

    def __init__(self, listen: Listen, answer: Answer, posts: frozenset[str] = frozenset()) -> None:
        """
        Args:
            posts: paths that take a body.
            answer: to a request that the guard let through; None where the events are asked for.
        Raises: OSError if the address can't be had.
        """
        self._answer, self._guard, self._posts = answer, Guard(listen.token, listen.hosts), posts
        self.counts: Counter[str] = Counter()
        self._clients: dict[socket.socket, _Client] = {}
        family = socket.AF_INET6 if listen.is_ipv6 else socket.AF_INET
        self._listener = socket.create_server((listen.address, listen.port), family=family, backlog=16)
        self._listener.setblocking(False)
        self._selector = selectors.DefaultSelector()
        self._selector.register(self._listener, selectors.EVENT_READ)
        self._accepts = True

    @property
    def port(self) -> int:
        return int(self._listener.getsockname()[1])

    @property
    def viewers(self) -> int:
        """How many get events."""
        return sum(client.streams for client in self._clients.values())

    @property
    def newcomers(self) -> bool:
        """Whether one of them got none yet."""
        return any(client.streams and client.seen < 0 and not client.out for client in self._clients.values())

    @property
    def clients(self) -> int:
        return len(self._clients)

    def close(self) -> None:
        for client in list(self._clients.values()):
            self._drop(client)
        self._selector.close()
        self._listener.close()

    def step(self, wait_s: float) -> None:
        """Wait for something to do, do it, and give up whoever is late."""
        ready = self._selector.select(wait_s)
        for key, _ in ready:
            if key.fileobj is self._listener:
                self._take()
            else:
                self._serve(key.data)
        self._finish_later()
        now_s = time.monotonic()
        for client in [one for one in self._clients.values() if one.until_s < now_s]:
            self.counts["dropped"] += not client.done
            self._drop(client)
        # Many clients are served no oftener than one.
        self._listens(len(self._clients) < MAX_CONNECTIONS)
        if ready:
            time.sleep(_REST_S)

    def tell(self, event: Callable[[int], tuple[int, bytes]]) -> None:
        """Send an event to whoever took all of the last.

        Args:
            event: of what is newer than a number: the newest number, and the event's text.
        """
        made: dict[int, tuple[int, bytes]] = {}
        for client in list(self._clients.values()):
            if not client.streams:
                continue
            if client.out:
                self.counts["missed"] += 1
                continue
            if client.seen not in made:
                made[client.seen] = event(client.seen)
            client.seen, text = made[client.seen]
            client.out = memoryview(text)
            client.until_s = time.monotonic() + STALL_TIMEOUT_S
            self._guarded(client, self._send)

    # -- one connection --------------------------------------------------------------------------------

    def _take(self) -> None:
        for _ in range(_ACCEPTS):
            try:
                sock, address = self._listener.accept()
            except OSError:  # none is left, it went away meanwhile, or there are no more descriptors
                return
            sock.setblocking(False)
            with contextlib.suppress(OSError):
                sock.setsockopt(socket.SOL_SOCKET, socket.SO_SNDBUF, _SEND_BUFFER_BYTES)
                sock.setsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY, 1)
            host = str(address[0])
            if sum(client.address == host for client in self._clients.values()) >= MAX_PER_ADDRESS:
                self.counts["refused"] += 1
                sock.close()
                continue
            client = _Client(sock, host, time.monotonic() + HEAD_TIMEOUT_S)
            self._clients[sock] = client
            self._selector.register(sock, selectors.EVENT_READ, client)
            if len(self._clients) >= MAX_CONNECTIONS:
                return

    def _listens(self, wanted: bool) -> None:
        if wanted == self._accepts:
            return
        self._accepts = wanted
        if wanted:
            self._selector.register(self._listener, selectors.EVENT_READ)
        else:
            # The rest waits in the kernel's backlog.
            self._selector.unregister(self._listener)

    def _serve(self, client: _Client) -> None:
        self._guarded(client, self._read)
        if client.out and client.sock in self._clients:
            self._guarded(client, self._send)

    def _guarded(self, client: _Client, act: Callable[[_Client], None]) -> None:
        try:
            act(client)
        except BlockingIOError:
            pass
        except OSError:
            self._drop(client)

    def _read(self, client: _Client) -> None:
        try:
            data = client.sock.recv(_READ_BYTES)
        except BlockingIOError:
            return
        if not data:
            # Half closed by a client that waits for its answer, or gone; sending tells.
            if client.done or not client.answered or client.streams or client.later is not None:
                self._drop(client)
            else:
                self._watch(client, selectors.EVENT_WRITE)
            return
        if client.answered:
            return
        client.head += data
        end = client.head.find(b"\r\n\r\n")
        if end < 0 and len(client.head) <= MAX_HEAD_BYTES:
            return
        if 0 <= end <= MAX_HEAD_BYTES and len(client.head) < end + 4 + self._body_bytes(client, end):
            return
        client.answered = True
        client.until_s = time.monotonic() + ANSWER_TIMEOUT_S
        client.out = memoryview(self._answered(client, end))
        client.head.clear()

    def _body_bytes(self, client: _Client, end: int) -> int:
        """How much is still to come after the head, of what will be looked at."""
        try:
            request = parse_request(bytes(client.head[:end]), self._posts)
            return request.body_bytes if self._guard.answer(request) is None else 0
        except RefusedError:
            return 0

    def _finish_later(self) -> None:
        """Send what has become of commands."""
        for client in list(self._clients.values()):
            if client.later is None:
                continue
            answer = client.later()
            if answer is not None:
                client.later, client.out = None, memoryview(answer)
                self._guarded(client, self._send)

    def _answered(self, client: _Client, end: int) -> bytes:
        self.counts["requests"] += 1
        try:
            if not 0 <= end <= MAX_HEAD_BYTES:
                raise RefusedError(431, f"more than {MAX_HEAD_BYTES} bytes before the empty line")
            request = parse_request(bytes(client.head[:end]), self._posts)
            if request.body_bytes:
                body = bytes(client.head[end + 4 : end + 4 + request.body_bytes])
                request = replace(request, body=body)
            barred = self._guard.answer(request)
            if barred is not None:
                self.counts["refused"] += barred.startswith(b"HTTP/1.1 4")
                return barred
            answer = self._answer(request)
            if callable(answer):
                client.later = answer
                return b""
            if answer is not None:
                return answer
            if self.viewers >= MAX_STREAMS:
                raise RefusedError(503, f"{MAX_STREAMS} pages are open already; close one")
        except RefusedError as refused:
            self.counts["refused"] += 1
            return response(refused.status, f"{refused.why}\n".encode())
        except Exception:  # one request that we fail at must end neither the thread nor the others
            self.counts["errors"] += 1
            if self.counts["errors"] == 1:
                logger.exception("ground page")
            return response(500, b"a defect of the page; the log has it\n")
        client.streams = True
        return stream_head()

    def _send(self, client: _Client) -> None:
        sent = client.sock.send(client.out[:_SEND_BYTES])
        client.out = client.out[sent:]
        if sent and client.streams:
            client.until_s = time.monotonic() + STALL_TIMEOUT_S
        if client.out:
            self._watch(client, selectors.EVENT_READ | selectors.EVENT_WRITE)
            return
        self._watch(client, selectors.EVENT_READ)
        if not client.streams:
            client.done, client.until_s = True, time.monotonic() + _LINGER_S
            client.sock.shutdown(socket.SHUT_WR)

    def _watch(self, client: _Client, events: int) -> None:
        if client.watched != events:
            client.watched = events
            self._selector.modify(client.sock, events, client)

    def _drop(self, client: _Client) -> None:
        if self._clients.pop(client.sock, None) is not None:
            self._selector.unregister(client.sock)
            client.sock.close()
