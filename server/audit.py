"""The audit log: who sent in, read or deleted what, and when. Rows are added and read, never changed; what
they speak of may be gone.
"""

from __future__ import annotations

import time
from collections.abc import Iterator
from dataclasses import dataclass
from typing import Any

import sqlalchemy as sa

from worker.database import Database, metadata

COMMAND_LINE = "command line"  # in place of an address
_AT_ONCE = 1000

audit = sa.Table(
    "audit",
    metadata,
    sa.Column("id", sa.Integer, primary_key=True),
    sa.Column("at", sa.Float, nullable=False, index=True),  # seconds since 1970, UTC
    sa.Column("tenant", sa.String(64), nullable=False),  # empty for who was not let in
    sa.Column("key_id", sa.String(16)),
    sa.Column("address", sa.String(64), nullable=False),
    sa.Column("action", sa.String(32), nullable=False),
    sa.Column("thing", sa.String(64), nullable=False, index=True),  # id of the upload, scan, job or key
    sa.Column("detail", sa.Text, nullable=False),
    sa.Column("request_id", sa.String(128)),
    sa.Index("ix_audit_tenant_at", "tenant", "at"),
)


@dataclass(frozen=True)
class Deed:
    """What somebody did."""

    tenant: str
    key_id: str | None
    address: str
    action: str
    thing: str
    detail: str = ""
    request_id: str | None = None


@dataclass(frozen=True)
class Wanted:
    """Which entries; None: any."""

    tenant: str | None = None
    key_id: str | None = None
    action: str | None = None
    thing: str | None = None
    since: float | None = None
    until: float | None = None


class AuditLog:
    def __init__(self, database: Database) -> None:
        self._database = database

    def note(self, deed: Deed) -> None:
        with self._database.writing() as write:
            write.execute(audit.insert().values(at=time.time(), **vars(deed)))

    def entries(self, wanted: Wanted) -> Iterator[dict[str, Any]]:
        """Oldest first, a page at a time, however many there are."""
        equal = {"tenant": wanted.tenant, "key_id": wanted.key_id, "action": wanted.action, "thing": wanted.thing}
        chosen = [audit.c[name] == value for name, value in equal.items() if value is not None]
        if wanted.since is not None:
            chosen.append(audit.c.at >= wanted.since)
        if wanted.until is not None:
            chosen.append(audit.c.at < wanted.until)
        last = 0
        while True:
            query = sa.select(audit).where(audit.c.id > last, *chosen).order_by(audit.c.id).limit(_AT_ONCE)
            with self._database.reading() as read:
                rows = [dict(row._mapping) for row in read.execute(query)]
            yield from rows
            if len(rows) < _AT_ONCE:
                return
            last = rows[-1]["id"]
