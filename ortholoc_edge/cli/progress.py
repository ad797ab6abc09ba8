"""A progress bar on stderr that appears with the first news, so that what is already there stays silent."""

from __future__ import annotations

import sys
from types import TracebackType

from tqdm import tqdm


class ProgressBar:
    """Context manager around work that reports ``step(what, done, steps)``."""

    def __init__(self, description: str) -> None:
        self._description = description
        self._bar: tqdm[None] | None = None

    def __enter__(self) -> ProgressBar:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        if self._bar is not None:
            self._bar.close()

    def step(self, what: str, done: int, steps: int) -> None:
        """``done`` of ``steps`` are over; ``what`` comes now."""
        if self._bar is None:
            self._bar = tqdm(total=steps, unit="step", file=sys.stderr, desc=self._description, leave=False)
        self._bar.total = steps
        self._bar.set_postfix_str(what, refresh=False)
        self._bar.update(done - self._bar.n)
        self._bar.refresh()
