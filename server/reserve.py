"""A file that holds a little of the disk, so that things can still be deleted when all else of it is taken.

Deleting writes: SQLite appends the change to its log before anything is gone. On a disk that is full to the last
byte that fails, and with it the one way to make room. Then this file is given up, the deletion done with what it
held, and the file made anew from what the deletion freed.
"""

from __future__ import annotations

import contextlib
import logging
import os
import threading
from collections.abc import Callable
from pathlib import Path
from typing import TypeVar

from worker.fulldisk import is_full

log = logging.getLogger("splatct.server")

T = TypeVar("T")


class Reserve:
    def __init__(self, data: Path, size: int) -> None:
        self._file = data / ".reserve"
        self._size = size
        self._lock = threading.Lock()

    def fill(self) -> bool:
        """Take the space, if it is to be had. Real blocks: a sparse file would hold nothing."""
        with self._lock:
            if self._held() == self._size:
                return True
            try:
                descriptor = os.open(self._file, os.O_RDWR | os.O_CREAT, 0o600)
                try:
                    os.ftruncate(descriptor, self._size)
                    if self._size:
                        os.posix_fallocate(descriptor, 0, self._size)
                finally:
                    os.close(descriptor)
            except OSError as error:
                with contextlib.suppress(FileNotFoundError):
                    self._file.unlink()
                if not is_full(error):
                    log.warning("the reserve of %d bytes in %s cannot be made (%s)", self._size, self._file, error)
                return False
            return True

    def release(self) -> bool:
        """Whether that made any room."""
        with self._lock:
            held = self._held()
            self._file.unlink(missing_ok=True)
        if held:
            log.warning("the disk is full: the reserve of %d bytes is given up to delete something", held)
        return bool(held)

    def deleting(self, delete: Callable[[], T]) -> T:
        """Do it, with the reserve if the disk is full. `delete` may be tried a second time."""
        try:
            return delete()
        except Exception as error:
            if not is_full(error) or not self.release():
                raise
        return delete()

    def _held(self) -> int:
        try:
            return self._file.stat().st_size
        except FileNotFoundError:
            return 0
