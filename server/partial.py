"""A file that arrives in pieces: parts/KEY.part, valid up to the offset that was acknowledged.

Bytes are acknowledged in two steps: fsync, then the offset goes into the database. Whatever lies
beyond that offset when the part is opened was cut off by a crash, may be torn, and is truncated away.
"""

from __future__ import annotations

import contextlib
import fcntl
import hashlib
import os
import threading
from collections.abc import Callable
from pathlib import Path

from server.intake import Busy, Mismatch
from server.writeback import Writeback
from worker.jobfolder import sync_folder


class Partial:
    """The part of one file, open for its only writer. Use from threads, one call at a time."""

    def __init__(self, parts: Path, name: str, size: int, acknowledged: int, record: Callable[[int], None]) -> None:
        self.path = part_path(parts, name)
        self._size = size
        self._record = record
        self._guard = threading.Lock()  # a cancelled request closes while its last write still runs
        new = not self.path.exists()
        self._file = os.fdopen(os.open(self.path, os.O_RDWR | os.O_CREAT, 0o644), "r+b", buffering=0)
        try:
            fcntl.flock(self._file, fcntl.LOCK_EX | fcntl.LOCK_NB)  # a second server on the same folder
            if new:
                sync_folder(parts)
            self.acknowledged = self.offset = min(acknowledged, os.fstat(self._file.fileno()).st_size)
            self._truncate()
            self._writeback = Writeback(self._file.fileno(), self.offset)
        except BlockingIOError:
            self._file.close()
            raise Busy from None
        except BaseException:
            self._file.close()
            raise

    def write(self, block: bytes) -> None:
        if self.offset + len(block) > self._size:
            raise Mismatch(f"more than the announced {self._size} bytes arrived")
        rest = memoryview(block)
        with self._guard:
            while rest:  # unbuffered, so that a full disk leaves `offset` at what was really written
                written = self._file.write(rest)
                self.offset += written
                rest = rest[written:]
            self._writeback.reached(self.offset)

    def acknowledge(self) -> None:
        """Make what was written count."""
        with self._guard:
            os.fsync(self._file.fileno())
        if self.offset != self.acknowledged:
            self._record(self.offset)
            self.acknowledged = self.offset

    def drop_chunk(self) -> None:
        """Forget what was not acknowledged."""
        with self._guard:
            self.offset = self.acknowledged
            self._truncate()

    def clear(self) -> None:
        """Start from nothing. The database goes first: it must never promise bytes that are not there."""
        self._record(0)
        self.acknowledged = 0
        self.drop_chunk()

    def sha256(self) -> str:
        self._file.seek(0)
        return hashlib.file_digest(self._file, "sha256").hexdigest()

    def move_to(self, path: Path) -> None:
        self.path.replace(path)
        sync_folder(path.parent)

    def close(self) -> None:
        with self._guard:
            self._file.close()

    def _truncate(self) -> None:
        self._file.truncate(self.offset)
        self._file.seek(self.offset)


def part_path(parts: Path, name: str) -> Path:
    """Named by a hash: with an ending, the longest allowed file name would be too long."""
    return parts / f"{hashlib.sha256(name.encode()).hexdigest()}.part"


def remove_part(parts: Path, name: str) -> None:
    with contextlib.suppress(FileNotFoundError):
        part_path(parts, name).unlink()


def take_back(parts: Path, name: str, settled: Path) -> None:
    """Undo a `move_to` that was not recorded, so that the file is checked and moved once more."""
    part = part_path(parts, name)
    if not part.exists() and settled.exists():
        settled.replace(part)
