"""Whose turn it is: the database says, whatever order the queue delivers in."""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable, Iterator
from pathlib import Path

import pytest

from worker.contract import Priority, State
from worker.database import Database
from worker.jobfolder import JobFolder
from worker.ledger import Job, Ledger, jobs
from worker.settings import WorkerSettings
from worker.supervise import work_on_next

NewJob = Callable[..., Job]


class Line:
    """Jobs by short names, submitted one after the other."""

    def __init__(self, database: Database) -> None:
        self._database, self.ledger = database, Ledger(database)
        self._now = 1000.0

    def submit(self, name: str, tenant: str = "local", priority: Priority = Priority.NORMAL) -> None:
        self._now += 1
        with self._database.writing() as write:
            Ledger(self._database, tenant).add(write, name, name, ("scan", "scan"), {}, priority)
            write.execute(jobs.update().where(jobs.c.id == name).values(created_at=self._now))

    def order(self) -> list[str]:
        return [job.id for job in self.ledger.line(100)]

    def start(self) -> str:
        """As a worker does that is woken by anything."""
        job = self.ledger.line(1)[0]
        assert self.ledger.claim(job.id, job.attempt, "here")
        self._now += 1
        with self._database.writing() as write:
            write.execute(jobs.update().where(jobs.c.id == job.id).values(started_at=self._now))
        return job.id

    def end(self, name: str) -> None:
        assert self.ledger.succeed(name, 1)


@pytest.fixture
def line(database: Database) -> Iterator[Line]:
    yield Line(database)


def test_oldest_first(line: Line) -> None:
    for name in ("b", "a", "c"):
        line.submit(name)
    assert line.order() == ["b", "a", "c"]


def test_priority_within_a_tenant(line: Line) -> None:
    line.submit("n1")
    line.submit("low", priority=Priority.LOW)
    line.submit("n2")
    line.submit("high", priority=Priority.HIGH)
    assert line.order() == ["high", "n1", "n2", "low"]
    places = line.ledger.positions(line.ledger.line(9))
    assert sorted(places, key=places.__getitem__) == line.order() and sorted(places.values()) == [1, 2, 3, 4]
    assert all(line.ledger.position(job) == places[job.id] for job in line.ledger.line(9))


def test_a_tenant_cannot_overtake_another_by_priority(line: Line) -> None:
    for n in range(3):
        line.submit(f"loud{n}", "loud", Priority.HIGH)
    line.submit("quiet", "quiet", Priority.LOW)
    assert line.order().index("quiet") == 1


def test_a_thousand_jobs_of_one_tenant_keep_another_waiting_for_one(line: Line) -> None:
    for n in range(50):
        line.submit(f"many{n:02}", "many")
    running = line.start()
    line.submit("one", "one")
    line.submit("two", "one")
    ran = []
    for _ in range(6):  # one worker: each starts when the last has ended
        line.end(running)
        running = line.start()
        ran.append(running)
    assert ran[:4] == ["one", "many01", "two", "many02"]


def test_several_workers_share_evenly(line: Line) -> None:
    for tenant in ("a", "b", "c"):
        for n in range(20):
            line.submit(f"{tenant}{n:02}", tenant)
    running = [line.start() for _ in range(6)]
    assert Counter(name[0] for name in running) == {"a": 2, "b": 2, "c": 2}
    for _ in range(12):
        line.end(running.pop(0))
        running.append(line.start())
        assert max(Counter(name[0] for name in running).values()) <= 3


def test_a_worker_takes_whose_turn_it_is_and_passes_over_who_is_locked(
    ledger: Ledger, new_job: NewJob, database: Database, settings: WorkerSettings, tmp_path: Path, keep_sigterm: None
) -> None:
    first, second, third = new_job(), new_job(), new_job()
    with database.writing() as write:
        write.execute(jobs.update().where(jobs.c.id == third.id).values(priority=Priority.HIGH))
    with JobFolder(tmp_path, third.id).lock():  # its last engine is just dying
        assert work_on_next(settings, ledger)
    assert [(found := ledger.get(job.id)) and found.state for job in (first, second, third)] == [
        State.SUCCEEDED, State.QUEUED, State.QUEUED
    ]  # fmt: skip
    assert work_on_next(settings, ledger) and work_on_next(settings, ledger) and not work_on_next(settings, ledger)
    ends = [ledger.get(job.id) for job in (third, second)]
    assert ends[0] and ends[1] and (ends[0].finished_at or 0) < (ends[1].finished_at or 0)
