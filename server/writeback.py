"""Begins to write a growing file to its disk long before anybody waits for that.

The kernel by itself lets gigabytes gather in memory first, for all of which the fsync before an upload is acknowledged
would have to wait.
"""

from __future__ import annotations

import os

from server.settings import MIB

EVERY = 8 * MIB


class Writeback:
    """Of one file, written from `start` on."""

    def __init__(self, descriptor: int, start: int = 0) -> None:
        self._descriptor, self._begun = descriptor, start

    def reached(self, offset: int) -> None:
        """So much has been written. Does not wait for the disk; promises nothing."""
        if offset - self._begun >= EVERY:
            # Linux writes out what it is told will not be needed; what is still on its way stays in memory.
            os.posix_fadvise(self._descriptor, self._begun, offset - self._begun, os.POSIX_FADV_DONTNEED)
            self._begun = offset
