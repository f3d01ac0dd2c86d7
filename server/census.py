"""Numbers about all jobs, for monitoring: how many in which state, how old the queue is, how jobs ended."""

from __future__ import annotations

import threading
import time
from collections import Counter

import sqlalchemy as sa

from worker.contract import State
from worker.database import Database
from worker.ledger import jobs

OVERLAP_S = 60.0


class Census:
    def __init__(self, database: Database) -> None:
        self._database = database

    def by_state(self) -> dict[State, int]:
        query = sa.select(jobs.c.state, sa.func.count()).group_by(jobs.c.state)
        with self._database.reading() as read:
            counted = {state: int(count) for state, count in read.execute(query)}
        return {state: counted.get(state, 0) for state in State}

    def queue_age_s(self) -> float:
        """How long ago the oldest queued job was submitted; 0 when none waits."""
        query = sa.select(sa.func.min(jobs.c.created_at)).where(jobs.c.state == State.QUEUED)
        with self._database.reading() as read:
            oldest = read.execute(query).scalar_one()
        return 0.0 if oldest is None else max(0.0, time.time() - float(oldest))


class Outcomes:
    """Counts jobs as they finish, from this process's start on. Workers write the ends, so they are looked up:
    whenever somebody asks, and before a job is deleted.

    A row may be committed a moment after the time that it names, and by another host's clock; so each
    look goes back a minute, and remembers whom it has counted.
    """

    def __init__(self, database: Database) -> None:
        self._database = database
        self._lock = threading.Lock()
        self._looked_at = time.time()
        self._counted: dict[str, float] = {}
        self.counts: Counter[tuple[State, str]] = Counter()
        self.catch_up()
        self.counts.clear()  # those who ended before we came

    def catch_up(self) -> None:
        with self._lock:
            since, now = self._looked_at - OVERLAP_S, time.time()
            query = sa.select(jobs.c.id, jobs.c.state, jobs.c.error_kind, jobs.c.finished_at).where(
                jobs.c.finished_at >= since
            )
            with self._database.reading() as read:
                rows = read.execute(query).all()
            for job_id, state, kind, _ in rows:
                if job_id not in self._counted:
                    self.counts[state, kind or ""] += 1
            self._counted = {job_id: ended for job_id, _, _, ended in rows if ended >= now - OVERLAP_S}
            self._looked_at = now
