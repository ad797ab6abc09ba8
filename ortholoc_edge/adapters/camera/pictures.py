"""Encoded pictures to pixels.

What is damaged is refused: libjpeg fills what is missing with grey and reports success.
"""

from __future__ import annotations

import re
import zlib
from pathlib import Path
from typing import Any

import cv2
import numpy as np

from ortholoc_edge.errors import CameraError
from ortholoc_edge.geometry.arrays import ImageArray

IMAGE_SUFFIXES = frozenset({".jpg", ".jpeg", ".png", ".tif", ".tiff", ".webp", ".bmp"})


def read_image(path: Path) -> ImageArray:
    """A picture file as (H, W, 3) RGB uint8, read-only; grey becomes RGB, 16 bits become 8.

    The pixels come as the sensor gave them: an EXIF orientation is not applied, since intrinsics belong to
    the sensor's rows and columns.
    Raises: CameraError naming the file, the defect and the remedy. A JPEG with wrong bytes in the middle and
        a sound end can't be told from a good one: the format has no checksum.
    """
    try:
        data = path.read_bytes()
    except OSError as error:
        raise CameraError(f"picture {path} can't be read: {error.strerror}; check the path and its rights") from error
    return decode_image(data, f"picture {path}", "copy it again from its source or take it out")


def decode_image(data: bytes, name: str, remedy: str) -> ImageArray:
    """An encoded picture, as `read_image`. Raises: CameraError, "NAME is unusable: DEFECT; REMEDY"."""
    decoded = decode(data)
    if isinstance(decoded, str):
        raise CameraError(f"{name} is unusable: {decoded}; {remedy}")
    return decoded


def decode_published(data: bytes, name: str, remedy: str) -> ImageArray:
    """As `decode_image`, of what anybody may have sent: only formats whose size is known before they are decoded."""
    if declared_px(data) is None:
        raise CameraError(f"{name} is unusable: neither JPEG, PNG nor WebP; {remedy}")
    return decode_image(data, name, remedy)


def decode(data: bytes) -> ImageArray | str:
    """An encoded picture as (H, W, 3) RGB uint8, read-only, or in words why it can't be."""
    defect = _defect(data)
    if defect is not None:
        return defect
    try:
        image = cv2.imdecode(np.frombuffer(data, dtype=np.uint8), cv2.IMREAD_COLOR_RGB | cv2.IMREAD_IGNORE_ORIENTATION)
    except cv2.error as error:
        return f"OpenCV can't decode it ({error.err})"
    if image is None or image.size == 0:
        return "not a picture that OpenCV can decode"
    return frozen_rgb(image, "a picture")


def rgb(image: Any, name: str) -> ImageArray:
    """What OpenCV captured, as RGB. Raises: CameraError naming the source."""
    if image.ndim == 2 or image.shape[2] == 1:
        return frozen_rgb(cv2.cvtColor(image, cv2.COLOR_GRAY2RGB), name)
    return frozen_rgb(cv2.cvtColor(image, cv2.COLOR_BGR2RGB), name)


def frozen_rgb(image: Any, name: str) -> ImageArray:
    """(H, W, 3) RGB as our own, read-only. Raises: CameraError naming the source if it is not uint8."""
    # numpy would wrap a 16-bit 300 to 44 without a word.
    if image.dtype != np.uint8:
        raise CameraError(
            f"{name} gives {image.dtype} pixels, not uint8; convert them before, in a GStreamer pipeline by "
            "'videoconvert ! video/x-raw,format=BGR'"
        )
    array: ImageArray = np.ascontiguousarray(image)
    array.flags.writeable = False
    return array


def _defect(data: bytes) -> str | None:
    """What is visibly wrong with an encoded picture, before anything decodes it; None if nothing is."""
    if not data:
        return "it is empty"
    size = declared_px(data)
    if size is not None and size[0] * size[1] > _MOST_PX:
        return f"of {size[0]} x {size[1]} pixels; at most {_MOST_PX / 1e6:.0f} million can be taken"
    if data.startswith(b"\xff\xd8"):
        return _jpeg_defect(data)
    if data.startswith(b"\x89PNG\r\n\x1a\n"):
        return _png_defect(data)
    if data[:4] == b"RIFF" and data[8:12] == b"WEBP" and len(data) < int.from_bytes(data[4:8], "little") + 8:
        return f"truncated: {len(data)} bytes of {int.from_bytes(data[4:8], 'little') + 8}"
    return None


# What a decoder takes memory for, 3 bytes each: larger than any camera's, smaller than what ends the daemon.
_MOST_PX = 150_000_000
# Starts of frames (SOF0 to SOF15; the three left out are tables).
_JPEG_FRAMES = frozenset(range(0xC0, 0xD0)) - {0xC4, 0xC8, 0xCC}
# In entropy-coded data FF is followed by 00 (a stuffed byte), by a restart marker or by more FF; else a
# segment begins.
_JPEG_NEXT_MARKER = re.compile(rb"\xff[^\x00\xd0-\xd7\xff]")


def declared_px(data: bytes) -> tuple[int, int] | None:
    """Width and height that a JPEG, PNG or WebP says it has; None of anything else, (0, 0) where it breaks off."""
    if data.startswith(b"\xff\xd8"):
        return _jpeg_px(data)
    if data.startswith(b"\x89PNG\r\n\x1a\n"):
        return int.from_bytes(data[16:20], "big"), int.from_bytes(data[20:24], "big")
    if data[:4] == b"RIFF" and data[8:12] == b"WEBP":
        kind, body = data[12:16], data[20:30]
        if kind == b"VP8X":
            return int.from_bytes(body[4:7], "little") + 1, int.from_bytes(body[7:10], "little") + 1
        if kind == b"VP8L":
            packed = int.from_bytes(body[1:5], "little")
            return (packed & 0x3FFF) + 1, (packed >> 14 & 0x3FFF) + 1
        return int.from_bytes(body[6:8], "little") & 0x3FFF, int.from_bytes(body[8:10], "little") & 0x3FFF
    return None


def _jpeg_px(data: bytes) -> tuple[int, int]:
    """By the segments, since an EXIF thumbnail has a size of its own."""
    at = 2
    while at + 9 <= len(data) and data[at] == 0xFF:
        marker = data[at + 1]
        if marker == 0xFF:  # fill
            at += 1
        elif marker in _JPEG_FRAMES:
            return int.from_bytes(data[at + 7 : at + 9], "big"), int.from_bytes(data[at + 5 : at + 7], "big")
        else:
            at += 2 + int.from_bytes(data[at + 2 : at + 4], "big")
    return 0, 0


def _jpeg_defect(data: bytes) -> str | None:
    """Walk the segments to the end marker.

    Looking at the last two bytes is not enough: some cameras append data, and an EXIF thumbnail has an end
    marker of its own, which a truncated file may well contain.
    """
    truncated = f"truncated after {len(data)} bytes (a JPEG without its end marker)"
    at = 2
    scans = 0
    while True:
        found = _JPEG_NEXT_MARKER.search(data, at)
        if found is None:
            return truncated
        # Between segments, not even one byte may lie; within a scan any number.
        if scans == 0 and data[at : found.start()].strip(b"\xff"):
            return f"damaged: no segment begins at byte {at}"
        marker, at = found[0][1], found.end()
        if marker == 0xD9:
            return None if scans else "damaged: a JPEG without a picture in it"
        if at + 2 > len(data):
            return truncated
        at += int.from_bytes(data[at : at + 2], "big")
        scans += marker == 0xDA


def _png_defect(data: bytes) -> str | None:
    """Walk the chunks, each with its checksum, to the end."""
    at = 8
    while at + 12 <= len(data):
        end = at + 12 + int.from_bytes(data[at : at + 4], "big")
        if end > len(data):
            break
        if zlib.crc32(data[at + 4 : end - 4]) != int.from_bytes(data[end - 4 : end], "big"):
            return f"damaged: checksum error in its chunk at byte {at}"
        if data[at + 4 : at + 8] == b"IEND":
            return None
        at = end
    return f"truncated after {len(data)} bytes (a PNG without its end)"
