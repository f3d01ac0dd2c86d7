"""How a job is answered: its representation, and when to ask again."""

from __future__ import annotations

from collections.abc import Sequence

from server.schema import JobOut
from server.service import Service
from worker.contract import FINISHED, State
from worker.ledger import Job

_POLL_S = {State.QUEUED: 5}  # all others: 1


def job_out(service: Service, job: Job) -> JobOut:
    return JobOut.of(job, service.store.jobs.position(job) if job.state is State.QUEUED else None)


def jobs_out(service: Service, jobs: Sequence[Job]) -> list[JobOut]:
    """Many, with one look at the queue."""
    queue = service.store.jobs.positions(jobs)
    return [JobOut.of(job, queue.get(job.id)) for job in jobs]


def retry_after(state: State) -> dict[str, str]:
    """The header for whoever polls; none when nothing will change any more."""
    return {} if state in FINISHED else {"Retry-After": str(_POLL_S.get(state, 1))}
