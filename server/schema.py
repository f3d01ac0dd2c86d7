"""The wire: what the API takes and gives. docs/http.md in types; the only definition of them."""

from __future__ import annotations

from datetime import UTC, datetime
from typing import Annotated, Any, Literal
from uuid import UUID

from pydantic import BaseModel, ConfigDict, Field, model_validator

from worker.contract import FINISHED, Priority, State
from worker.ledger import Job

# None that a terminal, a log or a page would obey: controls, line ends, turns of direction.
_PLAIN = r"^[^\x00-\x1f\x7f-\x9f\u061c\u200e\u200f\u2028-\u202e\u2066-\u2069]+$"
Name = Annotated[str, Field(min_length=1, max_length=200, pattern=_PLAIN)]


class Body(BaseModel):
    """Base of request bodies: unknown fields are refused."""

    model_config = ConfigDict(extra="forbid")


class FileIn(Body):
    name: Annotated[str, Field(min_length=1, max_length=1024)]
    size: Annotated[int, Field(ge=1, le=1 << 50, description="bytes")]
    sha256: Annotated[str, Field(pattern=r"^[0-9a-fA-F]{64}$")] | None = None


class UploadIn(Body):
    name: Name
    files: Annotated[list[FileIn], Field(max_length=50_000)]
    growing: bool = Field(default=False, description="more files, scan.json too perhaps, are announced later")

    @model_validator(mode="after")
    def _has_files(self) -> UploadIn:
        if not self.files and not self.growing:
            raise ValueError("files: is empty, expected at least scan.json; an upload that is growing may begin so")
        return self


class FilesIn(Body):
    files: Annotated[list[FileIn], Field(min_length=1, max_length=50_000)]


class ImportIn(Body):
    folder: Annotated[str, Field(min_length=1, max_length=4096, description="the allowed folder's name, then / below")]
    name: Name | None = Field(default=None, description="of the scan; default: that in scan.json")


PriorityName = Literal["low", "normal", "high"]


class JobIn(Body):
    scan_id: UUID
    options: dict[str, Any] = Field(default_factory=dict, description="see GET /v1/options")
    name: Name | None = None
    priority: PriorityName = Field(default="normal", description="among the jobs of the same tenant")


class RestartIn(Body):
    options: dict[str, Any] = Field(default_factory=dict, description="those that change; the others stay")
    name: Name | None = None
    priority: PriorityName | None = Field(default=None, description="default: that of the earlier job")


class JobChangeIn(Body):
    priority: PriorityName


class EstimateOut(BaseModel):
    """What a job would cost; nothing was run."""

    memory_bytes: int
    seconds: float = Field(description="rough")
    disk_bytes: int = Field(description="of results, and of the state while it runs")
    memory_free_bytes: int = Field(description="for the engine, on the server's machine; 0: unknown")
    disk_free_bytes: int
    options: dict[str, Any] = Field(description="all of them, defaults filled in")
    warnings: list[str]


class SessionIn(Body):
    key: Annotated[str, Field(min_length=1, max_length=4096)]


class SessionOut(BaseModel):
    tenant: str
    key_id: str | None = Field(description="null where there are no keys")
    scopes: list[str]
    expires_at: datetime | None = Field(description="of the session; null for who sends a key")
    csrf: str | None = Field(description="to be sent as X-CSRF-Token; null without a session")


class FileOut(BaseModel):
    name: str
    size: int
    received: int
    complete: bool
    sha256: str | None = Field(description="of the bytes received; null until complete")


class FileList(BaseModel):
    files: list[FileOut]


class UploadOut(BaseModel):
    id: str
    name: str
    state: str = Field(description="open or committed")
    files: list[FileOut]
    scan_id: str | None
    created_at: datetime
    links: dict[str, str]


class ScanOut(BaseModel):
    id: str
    name: str
    bytes: int
    facts: dict[str, Any]
    pinned: bool = Field(description="kept, however old it grows")
    created_at: datetime
    links: dict[str, str]


class ScanList(BaseModel):
    scans: list[ScanOut]


class ErrorOut(BaseModel):
    kind: str
    message: str


class JobOut(BaseModel):
    id: str
    name: str
    scan_id: str
    scan_name: str
    state: State
    stage: str
    message: str
    progress: float = Field(ge=0, le=1)
    eta_s: float | None
    queue_position: int | None = Field(description="1 is next; null unless queued")
    attempt: int
    priority: PriorityName
    restart_of: str | None = Field(description="the job that it was made from")
    pinned: bool = Field(description="kept, however old it grows")
    options: dict[str, Any]
    created_at: datetime
    started_at: datetime | None
    finished_at: datetime | None
    error: ErrorOut | None
    links: dict[str, str]

    @classmethod
    def of(cls, job: Job, position: int | None) -> JobOut:
        error = None if job.error_kind is None else ErrorOut(kind=job.error_kind, message=job.error_message or "")
        return cls(
            id=job.id,
            name=job.name,
            scan_id=job.scan_id,
            scan_name=job.scan_name,
            state=job.state,
            stage=job.stage,
            message=job.message,
            progress=job.progress,
            eta_s=job.eta_s,
            queue_position=position,
            attempt=job.attempt,
            priority=priority_name(job),
            restart_of=job.restart_of,
            pinned=job.pinned,
            options=job.options,
            created_at=moment(job.created_at),
            started_at=None if job.started_at is None else moment(job.started_at),
            finished_at=None if job.finished_at is None else moment(job.finished_at),
            error=error,
            links=_job_links(job),
        )


_PRIORITY_NAMES: dict[Priority, PriorityName] = {
    Priority.LOW: "low", Priority.NORMAL: "normal", Priority.HIGH: "high",
}  # fmt: skip
PRIORITIES = {name: priority for priority, name in _PRIORITY_NAMES.items()}


def priority_name(job: Job) -> PriorityName:
    return _PRIORITY_NAMES[Priority(job.priority)]


class JobList(BaseModel):
    jobs: list[JobOut]
    next: str | None = Field(description="give it as `before` for the next page; null on the last")


class JobNews(BaseModel):
    ids: list[str] = Field(description="the newest jobs there are, newest first")
    jobs: list[JobOut] = Field(description="those of them that the reader was not told of yet, or told otherwise")
    more: bool = Field(description="there are older ones")


class EventList(BaseModel):
    events: list[dict[str, Any]] = Field(description="progress events with number, at, attempt, stage, fraction, …")
    last: int = Field(description="number of the last event given; pass it as `after` next time")


Event = Literal["job.succeeded", "job.failed", "job.cancelled"]


class WebhookIn(Body):
    url: Annotated[str, Field(min_length=1, max_length=2000)]
    events: Annotated[set[Event], Field(min_length=1)] = {"job.succeeded", "job.failed", "job.cancelled"}


class WebhookOut(BaseModel):
    id: str
    url: str
    events: list[str]
    created_at: datetime
    secret: str | None = Field(description="what signatures are made with; told once, when the webhook is made")


class WebhookList(BaseModel):
    webhooks: list[WebhookOut]


class DeliveryOut(BaseModel):
    id: str = Field(description="the `webhook-id` of the message, the same in every attempt")
    job_id: str
    event: str
    state: str = Field(description="waiting, delivered or given up")
    attempts: int
    status: int | None = Field(description="of the last answer")
    error: str | None = Field(description="of the last attempt")
    created_at: datetime
    delivered_at: datetime | None
    next_at: datetime | None


class DeliveryList(BaseModel):
    deliveries: list[DeliveryOut]


class Taken(BaseModel):
    used: int
    limit: int | None = Field(description="null: none")


class Usage(BaseModel):
    bytes: Taken = Field(description="announced by open uploads, of scans, and of jobs: estimated until they end")
    active_jobs: Taken = Field(description="queued or running")
    open_uploads: Taken = Field(description="not yet committed")


class Readiness(BaseModel):
    ready: bool
    database: bool
    redis: bool
    disk: bool
    workers: int


def moment(seconds: float) -> datetime:
    return datetime.fromtimestamp(seconds, UTC)


def _job_links(job: Job) -> dict[str, str]:
    base = f"/v1/jobs/{job.id}"
    links = {"self": base, "scan": f"/v1/scans/{job.scan_id}", "events": f"{base}/events", "log": f"{base}/log"}
    links["stream"] = f"{base}/events/stream"
    if job.state is State.SUCCEEDED:
        links |= {"results": f"{base}/results", "report": f"{base}/report"}
    elif job.partial:
        links |= {"partial": f"{base}/partial", "report": f"{base}/report"}
    if job.state in FINISHED:
        links["restart"] = f"{base}/restart"
    elif job.state in (State.QUEUED, State.RUNNING):
        links["cancel"] = f"{base}/cancel"
    return links
