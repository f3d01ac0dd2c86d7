"""Whether the server can work: cheap to ask, however many do, and true all the same."""

from __future__ import annotations

import asyncio
import time
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest

from server.health import FRESH_S, Pulse
from server.migrations import prepare
from server.settings import Settings
from worker.database import Database


class Queue:
    """Counts who asks."""

    def __init__(self) -> None:
        self.asked = 0
        self.there = True

    def reachable(self) -> bool:
        self.asked += 1
        time.sleep(0.05)
        return self.there

    def live_workers(self) -> int:
        return 1


@pytest.fixture
def settings(tmp_path: Path) -> Settings:
    return Settings(data=tmp_path, disk_floor_mib=0)


@pytest.fixture
def database(settings: Settings) -> Iterator[Database]:
    opened = Database(settings.database)
    prepare(opened)
    yield opened
    opened.close()


def test_a_thousand_who_ask_are_served_by_one_look(database: Database, settings: Settings) -> None:
    queue: Any = Queue()

    async def ask() -> None:
        pulse = Pulse(database, queue, settings)
        answers = await asyncio.gather(*(pulse.now() for _ in range(1000)))
        assert all(answer.ready for answer in answers) and queue.asked == 1
        queue.there = False
        assert (await pulse.now()).ready, "a moment old"
        await asyncio.sleep(FRESH_S + 0.1)
        answers = await asyncio.gather(*(pulse.now() for _ in range(1000)))
        assert not any(answer.redis or answer.ready for answer in answers) and queue.asked == 2

    asyncio.run(ask())


def test_no_writer_is_kept_waiting(database: Database, settings: Settings) -> None:
    """Nor does a look wait for one: not after the first, which has seen that the database takes writers."""
    queue: Any = Queue()

    async def ask() -> None:
        pulse = Pulse(database, queue, settings)
        assert (await pulse.now()).database
        await asyncio.sleep(FRESH_S + 0.1)
        with database.writing():
            began = time.monotonic()
            assert (await pulse.now()).database
            assert time.monotonic() - began < 2

    asyncio.run(ask())


def test_a_database_that_is_away_is_told(database: Database, settings: Settings) -> None:
    queue: Any = Queue()

    async def ask() -> None:
        pulse = Pulse(database, queue, settings)
        assert (await pulse.now()).database
        await asyncio.sleep(FRESH_S + 0.1)
        database.engine.dispose()  # its last connection writes the log back
        (settings.data / "splatct.db").write_bytes(b"no database any more" * 100)
        readiness = await pulse.now()
        assert not readiness.database and not readiness.ready

    asyncio.run(ask())


def test_one_who_leaves_ends_the_look_for_nobody_else(database: Database, settings: Settings) -> None:
    queue: Any = Queue()

    async def ask() -> None:
        pulse = Pulse(database, queue, settings)
        leaving, staying = asyncio.create_task(pulse.now()), asyncio.create_task(pulse.now())
        await asyncio.sleep(0.01)
        leaving.cancel()
        assert (await staying).ready

    asyncio.run(ask())
