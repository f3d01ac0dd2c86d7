"""From a request's body to a file, in constant memory: while a thread works on one block, the next one gathers."""

from __future__ import annotations

import asyncio
from collections.abc import Callable
from types import TracebackType
from typing import Self

import anyio
from anyio import to_thread

from server.settings import MIB

BLOCK = MIB


class Spool:
    """Hands the pieces it is given to `work`, in blocks and in order, one call at a time, in threads.

    What `work` raises is raised by the next call here, or at the end of the `async with`, which waits for the last
    block in any case: after it nothing works any more. A cancelled request loses no piece that it has given.
    """

    def __init__(self, work: Callable[[bytes], None]) -> None:
        self._work = work
        self._gathered: list[bytes] = []
        self._bytes = 0
        self._at_work: asyncio.Task[None] | None = None

    async def give(self, piece: bytes) -> None:
        self._gathered.append(piece)
        self._bytes += len(piece)
        if self._bytes >= BLOCK:
            await self._hand_over()

    async def empty(self) -> None:
        """Have all that was given worked on, and wait for it."""
        await self._hand_over()
        await self._settle()

    async def __aenter__(self) -> Self:
        return self

    async def __aexit__(
        self, kind: type[BaseException] | None, error: BaseException | None, at: TracebackType | None
    ) -> None:
        await self._settle()

    async def _hand_over(self) -> None:
        await self._settle()
        pieces, self._gathered, self._bytes = self._gathered, [], 0
        self._at_work = asyncio.create_task(to_thread.run_sync(lambda: self._work(b"".join(pieces))))

    async def _settle(self) -> None:
        """Also where the request has been cancelled: its file must not be closed under a thread that writes to it."""
        task, self._at_work = self._at_work, None
        if task is not None:
            with anyio.CancelScope(shield=True):
                await task
