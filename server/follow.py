"""Routes for who waits for jobs: the state of one, at once or when it changes; its events as they come; the list.

Nobody who waits here holds a thread; `server.watch` looks for all of them.
"""

from __future__ import annotations

import asyncio
from collections.abc import AsyncIterator
from typing import Annotated
from uuid import UUID

from fastapi import APIRouter, Depends, Header, Query, Request, Response
from fastapi.concurrency import run_in_threadpool
from fastapi.sse import EventSourceResponse, ServerSentEvent

from server import stream
from server.answers import job_out, retry_after
from server.etags import matches, weak_etag
from server.schema import JobOut
from server.service import Served, Service
from server.watch import Eye, Listing, Sight
from worker.contract import FINISHED

router = APIRouter(prefix="/v1", tags=["jobs"])

LONGEST_S = 60
_STILL_THERE_S = 2.0  # how often we ask whether the caller is: who has left must not take a place


@router.get(
    "/jobs/{job_id}",
    response_model=JobOut,
    responses={304: {"description": "as `If-None-Match` names it, still"}},
)
async def get_job(
    job_id: UUID,
    request: Request,
    service: Served,
    response: Response,
    wait: Annotated[float, Query(ge=0, le=LONGEST_S, description="seconds to wait for a change")] = 0,
    if_none_match: Annotated[str | None, Header()] = None,
) -> JobOut | Response:
    """The job. With `wait`: as soon as it differs from what `If-None-Match` names, or else from what it is now."""
    out = await run_in_threadpool(_now, service, job_id)
    known = if_none_match or weak_etag(out)
    if wait and out.state not in FINISHED and matches(known, weak_etag(out)):
        out = await _changed(request, service, out, known, wait)
    headers = {"ETag": weak_etag(out), "Cache-Control": "no-cache", **retry_after(out.state)}
    if matches(if_none_match, headers["ETag"]):
        return Response(status_code=304, headers=headers)
    response.headers.update(headers)
    return out


async def _following(job_id: UUID, service: Served) -> AsyncIterator[Eye[Sight]]:
    """An eye on the job as long as the stream lasts; a 404 or 503 before it begins."""
    job = await run_in_threadpool(service.job, job_id)
    with service.watch.on(job.id, service.tenant, events=True) as eye:
        yield eye


@router.get("/jobs/{job_id}/events/stream", response_class=EventSourceResponse)
async def stream_events(
    job_id: UUID,
    eye: Annotated[Eye[Sight], Depends(_following)],
    service: Served,
    after: Annotated[int, Query(ge=0)] = 0,
    job: Annotated[bool, Query(description="tell, too, whenever the job itself changes: `event: job`")] = False,
    last_event_id: Annotated[int | None, Header(ge=0)] = None,
) -> AsyncIterator[ServerSentEvent]:
    """Events numbered above `Last-Event-ID` (or `after`) as they come; `end`, with the job, is the last."""
    async for event in stream.follow(service, str(job_id), eye, after if last_event_id is None else last_event_id, job):
        yield event


async def _watching(service: Served) -> AsyncIterator[Eye[Listing]]:
    with service.watch.on_list(service.tenant) as eye:
        yield eye


@router.get("/events", response_class=EventSourceResponse)
async def stream_jobs(eye: Annotated[Eye[Listing], Depends(_watching)]) -> AsyncIterator[ServerSentEvent]:
    """The tenant's 50 newest jobs as they change: `event: jobs`, at once and whenever there is news."""
    async for event in stream.follow_list(eye):
        yield event


def _now(service: Service, job_id: UUID) -> JobOut:
    return job_out(service, service.job(job_id))


async def _changed(request: Request, service: Service, out: JobOut, known: str, wait_s: float) -> JobOut:
    """The job once it differs from `known`, or as it is when the time is over."""
    loop = asyncio.get_running_loop()
    deadline = loop.time() + wait_s
    with service.watch.on(out.id, service.tenant) as eye:
        while (left := deadline - loop.time()) > 0:
            sight = await eye.news(min(left, _STILL_THERE_S))
            if sight is None and not service.watch.closed and not await request.is_disconnected():
                continue
            if sight is None or sight.job is None:
                break
            out = JobOut.of(sight.job, sight.queue_position)
            if out.state in FINISHED or not matches(known, weak_etag(out)):
                break
    return out
