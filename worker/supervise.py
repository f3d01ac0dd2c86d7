"""The task RQ runs: carries one attempt of one job from claim to publication.

Runs in the worker's forked child and never imports torch or numpy. The steps at the end are
ordered so that a kill between any two of them loses nothing: the results are made durable,
appear under their final name by one rename, and only then is the job recorded as done. A row left
`running` beside published results is finished by the server's reconcile loop.
"""

from __future__ import annotations

import logging
import os
import signal
import sys
import time
from collections.abc import Callable
from types import FrameType
from typing import Any, TypeVar

from sqlalchemy.exc import SQLAlchemyError

from worker.contract import HEARTBEAT_S, ErrorKind, Exit, State
from worker.database import Database
from worker.fulldisk import is_full
from worker.jobfolder import JobFolder
from worker.journal import EventWriter
from worker.ledger import Job, Ledger
from worker.lifeline import die_with_parent, host_id
from worker.oom import OomWatch
from worker.process import EngineProcess
from worker.redaction import Redaction
from worker.settings import WorkerSettings

log = logging.getLogger("splatct.worker")

T = TypeVar("T")

IN_LINE = 20  # jobs to try for; more workers than that never ask at one moment
LOCK_WAIT_S = 3.0  # an engine that was just killed needs a moment to let go
TICK_S = 0.5
DATABASE_PATIENCE_S = 600.0

_ERRORS = {
    Exit.BUG: ErrorKind.CRASHED,
    Exit.BAD_INPUT: ErrorKind.BAD_INPUT,
    Exit.CANNOT_RECONSTRUCT: ErrorKind.CANNOT_RECONSTRUCT,
    Exit.OUT_OF_MEMORY: ErrorKind.OUT_OF_MEMORY,
    Exit.DISK_FULL: ErrorKind.DISK_FULL,
}

_OUT_OF_MEMORY = (
    "The kernel ended the engine for want of memory. Try quality preview, fewer splats or a smaller volume, or a "
    "machine with more memory."
)

_WORDLESS: dict[int, str] = {
    Exit.DISK_FULL: "The disk is full. Make room and restart the job; it goes on from its last state.",
}


class Lost(Exception):
    """The job is no longer ours: it was given to another attempt, or deleted."""


class StopFlag:
    """Set by SIGTERM: the worker is to go, and its job back to the queue."""

    def __init__(self) -> None:
        self.set = False

    def __call__(self, _signal: int, _frame: FrameType | None) -> None:
        self.set = True


def run_job(job_id: str, attempt: int) -> None:
    """Entry point for RQ. Says nothing to RQ: the ledger is where outcomes go.

    What the queue names is only a sign that a job waits; which one is next the ledger says.
    """
    assert "torch" not in sys.modules, "the worker process must stay light; only the engine imports torch"
    worker = os.environ.get("SPLATCT_WORKER_PID")
    if worker is not None:
        die_with_parent(int(worker))
    settings = WorkerSettings()
    database = Database(settings.database)
    try:
        log.debug("woken for job %s, attempt %d", job_id, attempt)
        work_on_next(settings, Ledger(database))
    finally:
        database.close()


def work_on_next(settings: WorkerSettings, ledger: Ledger) -> bool:
    """See the next job in line through; False if none is to be had. Others take jobs at the same time: whom another
    has is passed over. The first is asked for again with patience, as its last engine may just be dying."""
    line = ledger.line(IN_LINE)
    tries = [(job, 0.0) for job in line] + [(job, LOCK_WAIT_S) for job in line[:1]]
    return any(supervise(settings, ledger, job.id, job.attempt, patience_s) for job, patience_s in tries)


def supervise(
    settings: WorkerSettings, ledger: Ledger, job_id: str, attempt: int, patience_s: float = LOCK_WAIT_S
) -> bool:
    """Claim the attempt and see it through; False, and nothing done, when it is not to be had."""
    stop = StopFlag()
    signal.signal(signal.SIGTERM, stop)
    folder = JobFolder(settings.data.absolute(), job_id)
    with folder.lock(patience_s) as lock:
        if lock is None or stop.set:
            return False  # deleted, or another process still works on it: the reconcile loop will ask again
        job = ledger.claim(job_id, attempt, host_id())
        if job is None:
            return False
        try:
            _Attempt(settings, ledger, folder, job, lock, stop).run()
        except Lost:
            log.warning("job %s: attempt %d is no longer ours", job_id, attempt)
        return True


class _Attempt:
    def __init__(
        self, settings: WorkerSettings, ledger: Ledger, folder: JobFolder, job: Job, lock: int, stop: StopFlag
    ) -> None:
        self._settings = settings
        self._ledger = ledger
        self._folder = folder
        self._job = job
        self._lock = lock
        self._started = time.monotonic()
        self._beaten = 0.0
        self._news: dict[str, Any] = {}  # progress the row does not show yet
        self._error = ""
        self._cancelling_since: float | None = None
        self._stop = stop
        self._stopping_since: float | None = None
        self._timed_out = False
        self._killed_by_us = False
        self._memory = OomWatch()
        self._redacted = Redaction(settings.data.absolute(), folder.path)

    def run(self) -> None:
        if self._folder.published():  # an earlier attempt got this far and died before saying so
            self._record_success()
            return
        try:
            self._work()
        except OSError as error:
            if not is_full(error) or self._folder.published():  # what is published the reconcile loop will record
                raise
            self._conclude(Exit.DISK_FULL)

    def _work(self) -> None:
        job = self._job
        settings = self._settings
        spec = {
            "id": job.id, "attempt": job.attempt, "options": job.options, "checkpoint_s": settings.checkpoint_s,
            "memory_mib": settings.engine_memory_mib, "file_mib": settings.engine_file_mib,
            "nice": settings.engine_nice, "test": settings.test_plan,
        }  # fmt: skip
        self._folder.prepare(spec, job.attempt)
        with EventWriter(self._folder.events) as events:
            if job.attempt > 1:
                again = {"stage": "start", "fraction": 0.0, "message": f"Starting again: attempt {job.attempt}"}
                self._keep(again, events)
            engine = EngineProcess(self._folder, job.attempt, self._settings.engine, self._lock)
            try:
                self._watch(engine, events)
            finally:
                engine.close()
        self._conclude(engine.code)

    def _watch(self, engine: EngineProcess, events: EventWriter) -> None:
        """Until the engine has ended: pass its progress on, keep the row alive, heed requests."""
        while not engine.ended():
            for event in engine.read(TICK_S / 2):
                self._take(event, events)
            now = time.monotonic()
            if self._stop.set:
                self._drain(engine, now)
            if now - self._beaten >= (TICK_S if self._news else HEARTBEAT_S / 2):
                self._beat(now)
            self._heed_limits(engine, now)
        for event in engine.read(0):
            self._take(event, events)

    def _drain(self, engine: EngineProcess, now: float) -> None:
        """Our worker is to go: ask the engine to keep its state, and wait for that no longer than we may."""
        if self._stopping_since is None:
            self._stopping_since = now
            engine.signal(signal.SIGTERM)
        elif now - self._stopping_since > self._settings.drain_grace_s:
            self._kill(engine)

    def _kill(self, engine: EngineProcess) -> None:
        self._killed_by_us = True
        engine.signal(signal.SIGKILL)

    def _take(self, event: dict[str, Any], events: EventWriter) -> None:
        if "error" in event:
            self._error = self._redacted(str(event["error"]))
            return
        said = {name: self._redacted(value) if isinstance(value, str) else value for name, value in event.items()}
        event = {**said, "attempt": self._job.attempt}
        self._keep(event, events)
        fraction = min(1.0, max(0.0, float(event.get("fraction", 0.0))))
        # The engine's own clock counts what earlier attempts have done of it.
        spent = float(event.get("seconds") or time.monotonic() - self._started)
        self._news = {
            "stage": str(event.get("stage", ""))[:32],
            "message": str(event.get("message", "")),
            "progress": fraction,
            "eta_s": round(spent * (1 - fraction) / fraction, 1) if fraction > 0.01 else None,
        }

    def _keep(self, event: dict[str, Any], events: EventWriter) -> None:
        """A full disk costs the journal an event, not the run its work: there may be room again before its end."""
        try:
            events.append(event)
        except OSError as error:
            if not is_full(error):
                raise
            log.warning("job %s: the disk is full; an event is not kept", self._job.id)

    def _beat(self, now: float) -> None:
        self._beaten = now
        try:
            state = self._ledger.beat(self._job.id, self._job.attempt, self._news)
        except SQLAlchemyError:
            log.warning("job %s: the database did not take a heartbeat", self._job.id, exc_info=True)
            return
        if state is None:
            raise Lost
        self._news = {}
        if state is State.CANCELLING and self._cancelling_since is None:
            self._cancelling_since = now
            self._folder.cancel.touch()

    def _heed_limits(self, engine: EngineProcess, now: float) -> None:
        """End a cancelled job, and one that takes too long: ask for a result of what there is, then kill.

        The clock is ours and SIGKILL needs no consent, so this holds while the engine is deep in native code."""
        if not self._timed_out and now - self._started > self._settings.job_seconds:
            self._timed_out = True
            self._folder.cancel.touch()
            self._cancelling_since = self._cancelling_since or now
        if self._cancelling_since is not None and now - self._cancelling_since > self._settings.cancel_grace_s:
            self._kill(engine)

    def _conclude(self, code: int) -> None:
        """Turn the engine's end into the job's."""
        job, ledger = self._job, self._ledger
        if code == Exit.OK:
            self._publish()
            return
        if code == Exit.DISK_FULL:
            self._folder.discard_attempts()  # at once: it may be the database that has no room to hear of it
        state = self._insist_on_state()
        if state is State.CANCELLING:
            self._record_cancel()
        elif self._timed_out:
            limit = f"{self._settings.job_seconds / 3600:.3g} h"
            partial = self._folder.publish_partial(job.attempt)
            kept = " What there was is kept as a partial result." if partial else ""
            message = f"The job was stopped at its time limit of {limit}.{kept}"
            self._insist(lambda: ledger.fail(job.id, job.attempt, ErrorKind.TIMEOUT, message, partial=partial))
        elif self._stop.set or code in (Exit.STOPPED, Exit.CANCELLED):  # without us: somebody terminated it politely
            self._insist(lambda: ledger.hand_back(job.id, job.attempt))
            return
        elif code in _ERRORS:
            message = self._error or _WORDLESS.get(code, "The engine failed. The log holds the details.")
            self._insist(lambda: ledger.fail(job.id, job.attempt, _ERRORS[Exit(code)], message))
        elif code == -signal.SIGKILL and not self._killed_by_us and self._memory.killed():
            self._insist(lambda: ledger.fail(job.id, job.attempt, ErrorKind.OUT_OF_MEMORY, _OUT_OF_MEMORY))
        else:
            by_others = code == -signal.SIGKILL and not self._killed_by_us
            advanced = self._folder.advanced()
            end = self._insist(lambda: ledger.crashed(job, _obituary(code), advanced, by_others))
            if end is not State.FAILED:
                return
        self._folder.tidy()

    def _publish(self) -> None:
        """Fence, make durable, rename, record: in this order."""
        if self._insist_on_state() is State.CANCELLING:
            self._record_cancel()
            return
        self._folder.publish(self._job.attempt)
        log.info("job %s: attempt %d published its results", self._job.id, self._job.attempt)
        self._record_success()

    def _record_success(self) -> None:
        if not self._insist(lambda: self._ledger.succeed(self._job.id, self._job.attempt)):
            if self._insist_on_state() is not State.CANCELLING:
                raise Lost
            self._record_cancel()  # the request came after the rename
            return
        self._folder.tidy()

    def _record_cancel(self) -> None:
        partial = self._folder.publish_partial(self._job.attempt)
        self._insist(lambda: self._ledger.end_cancel(self._job.id, self._job.attempt, partial))
        self._folder.tidy()

    def _insist_on_state(self) -> State:
        """The row's state. Raises Lost if it is not ours."""
        state = self._insist(lambda: self._ledger.beat(self._job.id, self._job.attempt, self._news))
        if state is None:
            raise Lost
        return state

    def _insist(self, act: Callable[[], T]) -> T:
        """Do it to the row, waiting out a database that is away or has no room; while it waits the job is shown as
        running. Raises what the database said if that takes too long: then, or if we are killed, the reconcile loop
        settles the job once the database takes it."""
        began = time.monotonic()
        while True:
            try:
                return act()
            except SQLAlchemyError:
                patience_s = self._settings.drain_grace_s if self._stop.set else DATABASE_PATIENCE_S
                if time.monotonic() - began > patience_s:
                    raise
                time.sleep(1.0)


def _obituary(code: int) -> str:
    if code < 0:
        return f"The engine was killed ({signal.Signals(-code).name})"
    return f"The engine ended unexpectedly (exit code {code})"
