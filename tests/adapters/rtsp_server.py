"""A network camera: RTSP (RFC 2326) with JPEG over RTP (RFC 2435), interleaved in its one TCP connection."""

from __future__ import annotations

import base64
import contextlib
import re
import socket
import socketserver
import struct
import threading
import time
from collections.abc import Callable

import cv2
import numpy as np

_PAYLOAD_BYTES = 1400
_CLOCK_HZ = 90_000


class RtspCamera:
    """Serves ``picture(number)`` (H, W, 3) BGR, sides multiples of 8, on 127.0.0.1.

    Attributes:
        port: chosen by the system unless given.
        sent: frames so far, to all.
        silent: while set no frame is sent, and connections stay.
        held: while set frames are taken but kept, and then sent all at once, as TCP does after a stall.
        taken_ns: when each picture was, monotonic clock.
        refused: how many requests came without the right name and password.
    """

    def __init__(
        self,
        picture: Callable[[int], np.ndarray],
        port: int = 0,
        rate_hz: float = 25.0,
        login: tuple[str, str] | None = None,
    ) -> None:
        camera = self

        class Handler(socketserver.StreamRequestHandler):
            def handle(self) -> None:
                with contextlib.suppress(OSError):
                    camera._talk(self.rfile, self.connection)

        class Server(socketserver.ThreadingTCPServer):
            allow_reuse_address = True
            daemon_threads = True

        self._picture, self._period_s, self._login = picture, 1.0 / rate_hz, login
        self._stop = threading.Event()
        self._connections: set[socket.socket] = set()
        self.silent = threading.Event()
        self.held = threading.Event()
        self.taken_ns: list[int] = []
        self.sent = 0
        self.refused = 0
        self._server = Server(("127.0.0.1", port), Handler)
        self.port: int = self._server.server_address[1]
        self._thread = threading.Thread(target=self._server.serve_forever, kwargs={"poll_interval": 0.02})
        self._thread.start()

    def close(self) -> None:
        """Gone, as if its plug were pulled."""
        self._stop.set()
        for connection in list(self._connections):
            with contextlib.suppress(OSError):
                connection.shutdown(socket.SHUT_RDWR)
        self._server.shutdown()
        self._server.server_close()
        self._thread.join()

    def _talk(self, lines: object, connection: socket.socket) -> None:
        self._connections.add(connection)
        sender = None
        lock = threading.Lock()
        try:
            while not self._stop.is_set():
                request, headers = _read_request(lines)
                if not request:
                    return
                method, _, address = request.partition(" ")
                status, more, body = self._answer(method, address.split(" ")[0], headers)
                answer = f"RTSP/1.0 {status}\r\nCSeq: {headers.get('cseq', '0')}\r\n{more}"
                if body:
                    answer += f"Content-Type: application/sdp\r\nContent-Length: {len(body)}\r\n"
                with lock:
                    connection.sendall(f"{answer}\r\n{body}".encode())
                if method == "PLAY" and sender is None:
                    sender = threading.Thread(target=self._send, args=(connection, lock), daemon=True)
                    sender.start()
                if method == "TEARDOWN":
                    return
        finally:
            self._connections.discard(connection)
            with contextlib.suppress(OSError):
                connection.shutdown(socket.SHUT_RDWR)

    def _answer(self, method: str, address: str, headers: dict[str, str]) -> tuple[str, str, str]:
        if method == "OPTIONS":
            return "200 OK", "Public: OPTIONS, DESCRIBE, SETUP, PLAY, TEARDOWN, GET_PARAMETER\r\n", ""
        if self._login is not None:
            right = base64.b64encode(":".join(self._login).encode()).decode()
            if headers.get("authorization") != f"Basic {right}":
                self.refused += 1
                return "401 Unauthorized", 'WWW-Authenticate: Basic realm="camera"\r\n', ""
        if method == "DESCRIBE":
            body = (
                "v=0\r\no=- 0 0 IN IP4 127.0.0.1\r\ns=camera\r\nc=IN IP4 0.0.0.0\r\nt=0 0\r\n"
                "m=video 0 RTP/AVP 26\r\na=control:track1\r\n"
            )
            return "200 OK", f"Content-Base: {address}/\r\n", body
        if method == "SETUP":
            if "RTP/AVP/TCP" not in headers.get("transport", ""):
                return "461 Unsupported Transport", "", ""
            return "200 OK", "Transport: RTP/AVP/TCP;unicast;interleaved=0-1\r\nSession: 1;timeout=60\r\n", ""
        return "200 OK", "Session: 1\r\n", ""

    def _send(self, connection: socket.socket, lock: threading.Lock) -> None:
        sequence = 0
        number = 0
        kept: list[bytes] = []
        with contextlib.suppress(OSError):
            while not self._stop.wait(self._period_s):
                number += 1
                if self.silent.is_set():
                    continue
                self.taken_ns.append(time.monotonic_ns())
                packets = rtp_packets(
                    self._picture(self.sent), sequence, round(number * self._period_s * _CLOCK_HZ)
                )
                sequence += len(packets)
                kept += [struct.pack(">cBH", b"$", 0, len(packet)) + packet for packet in packets]
                self.sent += 1
                if not self.held.is_set():
                    with lock:
                        connection.sendall(b"".join(kept))
                    kept.clear()


def _read_request(lines: object) -> tuple[str, dict[str, str]]:
    """Its first line and its headers; RTCP, which comes in between, is passed over."""
    while (first := lines.read(1)) == b"$":  # type: ignore[attr-defined]
        (length,) = struct.unpack(">xH", lines.read(3))  # type: ignore[attr-defined]
        lines.read(length)  # type: ignore[attr-defined]
    request = (first + lines.readline()).decode().strip()  # type: ignore[attr-defined]
    headers: dict[str, str] = {}
    while line := lines.readline().decode().strip():  # type: ignore[attr-defined]
        name, _, value = line.partition(":")
        headers[name.strip().lower()] = value.strip()
    return request, headers


def rtp_packets(picture: np.ndarray, sequence: int, stamp: int) -> list[bytes]:
    """A picture as RTP packets: the JPEG without its headers, which the receiver makes anew."""
    ok, encoded = cv2.imencode(".jpg", picture, [cv2.IMWRITE_JPEG_QUALITY, 85])
    assert ok
    jpeg = encoded.tobytes()
    tables = b"".join(
        found[5 : 5 + 64] for found in (jpeg[m.start() :] for m in re.finditer(rb"\xff\xdb\x00\x43[\x00\x01]", jpeg))
    )
    scan = jpeg.index(b"\xff\xda")
    data = jpeg[scan + 2 + int.from_bytes(jpeg[scan + 2 : scan + 4], "big") : -2]
    height, width = picture.shape[:2]
    packets = []
    for at in range(0, len(data), _PAYLOAD_BYTES):
        part = data[at : at + _PAYLOAD_BYTES]
        last = at + len(part) == len(data)
        header = struct.pack(">BBHII", 0x80, 26 | last << 7, (sequence + len(packets)) % 65536, stamp % 2**32, 7)
        # Type 1 is 4:2:0; 255 says that the tables follow.
        header += struct.pack(">I", at) + bytes([1, 255, width // 8, height // 8])
        if at == 0:
            header += struct.pack(">BBH", 0, 0, len(tables)) + tables
        packets.append(header + part)
    return packets
