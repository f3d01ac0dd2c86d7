"""The jobs table: the truth about every job. Redis may be wiped; this may not.

Every change of state is a compare-and-set: UPDATE ... WHERE state and attempt are what the
caller believes. Whoever loses a race changes nothing and learns so. `attempt` is the fence: it
grows whenever a job is taken from a worker, so a worker that comes back too late finds its row gone.
"""

from __future__ import annotations

import time
from collections.abc import Iterable
from dataclasses import dataclass, fields
from typing import Any

import sqlalchemy as sa

from worker.contract import (
    ACTIVE,
    FINISHED,
    LOCAL_TENANT,
    MAX_CRASHES,
    MAX_KILLS,
    TRANSITIONS,
    ErrorKind,
    Priority,
    State,
)
from worker.database import Database, metadata
from worker.outbox import announce

_STATE = sa.Enum(State, native_enum=False, length=16, values_callable=lambda states: [s.value for s in states])

jobs = sa.Table(
    "jobs",
    metadata,
    sa.Column("id", sa.String(36), primary_key=True),
    sa.Column("name", sa.Text, nullable=False),
    sa.Column("scan_id", sa.String(36), nullable=False, index=True),
    sa.Column("scan_name", sa.Text, nullable=False),
    sa.Column("options", sa.JSON, nullable=False),
    sa.Column("state", _STATE, nullable=False, index=True),
    sa.Column("stage", sa.String(32), nullable=False, default=""),
    sa.Column("message", sa.Text, nullable=False, default=""),
    sa.Column("progress", sa.Float, nullable=False, default=0.0),
    sa.Column("eta_s", sa.Float),
    sa.Column("attempt", sa.Integer, nullable=False, default=1),
    sa.Column("crashes", sa.Integer, nullable=False, default=0),
    sa.Column("host", sa.Text),
    sa.Column("heartbeat", sa.Float),
    sa.Column("error_kind", sa.String(32)),
    sa.Column("error_message", sa.Text),
    sa.Column("created_at", sa.Float, nullable=False, index=True),  # seconds since 1970, UTC
    sa.Column("started_at", sa.Float),
    sa.Column("finished_at", sa.Float),
    sa.Column("tenant", sa.String(64), nullable=False, server_default=LOCAL_TENANT),
    sa.Column("priority", sa.Integer, nullable=False, server_default=sa.text("0")),  # worker.contract.Priority
    sa.Column("partial", sa.Boolean, nullable=False, server_default=sa.false()),  # it left a partial result
    sa.Column("restart_of", sa.String(36)),  # the job that it was made from
    sa.Column("pinned", sa.Boolean, nullable=False, server_default=sa.false()),  # kept, however old it grows
    # Of the disk: as estimated until it has ended, then, once measured, what is left of it.
    sa.Column("bytes", sa.BigInteger, nullable=False, server_default=sa.text("0")),
    sa.Column("measured", sa.Boolean, nullable=False, server_default=sa.false(), index=True),
    sa.Index("ix_jobs_tenant_created_at", "tenant", "created_at"),
    sa.Index("ix_jobs_tenant_started_at", "tenant", "started_at"),
)


@dataclass(frozen=True)
class Job:
    """One row of the jobs table."""

    id: str
    name: str
    scan_id: str
    scan_name: str
    options: dict[str, Any]
    state: State
    stage: str
    message: str
    progress: float
    eta_s: float | None
    attempt: int
    crashes: int
    host: str | None
    heartbeat: float | None
    error_kind: str | None
    error_message: str | None
    created_at: float
    started_at: float | None
    finished_at: float | None
    tenant: str
    priority: int
    partial: bool
    restart_of: str | None
    pinned: bool
    bytes: int
    measured: bool


assert [column.name for column in jobs.columns] == [field.name for field in fields(Job)]  # rows become jobs as they are


class Ledger:
    """Reads and changes jobs. Methods that change one return whether the change took place.

    With a `tenant` it knows that one's jobs and no others; without, as workers and the server's own loops
    use it, all.
    """

    def __init__(self, database: Database, tenant: str | None = None) -> None:
        self._database = database
        self._tenant = tenant

    def of(self, tenant: str) -> Ledger:
        return Ledger(self._database, tenant)

    def add(
        self,
        write: sa.Connection,
        job_id: str,
        name: str,
        scan: tuple[str, str],
        options: dict[str, Any],
        priority: Priority = Priority.NORMAL,
        restart_of: str | None = None,
        size: int = 0,
    ) -> None:
        """Insert a queued job within the caller's transaction. `scan` is (id, name); `size`: bytes it may come to."""
        row: dict[str, Any] = {"id": job_id, "name": name, "scan_id": scan[0], "scan_name": scan[1], "options": options}
        row |= {"tenant": self._tenant or LOCAL_TENANT, "priority": int(priority), "restart_of": restart_of}
        row["bytes"] = size
        write.execute(jobs.insert().values(**row, state=State.QUEUED, message="Waiting", created_at=time.time()))

    def get(self, job_id: str) -> Job | None:
        with self._database.reading() as read:
            row = read.execute(sa.select(jobs).where(jobs.c.id == job_id, self._mine())).one_or_none()
        return None if row is None else Job(*row)

    def page(self, state: State | None, limit: int, before: Job | None) -> list[Job]:
        """Jobs, newest first, older than `before`."""
        query = sa.select(jobs).where(self._mine()).order_by(jobs.c.created_at.desc(), jobs.c.id.desc()).limit(limit)
        if state is not None:
            query = query.where(jobs.c.state == state)
        if before is not None:
            query = query.where(sa.tuple_(jobs.c.created_at, jobs.c.id) < (before.created_at, before.id))
        return self._read(query)

    def in_states(self, states: Iterable[State]) -> list[Job]:
        """Jobs in any of `states`, oldest first."""
        query = sa.select(jobs).where(jobs.c.state.in_(list(states))).order_by(jobs.c.created_at, jobs.c.id)
        return self._read(query)

    def many(self, ids: list[str]) -> list[Job]:
        """Those of `ids` that there are."""
        return self._read(sa.select(jobs).where(jobs.c.id.in_(ids)))

    def positions(self, among: Iterable[Job]) -> dict[str, int]:
        """The place of each that is queued among its tenant's, 1 for the one that is next: how many others wait is
        theirs to know."""
        ids = [job.id for job in among if job.state is State.QUEUED]
        if not ids:
            return {}
        places = (
            sa.select(jobs.c.id, _place().label("place")).where(jobs.c.state == State.QUEUED, self._mine()).subquery()
        )
        with self._database.reading() as read:
            found = read.execute(sa.select(places.c.id, places.c.place).where(places.c.id.in_(ids))).all()
        return {job_id: int(place) for job_id, place in found}

    def position(self, job: Job) -> int:
        """That of one queued job; where ten thousand wait, in a quarter of the time that `positions` takes."""
        before = sa.or_(
            jobs.c.priority > job.priority,
            sa.and_(
                jobs.c.priority == job.priority,
                sa.tuple_(jobs.c.created_at, jobs.c.id) < (job.created_at, job.id),
            ),
        )
        ahead = sa.and_(jobs.c.tenant == job.tenant, before)
        query = sa.select(sa.func.count()).select_from(jobs).where(jobs.c.state == State.QUEUED, ahead)
        with self._database.reading() as read:
            return int(read.execute(query).scalar_one()) + 1

    def line(self, limit: int) -> list[Job]:
        """The queued jobs that are next, in order: within a tenant by priority, then by age. Between tenants the one
        with the fewest jobs at work, each waiting one counted to those before it; of equals the one that was served
        the longest time ago. So a tenant with a thousand jobs keeps nobody else waiting for more than one."""
        at_work = (
            sa.select(jobs.c.tenant, sa.func.count().label("jobs"))
            .where(jobs.c.state.in_([State.RUNNING, State.CANCELLING]))
            .group_by(jobs.c.tenant)
            .subquery()
        )
        served = sa.select(jobs.c.tenant, sa.func.max(jobs.c.started_at).label("at")).group_by(jobs.c.tenant).subquery()
        waiting = sa.select(jobs.c.id, _place().label("place")).where(jobs.c.state == State.QUEUED).subquery()
        query = (
            sa.select(jobs)
            .join(waiting, waiting.c.id == jobs.c.id)
            .outerjoin(at_work, at_work.c.tenant == jobs.c.tenant)
            .outerjoin(served, served.c.tenant == jobs.c.tenant)
            .order_by(
                waiting.c.place + sa.func.coalesce(at_work.c.jobs, 0),
                sa.func.coalesce(served.c.at, 0),
                jobs.c.created_at,
                jobs.c.id,
            )
            .limit(limit)
        )
        return self._read(query)

    def needs_scan(self, read: sa.Connection, scan_id: str) -> bool:
        query = sa.select(jobs.c.id).where(jobs.c.scan_id == scan_id, jobs.c.state.in_(list(ACTIVE))).limit(1)
        return read.execute(query).first() is not None

    def claim(self, job_id: str, attempt: int, host: str) -> Job | None:
        """Take a queued attempt for this worker; None when it is not to be had (any more)."""
        now = time.time()
        fresh = {"stage": "start", "message": "Starting", "progress": 0.0, "eta_s": None, "heartbeat": now}
        if not self._move(job_id, attempt, State.QUEUED, State.RUNNING, host=host, started_at=now, **fresh):
            return None
        return self.get(job_id)

    def beat(self, job_id: str, attempt: int, values: dict[str, Any]) -> State | None:
        """Mark the row alive and note progress. Returns its state, None if the job is no longer ours."""
        mine = sa.and_(jobs.c.id == job_id, jobs.c.attempt == attempt)
        alive = jobs.c.state.in_([State.RUNNING, State.CANCELLING])
        update = jobs.update().where(mine, alive).values(heartbeat=time.time(), **values).returning(jobs.c.state)
        with self._database.writing() as write:
            row = write.execute(update).one_or_none()
        return None if row is None else row.state

    def succeed(self, job_id: str, attempt: int) -> bool:
        end = {"stage": "done", "message": "Done", "progress": 1.0}
        return self._move(job_id, attempt, State.RUNNING, State.SUCCEEDED, **end)

    def fail(
        self,
        job_id: str,
        attempt: int,
        kind: ErrorKind,
        message: str,
        was: State = State.RUNNING,
        partial: bool = False,
    ) -> bool:
        error = {"error_kind": kind.value, "error_message": message, "message": "Failed", "partial": partial}
        return self._move(job_id, attempt, was, State.FAILED, **error)

    def end_cancel(self, job_id: str, attempt: int, partial: bool = False) -> bool:
        message = "Cancelled; what there was is kept as a partial result" if partial else "Cancelled"
        return self._move(job_id, attempt, State.CANCELLING, State.CANCELLED, message=message, partial=partial)

    def hand_back(self, job_id: str, attempt: int) -> bool:
        """Queue the job again because its worker was told to stop: nobody's fault, not counted."""
        return self._requeue(job_id, attempt, "Its worker was stopped; waiting for another")

    def crashed(self, job: Job, what: str, advanced: bool = False, by_others: bool = False) -> State | None:
        """Queue the job again after its attempt died, or fail it if that happened too often. Returns what became of it,
        None if it is no longer that attempt's.

        advanced: the attempt kept a state that the next one goes on from; so it was not this job that is to blame, or
        at least it does not die at one place for ever. by_others: it did not die by itself.
        """
        crashes = 1 if advanced else job.crashes + 1
        if crashes < (MAX_KILLS if by_others else MAX_CRASHES):
            again = self._requeue(job.id, job.attempt, f"{what}; waiting to go on", crashes=crashes)
            return State.QUEUED if again else None
        message = f"{what}, {crashes} times without getting further. Its log may say why; restart it then."
        return State.FAILED if self.fail(job.id, job.attempt, ErrorKind.CRASHED, message) else None

    def ask_cancel(self, job_id: str) -> Job | None:
        """Cancel a queued job at once, ask for it when running, leave a finished one alone."""
        for _ in range(5):  # the state may change between look and leap
            job = self.get(job_id)
            if job is None or job.state not in (State.QUEUED, State.RUNNING):
                break
            queued = job.state is State.QUEUED
            goal, text = (State.CANCELLED, "Cancelled") if queued else (State.CANCELLING, "Cancelling")
            if self._move(job_id, job.attempt, job.state, goal, message=text, eta_s=None):
                break
        return self.get(job_id)

    def pin(self, job_id: str, pinned: bool) -> bool:
        """Keep a job from being cleaned away, or no longer; False if there is none."""
        mine = sa.and_(jobs.c.id == job_id, self._mine())
        with self._database.writing() as write:
            return write.execute(jobs.update().where(mine).values(pinned=pinned)).rowcount == 1

    def prioritise(self, job_id: str, priority: Priority) -> bool:
        """Give a job another place in its tenant's queue, the next time it waits; False if it has finished."""
        mine = sa.and_(jobs.c.id == job_id, self._mine(), jobs.c.state.in_(list(ACTIVE)))
        with self._database.writing() as write:
            return write.execute(jobs.update().where(mine).values(priority=int(priority))).rowcount == 1

    def unmeasured(self, most: int) -> list[str]:
        """Jobs that have ended, and of which nobody has measured yet what is left."""
        query = sa.select(jobs.c.id).where(jobs.c.measured == sa.false(), jobs.c.state.in_(list(FINISHED))).limit(most)
        with self._database.reading() as read:
            return list(read.execute(query).scalars())

    def measured(self, sizes: dict[str, int]) -> None:
        """What is left of jobs, in bytes."""
        with self._database.writing() as write:
            for job_id, size in sizes.items():
                write.execute(jobs.update().where(jobs.c.id == job_id).values(bytes=size, measured=True))

    def forget(self, job_id: str) -> bool:
        """Delete the row of a finished job."""
        done = sa.and_(jobs.c.id == job_id, self._mine(), jobs.c.state.in_(list(FINISHED)))
        with self._database.writing() as write:
            return write.execute(jobs.delete().where(done)).rowcount == 1

    def _read(self, query: sa.Select[Any]) -> list[Job]:
        with self._database.reading() as read:
            # All at once and by place: by name and one by one a request for fifty took 5.3 ms, not 3.1.
            return [Job(*row) for row in read.execute(query).all()]

    def _mine(self) -> sa.ColumnElement[bool]:
        return sa.true() if self._tenant is None else jobs.c.tenant == self._tenant

    def _requeue(self, job_id: str, attempt: int, message: str, **values: Any) -> bool:
        fresh = {"stage": "", "progress": 0.0, "eta_s": None, "host": None, "heartbeat": None}
        again = {"attempt": attempt + 1, "message": message, **fresh, **values}
        return self._move(job_id, attempt, State.RUNNING, State.QUEUED, **again)

    def _move(self, job_id: str, attempt: int, old: State, new: State, /, **values: Any) -> bool:
        assert new in TRANSITIONS[old], (old, new)
        if new in FINISHED:
            values = {"finished_at": time.time(), "eta_s": None, **values}
        expected = sa.and_(jobs.c.id == job_id, jobs.c.attempt == attempt, jobs.c.state == old)
        with self._database.writing() as write:
            moved = write.execute(jobs.update().where(expected).values(state=new, **values)).rowcount == 1
            if moved and new in FINISHED:
                job = Job(*write.execute(sa.select(jobs).where(jobs.c.id == job_id)).one())
                announce(write, job.tenant, f"job.{new}", _told(job))
            return moved


def _told(job: Job) -> dict[str, Any]:
    """What webhooks hear of a job."""
    error = None if job.error_kind is None else {"kind": job.error_kind, "message": job.error_message}
    names = {"id": job.id, "name": job.name, "scan_id": job.scan_id, "scan_name": job.scan_name}
    return {**names, "state": job.state, "error": error}


def _place() -> sa.ColumnElement[int]:
    """The order of a tenant's queued jobs, from 1."""
    order = [jobs.c.priority.desc(), jobs.c.created_at, jobs.c.id]
    return sa.func.row_number().over(partition_by=jobs.c.tenant, order_by=order)
