"""Makes a job of a request, and of the same request made again the same job."""

from __future__ import annotations

import hashlib
import json
from uuid import UUID, uuid4

from sqlalchemy.exc import DBAPIError, IntegrityError

from server.costs import found
from server.problems import ApiProblem, invalid, not_found
from server.schema import PRIORITIES, JobIn, RestartIn, priority_name
from server.service import Service
from server.store import NewJob, Scan
from server.submissions import Claim, Earlier, Kind
from splatcore.errors import OptionsError, Problem
from splatcore.options import Options
from worker.contract import FINISHED
from worker.fulldisk import is_full
from worker.ledger import Job


def submit(service: Service, body: JobIn, key: str | None) -> tuple[Job, bool]:
    """The job, and whether an earlier request made it."""
    return _submit(service, body, str(uuid4()), None if key is None else Claim(Kind.KEY, key, _digest(body)))


def submit_as(service: Service, body: JobIn, job_id: UUID) -> tuple[Job, bool]:
    """The same with an id that the client chose."""
    return _submit(service, body, str(job_id), Claim(Kind.ID, str(job_id), _digest(body)))


def restart(service: Service, earlier: Job, body: RestartIn, key: str | None) -> tuple[Job, bool]:
    """A new job of an earlier one's scan and options, some of them changed. With the same options it goes on from
    where the earlier one was ended."""
    if earlier.state not in FINISHED:
        raise ApiProblem(409, "not-finished", "The job has not finished; cancel it first.")
    again = JobIn(
        scan_id=UUID(earlier.scan_id),
        options=earlier.options | body.options,
        name=body.name or earlier.name,
        priority=body.priority or priority_name(earlier),
    )
    claim = None if key is None else Claim(Kind.KEY, key, _digest(again, earlier.id))
    return _submit(service, again, str(uuid4()), claim, earlier)


def validate(service: Service, body: JobIn) -> tuple[Scan, Options]:
    """What a request asks for. Raises the 422 that it would be answered with."""
    scan = service.store.scan(str(body.scan_id))
    if scan is None:
        raise invalid("There is no such scan.", [Problem("scan_id", "names no committed scan")])
    try:
        return scan, Options.from_dict(body.options)
    except OptionsError as error:
        raise invalid("An option cannot be used.", [Problem("options", str(error))]) from None


def _submit(
    service: Service, body: JobIn, job_id: str, claim: Claim | None, restarted: Job | None = None
) -> tuple[Job, bool]:
    earlier = None if claim is None else service.store.submissions.find(claim)
    if claim is not None and earlier is not None:  # before all checks: its scan may be gone since
        return _repeated(service, claim, earlier), True
    scan, options = validate(service, body)
    source = None if restarted is None else restarted.id
    size = found(scan, options).disk_bytes
    job = NewJob(job_id, body.name or scan.name, options.to_dict(), claim, PRIORITIES[body.priority], source, size)
    try:
        _queue(service, scan, job)
    except IntegrityError:
        if claim is None:
            raise
        return _lost_race(service, claim), True
    service.wake()
    return service.job(UUID(job_id)), False


def _queue(service: Service, scan: Scan, job: NewJob) -> None:
    """The folder is made under a name of its own and gets the job's in the transaction that wins the id: of two
    requests at once, neither can spoil the folder of the other."""
    made, folder, placed = service.folder(f".new-{uuid4()}"), service.folder(job.id), False

    def place() -> None:
        nonlocal placed
        made.become(folder)
        placed = True

    try:
        made.create(service.intake.scan_folder(scan.id))
        if job.restart_of is not None:
            made.go_on_from(service.folder(job.restart_of))
        queued = service.store.add_job(job, scan, place, service.quotas.job(service.tenant, job.bytes))
    except FileNotFoundError:
        queued = False
    except DBAPIError as error:
        if placed and is_full(error):  # the one error after which the row is surely not there
            folder.remove()
        raise
    finally:
        made.remove()  # nothing is there under that name once it has become the job's
    if not queued:
        raise invalid("There is no such scan.", [Problem("scan_id", "was deleted just now")])


def _lost_race(service: Service, claim: Claim) -> Job:
    earlier = service.store.submissions.find(claim)
    if earlier is None:  # its id is that of a job which was submitted without one, or by another tenant
        raise _other(claim) if service.store.jobs.get(claim.name) else not_found("job")
    return _repeated(service, claim, earlier)


def _repeated(service: Service, claim: Claim, earlier: Earlier) -> Job:
    if earlier.digest != claim.digest:
        raise _other(claim)
    job = service.store.jobs.get(earlier.job_id)
    if job is None:
        hint = "to run it again, submit it under a new one"
        where = _WHERE[claim.kind]
        raise ApiProblem(410, "job-deleted", "The job was deleted.", [Problem(where, "named a job once", hint)])
    return job


_WHERE = {Kind.KEY: "header/idempotency-key", Kind.ID: "path/job_id"}


def _other(claim: Claim) -> ApiProblem:
    hint = "repeat a request unchanged, and give a new one a new UUID"
    fault = Problem(_WHERE[claim.kind], "was used for another request", hint)
    if claim.kind is Kind.KEY:
        return ApiProblem(422, "idempotency-key-reused", "The key was sent with another body before.", [fault])
    return ApiProblem(409, "job-exists", "There is a job of this id, and another request made it.", [fault])


def _digest(body: JobIn, restart_of: str | None = None) -> str:
    """Of what was asked for; how the JSON was laid out is no difference, nor is a default that was written out."""
    asked = body.model_dump(mode="json") | ({} if restart_of is None else {"restart_of": restart_of})
    if asked["priority"] == "normal":
        del asked["priority"]
    return hashlib.sha256(json.dumps(asked, sort_keys=True).encode()).hexdigest()
