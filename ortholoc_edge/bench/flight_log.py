"""Flight logs (`adapters.flight_log`) read and flown again: the same bytes of picture, state and configuration through
the same code, and what came out held against what came out in flight."""

from __future__ import annotations

import base64
import binascii
import logging
import struct
import zlib
from collections.abc import Iterable, Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import cv2
import msgspec
import numpy as np
import zstandard
from mcap.exceptions import EndOfFile, McapError
from mcap.records import Channel, Message, Metadata
from mcap.stream_reader import CRCValidationError, StreamReader
from msgspec import Struct

from ortholoc_edge.adapters.flight_log import CAMERA_TOPIC, FRAME_TOPIC, HEADER_NAME, LogHeader, header_of
from ortholoc_edge.errors import DatasetError
from ortholoc_edge.geometry.arrays import ImageArray
from ortholoc_edge.pipeline.frame import Frame
from ortholoc_edge.pipeline.navigator import Navigator
from ortholoc_edge.pipeline.outcome import Outcome
from ortholoc_edge.pipeline.record import FrameRecord, outcome_record

logger = logging.getLogger(__name__)

# A length beyond any record of ours is a damaged one, and must not be believed.
_MAX_RECORD_BYTES = 256 << 20
_MOST_NAMED = 10
# A length inside a record that was damaged asks for more memory than there is.
_DAMAGE = (
    McapError, CRCValidationError, zstandard.ZstdError, struct.error, zlib.error, UnicodeDecodeError, KeyError,
    MemoryError, OverflowError,
)  # fmt: skip


@dataclass(frozen=True, slots=True, eq=False)
class LoggedFrame:
    """A step as it was recorded; ``image`` (H, W) grey is None where the log has no picture without loss."""

    record: FrameRecord
    image: ImageArray | None


def log_files(source: Path) -> list[Path]:
    """The flight logs that a path names: itself, or those of the last life of the daemon in a folder; in order."""
    if source.suffix == ".mcap":
        return [source]
    if not source.is_dir():
        return []
    found: list[tuple[int, Path, str]] = []
    for path in source.glob("flight-*.mcap"):
        try:
            header = read_header(path)
        except DatasetError as err:
            # A power cut, or a full disk, in the moment that it was begun.
            logger.warning("%s; left out", err)
            continue
        found.append((header.part, path, header.session))
    last = max((session for _, _, session in found), default="")
    return [path for _, path, session in sorted(found) if session == last]


def read_header(path: Path) -> LogHeader:
    """What a log says of its flight. Raises: DatasetError naming the file."""
    for item in _items(path):
        if isinstance(item, LogHeader):
            return item
        break
    raise DatasetError(f"{path}: no metadata {HEADER_NAME!r} at its beginning; not a flight log of ortholoc-edge")


def read_frames(path: Path) -> Iterator[LoggedFrame]:
    """The steps of a file, up to where it was cut off or damaged, which is said in a warning.

    Raises: DatasetError naming the file, for what is no flight log.
    """
    for item in _items(path):
        if isinstance(item, LoggedFrame):
            yield item


def _items(path: Path) -> Iterator[LogHeader | LoggedFrame]:
    try:
        with path.open("rb") as file:
            yield from _parsed(file, path)
    except OSError as err:
        raise DatasetError(f"{path}: can't be read ({err})") from err


def _parsed(file: Any, path: Path) -> Iterator[LogHeader | LoggedFrame]:
    topics: dict[int, str] = {}
    # The picture comes before its record, and only where it is whole does it belong to a replay.
    image: ImageArray | None = None
    frames = 0
    reader = StreamReader(file, validate_crcs=True, record_size_limit=_MAX_RECORD_BYTES)
    try:
        for record in reader.records:
            if isinstance(record, Metadata) and record.name == HEADER_NAME:
                yield header_of(record.metadata)
            elif isinstance(record, Channel):
                topics[record.id] = record.topic
            elif isinstance(record, Message) and topics.get(record.channel_id) == CAMERA_TOPIC:
                image = _image(record.data)
            elif isinstance(record, Message) and topics.get(record.channel_id) == FRAME_TOPIC:
                step = msgspec.json.decode(record.data, type=FrameRecord)
                yield LoggedFrame(step, image if step.whole else None)
                image, frames = None, frames + 1
    except EndOfFile:
        logger.warning("%s: ends after %d frames without an end; the daemon or its power was cut off", path, frames)
    except (*_DAMAGE, msgspec.ValidationError, msgspec.DecodeError, binascii.Error) as err:
        if not topics:
            raise DatasetError(f"{path}: not a flight log of ortholoc-edge ({err!r})") from err
        logger.warning("%s: damaged after %d frames (%r); the rest is left out", path, frames, err)


def _image(message: bytes) -> ImageArray | None:
    found = msgspec.json.decode(message)
    if found["format"] != "png":
        return None
    data = np.frombuffer(base64.b64decode(found["data"], validate=True), dtype=np.uint8)
    image = cv2.imdecode(data, cv2.IMREAD_GRAYSCALE)
    return None if image is None else np.asarray(image, dtype=np.uint8)


@dataclass(frozen=True, slots=True, eq=False)
class Repeated:
    """A step taken again.

    Attributes:
        was: `outcome_record` of the flight, and ``now`` of the replay; without timings.
        apart_m: between the two positions, where both are fixes.
        picture: whether it was looked at; a step without a prediction needs none.
        alone: whether it was taken from its recorded prediction, since steps before it are missing.
    """

    name: str
    was: dict[str, Any]
    now: dict[str, Any]
    picture: bool
    alone: bool

    @property
    def same(self) -> bool:
        return self.was == self.now

    @property
    def apart_m(self) -> float | None:
        if not (self.was["fix"] and self.now["fix"]):
            return None
        return float(np.linalg.norm(np.subtract(self.was["position_map_m"], self.now["position_map_m"])))


class Comparison(Struct, frozen=True, kw_only=True):
    """A log flown again; the object that ``replay LOG --json`` prints.

    Attributes:
        files: in order. version: of the program that wrote them; other_libraries: of what poses depend on, and is
            another here.
        steps: in the log. pictures: of these, with one without loss. left_out: that were not repeated, for want of it.
        repeated: taken again; alone: of these, from the recorded prediction, for steps before them are missing.
        fixes: of those repeated, in flight. same: came to the same in every bit.
        other_verdict: a fix in one of the two and not in the other.
        furthest_m: between the fixes of flight and replay; None if there are no such pairs.
        differ: names of the first that came to something else.
    """

    files: list[str]
    version: str
    other_libraries: dict[str, str]
    steps: int
    pictures: int
    left_out: int
    repeated: int
    alone: int
    fixes: int
    same: int
    other_verdict: int
    furthest_m: float | None
    differ: list[str]


def repeat(logged: Iterable[LoggedFrame], navigator: Navigator) -> Iterator[Repeated | None]:
    """Take the steps again; None for one that can't be.

    While the log is complete, one after another, each from what the earlier ones taught the tracker. After a gap (a
    frame that the log dropped, or has no picture of; a file that was rotated away) from the predictions as recorded.
    """
    expected = 0
    for one in logged:
        record, was = one.record, one.record.circumstances()
        complete = expected == record.number
        # Without a prediction the picture was not looked at.
        image = one.image if one.image is not None else np.zeros((0, 0), np.uint8) if was.prior is None else None
        now: Outcome | None = None
        if image is not None:
            frame = Frame(record.stamp_ns, image, record.name, record.exposure_ns)
            if complete:
                now = navigator.step_again(frame, record.state(), was)
                expected += 1
            else:
                now = navigator.localize_again(frame, record.state(), was)
        if now is None:
            yield None
        else:
            yield Repeated(
                record.name, _plain(record.outcome), _plain(outcome_record(now)), one.image is not None, not complete
            )


def compare(
    files: list[Path], version: str, other_libraries: dict[str, str], repeated: Iterable[Repeated | None]
) -> Comparison:
    """Sum up."""
    every = list(repeated)
    taken = [one for one in every if one is not None]
    apart = [one.apart_m for one in taken if one.apart_m is not None]
    return Comparison(
        files=[str(path) for path in files],
        version=version,
        other_libraries=other_libraries,
        steps=len(every),
        pictures=sum(one.picture for one in taken),
        left_out=len(every) - len(taken),
        repeated=len(taken),
        alone=sum(one.alone for one in taken),
        fixes=sum(bool(one.was["fix"]) for one in taken),
        same=sum(one.same for one in taken),
        other_verdict=sum(one.was["fix"] != one.now["fix"] for one in taken),
        furthest_m=max(apart, default=None),
        differ=[one.name for one in taken if not one.same][:_MOST_NAMED],
    )


def _plain(record: dict[str, Any]) -> dict[str, Any]:
    """As JSON has it, and without what is never the same twice."""
    plain: dict[str, Any] = msgspec.json.decode(msgspec.json.encode(record))
    del plain["timings_ms"]
    return plain
