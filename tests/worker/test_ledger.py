"""Compare-and-set: who loses a race changes nothing, and a stale attempt never gets a word in."""

from __future__ import annotations

import threading
from collections.abc import Callable

import pytest

from worker.contract import MAX_CRASHES, MAX_KILLS, ErrorKind, State
from worker.database import Database
from worker.ledger import Job, Ledger

NewJob = Callable[..., Job]


def current(ledger: Ledger, job: Job) -> Job:
    found = ledger.get(job.id)
    assert found is not None
    return found


def test_a_new_job_is_queued(new_job: NewJob) -> None:
    job = new_job()
    assert (job.state, job.attempt, job.progress, job.finished_at) == (State.QUEUED, 1, 0.0, None)


def test_of_many_claims_one_succeeds(ledger: Ledger, new_job: NewJob) -> None:
    job, won = new_job(), []
    threads = [threading.Thread(target=lambda: won.append(ledger.claim(job.id, 1, "here"))) for _ in range(8)]
    for thread in threads:
        thread.start()
    for thread in threads:
        thread.join()
    assert sum(claim is not None for claim in won) == 1 and len(won) == 8


def test_a_stale_attempt_is_fenced_off(ledger: Ledger, new_job: NewJob) -> None:
    job = new_job()
    first = ledger.claim(job.id, 1, "here")
    assert first is not None and ledger.crashed(first, "The worker died")
    assert current(ledger, job).attempt == 2
    assert ledger.claim(job.id, 1, "here") is None
    assert ledger.claim(job.id, 2, "there") is not None
    assert ledger.beat(job.id, 1, {"progress": 0.9}) is None
    assert not ledger.succeed(job.id, 1)
    assert not ledger.fail(job.id, 1, ErrorKind.CRASHED, "late")
    assert not ledger.hand_back(job.id, 1)
    assert not ledger.crashed(first, "again")
    assert (current(ledger, job).state, current(ledger, job).progress) == (State.RUNNING, 0.0)
    assert ledger.succeed(job.id, 2)


@pytest.mark.parametrize(("by_others", "most"), [(False, MAX_CRASHES), (True, MAX_KILLS)], ids=["itself", "others"])
def test_crashes_are_counted_and_end(ledger: Ledger, new_job: NewJob, by_others: bool, most: int) -> None:
    job = new_job()
    for attempt in range(1, most + 1):
        assert current(ledger, job).state is State.QUEUED
        claimed = ledger.claim(job.id, attempt, "here")
        assert claimed is not None and ledger.crashed(claimed, "The engine was killed (SIGKILL)", by_others=by_others)
    end = current(ledger, job)
    assert (end.state, end.error_kind, end.attempt) == (State.FAILED, ErrorKind.CRASHED, most)
    assert end.error_message is not None and f"killed (SIGKILL), {most} times" in end.error_message
    assert end.finished_at is not None


def test_hand_backs_are_not_counted(ledger: Ledger, new_job: NewJob) -> None:
    job = new_job()
    for attempt in range(1, 3 * MAX_CRASHES):
        assert ledger.claim(job.id, attempt, "here") is not None
        assert ledger.hand_back(job.id, attempt)
    assert (current(ledger, job).state, current(ledger, job).crashes) == (State.QUEUED, 0)


@pytest.mark.parametrize("running", [False, True])
def test_cancel_is_immediate_when_queued_and_a_request_when_running(
    ledger: Ledger, new_job: NewJob, running: bool
) -> None:
    job = new_job()
    if running:
        ledger.claim(job.id, 1, "here")
    asked = ledger.ask_cancel(job.id)
    assert asked is not None and asked.state is (State.CANCELLING if running else State.CANCELLED)
    again = ledger.ask_cancel(job.id)
    assert again == asked
    if running:
        assert not ledger.succeed(job.id, 1)
        assert ledger.beat(job.id, 1, {}) is State.CANCELLING
        assert ledger.end_cancel(job.id, 1)
    else:
        assert ledger.claim(job.id, 1, "here") is None
    assert current(ledger, job).state is State.CANCELLED


def test_cancelling_a_finished_job_changes_nothing(ledger: Ledger, new_job: NewJob) -> None:
    job = new_job()
    ledger.claim(job.id, 1, "here")
    ledger.succeed(job.id, 1)
    assert ledger.ask_cancel(job.id) == current(ledger, job)
    assert current(ledger, job).state is State.SUCCEEDED
    assert ledger.ask_cancel("unknown") is None


def test_only_finished_jobs_can_be_forgotten(ledger: Ledger, new_job: NewJob) -> None:
    job = new_job()
    assert not ledger.forget(job.id)
    ledger.claim(job.id, 1, "here")
    assert not ledger.forget(job.id)
    ledger.fail(job.id, 1, ErrorKind.BAD_INPUT, "bad")
    assert ledger.forget(job.id) and ledger.get(job.id) is None


def test_pages_and_positions(ledger: Ledger, new_job: NewJob) -> None:
    jobs = [new_job() for _ in range(5)]
    newest = [job.id for job in reversed(jobs)]
    first = ledger.page(None, 2, None)
    rest = ledger.page(None, 10, first[-1])
    assert [job.id for job in first + rest] == newest
    assert [ledger.position(job) for job in jobs] == [1, 2, 3, 4, 5]
    ledger.claim(jobs[0].id, 1, "here")
    assert ledger.position(jobs[4]) == 4
    assert [job.id for job in ledger.page(State.RUNNING, 10, None)] == [jobs[0].id]


def test_many_and_the_queue(ledger: Ledger, new_job: NewJob) -> None:
    jobs = [new_job() for _ in range(4)]
    ledger.claim(jobs[1].id, 1, "here")
    assert ledger.positions(jobs) == {jobs[0].id: 1, jobs[2].id: 2, jobs[3].id: 3}
    assert ledger.positions(jobs[3:]) == {jobs[3].id: 3} and ledger.positions([]) == {}
    assert [ledger.position(jobs[n]) for n in (0, 2, 3)] == [1, 2, 3], "the same order"
    found = {job.id: job.state for job in ledger.many([jobs[0].id, jobs[1].id, "none"])}
    assert found == {jobs[0].id: State.QUEUED, jobs[1].id: State.RUNNING}
    assert ledger.many([]) == []


def test_a_scan_is_needed_until_its_job_ends(ledger: Ledger, database: Database, new_job: NewJob) -> None:
    job = new_job()

    def needed() -> bool:
        with database.reading() as read:
            return ledger.needs_scan(read, job.scan_id)

    assert needed()
    ledger.claim(job.id, 1, "here")
    assert needed()
    ledger.succeed(job.id, 1)
    assert not needed()


def test_a_move_outside_the_table_is_refused(ledger: Ledger, new_job: NewJob) -> None:
    job = new_job()
    with pytest.raises(AssertionError):
        ledger._move(job.id, 1, State.QUEUED, State.SUCCEEDED)
