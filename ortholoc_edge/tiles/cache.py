"""Decoded blocks of a pack, so that a frame decodes only what the one before did not see."""

from __future__ import annotations

from collections import OrderedDict
from collections.abc import Hashable
from typing import Any

import numpy.typing as npt

Rasters = tuple[npt.NDArray[Any], ...]


class BlockCache:
    """Rasters of blocks, within a limit of bytes: what was used longest ago goes first.

    Without a lock of its own: the layers of a store read under one.
    """

    def __init__(self, limit_bytes: int) -> None:
        self._limit_bytes = limit_bytes
        self._bytes = 0
        self._blocks: OrderedDict[Hashable, Rasters] = OrderedDict()

    def __len__(self) -> int:
        return len(self._blocks)

    @property
    def bytes(self) -> int:
        """Of the rasters that are held."""
        return self._bytes

    def get(self, key: Hashable) -> Rasters | None:
        found = self._blocks.get(key)
        if found is not None:
            self._blocks.move_to_end(key)
        return found

    def put(self, key: Hashable, rasters: Rasters) -> None:
        """Hold the rasters of a key that `get` did not find."""
        self._blocks[key] = rasters
        self._bytes += _bytes_of(rasters)
        while self._bytes > self._limit_bytes:
            self._bytes -= _bytes_of(self._blocks.popitem(last=False)[1])

    def clear(self) -> None:
        self._blocks.clear()
        self._bytes = 0


def _bytes_of(rasters: Rasters) -> int:
    # One value that stands for all (numpy.broadcast_to) takes no memory to speak of.
    return sum(raster.nbytes if any(raster.strides) else raster.itemsize for raster in rasters)
