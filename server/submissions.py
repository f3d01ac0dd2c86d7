"""What was submitted under a name of the client's own, so that a repeated request finds its job and makes no second.

A name is an Idempotency-Key, remembered for a day, or the id of a job that the client chose, remembered
for a day and as long as there is the job. The row is written in the transaction that queues the job.
"""

from __future__ import annotations

import time
from dataclasses import dataclass
from enum import StrEnum

import sqlalchemy as sa

from worker.contract import LOCAL_TENANT
from worker.database import Database, metadata
from worker.ledger import jobs

KEPT_S = 24 * 3600.0


class Kind(StrEnum):
    KEY = "key"
    ID = "id"


submissions = sa.Table(
    "submissions",
    metadata,
    sa.Column("tenant", sa.String(64), primary_key=True),
    sa.Column("kind", sa.String(8), primary_key=True),
    sa.Column("name", sa.String(255), primary_key=True),
    sa.Column("digest", sa.String(64), nullable=False),  # of the request's body
    sa.Column("job_id", sa.String(36), nullable=False),
    sa.Column("created_at", sa.Float, nullable=False, index=True),
)


@dataclass(frozen=True)
class Claim:
    """A request's name, and the digest of its body."""

    kind: Kind
    name: str
    digest: str


@dataclass(frozen=True)
class Earlier:
    """The job that was made under the same name before."""

    job_id: str
    digest: str


class Submissions:
    """Of one tenant, as all tenants may choose the same names; without one, the machine's own."""

    def __init__(self, database: Database, tenant: str | None = None) -> None:
        self._database = database
        self._tenant = tenant or LOCAL_TENANT

    def find(self, claim: Claim) -> Earlier | None:
        query = sa.select(submissions.c.job_id, submissions.c.digest).where(self._named(claim), ~_outdated())
        with self._database.reading() as read:
            row = read.execute(query).one_or_none()
        return None if row is None else Earlier(*row)

    def add(self, write: sa.Connection, claim: Claim, job_id: str) -> None:
        """Within the caller's transaction. Raises IntegrityError if another took the name first."""
        row = {"tenant": self._tenant, "kind": claim.kind.value, "name": claim.name}
        write.execute(submissions.delete().where(self._named(claim), _outdated()))
        write.execute(submissions.insert().values(**row, digest=claim.digest, job_id=job_id, created_at=time.time()))

    def purge(self) -> None:
        """Forget what is not remembered any more, of all tenants. Apart from `add`, where two at once might lock each
        other out."""
        with self._database.writing() as write:
            write.execute(submissions.delete().where(_outdated()))

    def _named(self, claim: Claim) -> sa.ColumnElement[bool]:
        named = sa.tuple_(submissions.c.kind, submissions.c.name) == (claim.kind.value, claim.name)
        return sa.and_(submissions.c.tenant == self._tenant, named)


def _outdated() -> sa.ColumnElement[bool]:
    gone = submissions.c.job_id.not_in(sa.select(jobs.c.id))
    return sa.and_(submissions.c.created_at < time.time() - KEPT_S, sa.or_(submissions.c.kind == Kind.KEY.value, gone))
