"""Makes a job of a request, and of the same request made again the same job."""

from __future__ import annotations

import hashlib
import json
from uuid import UUID, uuid4

from sqlalchemy.exc import IntegrityError

from server.problems import ApiProblem, invalid, not_found
from server.schema import JobIn
from server.service import Service
from server.store import NewJob, Scan
from server.submissions import Claim, Earlier, Kind
from splatcore.errors import OptionsError, Problem
from splatcore.options import Options
from worker.ledger import Job


def submit(service: Service, body: JobIn, key: str | None) -> tuple[Job, bool]:
    """The job, and whether an earlier request made it."""
    return _submit(service, body, str(uuid4()), None if key is None else Claim(Kind.KEY, key, _digest(body)))


def submit_as(service: Service, body: JobIn, job_id: UUID) -> tuple[Job, bool]:
    """The same with an id that the client chose."""
    return _submit(service, body, str(job_id), Claim(Kind.ID, str(job_id), _digest(body)))


def _submit(service: Service, body: JobIn, job_id: str, claim: Claim | None) -> tuple[Job, bool]:
    earlier = None if claim is None else service.store.submissions.find(claim)
    if claim is not None and earlier is not None:  # before all checks: its scan may be gone since
        return _repeated(service, claim, earlier), True
    scan = service.store.scan(str(body.scan_id))
    if scan is None:
        raise invalid("There is no such scan.", [Problem("scan_id", "names no committed scan")])
    try:
        options = Options.from_dict(body.options).to_dict()
    except OptionsError as error:
        raise invalid("An option cannot be used.", [Problem("options", str(error))]) from None
    try:
        _queue(service, scan, NewJob(job_id, body.name or scan.name, options, claim))
    except IntegrityError:
        if claim is None:
            raise
        return _lost_race(service, claim), True
    service.wake()
    return service.job(UUID(job_id)), False


def _queue(service: Service, scan: Scan, job: NewJob) -> None:
    """The folder is made under a name of its own and gets the job's in the transaction that wins the id: of two
    requests at once, neither can spoil the folder of the other."""
    made, folder = service.folder(f".new-{uuid4()}"), service.folder(job.id)
    try:
        made.create(service.intake.scan_folder(scan.id))
        queued = service.store.add_job(job, scan, lambda: made.become(folder), service.quotas.place_for(service.tenant))
    except FileNotFoundError:
        queued = False
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


def _digest(body: JobIn) -> str:
    """Of what was asked for; how the JSON was laid out is no difference."""
    return hashlib.sha256(json.dumps(body.model_dump(mode="json"), sort_keys=True).encode()).hexdigest()
