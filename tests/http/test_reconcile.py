"""The reconcile loop alone, with a clock of its own and no Redis."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from pathlib import Path
from uuid import uuid4

import pytest

from server.migrations import prepare
from server.reconcile import Reconciler
from server.store import Store
from worker.contract import DEAD_S, MAX_KILLS, STUCK_S, ErrorKind, State
from worker.database import Database
from worker.jobfolder import JobFolder
from worker.ledger import Job
from worker.lifeline import host_id


class Queue:
    """Stands in for the dispatcher: remembers what it was asked to queue."""

    def __init__(self) -> None:
        self.seen: list[tuple[str, int]] = []

    def ensure_queued(self, jobs: Sequence[Job]) -> None:
        self.seen = [(job.id, job.attempt) for job in jobs]


class World:
    def __init__(self, data: Path, database: Database) -> None:
        self.data, self.database = data, database
        self.store, self.queue, self.now = Store(database), Queue(), 1000.0
        self.reconciler = Reconciler(self.store.jobs, self.queue, data, lambda: self.now)  # type: ignore[arg-type]

    def running(self, host: str) -> Job:
        job_id = str(uuid4())
        (self.data / "scan").mkdir(exist_ok=True)
        JobFolder(self.data, job_id).create(self.data / "scan")
        with self.database.writing() as write:
            self.store.jobs.add(write, job_id, "job", ("scan", "scan"), {})
        job = self.store.jobs.claim(job_id, 1, host)
        assert job is not None
        return job

    def state(self, job: Job) -> tuple[State, int]:
        found = self.store.jobs.get(job.id)
        assert found is not None
        return found.state, found.attempt

    def publish(self, job: Job) -> None:
        folder = JobFolder(self.data, job.id)
        (folder.prepare({}, job.attempt) / "manifest.json").write_text("{}")
        folder.publish(job.attempt)


@pytest.fixture
def world(tmp_path: Path) -> Iterator[World]:
    database = Database(f"sqlite:///{tmp_path / 'test.db'}")
    prepare(database)
    yield World(tmp_path, database)
    database.close()


def test_a_free_lock_on_this_host_is_a_dead_worker(world: World) -> None:
    job = world.running(host_id())
    world.reconciler.sweep()
    assert world.state(job) == (State.QUEUED, 2)
    world.reconciler.sweep()
    assert world.queue.seen == [(job.id, 2)]


def test_a_held_lock_on_this_host_is_a_living_one(world: World) -> None:
    job = world.running(host_id())
    with JobFolder(world.data, job.id).lock():
        world.reconciler.sweep()
        world.now += STUCK_S - 1
        world.reconciler.sweep()
        assert world.state(job) == (State.RUNNING, 1)
        world.now += 2  # alive but without a heartbeat for so long: stopped, or cut off
        world.reconciler.sweep()
        assert world.state(job) == (State.QUEUED, 2)


def test_elsewhere_the_heartbeat_decides(world: World) -> None:
    job = world.running("another host")
    for _ in range(10):
        world.reconciler.sweep()
        world.now += DEAD_S / 2
        world.store.jobs.beat(job.id, 1, {})
    world.reconciler.sweep()
    assert world.state(job) == (State.RUNNING, 1)
    world.now += DEAD_S + 1
    world.reconciler.sweep()
    assert world.state(job) == (State.QUEUED, 2)


def test_published_results_are_recorded(world: World) -> None:
    job = world.running(host_id())
    world.publish(job)
    world.reconciler.sweep()
    assert world.state(job) == (State.SUCCEEDED, 1)


def test_a_cancelled_jobs_results_are_dropped(world: World) -> None:
    job = world.running(host_id())
    world.publish(job)
    world.store.jobs.ask_cancel(job.id)
    world.reconciler.sweep()
    assert world.state(job) == (State.CANCELLED, 1)
    assert not JobFolder(world.data, job.id).results.exists()


def test_it_is_given_up_at_last(world: World) -> None:
    job = world.running(host_id())
    for attempt in range(1, MAX_KILLS + 1):
        world.reconciler.sweep()
        world.store.jobs.claim(job.id, attempt + 1, host_id())
    end = world.store.jobs.get(job.id)
    assert end is not None and (end.state, end.error_kind) == (State.FAILED, ErrorKind.CRASHED)
    assert f"The worker died, {MAX_KILLS} times" in (end.error_message or "")


def test_a_job_without_a_folder_fails_with_a_reason(world: World) -> None:
    job = world.running(host_id())
    JobFolder(world.data, job.id).remove()
    world.reconciler.sweep()
    end = world.store.jobs.get(job.id)
    assert end is not None and end.state is State.FAILED and "folder" in (end.error_message or "")
