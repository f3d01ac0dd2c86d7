"""The way of a body into its file: in order, a block at a time, and nothing at work after the end."""

from __future__ import annotations

import asyncio
import threading

import anyio
import pytest

from server.spool import BLOCK, Spool

PIECES = [bytes([n]) * (BLOCK // 3) for n in range(20)]


def test_all_arrives_in_order_and_in_blocks() -> None:
    blocks: list[bytes] = []

    async def run() -> None:
        async with Spool(blocks.append) as spool:
            for piece in PIECES:
                await spool.give(piece)
            await spool.empty()

    asyncio.run(run())
    assert b"".join(blocks) == b"".join(PIECES)
    assert all(BLOCK <= len(block) < 2 * BLOCK for block in blocks[:-1])


def test_the_next_block_gathers_while_one_is_at_work_and_no_more_than_one() -> None:
    at_work, go_on, given = threading.Event(), threading.Event(), 0

    def work(_block: bytes) -> None:
        at_work.set()
        assert go_on.wait(30)

    async def run() -> None:
        async with Spool(work) as spool:

            async def give_all() -> None:
                nonlocal given
                for piece in PIECES:
                    await spool.give(piece)
                    given += 1

            giving = asyncio.create_task(give_all())
            await asyncio.to_thread(at_work.wait, 30)
            await asyncio.sleep(0.2)
            held_up = given
            go_on.set()
            await giving
            assert 4 <= held_up <= 8 and given == len(PIECES)

    asyncio.run(run())


def test_what_the_thread_raises_ends_the_request() -> None:
    seen: list[int] = []

    def work(block: bytes) -> None:
        seen.append(len(block))
        raise OSError(28, "No space left on device")

    async def run(pieces: list[bytes]) -> None:
        async with Spool(work) as spool:
            for piece in pieces:
                await spool.give(piece)
            await spool.empty()

    for pieces in (PIECES, PIECES[:1], PIECES[:4]):
        seen.clear()
        with pytest.raises(OSError, match="No space left"):
            asyncio.run(run(pieces))
        assert len(seen) == 1


def test_a_cancelled_request_waits_for_its_thread_and_loses_nothing_it_gave() -> None:
    blocks: list[bytes] = []
    at_work, go_on = threading.Event(), threading.Event()

    def work(block: bytes) -> None:
        at_work.set()
        assert go_on.wait(30)
        blocks.append(block)

    async def run() -> None:
        async with Spool(work) as spool:
            scope, given = anyio.CancelScope(), []

            async def give_for_ever() -> None:
                with scope:
                    for piece in PIECES:
                        given.append(piece)
                        await spool.give(piece)
                        await asyncio.sleep(0)

            giving = asyncio.create_task(give_for_ever())
            await asyncio.to_thread(at_work.wait, 30)
            scope.cancel()
            asyncio.get_running_loop().call_later(0.1, go_on.set)
            await giving
            assert scope.cancelled_caught and 0 < len(given) < len(PIECES)
            await spool.empty()
            assert b"".join(blocks) == b"".join(given)

    asyncio.run(run())


def test_an_end_by_an_error_waits_for_the_thread() -> None:
    ended: list[bool] = []

    def work(_block: bytes) -> None:
        threading.Event().wait(0.2)
        ended.append(True)

    async def run() -> None:
        async with Spool(work) as spool:
            for piece in PIECES[:4]:
                await spool.give(piece)
            raise RuntimeError("the client has gone")

    with pytest.raises(RuntimeError, match="has gone"):
        asyncio.run(run())
    assert ended == [True]
