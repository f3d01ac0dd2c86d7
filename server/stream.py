"""Server-sent events: those of a job, replayed from the number that the reader has, then as they come; and a tenant's
list of jobs, as it changes.
"""

from __future__ import annotations

from collections.abc import AsyncIterator

from fastapi.concurrency import run_in_threadpool
from fastapi.sse import ServerSentEvent

from server.schema import JobNews, JobOut
from server.service import Service
from server.watch import Eye, Listing, Sight
from worker.contract import FINISHED
from worker.journal import Cursor

_AT_ONCE = 500


async def follow(
    service: Service, job_id: str, eye: Eye[Sight], after: int, rows: bool
) -> AsyncIterator[ServerSentEvent]:
    """Events numbered above `after`, and `end` when the job has finished and all were given. With `rows` also the job,
    as `job`, whenever it has changed; these have no number, and the first says how it is now.

    Ends without `end` when the server stops; the reader comes back with the last id that it saw.
    """
    cursor, last, told = Cursor(service.folder(job_id).events), after, None
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


async def follow_list(eye: Eye[Listing]) -> AsyncIterator[ServerSentEvent]:
    """The newest jobs as `jobs`, at first and after each change: which they are, and those of them that are new to the
    reader or not as it was told. Ends when the server stops."""
    told: dict[str, JobOut] = {}
    while (listing := await eye.news()) is not None:
        changed = [job for job_id, job in listing.jobs.items() if told.get(job_id) != job]
        told = listing.jobs
        yield ServerSentEvent(event="jobs", data=JobNews(ids=list(told), jobs=changed, more=listing.more))
