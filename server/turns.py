"""One writer for each file on its way: whoever comes last takes over.

A client whose connection died silently comes back long before the server notices. So the newcomer
never waits for the old request to time out: that one is told to leave, saves what it has, and goes.
"""

from __future__ import annotations

import asyncio
import contextlib
from collections.abc import AsyncIterator

import anyio


class Turn:
    """The right to write one file. Receive inside `scope`, which a newcomer cancels; save after it."""

    def __init__(self) -> None:
        self.scope = anyio.CancelScope()


class _Place:
    def __init__(self) -> None:
        self.lock = asyncio.Lock()
        self.newest: Turn | None = None
        self.here = 0


class Turns:
    """For one event loop."""

    def __init__(self) -> None:
        self._places: dict[tuple[str, str], _Place] = {}

    @contextlib.asynccontextmanager
    async def take(self, upload_id: str, name: str) -> AsyncIterator[Turn]:
        key = upload_id, name
        place = self._places.setdefault(key, _Place())
        turn, place.here = Turn(), place.here + 1
        if place.newest is not None:  # at work, or still waiting: then it leaves as soon as it gets in
            place.newest.scope.cancel()
        place.newest = turn
        try:
            async with place.lock:
                yield turn
        finally:
            place.here -= 1
            if not place.here:
                del self._places[key]
