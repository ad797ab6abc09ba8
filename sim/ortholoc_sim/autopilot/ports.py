"""How the autopilot's messages travel: UDP, TCP or a pseudo-terminal, each with an optional line that is slow and bad.

All ports have one contract, `Port`. They never block; the owner waits with select on `fileno` for no longer than until
`next_ns`, and calls `receive` when something is there or that time has come.
"""

from __future__ import annotations

import contextlib
import os
import socket
import tty
from typing import Protocol

import numpy as np

from ortholoc_edge.clock import Clock, SystemClock
from ortholoc_sim.autopilot.dialect import Message, dialect
from ortholoc_sim.line import LineOptions, Wire

_READ_BYTES = 65536
_PIECE_BYTES = 256


class Port(Protocol):
    """See the module."""

    bad_data: int

    @property
    def endpoint(self) -> str:
        """Where a companion finds it, as ``[link] endpoint`` takes it."""
        ...

    def fileno(self) -> int:
        """For select; may change from call to call."""
        ...

    def receive(self) -> list[Message]:
        """What arrived since the last call. Also carries on what is under way."""
        ...

    def send(self, messages: list[Message]) -> None:
        """Messages that nobody takes are lost, as on a real line."""
        ...

    def next_ns(self) -> int | None:
        """When `receive` should be called though nothing is to be read, by the port's clock."""
        ...

    def close(self) -> None: ...


class _Bytes(Protocol):
    def fileno(self) -> int: ...

    def read(self) -> list[bytes]: ...

    def write(self, data: bytes) -> None: ...

    def close(self) -> None: ...


class _MavlinkPort:
    """MAVLink 2 over any bytes."""

    def __init__(
        self, device: _Bytes, endpoint: str, system_id: int, line: LineOptions | None, clock: Clock | None, seed: int
    ) -> None:
        self._device, self._endpoint = device, endpoint
        self._mav = dialect.MAVLink(None, system_id, dialect.MAV_COMP_ID_AUTOPILOT1)
        self._mav.robust_parsing = True
        self._clock = clock or SystemClock()
        self._in = None if line is None else Wire(line, np.random.default_rng([seed, 63, 0]))
        self._out = None if line is None else Wire(line, np.random.default_rng([seed, 63, 1]))
        self.bad_data = 0

    @property
    def endpoint(self) -> str:
        return self._endpoint

    def fileno(self) -> int:
        return self._device.fileno()

    def receive(self) -> list[Message]:
        chunks = self._device.read()
        if self._in is not None and self._out is not None:
            now_ns = self._clock.now_ns()
            for chunk in chunks:
                # What was read at once was written bit by bit.
                for start in range(0, len(chunk), _PIECE_BYTES):
                    self._in.send(chunk[start : start + _PIECE_BYTES], now_ns)
            chunks = self._in.arrived(now_ns)
            for chunk in self._out.arrived(now_ns):
                self._device.write(chunk)
        messages: list[Message] = []
        for chunk in chunks:
            for message in self._mav.parse_buffer(chunk) or []:
                if message.get_type() == "BAD_DATA":
                    self.bad_data += 1
                else:
                    messages.append(message)
        return messages

    def send(self, messages: list[Message]) -> None:
        for message in messages:
            data = bytes(message.pack(self._mav))
            self._mav.seq = (self._mav.seq + 1) % 256
            if self._out is None:
                self._device.write(data)
            else:
                self._out.send(data, self._clock.now_ns())

    def next_ns(self) -> int | None:
        due = [line.next_ns() for line in (self._in, self._out) if line is not None]
        return min((at for at in due if at is not None), default=None)

    def close(self) -> None:
        self._device.close()


class _Udp:
    def __init__(self, address: tuple[str, int], peer: tuple[str, int] | None) -> None:
        self._socket = socket.socket(socket.AF_INET, socket.SOCK_DGRAM)
        self._socket.bind(address)
        self._socket.setblocking(False)
        self._fixed, self._peer = peer is not None, peer

    @property
    def port(self) -> int:
        return int(self._socket.getsockname()[1])

    def fileno(self) -> int:
        return self._socket.fileno()

    def read(self) -> list[bytes]:
        chunks: list[bytes] = []
        while True:
            try:
                data, peer = self._socket.recvfrom(2048)
            except (BlockingIOError, ConnectionRefusedError):
                return chunks
            if not self._fixed:
                self._peer = peer
            chunks.append(data)

    def write(self, data: bytes) -> None:
        if self._peer is not None:
            with contextlib.suppress(ConnectionRefusedError, BlockingIOError):
                self._socket.sendto(data, self._peer)

    def close(self) -> None:
        self._socket.close()


class _TcpServer:
    """One companion at a time; the next may come when it has gone."""

    def __init__(self, address: tuple[str, int]) -> None:
        self._server = socket.create_server(address)
        self._server.setblocking(False)
        self._connection: socket.socket | None = None

    @property
    def port(self) -> int:
        return int(self._server.getsockname()[1])

    def fileno(self) -> int:
        return (self._connection or self._server).fileno()

    def read(self) -> list[bytes]:
        if self._connection is None:
            try:
                self._connection, _ = self._server.accept()
            except BlockingIOError:
                return []
            self._connection.setblocking(False)
            self._connection.setsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY, 1)
        try:
            data = self._connection.recv(_READ_BYTES)
        except BlockingIOError:
            return []
        except OSError:
            data = b""
        if not data:
            self._hang_up()
        return [data] if data else []

    def write(self, data: bytes) -> None:
        if self._connection is not None:
            try:
                sent = self._connection.send(data)
            except BlockingIOError:
                return
            except OSError:
                self._hang_up()
                return
            if sent < len(data):
                self._hang_up()  # half of a frame went out: what follows could not be told from it

    def _hang_up(self) -> None:
        if self._connection is not None:
            self._connection.close()
            self._connection = None

    def close(self) -> None:
        self._hang_up()
        self._server.close()


class _Pty:
    """The master's end; the slave is held open, so that a companion may come and go."""

    def __init__(self) -> None:
        self._master, self._slave = os.openpty()
        tty.setraw(self._slave)
        os.set_blocking(self._master, False)
        self.path = os.ttyname(self._slave)

    def fileno(self) -> int:
        return self._master

    def read(self) -> list[bytes]:
        try:
            data = os.read(self._master, _READ_BYTES)
        except BlockingIOError:
            return []
        return [data] if data else []

    def write(self, data: bytes) -> None:
        # Nobody reads: the kernel's buffer is full, and the frame is lost.
        with contextlib.suppress(BlockingIOError):
            os.write(self._master, data)

    def close(self) -> None:
        os.close(self._master)
        os.close(self._slave)


class UdpPort(_MavlinkPort):
    """A UDP socket, by default on loopback. Sends to ``peer``, or to whoever spoke last if none is given."""

    def __init__(
        self,
        system_id: int = 1,
        address: tuple[str, int] = ("127.0.0.1", 0),
        peer: tuple[str, int] | None = None,
        line: LineOptions | None = None,
        clock: Clock | None = None,
        seed: int = 0,
    ) -> None:
        """Raises: OSError if the address can't be had."""
        device = _Udp(address, peer)
        self.port = device.port
        endpoint = f"udpout:{address[0]}:{device.port}" if peer is None else f"udp:{peer[0]}:{peer[1]}"
        super().__init__(device, endpoint, system_id, line, clock, seed)


class TcpPort(_MavlinkPort):
    """A TCP server, as a simulator in the loop has one; one connection at a time."""

    def __init__(
        self,
        system_id: int = 1,
        address: tuple[str, int] = ("127.0.0.1", 0),
        line: LineOptions | None = None,
        clock: Clock | None = None,
        seed: int = 0,
    ) -> None:
        """Raises: OSError if the address can't be had."""
        device = _TcpServer(address)
        self.port = device.port
        super().__init__(device, f"tcp:{address[0]}:{device.port}", system_id, line, clock, seed)


class PtyPort(_MavlinkPort):
    """A pseudo-terminal, to be opened as a serial device at ``path``."""

    def __init__(
        self, system_id: int = 1, line: LineOptions | None = None, clock: Clock | None = None, seed: int = 0
    ) -> None:
        device = _Pty()
        self.path = device.path
        baud = line.baud if line is not None and line.baud > 0 else 921_600
        super().__init__(device, f"serial:{device.path}:{baud}", system_id, line, clock, seed)
