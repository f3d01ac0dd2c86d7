"""What one tenant may take of the server: bytes, and jobs at a time.

Both are judged in the transaction that takes them, while no other of the same tenant is open: of two
requests at once that fit only one by one, one is refused.
"""

from __future__ import annotations

from dataclasses import dataclass

import sqlalchemy as sa

from server.problems import ApiProblem
from server.store import Permit, files, uploads
from splatcore.errors import Problem
from worker.contract import ACTIVE
from worker.ledger import jobs

_ADVISORY_LOCK = 0x5155  # the first half of a pair whose second is the tenant
_RETRY_S = 30


@dataclass(frozen=True)
class Quotas:
    """Of each tenant; 0 for no limit."""

    bytes: int
    active_jobs: int

    def room_for(self, tenant: str, size: int) -> Permit:
        """For an upload of so many bytes: what it announces is taken, whether it has come or not."""

        def permit(write: sa.Connection) -> None:
            if not self.bytes:
                return
            if size > self.bytes:
                what = f"the files have {size} bytes together, a tenant may keep {self.bytes}"
                raise ApiProblem(413, "quota-too-small", "The scan is larger than the quota.", [_fault(what)])
            alone(write, tenant)
            used = used_bytes(write, tenant)
            if used + size > self.bytes:
                what = f"{size} bytes are asked for; {used} of {self.bytes} are taken, {self.bytes - used} are free"
                raise ApiProblem(507, "quota-exceeded", "The quota has no room for this upload.", [_fault(what)])

        return permit

    def place_for(self, tenant: str) -> Permit:
        """For one job more."""

        def permit(write: sa.Connection) -> None:
            if not self.active_jobs:
                return
            alone(write, tenant)
            active = active_jobs(write, tenant)
            if active >= self.active_jobs:
                fault = Problem(
                    "jobs", f"{active} are queued or running, {self.active_jobs} may be", "wait for one to end"
                )
                raise ApiProblem(429, "too-many-jobs", "The tenant has enough jobs at work.", [fault], _RETRY_S)

        return permit


def used_bytes(read: sa.Connection, tenant: str) -> int:
    """Of open uploads, as announced, and of scans."""
    query = sa.select(sa.func.coalesce(sa.func.sum(files.c.size), 0)).select_from(
        files.join(uploads, uploads.c.id == files.c.upload_id)
    )
    return int(read.execute(query.where(uploads.c.tenant == tenant)).scalar_one())


def active_jobs(read: sa.Connection, tenant: str) -> int:
    query = sa.select(sa.func.count()).select_from(jobs)
    return int(read.execute(query.where(jobs.c.tenant == tenant, jobs.c.state.in_(list(ACTIVE)))).scalar_one())


def alone(write: sa.Connection, tenant: str) -> None:
    """For the rest of the transaction no other that asks for it has this tenant. SQLite has one writer as it is."""
    if write.dialect.name == "postgresql":
        write.execute(sa.select(sa.func.pg_advisory_xact_lock(_ADVISORY_LOCK, sa.func.hashtext(tenant))))


def _fault(what: str) -> Problem:
    return Problem("files", what, "delete scans or open uploads that are no longer needed; GET /v1/usage tells both")
