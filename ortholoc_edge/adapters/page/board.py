"""What there is to show: the last outcomes in full, and the way so far in little. Used by one thread, no I/O."""

from __future__ import annotations

from collections import deque

from msgspec.structs import replace

from ortholoc_edge.adapters.page.marks import Mark

# In full, so many are kept, and so many sent to who opens the page; of a client that fell behind, the rest is in the
# track at its next visit.
_MARKS, _AT_ONCE = 400, 120
# Of the way so far: places of fixes and of rejections. Beyond, every second goes, and every second that comes.
_MOST_PLACES = 4000

# East, north, m; 1: a fix, 0: a rejection, at its prediction; ms of the daemon's clock.
Place = tuple[float, float, int, int]


class Board:
    """
    Attributes:
        last: number of the last mark, -1 before the first.
    """

    def __init__(self) -> None:
        self._marks: deque[Mark] = deque(maxlen=_MARKS)
        self._track: list[Place] = []
        self._every = 1
        self.last = -1

    def add(self, mark: Mark) -> None:
        """The next outcome."""
        self.last = mark.n
        self._marks.append(mark)
        pose = mark.fix or mark.prior
        if pose is None or mark.n % self._every:
            return
        self._track.append((pose.at[0], pose.at[1], int(mark.fix is not None), round(mark.t)))
        if len(self._track) > _MOST_PLACES:
            self._every *= 2
            self._track = self._track[::2]

    def since(self, seen: int) -> list[Mark]:
        """Outcomes after a number, the last `_AT_ONCE` of them at most; only the last with what the camera sees."""
        newer = min(self.last - seen, _AT_ONCE, len(self._marks))
        return [*(_without_rims(self._marks[k]) for k in range(-newer, -1)), *([self._marks[-1]] if newer else [])]

    def track(self) -> list[Place]:
        """The way before the marks that `since` gives of everything."""
        first = self.since(-1)
        return [place for place in self._track if not first or place[3] < first[0].t]


def _without_rims(mark: Mark) -> Mark:
    """Most of a mark's bytes, and only of the newest are they drawn."""
    return replace(
        mark,
        fix=None if mark.fix is None else replace(mark.fix, rim=[]),
        prior=None if mark.prior is None else replace(mark.prior, rim=[]),
    )
