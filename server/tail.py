"""The newest lines of a job's journal, read once for all who follow it.

A follower that keeps up is served from memory. One that asks for older lines, or was too slow, reads
the journal by itself: nobody waits for it, and what is kept here does not grow with it.
"""

from __future__ import annotations

from collections import deque
from pathlib import Path

from worker.journal import Cursor, Line

KEPT = 1000
_AT_ONCE = 5000


class Tail:
    def __init__(self, journal: Path) -> None:
        self._cursor = Cursor(journal)
        self._kept: deque[Line] = deque(maxlen=KEPT)

    @property
    def last(self) -> int:
        """Number of the newest line."""
        return self._kept[-1].number if self._kept else 0

    def fetch(self) -> list[Line]:
        """What was appended since the last call. Reads the disk, so not on the event loop."""
        newest: deque[Line] = deque(maxlen=KEPT)
        while lines := self._cursor.read(_AT_ONCE):
            newest.extend(lines)
        return list(newest)

    def keep(self, lines: list[Line]) -> None:
        self._kept.extend(lines)

    def since(self, number: int) -> list[Line] | None:
        """The lines numbered above `number`; None if they are no longer all here."""
        if number >= self.last:
            return []
        if self._kept[0].number > number + 1:
            return None
        return [line for line in self._kept if line.number > number]
