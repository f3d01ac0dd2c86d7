"""Routes about jobs: submit, list, cancel, forget. Those for who waits for one are in `server.follow`."""

from __future__ import annotations

from typing import Annotated, Any
from uuid import UUID

from fastapi import APIRouter, Header, Query, Response
from fastapi.responses import PlainTextResponse, StreamingResponse

from server import costs
from server.answers import job_out, jobs_out, retry_after
from server.problems import ApiProblem, not_found
from server.schema import PRIORITIES, EstimateOut, EventList, JobChangeIn, JobIn, JobList, JobOut, RestartIn
from server.service import Served, Service
from server.submit import restart, submit, submit_as, validate
from splatcore.options import describe
from worker.contract import State
from worker.journal import read_events
from worker.ledger import Job
from worker.redaction import Redaction

router = APIRouter(prefix="/v1", tags=["jobs"])

MOST_EVENTS = 5000


@router.get("/options")
def get_options() -> dict[str, list[dict[str, Any]]]:
    return {"options": describe()}


IdempotencyKey = Annotated[
    str | None, Header(pattern=r"^[!-~]{1,255}$", description="the same key with the same body: the same job, for 24 h")
]


@router.post("/jobs", status_code=202)
def submit_job(body: JobIn, service: Served, response: Response, idempotency_key: IdempotencyKey = None) -> JobOut:
    return _submitted(service, response, *submit(service, body, idempotency_key))


@router.post("/jobs/validate")
def validate_job(body: JobIn, service: Served) -> EstimateOut:
    """What the job would cost. Nothing is run or queued; what cannot be used is refused as a submission would be."""
    return costs.of(service, *validate(service, body))


@router.put("/jobs/{job_id}", status_code=202)
def put_job(job_id: UUID, body: JobIn, service: Served, response: Response) -> JobOut:
    """Submit under an id of the client's own. Repeated with the same body: the job; with another: 409."""
    return _submitted(service, response, *submit_as(service, body, job_id))


@router.get("/jobs", response_model=JobList)
def list_jobs(
    service: Served,
    state: State | None = None,
    limit: Annotated[int, Query(ge=1, le=500)] = 50,
    before: UUID | None = None,
) -> Response:
    """Newest first. `before` is the id of a job; older ones are listed."""
    jobs = service.store.jobs.page(state, limit + 1, None if before is None else service.job(before))
    more = len(jobs) > limit
    jobs = jobs[:limit]
    listed = JobList(jobs=jobs_out(service, jobs), next=jobs[-1].id if more else None)
    return Response(listed.model_dump_json(), media_type="application/json")  # as it is: fifty need no second check


@router.patch("/jobs/{job_id}")
def change_job(job_id: UUID, body: JobChangeIn, service: Served) -> JobOut:
    """Another place in the queue: the one thing of a job that can be changed after it was submitted."""
    job = service.job(job_id)
    if not service.store.jobs.prioritise(job.id, PRIORITIES[body.priority]):
        raise ApiProblem(409, "finished", f"The job is {job.state}: its place in the queue matters no more.")
    return job_out(service, service.job(job_id))


@router.post("/jobs/{job_id}/cancel", status_code=202)
def cancel_job(job_id: UUID, service: Served, response: Response) -> JobOut:
    job = service.store.jobs.ask_cancel(str(job_id))
    if job is None:
        raise not_found("job")
    if job.state is State.CANCELLED:  # it was queued, so that nobody else will clear away what it has no more use for
        service.folder(job.id).tidy()
    return _answer(service, job, response)


@router.post("/jobs/{job_id}/restart", status_code=202)
def restart_job(
    job_id: UUID,
    service: Served,
    response: Response,
    body: RestartIn | None = None,
    idempotency_key: IdempotencyKey = None,
) -> JobOut:
    """A new job from a finished one, with some options changed; unchanged, it goes on from where that was ended."""
    return _submitted(service, response, *restart(service, service.job(job_id), body or RestartIn(), idempotency_key))


@router.delete("/jobs/{job_id}", status_code=204)
def delete_job(job_id: UUID, service: Served) -> None:
    job = service.job(job_id)
    service.outcomes.catch_up()
    if not service.reserve.deleting(lambda: service.store.forget_job(job)):
        raise ApiProblem(409, "not-finished", "The job has not finished; cancel it first.")
    service.folder(str(job_id)).remove()
    service.reserve.fill()


@router.get("/jobs/{job_id}/events")
def get_events(job_id: UUID, service: Served, after: Annotated[int, Query(ge=0)] = 0) -> EventList:
    """Events numbered above `after`, at most 5000 at a time."""
    events = read_events(service.folder(service.job(job_id).id).events, after, MOST_EVENTS)
    return EventList(events=events, last=events[-1]["number"] if events else after)


@router.get("/jobs/{job_id}/log", response_class=PlainTextResponse)
def get_log(
    job_id: UUID,
    service: Served,
    last: Annotated[int | None, Query(ge=1, le=1 << 30, description="bytes: no more than these, whole lines")] = None,
) -> Response:
    """What the engine said, without the places where things lie on the server."""
    folder = service.folder(service.job(job_id).id)
    redacted = Redaction(service.settings.data, folder.path)
    return StreamingResponse(redacted.log(folder.log, last), media_type="text/plain")


def _submitted(service: Service, response: Response, job: Job, replayed: bool) -> JobOut:
    response.headers["Location"] = f"/v1/jobs/{job.id}"
    if replayed:
        response.headers["Idempotency-Replayed"] = "true"
    return _answer(service, job, response)


def _answer(service: Service, job: Job, response: Response) -> JobOut:
    response.headers.update(retry_after(job.state))
    return job_out(service, job)
