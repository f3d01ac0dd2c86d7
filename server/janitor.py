"""Removes what may go: what `server.retention` lists, and outdated submission keys and webhook deliveries.

Whether a row may go is asked again in the statement that deletes it: a pin, a new job or another byte that came since
the list was made keeps it.
"""

from __future__ import annotations

import asyncio
import logging
import time
from pathlib import Path

import sqlalchemy as sa
from sqlalchemy.exc import SQLAlchemyError

from server.audit import AuditLog, Deed
from server.deliveries import purge_deliveries
from server.intake import Busy, Gone, Intake
from server.reserve import Reserve
from server.retention import Doomed, Rules, doomed, job_may_go, scan_may_go, upload_may_go
from server.store import Store, files, parts, scans, uploads
from worker.jobfolder import JobFolder
from worker.ledger import jobs

log = logging.getLogger("splatct.server")

EVERY_S = 3600.0
JANITOR = "janitor"  # in the audit log, in place of an address
_ACTIONS = {"results": "delete-job", "failed": "delete-job", "scan": "delete-scan", "upload": "delete-upload"}


class Janitor:
    def __init__(self, store: Store, intake: Intake, data: Path, rules: Rules, reserve: Reserve) -> None:
        self._store, self._intake, self._data, self._rules, self._reserve = store, intake, data, rules, reserve
        self._audit = AuditLog(store.database)

    def plan(self, now: float) -> list[Doomed]:
        """What `sweep` would remove."""
        return doomed(self._store, self._data, self._rules, now)

    def sweep(self, now: float) -> list[Doomed]:
        """Remove what may go; returns what went."""
        self._reserve.deleting(self._store.submissions.purge)
        self._reserve.deleting(lambda: purge_deliveries(self._store.database))
        gone = [one for one in self.plan(now) if self._remove(one, now)]
        self._reserve.fill()
        if gone:
            log.info("removed %d things that were not to be kept any longer", len(gone))
        return gone

    def _remove(self, one: Doomed, now: float) -> bool:
        if one.kind == "orphan":
            self._remove_folder(one.name.partition("/")[0], one.id)
            return True
        removed = self._upload(one.id, now) if one.kind == "upload" else self._job_or_scan(one, now)
        if removed:
            try:
                self._audit.note(Deed(one.tenant, None, JANITOR, _ACTIONS[one.kind], one.id))
            except SQLAlchemyError:  # as in server.witness: a full disk must not keep things from being deleted
                log.exception("the audit log could not be written: %s %s", _ACTIONS[one.kind], one.id)
        return removed

    def _job_or_scan(self, one: Doomed, now: float) -> bool:
        kept_s = {"results": self._rules.results, "failed": self._rules.failed, "scan": self._rules.scans}[one.kind]
        assert kept_s is not None, "what is kept for ever is not listed"
        before = now - kept_s

        def forget() -> bool:
            with self._store.database.writing() as write:
                if one.kind == "scan":
                    return _forget_scan(write, one.id, before)
                scan_id = sa.select(jobs.c.scan_id).where(jobs.c.id == one.id).scalar_subquery()
                write.execute(scans.update().where(scans.c.id == scan_id).values(used_at=time.time()))
                done = jobs.delete().where(jobs.c.id == one.id, job_may_go(one.kind, before))
                return write.execute(done).rowcount == 1

        if not self._reserve.deleting(forget):
            return False
        self._remove_folder("scans" if one.kind == "scan" else "jobs", one.id)
        return True

    def _upload(self, upload_id: str, now: float) -> bool:
        assert self._rules.uploads is not None
        before = now - self._rules.uploads

        def forget() -> bool:
            with self._store.database.writing() as write:
                stale = sa.select(uploads.c.id).where(uploads.c.id == upload_id, upload_may_go(before))
                if write.execute(stale).first() is None:
                    return False
                for column in (parts.c.upload_id, files.c.upload_id, uploads.c.id):
                    write.execute(column.table.delete().where(column == upload_id))
                return True

        try:
            with self._intake.alone(upload_id, 0.0):
                removed = self._reserve.deleting(forget)
                if removed:
                    self._intake.remove_upload(upload_id)
                return removed
        except Busy:
            return False
        except Gone:
            return self._reserve.deleting(forget)

    def _remove_folder(self, kind: str, name: str) -> None:
        if kind == "uploads":
            self._intake.remove_upload(name)
        elif kind == "scans":
            self._intake.remove_scan(name)
        else:
            JobFolder(self._data, name).remove()


def _forget_scan(write: sa.Connection, scan_id: str, before: float) -> bool:
    if not write.execute(scans.delete().where(scans.c.id == scan_id, scan_may_go(before))).rowcount:
        return False
    for column in (parts.c.upload_id, files.c.upload_id, uploads.c.id):
        write.execute(column.table.delete().where(column == scan_id))
    return True


async def keep_clean(janitor: Janitor) -> None:
    while True:
        try:
            await asyncio.to_thread(janitor.sweep, time.time())
        except Exception:
            log.exception("cleaning up failed; trying again in an hour")
        await asyncio.sleep(EVERY_S)
