"""Removes what nobody will come back for: stale uploads, outdated submission keys, and folders without a row.

A folder is made before its row and removed after it, so a crash leaves folders, never rows without
one. They are given an hour, because a request may be between the two steps right now.
"""

from __future__ import annotations

import asyncio
import logging
import time
from pathlib import Path

from server.deliveries import purge_deliveries
from server.intake import Busy, Gone, Intake
from server.store import Store
from worker.jobfolder import JobFolder

log = logging.getLogger("splatct.server")

EVERY_S = 3600.0
ORPHAN_AGE_S = 3600.0


def sweep(store: Store, intake: Intake, data: Path, stale_upload_s: float, now: float) -> None:
    store.submissions.purge()
    purge_deliveries(store.database)
    for upload_id in store.stale_uploads(now - stale_upload_s):
        try:
            with intake.alone(upload_id, 0.0):
                if store.drop_upload(upload_id):
                    intake.remove_upload(upload_id)
        except Busy:
            continue
        except Gone:
            store.drop_upload(upload_id)
    for name in intake.upload_folders():
        upload = store.upload(name)
        if (upload is None or upload.committed) and _old(data / "uploads" / name, now):
            intake.remove_upload(name)
    for name in intake.scan_folders():
        if store.scan(name) is None and store.upload(name) is None and _old(data / "scans" / name, now):
            intake.remove_scan(name)
    for folder in (data / "jobs").iterdir():
        if store.jobs.get(folder.name) is None and _old(folder, now):
            JobFolder(data, folder.name).remove()


def _old(folder: Path, now: float) -> bool:
    try:
        return now - folder.stat().st_mtime > ORPHAN_AGE_S
    except FileNotFoundError:
        return False


async def keep_clean(store: Store, intake: Intake, data: Path, stale_upload_s: float) -> None:
    while True:
        try:
            await asyncio.to_thread(sweep, store, intake, data, stale_upload_s, time.time())
        except Exception:
            log.exception("cleaning up failed; trying again in an hour")
        await asyncio.sleep(EVERY_S)
