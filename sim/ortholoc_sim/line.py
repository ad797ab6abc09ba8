"""A simulated line between companion and autopilot: frames go in and come out later, or not at all."""

from __future__ import annotations

import heapq
from collections import Counter
from enum import IntEnum
from typing import Annotated, Any

import numpy as np
from msgspec import Meta, Struct

from ortholoc_edge.clock import Clock

# As the real transport has it: what may wait to be written.
_OUT_LIMIT_BYTES = 2048


class LineOptions(Struct, frozen=True, kw_only=True, forbid_unknown_fields=True):
    """How frames travel; the same in both directions.

    Attributes:
        delay_ms: of every frame; 25 are a round trip of 50 ms. jitter_ms: up to so much more, by lot.
        loss: share of frames that never arrive.
        baud: of a serial line, ten bits to a byte; 0: as fast as a socket.
    """

    delay_ms: Annotated[float, Meta(ge=0, le=2000)] = 0.5
    jitter_ms: Annotated[float, Meta(ge=0, le=2000)] = 1.0
    loss: Annotated[float, Meta(ge=0, le=1)] = 0.0
    baud: Annotated[int, Meta(ge=0)] = 0


class End(IntEnum):
    """Who a frame is for."""

    COMPANION = 0
    AUTOPILOT = 1


class Line:
    """Frames on their way, by time of arrival. Order is kept, as on a wire.

    Attributes:
        down: per end, whether frames for it are lost now.
        counts: ``lost``, ``refused`` (no room) and ``carried``.
    """

    def __init__(self, options: LineOptions, seed: int) -> None:
        self.options = options
        self.down = {end: False for end in End}
        self.counts: Counter[str] = Counter()
        self._rng = np.random.default_rng([seed, 61])
        self._way: list[tuple[int, int, End, bytes]] = []
        self._last_ns = {end: 0 for end in End}
        # Until when the wire is busy with what was handed to it.
        self._free_ns = {end: 0 for end in End}
        self._sent = 0

    def waiting_bytes(self, end: End, now_ns: int) -> int:
        """What has not left the sender's buffer."""
        if not self.options.baud:
            return 0
        return max(0, (self._free_ns[end] - now_ns) * self.options.baud // 10_000_000_000)

    def send(self, end: End, frame: bytes, now_ns: int) -> bool:
        """Hand a frame to the line; False if its buffer has no room for it."""
        if self.waiting_bytes(end, now_ns) + len(frame) > _OUT_LIMIT_BYTES:
            self.counts["refused"] += 1
            return False
        leaves_ns = now_ns
        if self.options.baud:
            leaves_ns = max(now_ns, self._free_ns[end]) + len(frame) * 10_000_000_000 // self.options.baud
            self._free_ns[end] = leaves_ns
        # Both are drawn for every frame, so that one fault leaves the fate of all others as it was.
        jitter, fate = self._rng.random(2)
        if self.down[end] or fate < self.options.loss:
            self.counts["lost"] += 1
            return True
        late_ns = round((self.options.delay_ms + jitter * self.options.jitter_ms) * 1e6)
        arrives_ns = max(leaves_ns + late_ns, self._last_ns[end])
        self._last_ns[end] = arrives_ns
        self._sent += 1
        heapq.heappush(self._way, (arrives_ns, self._sent, end, frame))
        self.counts["carried"] += 1
        return True

    def next_ns(self) -> int | None:
        """When the next frame arrives; None if none is under way."""
        return self._way[0][0] if self._way else None

    def take(self) -> tuple[End, bytes]:
        """The frame of `next_ns`."""
        _, _, end, frame = heapq.heappop(self._way)
        return end, frame


class LineTransport:
    """The companion's end of a line; a `mavlink.transport.Transport`, which cuts no frame."""

    cut_datagrams = 0

    def __init__(self, line: Line, clock: Clock) -> None:
        self._line, self._clock = line, clock
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
        return self._line.send(End.AUTOPILOT, frame, self._clock.now_ns())

    def pending(self) -> bool:
        return self._line.waiting_bytes(End.AUTOPILOT, self._clock.now_ns()) > 0

    def flush(self) -> None:
        pass

    def prefer(self, peer: Any) -> None:
        pass

    def close(self) -> None:
        pass
