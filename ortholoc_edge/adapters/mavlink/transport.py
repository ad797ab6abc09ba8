"""Non-blocking bytes: UDP, TCP and serial lines."""

from __future__ import annotations

import contextlib
import os
import socket
from typing import Any, Protocol

import serial

from ortholoc_edge.adapters.mavlink.options import Endpoint

# What may wait in a serial line's or TCP socket's buffer: 0.35 s at 57600 baud. Beyond it, messages are dropped.
_OUT_LIMIT_BYTES = 2048


# What is taken in before something is said again: some 35 ms of work if all of it is hostile. A line of 3 Mbaud brings
# as much in 14 ms.
IN_LIMIT_BYTES = 4096
_IN_LIMIT_DATAGRAMS = 64


class Transport(Protocol):
    """Non-blocking bytes. Every method may raise OSError, after which the transport is closed and opened
    anew.

    Attributes:
        cut_datagrams: how many were longer than what is taken in at a time, and lost their end.
    """

    cut_datagrams: int

    def fileno(self) -> int: ...

    def receive(self) -> list[tuple[bytes, Any]]:
        """What has arrived, with whom it came from."""
        ...

    def send(self, frame: bytes) -> bool:
        """Send or queue a whole frame; False if there is no room or nobody to send to."""
        ...

    def pending(self) -> bool:
        """Whether a part of a frame waits to be written."""
        ...

    def flush(self) -> None: ...

    def prefer(self, peer: Any) -> None:
        """Send to this peer from now on."""
        ...

    def close(self) -> None: ...


class _Udp:
    def __init__(self, endpoint: Endpoint) -> None:
        self._listen = endpoint.kind == "udp"
        host = endpoint.address.strip("[]")
        family, _, _, _, address = socket.getaddrinfo(host, endpoint.port, type=socket.SOCK_DGRAM)[0]
        self._socket = socket.socket(family, socket.SOCK_DGRAM)
        self._peer: Any = None
        self.cut_datagrams = 0
        try:
            self._socket.setblocking(False)
            if self._listen:
                self._socket.bind(address)
            else:
                self._socket.connect(address)
        except OSError:
            self._socket.close()
            raise

    def fileno(self) -> int:
        return self._socket.fileno()

    def receive(self) -> list[tuple[bytes, Any]]:
        got: list[tuple[bytes, Any]] = []
        size = 0
        # Bounded, so that a flood leaves time to speak; the rest waits in the socket, and select tells of it at once.
        while size < IN_LIMIT_BYTES and len(got) < _IN_LIMIT_DATAGRAMS:
            try:
                data, peer = self._socket.recvfrom(65535)
                # A datagram holds a frame or a few. One longer than any router makes is cut, so that what waits behind
                # it is heard the sooner.
                got.append((data[:IN_LIMIT_BYTES], peer))
                self.cut_datagrams += len(data) > IN_LIMIT_BYTES
                size += len(data)
            except (BlockingIOError, InterruptedError):
                break
            except ConnectionRefusedError:
                continue  # an answer to an earlier datagram: nobody listens there yet
        return got

    def send(self, frame: bytes) -> bool:
        try:
            if not self._listen:
                self._socket.send(frame)
            elif self._peer is None:
                return False
            else:
                self._socket.sendto(frame, self._peer)
        except (BlockingIOError, ConnectionRefusedError):
            return False
        return True

    def pending(self) -> bool:
        return False

    def flush(self) -> None:
        pass

    def prefer(self, peer: Any) -> None:
        self._peer = peer

    def close(self) -> None:
        self._socket.close()


class _Device(Protocol):
    """A socket or a serial port."""

    def fileno(self) -> int: ...

    def close(self) -> None: ...


class _ByteStream:
    """TCP and serial: read and written by file descriptor, with one bounded buffer for what did not go
    out."""

    def __init__(self, device: _Device, name: str) -> None:
        self._device, self._name = device, name
        self._out = bytearray()
        self.cut_datagrams = 0

    def fileno(self) -> int:
        return self._device.fileno()

    def receive(self) -> list[tuple[bytes, Any]]:
        try:
            data = os.read(self._device.fileno(), IN_LIMIT_BYTES)
        except (BlockingIOError, InterruptedError):
            return []
        if not data:
            # Readable without data: the peer closed, or the adapter was pulled out.
            raise ConnectionError(f"{self._name} was closed by the other side")
        return [(data, None)]

    def send(self, frame: bytes) -> bool:
        if len(self._out) + len(frame) > _OUT_LIMIT_BYTES:
            return False
        self._out += frame
        self.flush()
        return True

    def pending(self) -> bool:
        return bool(self._out)

    def flush(self) -> None:
        with contextlib.suppress(BlockingIOError, InterruptedError):
            while self._out:
                del self._out[: os.write(self._device.fileno(), self._out)]

    def prefer(self, peer: Any) -> None:
        pass

    def close(self) -> None:
        with contextlib.suppress(OSError):
            self._device.close()


def open_transport(endpoint: Endpoint) -> Transport:
    """Raises: OSError (pyserial's exceptions are such)."""
    if endpoint.kind in ("udp", "udpout"):
        return _Udp(endpoint)
    if endpoint.kind == "tcp":
        connection = socket.create_connection((endpoint.address.strip("[]"), endpoint.port), timeout=1.0)
        connection.setblocking(False)
        connection.setsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY, 1)
        return _ByteStream(connection, f"tcp {endpoint.address}:{endpoint.port}")
    try:
        # exclusive: two processes that read one line each get half of every frame.
        port = serial.Serial(endpoint.address, endpoint.port, timeout=0, write_timeout=0, exclusive=True)
    except ValueError as error:  # a baud rate that the driver refuses
        raise OSError(str(error)) from error
    return _ByteStream(port, endpoint.address)
