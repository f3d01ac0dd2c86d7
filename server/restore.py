"""Makes a data folder from a backup: everything that was recorded, and jobs that were at work in the queue again.

The database is put in its place last. A restore that was cut short leaves a folder without one, which no server
takes for its own.
"""

from __future__ import annotations

import contextlib
import os
import shutil
import sqlite3
from dataclasses import dataclass
from pathlib import Path

import sqlalchemy as sa

from server.archive import DATABASE, BackupError, Copier, Manifest
from server.intake import Intake
from server.migrations import prepare
from server.settings import Settings
from server.store import Store, files, parts, scans, uploads
from worker.contract import ACTIVE, State
from worker.database import Database
from worker.jobfolder import JobFolder, link_or_copy, sync_folder
from worker.ledger import jobs


@dataclass(frozen=True)
class Restored:
    scans: int
    jobs: int
    queued: int  # jobs that will run
    dropped: tuple[str, ...]  # what a database of its own spoke of, and the backup has not


def restore(settings: Settings, source: Path) -> Restored:
    """Into an empty data folder. Raises BackupError, and then there is no database in it."""
    manifest = Manifest.read(source)
    _require_sound(manifest, source)
    if manifest.database and settings.database_url:
        raise BackupError(
            "the backup holds a SQLite database, and SPLATCT_DATABASE_URL names another: unset it, or restore the "
            "backup that was made with --files-only"
        )
    if not manifest.database and not settings.database_url:
        raise BackupError(
            "the backup holds files alone (--files-only): restore the database with pg_restore first, then name it "
            "in SPLATCT_DATABASE_URL and run this again"
        )
    data = settings.data.absolute()
    _require_empty(data, source, manifest)
    try:
        return _made(settings, manifest, source.absolute(), data)
    except OSError as error:
        raise BackupError(
            f"{data}: the backup cannot be restored: {error.strerror or error}; empty the folder, then try again"
        ) from error


def _require_sound(manifest: Manifest, source: Path) -> None:
    faults = list(manifest.verify(source))
    if faults:
        raise BackupError(f"{source} is damaged; restore from another backup:\n" + "\n".join(faults[:20]))


def _require_empty(data: Path, source: Path, manifest: Manifest) -> None:
    if data.exists() and (not data.is_dir() or next(data.iterdir(), None) is not None):
        raise BackupError(f"data: {data} is not an empty folder; name a new one with --data, or move that one away")
    if data.is_relative_to(source.absolute()):
        raise BackupError(f"data: {data} lies in the backup itself; choose another folder")
    data.mkdir(parents=True, exist_ok=True, mode=0o700)
    needed, free = sum(entry.size for entry in manifest.files), shutil.disk_usage(data).free
    if needed > free:
        raise BackupError(f"{needed} bytes are to be restored, {free} are free at {data}; choose a larger disk")


def _made(settings: Settings, manifest: Manifest, source: Path, data: Path) -> Restored:
    Intake(data)
    (data / "jobs").mkdir()
    for job_id in manifest.jobs:
        JobFolder(data, job_id).path.mkdir()
    copier, part = Copier(), data / f".{DATABASE}.part"
    for entry in manifest.files:
        copied = copier.copy(source / entry.path, data, part.name if entry.path == DATABASE else entry.path)
        if copied.sha256 != entry.sha256:
            raise BackupError(f"{source / entry.path} changed while it was copied; restore again")
    copier.sync()
    database = Database(f"sqlite:///{part}" if manifest.database else settings.database)
    try:
        prepare(database)
        restored = _settle(Store(database), data, manifest)
    finally:
        database.close()
    for folder in ("scans", "jobs"):
        sync_folder(data / folder)
    if manifest.database:
        _close(part)
        part.rename(data / DATABASE)
    sync_folder(data)
    return restored


def _settle(store: Store, data: Path, manifest: Manifest) -> Restored:
    """Bring the rows in line with what is here: no worker works, no upload is open."""
    dropped = _drop_strangers(store.database, manifest)
    for job in store.jobs.in_states([State.RUNNING]):
        store.jobs.hand_back(job.id, job.attempt)  # a higher attempt: a worker that still lives somewhere is fenced
    for job in store.jobs.in_states([State.CANCELLING]):
        store.jobs.end_cancel(job.id, job.attempt)
    waiting = store.jobs.in_states(ACTIVE)
    for job in waiting:
        folder = JobFolder(data, job.id)
        folder.scan.mkdir(exist_ok=True)
        scan = data / "scans" / job.scan_id
        for file in scan.iterdir() if scan.is_dir() else ():  # without one the job will fail, and say so
            link_or_copy(file, folder.scan / file.name)
        folder.lock_file.touch()
        sync_folder(folder.scan)
        sync_folder(folder.path)
    return Restored(len(manifest.scans), len(manifest.jobs), len(waiting), tuple(dropped))


def _drop_strangers(database: Database, manifest: Manifest) -> list[str]:
    """Rows of which the backup has nothing: open uploads, and what came or went between the two halves of a backup."""
    with database.writing() as write:
        lost_scans = set(write.execute(sa.select(scans.c.id)).scalars()) - set(manifest.scans)
        lost_jobs = set(write.execute(sa.select(jobs.c.id)).scalars()) - set(manifest.jobs)
        unsent = set(write.execute(sa.select(uploads.c.id).where(~uploads.c.committed)).scalars())
        for one in unsent | lost_scans:
            for column in (parts.c.upload_id, files.c.upload_id, uploads.c.id, scans.c.id):
                write.execute(column.table.delete().where(column == one))
        for one in lost_jobs:
            write.execute(jobs.delete().where(jobs.c.id == one))
    return [*(f"scans/{one}" for one in sorted(lost_scans)), *(f"jobs/{one}" for one in sorted(lost_jobs))]


def _close(file: Path) -> None:
    """One file again, with no log beside it, and on the disk."""
    with contextlib.closing(sqlite3.connect(file)) as connection:
        connection.execute("PRAGMA journal_mode=DELETE")
    with file.open("rb") as written:
        os.fsync(written.fileno())
