"""Uploads and scans in the database, beside the jobs table of `worker.ledger`."""

from __future__ import annotations

import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Any
from uuid import uuid4

import sqlalchemy as sa

from server.submissions import Claim, Submissions
from worker.contract import LOCAL_TENANT, Priority
from worker.database import Database, metadata
from worker.ledger import Job, Ledger

uploads = sa.Table(
    "uploads",
    metadata,
    sa.Column("id", sa.String(36), primary_key=True),
    sa.Column("name", sa.Text, nullable=False),
    sa.Column("committed", sa.Boolean, nullable=False, default=False),
    sa.Column("created_at", sa.Float, nullable=False),
    sa.Column("touched_at", sa.Float, nullable=False),
    sa.Column("tenant", sa.String(64), nullable=False, server_default=LOCAL_TENANT),
    sa.Index("ix_uploads_tenant_created_at", "tenant", "created_at"),
)

files = sa.Table(
    "upload_files",
    metadata,
    sa.Column("upload_id", sa.String(36), sa.ForeignKey("uploads.id", ondelete="CASCADE"), primary_key=True),
    sa.Column("name", sa.String(255), primary_key=True),
    sa.Column("position", sa.Integer, nullable=False),
    sa.Column("size", sa.BigInteger, nullable=False),
    sa.Column("expected_sha256", sa.String(64)),
    sa.Column("sha256", sa.String(64), index=True),  # of the bytes on disk; null until complete
)

parts = sa.Table(
    "upload_parts",
    metadata,
    sa.Column("upload_id", sa.String(36), sa.ForeignKey("uploads.id", ondelete="CASCADE"), primary_key=True),
    sa.Column("name", sa.String(255), primary_key=True),
    sa.Column("acknowledged", sa.BigInteger, nullable=False),  # that many bytes of the part are durable
)

scans = sa.Table(
    "scans",
    metadata,
    sa.Column("id", sa.String(36), primary_key=True),  # that of its upload
    sa.Column("name", sa.Text, nullable=False),
    sa.Column("bytes", sa.BigInteger, nullable=False),
    sa.Column("facts", sa.JSON, nullable=False),
    sa.Column("created_at", sa.Float, nullable=False, index=True),
    sa.Column("tenant", sa.String(64), nullable=False, server_default=LOCAL_TENANT),
    sa.Column("pinned", sa.Boolean, nullable=False, server_default=sa.false()),  # kept, however old it grows
    sa.Column("used_at", sa.Float),  # when a job of it last came or went
    sa.Index("ix_scans_tenant_created_at", "tenant", "created_at"),
)

_FILES_AND_PARTS = files.outerjoin(parts, sa.and_(parts.c.upload_id == files.c.upload_id, parts.c.name == files.c.name))
_FILE = (
    files.c.name,
    files.c.size,
    files.c.expected_sha256,
    files.c.sha256,
    sa.func.coalesce(parts.c.acknowledged, 0),
)


@dataclass(frozen=True)
class File:
    name: str
    size: int
    expected_sha256: str | None
    sha256: str | None
    acknowledged: int = 0  # bytes of an incomplete file that are here

    @property
    def received(self) -> int:
        return self.size if self.sha256 else self.acknowledged


@dataclass(frozen=True)
class Upload:
    id: str
    name: str
    committed: bool
    created_at: float
    files: tuple[File, ...]

    def missing(self) -> list[str]:
        return [file.name for file in self.files if file.sha256 is None]


@dataclass(frozen=True)
class Scan:
    id: str
    name: str
    bytes: int
    facts: dict[str, Any]
    created_at: float
    tenant: str
    pinned: bool = False
    used_at: float | None = None


@dataclass(frozen=True)
class NewJob:
    id: str
    name: str
    options: dict[str, Any]
    claim: Claim | None = None
    priority: Priority = Priority.NORMAL
    restart_of: str | None = None
    bytes: int = 0  # that it may come to


Permit = Callable[[sa.Connection], None]


def _always(_write: sa.Connection) -> None:
    """For who has no quota."""


def _file_rows(upload_id: str, announced: Sequence[File], first: int) -> list[dict[str, Any]]:
    return [
        {"upload_id": upload_id, "position": n, "name": f.name, "size": f.size, "expected_sha256": f.expected_sha256}
        for n, f in enumerate(announced, first)
    ]


class Store:
    """Everything the server keeps, on one database.

    With a `tenant` it finds what is that one's and nothing else, whatever id it is asked for: this is where
    ownership is checked. Without, for the server's own loops, it finds all, and what it makes is `local`'s.
    """

    def __init__(self, database: Database, tenant: str | None = None) -> None:
        self.database = database
        self.tenant = tenant
        self.jobs = Ledger(database, tenant)
        self.submissions = Submissions(database, tenant)

    def of(self, tenant: str) -> Store:
        return Store(self.database, tenant)

    def _mine(self, table: sa.Table) -> sa.ColumnElement[bool]:
        return sa.true() if self.tenant is None else table.c.tenant == self.tenant

    # Uploads

    def add_upload(
        self, name: str, announced: Sequence[File], permit: Permit = _always, upload_id: str | None = None
    ) -> Upload:
        """`permit` may refuse by raising; it sees what there is, and what comes after it cannot change that.

        Raises IntegrityError if there is an upload of that id, whosever it is."""
        upload_id, now = upload_id or str(uuid4()), time.time()
        with self.database.writing() as write:
            permit(write)
            row = {"id": upload_id, "name": name, "committed": False, "created_at": now, "touched_at": now}
            write.execute(uploads.insert().values(**row, tenant=self.tenant or LOCAL_TENANT))
            if announced:
                write.execute(files.insert(), _file_rows(upload_id, announced, 0))
        return Upload(upload_id, name, False, now, tuple(announced))

    def upload(self, upload_id: str) -> Upload | None:
        with self.database.reading() as read:
            row = read.execute(sa.select(uploads).where(uploads.c.id == upload_id, self._mine(uploads))).one_or_none()
            if row is None:
                return None
            query = (
                sa.select(*_FILE)
                .select_from(_FILES_AND_PARTS)
                .where(files.c.upload_id == upload_id)
                .order_by(files.c.position)
            )
            announced = tuple(File(*file) for file in read.execute(query))
        return Upload(row.id, row.name, row.committed, row.created_at, announced)

    def upload_file(self, upload_id: str, name: str) -> tuple[bool, File] | None:
        """Whether the upload is committed, and one of its files."""
        if "\0" in name:  # PostgreSQL fails on it
            return None
        query = (
            sa.select(uploads.c.committed, *_FILE)
            .select_from(_FILES_AND_PARTS.join(uploads, uploads.c.id == files.c.upload_id))
            .where(files.c.upload_id == upload_id, files.c.name == name, self._mine(uploads))
        )
        with self.database.reading() as read:
            row = read.execute(query).one_or_none()
        return None if row is None else (row.committed, File(*row[1:]))

    def received(self, upload_id: str, name: str, sha256: str) -> None:
        mine = sa.and_(files.c.upload_id == upload_id, files.c.name == name)
        with self.database.writing() as write:
            write.execute(files.update().where(mine).values(sha256=sha256))
            write.execute(parts.delete().where(parts.c.upload_id == upload_id, parts.c.name == name))
            write.execute(uploads.update().where(uploads.c.id == upload_id).values(touched_at=time.time()))

    def received_all(self, upload_id: str, digests: dict[str, str]) -> None:
        """Files that are complete without having been sent, by name."""
        with self.database.writing() as write:
            for name, sha256 in digests.items():
                mine = sa.and_(files.c.upload_id == upload_id, files.c.name == name)
                write.execute(files.update().where(mine).values(sha256=sha256))

    def add_files(
        self, upload_id: str, judge: Callable[[Sequence[File]], list[File]], permit: Callable[[int], Permit]
    ) -> list[File] | None:
        """Announce more files of an open upload; None if it is none. `judge` is shown the files that are there, and
        says which are to be added, or refuses by raising, as `permit` for the bytes of these may."""
        with self.database.writing() as write:
            is_open = sa.and_(uploads.c.id == upload_id, self._mine(uploads), ~uploads.c.committed)
            touched = uploads.update().where(is_open).values(touched_at=time.time())
            if not write.execute(touched).rowcount:  # this row is ours until the end: others who add files wait
                return None
            columns = (files.c.name, files.c.size, files.c.expected_sha256, files.c.sha256)
            there = [File(*row) for row in write.execute(sa.select(*columns).where(files.c.upload_id == upload_id))]
            new = judge(there)
            permit(sum(file.size for file in new))(write)
            if new:
                write.execute(files.insert(), _file_rows(upload_id, new, len(there)))
        return new

    def acknowledge(self, upload_id: str, name: str, offset: int) -> None:
        """So many bytes of a file that arrives in pieces are durable."""
        mine = sa.and_(parts.c.upload_id == upload_id, parts.c.name == name)
        with self.database.writing() as write:
            if not write.execute(parts.update().where(mine).values(acknowledged=offset)).rowcount:
                write.execute(parts.insert().values(upload_id=upload_id, name=name, acknowledged=offset))
            write.execute(uploads.update().where(uploads.c.id == upload_id).values(touched_at=time.time()))

    def outstanding_bytes(self) -> int:
        """Announced by open uploads, whosever they are, and not yet here: disk that is spoken for."""
        still_to_come = files.c.size - sa.func.coalesce(parts.c.acknowledged, 0)
        query = sa.select(sa.func.coalesce(sa.func.sum(still_to_come), 0)).select_from(
            _FILES_AND_PARTS.join(uploads, uploads.c.id == files.c.upload_id)
        )
        with self.database.reading() as read:
            return int(read.execute(query.where(~uploads.c.committed, files.c.sha256.is_(None))).scalar_one())

    def drop_upload(self, upload_id: str) -> bool:
        """Forget an open upload."""
        is_open = sa.and_(uploads.c.id == upload_id, self._mine(uploads), ~uploads.c.committed)
        with self.database.writing() as write:
            if write.execute(uploads.select().where(is_open)).first() is None:
                return False
            write.execute(parts.delete().where(parts.c.upload_id == upload_id))
            write.execute(files.delete().where(files.c.upload_id == upload_id))
            write.execute(uploads.delete().where(is_open))
            return True

    # Scans

    def commit(self, upload: Upload, facts: dict[str, Any]) -> Scan:
        size, tenant = sum(file.size for file in upload.files), self.tenant or LOCAL_TENANT
        scan = Scan(upload.id, upload.name, size, facts, time.time(), tenant)
        with self.database.writing() as write:
            write.execute(uploads.update().where(uploads.c.id == upload.id).values(committed=True))
            write.execute(scans.insert().values(**vars(scan)))
        return scan

    def scan(self, scan_id: str) -> Scan | None:
        with self.database.reading() as read:
            row = read.execute(sa.select(scans).where(scans.c.id == scan_id, self._mine(scans))).one_or_none()
        return None if row is None else Scan(*row)

    def scans(self) -> list[Scan]:
        query = sa.select(scans).where(self._mine(scans)).order_by(scans.c.created_at.desc(), scans.c.id).limit(1000)
        with self.database.reading() as read:
            return [Scan(*row) for row in read.execute(query)]

    def pin_scan(self, scan_id: str, pinned: bool) -> bool:
        """Keep a scan from being cleaned away, or no longer; False if there is none."""
        mine = sa.and_(scans.c.id == scan_id, self._mine(scans))
        with self.database.writing() as write:
            return write.execute(scans.update().where(mine).values(pinned=pinned)).rowcount == 1

    def drop_scan(self, scan_id: str) -> bool:
        """Forget a scan, and the upload it came from; False while a job needs it."""
        with self.database.writing() as write:
            mine = sa.and_(scans.c.id == scan_id, self._mine(scans))
            if write.execute(sa.select(scans.c.id).where(mine)).first() is None or self.jobs.needs_scan(write, scan_id):
                return False
            write.execute(scans.delete().where(scans.c.id == scan_id))
            write.execute(parts.delete().where(parts.c.upload_id == scan_id))
            write.execute(files.delete().where(files.c.upload_id == scan_id))
            write.execute(uploads.delete().where(uploads.c.id == scan_id))
            return True

    # Jobs

    def add_job(self, job: NewJob, scan: Scan, place: Callable[[], None], permit: Permit = _always) -> bool:
        """Queue a job; False if the scan was deleted meanwhile. One transaction with `drop_scan`'s check.

        `place` puts the job's folder where it belongs, once id and claim are ours and before others see them.
        Raises IntegrityError if another request took either.
        """
        with self.database.writing() as write:
            mine = sa.and_(scans.c.id == scan.id, self._mine(scans))
            if write.execute(sa.select(scans.c.id).where(mine)).first() is None:
                return False
            permit(write)
            write.execute(scans.update().where(mine).values(used_at=time.time()))
            named = (scan.id, scan.name)
            self.jobs.add(write, job.id, job.name, named, job.options, job.priority, job.restart_of, job.bytes)
            if job.claim is not None:
                self.submissions.add(write, job.claim, job.id)
            place()
            return True

    def forget_job(self, job: Job) -> bool:
        """Delete the row of a finished job. Its scan is unused from now on, not from whenever it was sent."""
        with self.database.writing() as write:
            write.execute(scans.update().where(scans.c.id == job.scan_id).values(used_at=time.time()))
        return self.jobs.forget(job.id)
