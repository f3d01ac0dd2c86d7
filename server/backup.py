"""Makes a backup of a server that may be running.

The database comes first, as it was at one moment; then the files that it speaks of. Scans and results never change
once they are recorded, so what is copied later is still what the database meant. What was deleted in between leaves
the copy of the database, too. Open uploads are not kept: their bytes still come, and a client begins again.
"""

from __future__ import annotations

import contextlib
import json
import os
import shutil
import sqlite3
from collections.abc import Iterator
from datetime import UTC, datetime
from pathlib import Path

import sqlalchemy as sa

import splatcore
from server.archive import DATABASE, BackupError, Copier, Entry, Manifest, digest
from server.settings import Settings
from server.store import Store, files, parts, scans, uploads
from worker.contract import State
from worker.database import Database
from worker.jobfolder import JobFolder
from worker.ledger import Job, jobs


def back_up(settings: Settings, target: Path, files_only: bool) -> Manifest:
    """Raises BackupError, and then there is no backup. What it names as damaged is damaged in the data folder."""
    if settings.database_url and not files_only:
        raise BackupError(
            "the database is not a file of ours (SPLATCT_DATABASE_URL is set), so this command cannot copy it: run "
            "pg_dump first, then `splatct backup DEST --files-only`, and keep both together"
        )
    if files_only and not settings.database_url:
        raise BackupError("--files-only is for a database server's database; this one is a file: leave the option out")
    if target.exists():
        raise BackupError(f"{target} exists, expected the name of a new folder; choose another")
    part = target.with_name(f".{target.name}.part")
    if part.exists():
        raise BackupError(f"{part} is left of a backup that was cut short, or is being made; delete it if none runs")
    try:
        part.mkdir(parents=True, mode=0o700)
        manifest = _made(settings, part, files_only)
        part.rename(target)
        return manifest
    except OSError as error:
        raise BackupError(f"{target}: the backup cannot be written: {error.strerror or error}") from error
    finally:
        shutil.rmtree(part, ignore_errors=True)


def _made(settings: Settings, folder: Path, files_only: bool) -> Manifest:
    live = Database(settings.database)
    copier = Copier()
    try:
        if files_only:
            backup = _Backup(settings.data, folder, live, live, copier)
            backup.copy_all()
        else:
            _snapshot(settings.data / DATABASE, folder / DATABASE)
            with _opened(folder / DATABASE) as copy:
                backup = _Backup(settings.data, folder, live, copy, copier)
                backup.copy_all()
                backup.forget_what_is_gone()
            backup.entries.append(_entry(folder / DATABASE))
    finally:
        live.close()
    copier.sync()
    manifest = Manifest(
        made_at=datetime.now(UTC).isoformat(timespec="seconds"),
        software=splatcore.__version__,
        database=not files_only,
        scans=tuple(backup.scans),
        jobs=tuple(backup.jobs),
        files=tuple(backup.entries),
        damaged=tuple(backup.damaged),
    )
    manifest.write(folder)
    return manifest


class _Backup:
    def __init__(self, data: Path, folder: Path, live: Database, copy: Database, copier: Copier) -> None:
        self._data, self._folder, self._live, self._copy, self._copier = data, folder, live, copy, copier
        self.entries: list[Entry] = []
        self.scans: list[str] = []
        self.jobs: list[str] = []
        self.damaged: list[str] = []
        self._gone_scans: list[str] = []
        self._gone_jobs: list[str] = []

    def copy_all(self) -> None:
        with self._copy.reading() as read:
            scan_ids = list(read.execute(sa.select(scans.c.id).order_by(scans.c.created_at)).scalars())
            job_ids = list(read.execute(sa.select(jobs.c.id).order_by(jobs.c.created_at)).scalars())
        self._require_room(scan_ids, job_ids)
        for scan_id in scan_ids:
            self._copy_scan(scan_id)
        ledger = Store(self._copy).jobs
        for job_id in job_ids:
            job = ledger.get(job_id)
            if job is not None:
                self._copy_job(job)

    def _require_room(self, scan_ids: list[str], job_ids: list[str]) -> None:
        needed = sum(_bytes(self._data / "scans" / name) for name in scan_ids)
        for job in (JobFolder(self._data, name) for name in job_ids):
            needed += sum(map(_bytes, (job.results, job.partial, job.events, job.log, job.checkpoint)))
        free = shutil.disk_usage(self._folder).free
        if needed > free:
            raise BackupError(f"{needed} bytes are to be copied, {free} are free there; choose a disk with more room")

    def _copy_scan(self, scan_id: str) -> None:
        query = sa.select(files.c.name, files.c.sha256).where(files.c.upload_id == scan_id)
        with self._copy.reading() as read:
            recorded = list(read.execute(query))
        made: list[Entry] = []
        try:
            for name, sha256 in recorded:
                path = f"scans/{scan_id}/{name}"
                made.append(self._copier.copy(self._data / path, self._folder, path))
                if made[-1].sha256 != sha256:
                    self.damaged.append(f"{path}: its sha256 is {made[-1].sha256}, at its commit it was {sha256}")
        except FileNotFoundError as error:
            if self._still_there(scans, scan_id):
                self.damaged.append(f"scans/{scan_id}: {Path(str(error.filename)).name} is missing")
            else:
                shutil.rmtree(self._folder / "scans" / scan_id, ignore_errors=True)
                self._gone_scans.append(scan_id)
                return
        self.entries += made
        self.scans.append(scan_id)

    def _copy_job(self, job: Job) -> None:
        folder = JobFolder(self._data, job.id)
        made: list[Entry] = []
        wanted = [folder.events, folder.log, folder.checkpoint]
        try:
            if job.state is State.SUCCEEDED:
                made += self._copy_results(job.id, folder.results)
            if job.partial:
                made += self._copy_results(job.id, folder.partial)
            for file in wanted:
                with contextlib.suppress(FileNotFoundError):  # not there yet, or no more
                    made.append(self._copier.copy(file, self._folder, f"jobs/{job.id}/{file.name}"))
        except FileNotFoundError as error:
            if self._still_there(jobs, job.id):
                self.damaged.append(f"jobs/{job.id}: {Path(str(error.filename)).name} is missing")
        if not self._still_there(jobs, job.id):
            shutil.rmtree(self._folder / "jobs" / job.id, ignore_errors=True)
            self._gone_jobs.append(job.id)
            return
        self.entries += made
        self.jobs.append(job.id)

    def _copy_results(self, job_id: str, folder: Path) -> Iterator[Entry]:
        """All files, held against the digests in the folder's own manifest."""
        listed = json.loads((folder / "manifest.json").read_bytes())["files"]
        digests = {file["name"]: file["sha256"] for file in listed}
        for name in [*digests, "manifest.json"]:
            path = f"jobs/{job_id}/{folder.name}/{name}"
            entry = self._copier.copy(folder / name, self._folder, path)
            if entry.sha256 != digests.get(name, entry.sha256):
                self.damaged.append(f"{path}: its sha256 is {entry.sha256}, when it was made it was {digests[name]}")
            yield entry

    def _still_there(self, table: sa.Table, thing: str) -> bool:
        with self._live.reading() as read:
            return read.execute(sa.select(table.c.id).where(table.c.id == thing)).first() is not None

    def forget_what_is_gone(self) -> None:
        """So that the copy of the database speaks of nothing that the backup has not."""
        with self._copy.writing() as write:
            unsent = sa.select(uploads.c.id).where(~uploads.c.committed)
            for column in (parts.c.upload_id, files.c.upload_id, uploads.c.id):
                write.execute(column.table.delete().where(column.in_(unsent) | column.in_(self._gone_scans)))
            write.execute(scans.delete().where(scans.c.id.in_(self._gone_scans)))
            write.execute(jobs.delete().where(jobs.c.id.in_(self._gone_jobs)))


def _snapshot(source: Path, target: Path) -> None:
    """SQLite's own online backup: one moment, whoever writes meanwhile."""
    os.close(os.open(target, os.O_CREAT | os.O_EXCL | os.O_WRONLY, 0o600))
    try:
        with contextlib.closing(sqlite3.connect(source)) as live, contextlib.closing(sqlite3.connect(target)) as copy:
            live.backup(copy)
            verdict = copy.execute("PRAGMA integrity_check(1)").fetchone()[0]
    except sqlite3.Error as error:
        raise BackupError(f"{source}: the database cannot be copied: {error}") from error
    if verdict != "ok":
        raise BackupError(f"{source}: the database is damaged ({verdict}); keep it, and restore an earlier backup")


@contextlib.contextmanager
def _opened(file: Path) -> Iterator[Database]:
    """A database that is one file again afterwards, with no log beside it."""
    database = Database(f"sqlite:///{file}")
    try:
        yield database
    finally:
        database.close()
    with contextlib.closing(sqlite3.connect(file)) as connection:
        connection.execute("PRAGMA journal_mode=DELETE")
    with file.open("rb") as written:
        os.fsync(written.fileno())


def _entry(file: Path) -> Entry:
    size, sha256 = digest(file)
    return Entry(file.name, size, sha256)


def _bytes(path: Path) -> int:
    """Of a file, or of those in a folder. Roughly: they may change while they are looked at."""
    total = 0
    for file in path.iterdir() if path.is_dir() else (path,):
        with contextlib.suppress(FileNotFoundError):
            total += file.stat().st_size
    return total
