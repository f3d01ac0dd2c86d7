"""A job's events as server-sent events: replayed from the number that the reader has, then as they come."""

from __future__ import annotations

from collections.abc import AsyncIterator

from fastapi.concurrency import run_in_threadpool
from fastapi.sse import ServerSentEvent

from server.schema import JobOut
from server.service import Service
from server.watch import Eye
from worker.contract import FINISHED
from worker.journal import Cursor

_AT_ONCE = 500


async def follow(service: Service, eye: Eye, after: int, rows: bool) -> AsyncIterator[ServerSentEvent]:
    """Events numbered above `after`, and `end` when the job has finished and all were given. With `rows` also the job,
    as `job`, whenever it has changed; these have no number, and the first says how it is now.

    Ends without `end` when the server stops; the reader comes back with the last id that it saw.
    """
    cursor, last, told = Cursor(service.folder(eye.job_id).events), after, None
    while (sight := await eye.news()) is not None:
        while (lines := eye.tail.since(last)) != []:
            if lines is None:
                lines = await run_in_threadpool(cursor.read, _AT_ONCE, last)
            if not lines:
                break  # the journal was deleted, and so is the job
            for line in lines:
                yield ServerSentEvent(raw_data=line.text, id=str(line.number))
            last = lines[-1].number
        if sight.job is None or sight.job.state in FINISHED:
            data = None if sight.job is None else JobOut.of(sight.job, sight.queue_position)
            yield ServerSentEvent(event="end", data=data or {}, id=str(last) if last else None)
            return
        if rows and (now := JobOut.of(sight.job, sight.queue_position)) != told:
            told = now
            yield ServerSentEvent(event="job", data=now)
