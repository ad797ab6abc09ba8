"""What stands between a companion and several vehicles and ground stations: forwards as mavlink-router does.

A frame goes to every endpoint but those that its sender was heard on; if it names a target, only to those on which
that target was heard. So nobody who has not spoken is spoken to, and frames pass unchanged.
"""

from __future__ import annotations

import contextlib
import select
import socket
import threading
from collections import Counter
from typing import Any

from pymavlink.dialects.v20 import ardupilotmega as dialect

from ortholoc_edge.adapters.mavlink.codec import FrameParser


class _Endpoint:
    """A UDP port; whoever sends there is answered there."""

    def __init__(self) -> None:
        self.socket = socket.socket(socket.AF_INET, socket.SOCK_DGRAM)
        self.socket.bind(("127.0.0.1", 0))
        self.port = self.socket.getsockname()[1]
        self.remote: Any = None
        self.heard: set[tuple[int, int]] = set()
        self.parser = FrameParser()

    def fileno(self):
        return self.socket.fileno()

    def wants(self, message) -> bool:
        if (message.get_srcSystem(), message.get_srcComponent()) in self.heard or self.remote is None:
            return False
        system = getattr(message, "target_system", 0)
        component = getattr(message, "target_component", 0)
        if system == 0:
            return True
        if component == 0:
            return any(known == system for known, _ in self.heard)
        return (system, component) in self.heard


class Router:
    """Runs in a thread until `close`; `forwarded` counts (system, component, message) that passed."""

    def __init__(self, endpoints: int) -> None:
        self._endpoints = [_Endpoint() for _ in range(endpoints)]
        self.ports = [one.port for one in self._endpoints]
        self.forwarded: Counter[tuple[int, int, str]] = Counter()
        self.timesync: list[tuple[tuple[int, int], Any]] = []
        self._stop = threading.Event()
        self._thread = threading.Thread(target=self._run, name="router")
        self._thread.start()

    def close(self) -> None:
        self._stop.set()
        self._thread.join()
        for one in self._endpoints:
            one.socket.close()

    def _run(self) -> None:
        while not self._stop.is_set():
            for one in select.select(self._endpoints, [], [], 0.05)[0]:
                with contextlib.suppress(ConnectionRefusedError):
                    data, one.remote = one.socket.recvfrom(65535)
                    for message in one.parser.feed(data, 0):
                        self._forward(one, message)

    def _forward(self, source: _Endpoint, message) -> None:
        sender = message.get_srcSystem(), message.get_srcComponent()
        source.heard.add(sender)
        self.forwarded[(*sender, message.get_type())] += 1
        if message.get_type() == "TIMESYNC":
            self.timesync.append((sender, message))
        for other in self._endpoints:
            if other is not source and other.wants(message):
                other.socket.sendto(bytes(message.get_msgbuf()), other.remote)


class GroundStation:
    """Beats once per `beat` and keeps what it hears."""

    def __init__(self, port: int, system: int) -> None:
        self._socket = socket.socket(socket.AF_INET, socket.SOCK_DGRAM)
        self._socket.connect(("127.0.0.1", port))
        self._socket.setblocking(False)
        self._mav = dialect.MAVLink(None, system, 190)
        self._parser = FrameParser()
        self.heard: list[Any] = []

    def send(self, message) -> None:
        self._socket.send(bytes(message.pack(self._mav)))

    def beat(self) -> None:
        self.send(dialect.MAVLink_heartbeat_message(6, 8, 0, 0, 4, 3))
        with contextlib.suppress(BlockingIOError):
            while True:
                self.heard += self._parser.feed(self._socket.recv(65535), 0)

    def of(self, system: int, component: int) -> set[str]:
        """Names of the messages heard from there."""
        return {
            m.get_type() for m in self.heard if (m.get_srcSystem(), m.get_srcComponent()) == (system, component)
        }

    def close(self) -> None:
        self._socket.close()
