"""Keeps the queue and the world in step with the database: no job is lost, none runs for ever.

Every couple of seconds: queued jobs that are not on the queue are put there (Redis may have been
wiped), and jobs whose worker died are finished, cancelled or queued again. A worker is dead at once
when it ran on this host and its lock is free; elsewhere, when its heartbeat has stood still. Time is
this process's own: no two clocks are compared.
"""

from __future__ import annotations

import asyncio
import contextlib
import logging
import time
from collections.abc import Callable
from pathlib import Path

from sqlalchemy.exc import DBAPIError

from server.dispatch import Dispatcher, RedisError
from worker.contract import DEAD_S, STUCK_S, ErrorKind, State
from worker.fulldisk import is_full
from worker.jobfolder import JobFolder
from worker.ledger import Job, Ledger
from worker.lifeline import host_id

log = logging.getLogger("splatct.server")

MEASURED_AT_ONCE = 500  # jobs of one sweep: after an upgrade there may be many


class Reconciler:
    def __init__(self, ledger: Ledger, dispatcher: Dispatcher, data: Path, clock: Callable[[], float] = time.monotonic):
        self._ledger = ledger
        self._dispatcher = dispatcher
        self._data = data
        self._clock = clock
        self._host = host_id()
        self._pulse: dict[tuple[str, int], tuple[float | None, float]] = {}  # last heartbeat, when it was new to us
        self._redis_was_away = False
        self.recoveries = 0  # jobs taken from a dead worker, since the start

    def sweep(self) -> None:
        """One look at everything that is not finished."""
        active = self._ledger.in_states([State.QUEUED, State.RUNNING, State.CANCELLING])
        working = [job for job in active if job.state is not State.QUEUED]
        self._pulse = {key: seen for key, seen in self._pulse.items() if key in {(j.id, j.attempt) for j in working}}
        for job in working:
            self._revive(job)
        self._dispatch([job for job in active if job.state is State.QUEUED])
        self._measure()

    def _revive(self, job: Job) -> None:
        """Settle the job if its worker is dead."""
        silent_s = self._silence(job)
        here = job.host == self._host
        folder = JobFolder(self._data, job.id)
        if not folder.path.is_dir():
            message = "The job's folder has disappeared from the data folder."
            self._end_lost(job, message)
            return
        with folder.lock() as lock:
            gone = lock is not None and here
            if gone or silent_s > (STUCK_S if here else DEAD_S):
                self._settle(job, folder)

    def _settle(self, seen: Job, folder: JobFolder) -> None:
        job = self._ledger.get(seen.id)
        if job is None or (job.state, job.attempt) != (seen.state, seen.attempt):
            return  # its worker came to an end by itself meanwhile
        self.recoveries += 1
        log.warning("job %s: the worker of attempt %d is gone", job.id, job.attempt)
        if job.state is State.CANCELLING:
            self._ledger.end_cancel(job.id, job.attempt, folder.publish_partial(job.attempt))
            folder.tidy()
        elif folder.published():
            self._ledger.succeed(job.id, job.attempt)
        else:
            end = self._ledger.crashed(job, "The worker died", folder.advanced(), by_others=True)
            if end is State.FAILED:
                folder.tidy()

    def _measure(self) -> None:
        """Note what jobs that have ended left, for the quotas; until then they count as estimated."""
        ended = self._ledger.unmeasured(MEASURED_AT_ONCE)
        if not ended:
            return
        try:
            self._ledger.measured({job_id: JobFolder(self._data, job_id).kept_bytes() for job_id in ended})
        except DBAPIError as error:
            if not is_full(error):
                raise
            log.debug("the disk is full: %d jobs are measured when there is room again", len(ended))

    def _end_lost(self, job: Job, message: str) -> None:
        if job.state is State.CANCELLING:
            self._ledger.end_cancel(job.id, job.attempt)
        else:
            self._ledger.fail(job.id, job.attempt, ErrorKind.CRASHED, message)

    def _silence(self, job: Job) -> float:
        """For how long the heartbeat has not changed, as seen from here."""
        now, key = self._clock(), (job.id, job.attempt)
        value, since = self._pulse.get(key, (None, now))
        if value != job.heartbeat:
            value, since = job.heartbeat, now
        self._pulse[key] = (value, since)
        return now - since

    def _dispatch(self, queued: list[Job]) -> None:
        present = []
        for job in queued:
            if JobFolder(self._data, job.id).path.is_dir():
                present.append(job)
            else:
                message = "The job's folder has disappeared from the data folder."
                self._ledger.fail(job.id, job.attempt, ErrorKind.CRASHED, message, was=State.QUEUED)
        try:
            self._dispatcher.ensure_queued(present)
            self._redis_was_away = False
        except RedisError as error:
            if not self._redis_was_away:
                log.warning("Redis is away (%s): jobs wait in the database", type(error).__name__)
            self._redis_was_away = True


async def keep_reconciling(reconciler: Reconciler, every_s: float, wake: asyncio.Event) -> None:
    """Sweep for ever, at once when woken; an exception is logged and the next sweep tries again."""
    while True:
        wake.clear()
        try:
            await asyncio.to_thread(reconciler.sweep)
        except Exception:
            log.exception("reconciling failed; trying again")
        with contextlib.suppress(TimeoutError):
            await asyncio.wait_for(wake.wait(), every_s)
