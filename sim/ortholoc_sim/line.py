"""A simulated line between companion and autopilot: frames go in and come out later, damaged, or not at all."""

from __future__ import annotations

from collections import Counter, deque
from enum import IntEnum
from typing import Annotated, Any

import numpy as np
from msgspec import Meta, Struct

from ortholoc_edge.clock import Clock

_S = 1_000_000_000
_BITS_PER_BYTE = 10  # with start and stop bit
# As the real transport has it: what may wait to be written.
_ROOM_BYTES = 2048


class LineOptions(Struct, frozen=True, kw_only=True, forbid_unknown_fields=True):
    """How frames travel; the same in both directions.

    Attributes:
        delay_ms: of every frame; 25 are a round trip of 50 ms. jitter_ms: up to so much more, by lot.
        loss: share of frames that never arrive.
        corruption: share of bytes of which one bit turns.
        baud: of a serial line, ten bits to a byte; 0: as fast as a socket.
    """

    delay_ms: Annotated[float, Meta(ge=0, le=2000)] = 0.5
    jitter_ms: Annotated[float, Meta(ge=0, le=2000)] = 1.0
    loss: Annotated[float, Meta(ge=0, le=1)] = 0.0
    corruption: Annotated[float, Meta(ge=0, le=1)] = 0.0
    baud: Annotated[int, Meta(ge=0)] = 0


PERFECT = LineOptions(delay_ms=0.0, jitter_ms=0.0)


class Wire:
    """One direction: frames on their way. Order is kept.

    Attributes:
        down: whether frames are lost now.
        counts: ``lost``, ``refused`` (no room) and ``carried``.
    """

    def __init__(self, options: LineOptions, rng: np.random.Generator) -> None:
        self._options, self._rng = options, rng
        self.down = False
        self.counts: Counter[str] = Counter()
        self._way: deque[tuple[int, bytes]] = deque()
        self._last_ns = 0
        # Until when it is busy with what was handed to it.
        self._free_ns = 0

    def waiting_bytes(self, now_ns: int) -> int:
        """What has not left the sender's buffer."""
        if not self._options.baud:
            return 0
        return max(0, (self._free_ns - now_ns) * self._options.baud // (_BITS_PER_BYTE * _S))

    def send(self, frame: bytes, now_ns: int) -> bool:
        """Hand a frame over, which travels as a whole; False if the buffer of a serial line has no room for it."""
        options = self._options
        if self._options.baud and self.waiting_bytes(now_ns) + len(frame) > _ROOM_BYTES:
            self.counts["refused"] += 1
            return False
        leaves_ns = now_ns
        if options.baud:
            leaves_ns = max(now_ns, self._free_ns) + len(frame) * _BITS_PER_BYTE * _S // options.baud
            self._free_ns = leaves_ns
        # Both are drawn for every frame, so that one fault leaves the fate of all others as it was.
        jitter, fate = self._rng.random(2)
        if self.down or fate < options.loss:
            self.counts["lost"] += 1
            return True
        if options.corruption:
            frame = self._damaged(frame)
        late_ns = round((options.delay_ms + jitter * options.jitter_ms) * 1e6)
        self._last_ns = max(leaves_ns + late_ns, self._last_ns)
        self._way.append((self._last_ns, frame))
        self.counts["carried"] += 1
        return True

    def next_ns(self) -> int | None:
        """When the next frame arrives; None if none is under way."""
        return self._way[0][0] if self._way else None

    def take(self) -> bytes:
        """The frame of `next_ns`."""
        return self._way.popleft()[1]

    def arrived(self, now_ns: int) -> list[bytes]:
        """All frames that are there by now."""
        frames = []
        while self._way and self._way[0][0] <= now_ns:
            frames.append(self.take())
        return frames

    def _damaged(self, frame: bytes) -> bytes:
        array = np.frombuffer(frame, np.uint8)
        hit = self._rng.random(len(array)) < self._options.corruption
        bits = np.uint8(1) << self._rng.integers(0, 8, len(array), dtype=np.uint8)
        return (array ^ np.where(hit, bits, np.uint8(0))).tobytes()


class End(IntEnum):
    """Who a frame is for."""

    COMPANION = 0
    AUTOPILOT = 1


class Line:
    """Both directions, by time of arrival. ``wires``: towards each end."""

    def __init__(self, options: LineOptions, seed: int) -> None:
        self.wires = {end: Wire(options, np.random.default_rng([seed, 61, end])) for end in End}

    @property
    def counts(self) -> Counter[str]:
        """Of both."""
        return sum((wire.counts for wire in self.wires.values()), Counter())

    def next_ns(self) -> int | None:
        """When the next frame arrives at either end; None if none is under way."""
        due = [at for wire in self.wires.values() if (at := wire.next_ns()) is not None]
        return min(due, default=None)

    def take(self) -> tuple[End, bytes]:
        """The frame of `next_ns`."""
        _, end = min((at, end) for end, wire in self.wires.items() if (at := wire.next_ns()) is not None)
        return end, self.wires[end].take()


class LineTransport:
    """The companion's end of a line; a `mavlink.transport.Transport`, which cuts no frame."""

    cut_datagrams = 0

    def __init__(self, line: Line, clock: Clock) -> None:
        self._wire, self._clock = line.wires[End.AUTOPILOT], clock
        self._arrived: list[bytes] = []

    def arrive(self, frame: bytes) -> None:
        """A frame came out of the line."""
        self._arrived.append(frame)

    def fileno(self) -> int:
        raise OSError("a simulated line has no file descriptor")

    def receive(self) -> list[tuple[bytes, Any]]:
        arrived, self._arrived = self._arrived, []
        return [(frame, None) for frame in arrived]

    def send(self, frame: bytes) -> bool:
        return self._wire.send(frame, self._clock.now_ns())

    def pending(self) -> bool:
        return self._wire.waiting_bytes(self._clock.now_ns()) > 0

    def flush(self) -> None:
        pass

    def prefer(self, peer: Any) -> None:
        pass

    def close(self) -> None:
        pass
