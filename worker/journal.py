"""The progress events of a job, one JSON object per line, numbered from 1 across all attempts.

One writer (whoever holds the job's lock), any number of readers; no reader ever sees half a
line, because a line counts only once its newline is there.
"""

from __future__ import annotations

import json
import os
import time
from dataclasses import dataclass
from pathlib import Path
from types import TracebackType
from typing import Any


class EventWriter:
    def __init__(self, path: Path) -> None:
        self._file = path.open("ab", buffering=0)
        self._whole, self.last = _whole_lines(path)
        os.truncate(self._file.fileno(), self._whole)  # a crash may have left half a line

    def append(self, event: dict[str, Any]) -> None:
        """Raises OSError, and then the journal is as it was."""
        line = json.dumps({"number": self.last + 1, "at": time.time(), **event}, allow_nan=False)
        whole = memoryview(line.encode() + b"\n")
        written = 0
        try:
            while written < len(whole):
                written += self._file.write(whole[written:])
        except OSError:  # a full disk takes a part of a line
            os.truncate(self._file.fileno(), self._whole)
            raise
        self.last += 1
        self._whole += written

    def __enter__(self) -> EventWriter:
        return self

    def __exit__(self, kind: type[BaseException] | None, error: BaseException | None, at: TracebackType | None) -> None:
        self._file.close()


def read_events(path: Path, after: int, limit: int) -> list[dict[str, Any]]:
    """Up to `limit` events numbered above `after`, oldest first."""
    events: list[dict[str, Any]] = []
    try:
        with path.open("rb") as file:
            for number, line in enumerate(file, start=1):
                if not line.endswith(b"\n") or len(events) >= limit:
                    break
                if number > after:
                    events.append(json.loads(line))
    except FileNotFoundError:
        pass
    return events


@dataclass(frozen=True)
class Line:
    number: int
    text: str


class Cursor:
    """A reader that remembers where it stopped, so that following a journal does not read it again and again."""

    def __init__(self, path: Path) -> None:
        self._path = path
        self._offset = 0
        self._number = 0

    def read(self, limit: int, after: int = 0) -> list[Line]:
        """Up to `limit` of the next lines, those numbered `after` and below passed over."""
        lines: list[Line] = []
        try:
            with self._path.open("rb") as file:
                file.seek(self._offset)
                for raw in file:
                    if not raw.endswith(b"\n") or len(lines) >= limit:
                        break
                    self._offset += len(raw)
                    self._number += 1
                    if self._number > after:
                        lines.append(Line(self._number, raw.decode().rstrip("\n")))
        except FileNotFoundError:
            pass
        return lines


def _whole_lines(path: Path) -> tuple[int, int]:
    """Length in bytes and number of the complete lines."""
    size = count = 0
    with path.open("rb") as file:
        for line in file:
            if line.endswith(b"\n"):
                size, count = size + len(line), count + 1
    return size, count
