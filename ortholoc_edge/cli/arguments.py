"""Argument types that several commands share: what they refuse is a usage error, exit code 2."""

from __future__ import annotations

import argparse
import math
import tempfile
from collections.abc import Callable
from pathlib import Path
from typing import TypeVar

from ortholoc_edge.bench.replay import Length
from ortholoc_edge.errors import ConfigError, OrtholocError

N = TypeVar("N", int, float)
Triple = tuple[float, float, float]

# Beyond the Earth's size; also of the coordinates of any projection.
_MAX_LENGTH_M = 1e8


def any_triple(text: str) -> Triple:
    """``1,2,3``; NaN too, where the pipeline has an answer to it."""
    try:
        a, b, c = (float(part) for part in text.split(","))
    except ValueError as err:
        raise argparse.ArgumentTypeError(f"{text!r} is not three numbers with commas") from err
    return a, b, c


def triple(text: str) -> Triple:
    """``1,2,3``, finite."""
    numbers = any_triple(text)
    if not all(math.isfinite(number) for number in numbers):
        raise argparse.ArgumentTypeError(f"{text!r} is not three finite numbers")
    return numbers


def map_position(text: str) -> Triple:
    """``E,N,H`` in m."""
    place = triple(text)
    if max(abs(part) for part in place) > _MAX_LENGTH_M:
        raise argparse.ArgumentTypeError(f"{text!r} is not on the Earth")
    return place


def sigma_triple(text: str) -> Triple:
    """``1,1,3``: three 1-sigmas of angles, degrees."""
    sigmas = triple(text)
    if min(sigmas) < 0 or max(sigmas) > 180:
        raise argparse.ArgumentTypeError(f"{text!r}: a sigma of an angle is from 0 to 180 degrees")
    return sigmas


def geodetic(text: str) -> Triple:
    """``LAT,LON,AMSL``"""
    latitude, longitude, height = triple(text)
    if abs(latitude) > 90 or abs(longitude) > 180 or abs(height) > _MAX_LENGTH_M:
        raise argparse.ArgumentTypeError(
            f"{text!r} is not on the Earth: latitude from -90 to 90, longitude from -180 to 180 degrees"
        )
    return latitude, longitude, height


def non_negative(text: str) -> float:
    """A finite number of zero or more."""
    number = _number(text)
    if number < 0:
        raise argparse.ArgumentTypeError(f"{text!r} is below zero")
    return number


def positive(text: str) -> float:
    """A finite number above zero."""
    number = _number(text)
    if number <= 0:
        raise argparse.ArgumentTypeError(f"{text!r} is not above zero")
    return number


def positive_int(text: str) -> int:
    """1, 2, 3, …"""
    return _whole(text, 1)


def seed(text: str) -> int:
    """0, 1, 2, …"""
    return _whole(text, 0)


def within(what: str, kind: Callable[[str], N], least: float, most: float) -> Callable[[str], N]:
    """An argument type: numbers of a ``kind`` (int or float) in a range; ``what`` names one in the refusal."""

    def parse(text: str) -> N:
        value: N | None
        try:
            value = kind(text)
        except ValueError:
            value = None
        if value is None or not least <= value <= most:
            raise argparse.ArgumentTypeError(f"{text!r} is not {what} from {least:g} to {most:g}")
        return value

    return parse


def length(text: str) -> Length:
    """``5``, ``5m`` or ``4%``"""
    try:
        parsed = Length.parse(text)
    except ConfigError as err:
        raise argparse.ArgumentTypeError(str(err)) from err
    if max(parsed.metres, parsed.of_height) > _MAX_LENGTH_M:
        raise argparse.ArgumentTypeError(f"{text!r} is farther than any vehicle flies")
    return parsed


def writable_folder(folder: Path, option: str) -> None:
    """Make sure before the work that its results can be written after it.

    Raises: OrtholocError naming the folder and the option.
    """
    try:
        folder.mkdir(parents=True, exist_ok=True)
        with tempfile.TemporaryFile(dir=folder):
            pass
    except OSError as err:
        raise OrtholocError(f"{folder}: can't write results there ({err}); choose another {option}") from err


def _number(text: str) -> float:
    try:
        number = float(text)
    except ValueError as err:
        raise argparse.ArgumentTypeError(f"{text!r} is not a number") from err
    if not math.isfinite(number):
        raise argparse.ArgumentTypeError(f"{text!r} is not a finite number")
    return number


def _whole(text: str, least: int) -> int:
    try:
        number = int(text)
    except ValueError as err:
        raise argparse.ArgumentTypeError(f"{text!r} is not a whole number") from err
    if number < least:
        raise argparse.ArgumentTypeError(f"{text!r} is below {least}")
    return number
