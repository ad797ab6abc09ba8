"""Argument types that several commands share."""

from __future__ import annotations

import argparse

from ortholoc_edge.bench.replay import Length
from ortholoc_edge.errors import ConfigError


def triple(text: str) -> tuple[float, float, float]:
    """``1,2,3``"""
    try:
        a, b, c = (float(part) for part in text.split(","))
    except ValueError as err:
        raise argparse.ArgumentTypeError(f"{text!r} is not three numbers with commas") from err
    return a, b, c


def length(text: str) -> Length:
    """``5``, ``5m`` or ``4%``"""
    try:
        return Length.parse(text)
    except ConfigError as err:
        raise argparse.ArgumentTypeError(str(err)) from err
