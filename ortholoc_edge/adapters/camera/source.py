"""What gives frames, and how it says that one is bad or that there are no more."""

from __future__ import annotations

from typing import Protocol, runtime_checkable

from ortholoc_edge.errors import CameraError
from ortholoc_edge.pipeline.frame import Frame


class EndOfFrames(Exception):  # noqa: N818 -- the ordinary end of a recording, as StopIteration is
    """The source has no more frames and never will."""


class BadFrameError(CameraError):
    """One frame is unusable; the next may be fine, and `read` goes on with it.

    Attributes:
        stamp_ns: when the frame was due, monotonic clock.
        name: of the frame.
    """

    def __init__(self, message: str, stamp_ns: int, name: str) -> None:
        super().__init__(message)
        self.stamp_ns, self.name = stamp_ns, name


class FrameSource(Protocol):
    """Where frames come from."""

    def read(self, timeout_s: float) -> Frame | None:
        """The next frame, or None if none was due within ``timeout_s`` (0: do not wait).

        Raises: EndOfFrames; BadFrameError for one unusable frame; CameraError if the source is beyond use.
        """
        ...

    def close(self) -> None:
        """Release the device. Idempotent; `read` in another thread returns."""
        ...


@runtime_checkable
class Counting(Protocol):
    """A live source, which loses frames on the way."""

    def counts(self) -> dict[str, int]:
        """What was lost since the start, by name; for the statistics."""
        ...
