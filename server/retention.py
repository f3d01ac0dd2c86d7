"""What may go, and when: the ends of jobs, scans without jobs, uploads that nobody goes on with, folders without a row.

One list for both, so that a dry run shows what the janitor would take and nothing else.
"""

from __future__ import annotations

import os
from collections.abc import Iterable, Iterator
from dataclasses import dataclass
from pathlib import Path

import sqlalchemy as sa

from server.settings import Settings
from server.store import Store, scans, uploads
from worker.contract import State
from worker.ledger import jobs

DAY_S = 24 * 3600.0
ORPHAN_AGE_S = 3600.0  # a request may be between the making of a folder and that of its row right now


@dataclass(frozen=True)
class Rules:
    """How long each class is kept after its last use, in seconds; None: for ever."""

    results: float | None
    failed: float | None
    scans: float | None
    uploads: float | None

    @classmethod
    def of(cls, settings: Settings) -> Rules:
        def days(number: float) -> float | None:
            return number * DAY_S if number else None

        return cls(
            days(settings.keep_results_days),
            days(settings.keep_failed_days),
            days(settings.keep_scans_days),
            settings.stale_upload_hours * 3600.0,
        )


@dataclass(frozen=True)
class Doomed:
    """Something that may go."""

    kind: str  # results, failed, scan, upload, or orphan: a folder without a row
    id: str
    tenant: str
    name: str
    since: float  # when it was last used
    folder: Path


def doomed(store: Store, data: Path, rules: Rules, now: float) -> list[Doomed]:
    """All that may go now, in the order in which it would."""
    return [*_rows(store, data, rules, now), *_orphans(store, data, now)]


def _rows(store: Store, data: Path, rules: Rules, now: float) -> Iterator[Doomed]:
    with store.database.reading() as read:
        for kind, kept_s in (("results", rules.results), ("failed", rules.failed)):
            if kept_s is not None:
                query = sa.select(jobs.c.id, jobs.c.tenant, jobs.c.name, jobs.c.finished_at)
                for row in read.execute(query.where(job_may_go(kind, now - kept_s)).order_by(jobs.c.finished_at)):
                    yield Doomed(kind, *row, data / "jobs" / row.id)
        if rules.scans is not None:
            query = sa.select(scans.c.id, scans.c.tenant, scans.c.name, _last_use())
            for row in read.execute(query.where(scan_may_go(now - rules.scans)).order_by(_last_use())):
                yield Doomed("scan", *row, data / "scans" / row.id)
        if rules.uploads is not None:
            query = sa.select(uploads.c.id, uploads.c.tenant, uploads.c.name, uploads.c.touched_at)
            for row in read.execute(query.where(upload_may_go(now - rules.uploads)).order_by(uploads.c.touched_at)):
                yield Doomed("upload", *row, data / "uploads" / row.id)


def job_may_go(kind: str, before: float) -> sa.ColumnElement[bool]:
    states = [State.SUCCEEDED] if kind == "results" else [State.FAILED, State.CANCELLED]
    return sa.and_(jobs.c.state.in_(states), ~jobs.c.pinned, jobs.c.finished_at < before)


def scan_may_go(before: float) -> sa.ColumnElement[bool]:
    """Only where no job is left of it: a result can be made again as long as there is its scan."""
    used = sa.exists().where(jobs.c.scan_id == scans.c.id)
    return sa.and_(~scans.c.pinned, ~used, _last_use() < before)


def upload_may_go(before: float) -> sa.ColumnElement[bool]:
    return sa.and_(~uploads.c.committed, uploads.c.touched_at < before)


def _last_use() -> sa.ColumnElement[float]:
    return sa.func.coalesce(scans.c.used_at, scans.c.created_at)


def _orphans(store: Store, data: Path, now: float) -> Iterator[Doomed]:
    """A folder is made before its row and removed after it, so a crash leaves folders, never rows without one."""
    for kind in ("uploads", "scans", "jobs"):
        for folder in sorted((data / kind).iterdir()):
            if not _has_row(store, kind, folder.name):
                since = _changed(folder, now)
                if now - since > ORPHAN_AGE_S:
                    yield Doomed("orphan", folder.name, "", f"{kind}/{folder.name}", since, folder)


def _has_row(store: Store, kind: str, name: str) -> bool:
    if kind == "jobs":
        return store.jobs.get(name) is not None
    upload = store.upload(name)
    if kind == "uploads":
        return upload is not None and not upload.committed
    return upload is not None or store.scan(name) is not None


def _changed(folder: Path, now: float) -> float:
    try:
        return folder.stat().st_mtime
    except FileNotFoundError:  # removed by another just now
        return now


def freed(folders: Iterable[Path]) -> int:
    """Bytes that come free when all of these are deleted. A file that has a name elsewhere too, as in another scan with
    the same content, comes free with the last of its names."""
    names: dict[tuple[int, int], int] = {}
    total = 0
    for folder in folders:
        for place, _, found in os.walk(folder):
            for name in found:
                try:
                    status = (Path(place) / name).lstat()
                except FileNotFoundError:
                    continue
                key = (status.st_dev, status.st_ino)
                names[key] = names.get(key, 0) + 1
                if names[key] == status.st_nlink:
                    total += status.st_size
    return total
