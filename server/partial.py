"""The bytes of a file on its way: parts/NAME, valid up to the offset that was acknowledged.

Bytes are acknowledged in two steps: fsync, then, of a file that may be gone on with, the offset goes into the database.
Whatever lies beyond that offset when the part is opened was cut off by a crash, may be torn, and is truncated away.
"""

from __future__ import annotations

import contextlib
import fcntl
import hashlib
import os
import threading
from collections.abc import Callable
from pathlib import Path

from server.digests import Hash
from server.intake import Busy, Mismatch
from server.writeback import Writeback
from worker.jobfolder import sync_folder


class Running:
    """SHA-256 of what has come of each part that nobody writes to just now, so that no file is read again at its end.

    Kept in memory, of the `most` parts written to last: of others, and after a restart, the file is read once more.
    """

    def __init__(self, most: int = 1000) -> None:
        self._most = most
        self._guard = threading.Lock()
        self._kept: dict[Path, tuple[tuple[int, ...], Hash]] = {}  # the part as it lay there, longest ago first

    def take(self, path: Path, file: int) -> Hash | None:
        """None if it is not known, or if something else wrote to the part since, as a second server may."""
        with self._guard:
            left, digest = self._kept.pop(path, ((), None))
        return digest if left == _state(file) else None

    def keep(self, path: Path, file: int, digest: Hash) -> None:
        with self._guard:
            self._kept[path] = _state(file), digest
            if len(self._kept) > self._most:
                del self._kept[next(iter(self._kept))]


def _state(file: int) -> tuple[int, ...]:
    status = os.fstat(file)
    return status.st_ino, status.st_size, status.st_mtime_ns


class Part:
    """The part of one file, open for its only writer. Use from threads, one call at a time.

    With `record`, which is told every acknowledged offset, it is gone on with from `acknowledged`; without, it is of
    use to this writer alone.
    """

    def __init__(
        self,
        path: Path,
        size: int,
        acknowledged: int = 0,
        record: Callable[[int], None] | None = None,
        running: Running | None = None,
    ) -> None:
        self.path, self._size, self._record, self._running = path, size, record, running
        self._guard = threading.Lock()  # a cancelled request closes while its last write still runs
        self._new = not path.exists()
        self._file = os.fdopen(os.open(path, os.O_RDWR | os.O_CREAT, 0o644), "r+b", buffering=0)
        try:
            fcntl.flock(self._file, fcntl.LOCK_EX | fcntl.LOCK_NB)  # a second server on the same folder
            self.acknowledged = self.offset = min(acknowledged, os.fstat(self._file.fileno()).st_size)
            self._digest = running.take(path, self._file.fileno()) if running and self.offset else hashlib.sha256()
            self._truncate()
            self._writeback = Writeback(self._file.fileno(), self.offset)
        except BlockingIOError:
            self._file.close()
            raise Busy from None
        except BaseException:
            self._file.close()
            raise
        self._sound = self._copy(self._digest)  # of what is acknowledged

    def write(self, block: bytes) -> None:
        if self.offset + len(block) > self._size:
            raise Mismatch(f"more than the announced {self._size} bytes arrived")
        rest = memoryview(block)
        with self._guard:
            while rest:  # unbuffered, so that a full disk leaves `offset` at what was really written
                written = self._file.write(rest)
                self.offset += written
                if self._digest is not None:
                    self._digest.update(rest[:written])
                rest = rest[written:]
            self._writeback.reached(self.offset)

    def acknowledge(self) -> None:
        """Make what was written count."""
        with self._guard:
            os.fsync(self._file.fileno())
        if self._record is not None and self.offset != self.acknowledged:
            if self._new:
                sync_folder(self.path.parent)
                self._new = False
            self._record(self.offset)
        self.acknowledged, self._sound = self.offset, self._copy(self._digest)

    def drop_chunk(self) -> None:
        """Forget what was not acknowledged."""
        with self._guard:
            self.offset, self._digest = self.acknowledged, self._copy(self._sound)
            self._truncate()

    def clear(self) -> None:
        """Start from nothing. The database goes first: it must never promise bytes that are not there."""
        if self._record is not None:
            self._record(0)
        self.acknowledged, self._sound = 0, hashlib.sha256()
        self.drop_chunk()

    def sha256(self) -> str:
        """Of all that was written."""
        if self._digest is not None:
            return self._digest.hexdigest()
        self._file.seek(0)
        return hashlib.file_digest(self._file, "sha256").hexdigest()

    def move_to(self, path: Path) -> None:
        self.path.replace(path)
        sync_folder(path.parent)
        self._sound = None  # it is no part any more

    def close(self) -> None:
        with self._guard:
            if self._running is not None and self._sound is not None and not self._file.closed:
                self._running.keep(self.path, self._file.fileno(), self._sound)
            self._file.close()

    def discard(self) -> None:
        """For who was the only one to have use for it."""
        self.close()
        self.path.unlink(missing_ok=True)

    def _truncate(self) -> None:
        self._file.truncate(self.offset)
        self._file.seek(self.offset)

    @staticmethod
    def _copy(digest: Hash | None) -> Hash | None:
        return None if digest is None else digest.copy()


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
