"""Lines that repeat, at a rate that keeps the rare line visible."""

from __future__ import annotations

import logging

logger = logging.getLogger(__name__)

_S = 1_000_000_000


class LimitedLog:
    """Logs one kind of line at most once per interval, then with the count of those left out."""

    def __init__(self, interval_ns: int = 10 * _S) -> None:
        self._interval_ns = interval_ns
        self._last: dict[str, tuple[int, int]] = {}

    def __call__(self, now_ns: int, level: int, key: str, message: str) -> None:
        """``key`` is the kind; it must come from a fixed set."""
        last_ns, left_out = self._last.get(key, (None, 0))
        if last_ns is not None and now_ns - last_ns < self._interval_ns:
            self._last[key] = (last_ns, left_out + 1)
            return
        self._last[key] = (now_ns, 0)
        logger.log(level, "%s%s", message, f" ({left_out} more like it before)" if left_out else "")
