"""What a browser on the ground page costs the daemon, without a browser."""

from __future__ import annotations

import contextlib
import socket
import urllib.request
from multiprocessing.synchronize import Event


def watch(port: int, stop: Event) -> None:
    """A browser: the page, its tiles, the events, and each picture that they tell of."""
    address = f"http://127.0.0.1:{port}"

    def fetch(path: str) -> bytes:
        with urllib.request.urlopen(address + path, timeout=20.0) as answer:
            return bytes(answer.read())

    for path in ("/", "/page.css", "/map.js", "/page.js", *(f"/tiles/0/{k % 4}/{k // 4}.jpg" for k in range(12))):
        # Attackers share its address, and so its share of the places.
        with contextlib.suppress(OSError):
            fetch(path)
    with contextlib.suppress(OSError), socket.create_connection(("127.0.0.1", port)) as sock:
        sock.settimeout(0.5)
        sock.sendall(b"GET /events HTTP/1.1\r\nHost: 127.0.0.1\r\n\r\n")
        while not stop.is_set():
            try:
                data = sock.recv(65536)
            except TimeoutError:
                continue
            if not data:
                return
            if (at := data.find(b'"picture":{"n":')) >= 0:
                number = data[at + 15 :].split(b",", 1)[0]
                try:
                    fetch(f"/frame/{int(number)}.jpg")
                except (OSError, ValueError):
                    continue
