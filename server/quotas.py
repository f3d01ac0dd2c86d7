"""What one tenant may take of the server: bytes, jobs at a time, open uploads.

All are judged in the transaction that takes them, while no other of the same tenant is open: of two
requests at once that fit only one by one, one is refused.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import sqlalchemy as sa

from server.problems import ApiProblem
from server.settings import Settings
from server.store import Permit, files, uploads
from splatcore.errors import Problem
from worker.contract import ACTIVE
from worker.database import Database, alone, metadata
from worker.ledger import jobs

_RETRY_S = 30

overrides = sa.Table(
    "tenant_quotas",
    metadata,
    sa.Column("tenant", sa.String(64), primary_key=True),
    # Null: as the settings have it; 0: no limit.
    sa.Column("bytes", sa.BigInteger),
    sa.Column("active_jobs", sa.Integer),
    sa.Column("open_uploads", sa.Integer),
)


@dataclass(frozen=True)
class Quotas:
    """Of each tenant that has none of its own; 0 for no limit."""

    bytes: int = 0
    active_jobs: int = 0
    open_uploads: int = 0

    @classmethod
    def from_settings(cls, settings: Settings) -> Quotas:
        return cls(round(settings.tenant_gib * (1 << 30)), settings.tenant_jobs, settings.tenant_uploads)

    def of(self, read: sa.Connection, tenant: str) -> Quotas:
        """That tenant's."""
        row = read.execute(sa.select(overrides).where(overrides.c.tenant == tenant)).one_or_none()
        if row is None:
            return self
        own = {name: value for name, value in row._mapping.items() if name != "tenant" and value is not None}
        return replace(self, **own)

    def bytes_left(self, read: sa.Connection, tenant: str) -> int | None:
        """None: there is no limit."""
        limit = self.of(read, tenant).bytes
        return max(0, limit - used_bytes(read, tenant)) if limit else None

    def upload(self, tenant: str, size: int) -> Permit:
        """For a new upload of so many bytes."""

        def permit(write: sa.Connection) -> None:
            alone(write, tenant)
            most, there = self.of(write, tenant).open_uploads, open_uploads(write, tenant)
            if most and there >= most:
                fault = Problem("uploads", f"{there} are open, {most} may be", "commit or delete some of them")
                raise ApiProblem(429, "too-many-uploads", "The tenant has enough open uploads.", [fault], _RETRY_S)
            self.files(tenant, size)(write)

        return permit

    def files(self, tenant: str, size: int) -> Permit:
        """For files of so many bytes: what is announced is taken, whether it has come or not."""

        def permit(write: sa.Connection) -> None:
            alone(write, tenant)
            limit = self.of(write, tenant).bytes
            if limit and size > limit:
                what = f"the files have {size} bytes together, a tenant may keep {limit}"
                raise ApiProblem(413, "quota-too-small", "The scan is larger than the quota.", [_fault("files", what)])
            _require_room(write, tenant, limit, size, "files", "The quota has no room for this upload.")

        return permit

    def job(self, tenant: str, size: int) -> Permit:
        """For one job more, that may come to so many bytes."""

        def permit(write: sa.Connection) -> None:
            alone(write, tenant)
            limits, active = self.of(write, tenant), active_jobs(write, tenant)
            if limits.active_jobs and active >= limits.active_jobs:
                what = f"{active} are queued or running, {limits.active_jobs} may be"
                fault = Problem("jobs", what, "wait for one to end")
                raise ApiProblem(429, "too-many-jobs", "The tenant has enough jobs at work.", [fault], _RETRY_S)
            _require_room(write, tenant, limits.bytes, size, "job", "The quota has no room for what the job may write.")

        return permit


def set_own(database: Database, tenant: str, wanted: dict[str, int | None]) -> None:
    """Some of a tenant's quotas, by the names of `Quotas`: 0 for no limit, None for that of all."""
    mine = overrides.c.tenant == tenant
    with database.writing() as write:
        if not write.execute(overrides.update().where(mine).values(**wanted)).rowcount:
            write.execute(overrides.insert().values(tenant=tenant, **wanted))


def used_bytes(read: sa.Connection, tenant: str) -> int:
    """Of open uploads, as announced, of scans, and of jobs: as estimated while they wait or run, then as they lie
    there."""
    sent = sa.select(sa.func.coalesce(sa.func.sum(files.c.size), 0)).select_from(
        files.join(uploads, uploads.c.id == files.c.upload_id)
    )
    made = sa.select(sa.func.coalesce(sa.func.sum(jobs.c.bytes), 0)).where(jobs.c.tenant == tenant)
    return int(read.execute(sent.where(uploads.c.tenant == tenant)).scalar_one()) + int(read.execute(made).scalar_one())


def active_jobs(read: sa.Connection, tenant: str) -> int:
    query = sa.select(sa.func.count()).select_from(jobs)
    return int(read.execute(query.where(jobs.c.tenant == tenant, jobs.c.state.in_(list(ACTIVE)))).scalar_one())


def open_uploads(read: sa.Connection, tenant: str) -> int:
    query = sa.select(sa.func.count()).select_from(uploads)
    return int(read.execute(query.where(uploads.c.tenant == tenant, ~uploads.c.committed)).scalar_one())


def _require_room(write: sa.Connection, tenant: str, limit: int, size: int, where: str, detail: str) -> None:
    used = used_bytes(write, tenant) if limit else 0
    if limit and used + size > limit:
        what = f"{size} bytes are asked for; {used} of {limit} are taken, {max(0, limit - used)} are free"
        raise ApiProblem(507, "quota-exceeded", detail, [_fault(where, what)])


def _fault(where: str, what: str) -> Problem:
    hint = "delete jobs, scans or open uploads that are no longer needed; GET /v1/usage tells how much all take"
    return Problem(where, what, hint)
