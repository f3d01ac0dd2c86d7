"""One attempt from claim to end, with a real engine process around a fake engine."""

from __future__ import annotations

import contextlib
import json
import os
import signal
import sqlite3
import threading
import time
import zipfile
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest
from sqlalchemy.exc import OperationalError

from worker.contract import MAX_CRASHES, ErrorKind, State
from worker.jobfolder import JobFolder
from worker.journal import read_events
from worker.ledger import Job, Ledger
from worker.settings import WorkerSettings
from worker.supervise import supervise

NewJob = Callable[..., Job]
pytestmark = pytest.mark.usefixtures("keep_sigterm")


@pytest.fixture
def run(settings: WorkerSettings, ledger: Ledger) -> Callable[[Job], Job]:
    """Supervise the job's present attempt and return what became of it."""

    def supervised(job: Job) -> Job:
        supervise(settings, ledger, job.id, job.attempt)
        found = ledger.get(job.id)
        assert found is not None
        return found

    return supervised


Run = Callable[[Job], Job]


def later(seconds: float, action: Callable[[], object]) -> threading.Timer:
    timer = threading.Timer(seconds, action)
    timer.start()
    return timer


def when_running(ledger: Ledger, job: Job, action: Callable[[], object]) -> threading.Thread:
    """Act once the engine has spoken."""

    def wait() -> None:
        for _ in range(500):
            found = ledger.get(job.id)
            if (found is not None and found.message == "At work") or (found and found.stage == "level"):
                action()
                return
            time.sleep(0.02)

    thread = threading.Thread(target=wait)
    thread.start()
    return thread


def test_success(run: Run, new_job: NewJob, tmp_path: Path) -> None:
    job = run(new_job(steps=4))
    folder = JobFolder(tmp_path, job.id)
    assert (job.state, job.progress, job.error_kind) == (State.SUCCEEDED, 1.0, None)
    assert folder.published() and not folder.checkpoint.exists()
    assert not folder.scan.exists() and not list(folder.path.glob("attempt-*"))
    events = read_events(folder.events, 0, 100)
    assert [e["stage"] for e in events] == ["read", "start", "level", "level", "level", "level"]
    assert [e["number"] for e in events] == [1, 2, 3, 4, 5, 6]
    assert "a stray print" in folder.log.read_text()


@pytest.mark.parametrize(
    ("end", "kind", "words"),
    [
        ("bad_input", ErrorKind.BAD_INPUT, "projections.tif: page 3 is torn"),
        ("diverged", ErrorKind.CANNOT_RECONSTRUCT, "the geometry may be mirrored"),
        ("memory", ErrorKind.OUT_OF_MEMORY, "not enough memory"),
        ("full", ErrorKind.DISK_FULL, "disk filled up"),
        ("bug", ErrorKind.CRASHED, "ZeroDivisionError"),
    ],
)
def test_errors_have_kinds_and_words(run: Run, new_job: NewJob, end: str, kind: ErrorKind, words: str) -> None:
    job = run(new_job(end=end))
    assert (job.state, job.error_kind) == (State.FAILED, kind)
    assert words in (job.error_message or "")
    assert "secret detail" not in (job.error_message or "")


def _fail_with(number: int) -> Callable[..., Any]:
    def fail(*_: object) -> Any:
        raise OSError(number, os.strerror(number))

    return fail


@pytest.mark.parametrize("step", ["prepare", "publish"])
def test_a_disk_that_is_full_around_the_engine_is_told_as_such(
    run: Run, new_job: NewJob, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, step: str
) -> None:
    """Pretended here: tests/http/test_full_disk.py fills a real one."""
    monkeypatch.setattr(JobFolder, step, _fail_with(28))
    job = run(new_job())
    assert (job.state, job.error_kind) == (State.FAILED, ErrorKind.DISK_FULL)
    assert "Make room and restart" in (job.error_message or "")
    assert not list(JobFolder(tmp_path, job.id).path.glob("attempt-*"))


def test_another_error_around_the_engine_is_no_full_disk(
    run: Run, new_job: NewJob, ledger: Ledger, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(JobFolder, "publish", _fail_with(5))
    job = new_job()
    with pytest.raises(OSError, match="Input/output error"):
        run(job)
    found = ledger.get(job.id)
    assert found is not None and found.state is State.RUNNING, "the reconcile loop will judge"


@pytest.mark.parametrize(
    ("plan", "method", "state"),
    [
        ({}, "succeed", State.SUCCEEDED),
        ({"end": "full"}, "fail", State.FAILED),
        ({"end": "killed"}, "crashed", State.QUEUED),
    ],
    ids=["success", "failure", "death"],
)
def test_an_end_that_the_database_has_no_room_for_is_recorded_when_it_has(
    run: Run, new_job: NewJob, monkeypatch: pytest.MonkeyPatch, plan: dict[str, Any], method: str, state: State
) -> None:
    monkeypatch.setattr("worker.supervise.time.sleep", lambda _: None)
    record, refused = getattr(Ledger, method), []

    def full(*given: Any, **named: Any) -> Any:
        if len(refused) < 3:
            refused.append(method)
            raise OperationalError("UPDATE jobs", {}, sqlite3.OperationalError("database or disk is full"))
        return record(*given, **named)

    monkeypatch.setattr(Ledger, method, full)
    job = run(new_job(**plan))
    assert (job.state, len(refused)) == (state, 3)
    assert (job.error_kind == ErrorKind.DISK_FULL) == (state is State.FAILED)


def test_events_that_do_not_fit_cost_the_run_nothing(
    run: Run, new_job: NewJob, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("worker.journal.EventWriter.append", _fail_with(28))
    assert run(new_job(steps=4)).state is State.SUCCEEDED


def test_an_engine_that_dies_is_tried_again_but_not_for_ever(run: Run, new_job: NewJob, tmp_path: Path) -> None:
    job = new_job(end="segfault", steps=0)
    for attempt in range(2, MAX_CRASHES + 1):
        job = run(job)
        assert (job.state, job.attempt) == (State.QUEUED, attempt)
    job = run(job)
    assert (job.state, job.error_kind) == (State.FAILED, ErrorKind.CRASHED)
    message = job.error_message or ""
    assert "SIGSEGV" in message and "environment: " not in message  # the log has that, and is not for everybody


def test_an_engine_that_something_else_kills_is_not_given_up_so_soon(run: Run, new_job: NewJob) -> None:
    job = new_job(end="killed", steps=0)
    for attempt in range(2, MAX_CRASHES + 3):
        job = run(job)
        assert (job.state, job.attempt, job.crashes) == (State.QUEUED, attempt, attempt - 1)


@pytest.mark.slow
def test_an_engine_that_gets_further_each_time_is_not_given_up(
    settings: WorkerSettings, ledger: Ledger, new_job: NewJob
) -> None:
    """A machine that kills it whenever it has kept a state costs attempts, not the job."""
    job = new_job(steps=60, pause=0.05)
    folder = JobFolder(settings.data, job.id)

    def kill_once_further() -> None:
        while (row := ledger.get(job.id)) is not None and row.state is State.RUNNING and row.attempt <= MAX_CRASHES + 1:
            if folder.advanced():
                kill_engine(job.id)
                return
            time.sleep(0.02)

    for _ in range(20):
        before = ledger.get(job.id)
        assert before is not None
        if before.state is State.SUCCEEDED:
            break
        killer = when_running(ledger, job, kill_once_further)
        supervise(settings, ledger, job.id, before.attempt)
        killer.join()
    done = ledger.get(job.id)
    assert done is not None and done.state is State.SUCCEEDED and done.attempt > MAX_CRASHES and done.crashes == 1


def kill_engine(job_id: str) -> None:
    for entry in Path("/proc").iterdir():
        with contextlib.suppress(OSError):
            if entry.name.isdecimal() and f"jobs/{job_id}".encode() in (entry / "cmdline").read_bytes():
                os.kill(int(entry.name), signal.SIGKILL)


def test_the_next_attempt_goes_on_from_the_last_checkpoint(run: Run, new_job: NewJob, tmp_path: Path) -> None:
    job = run(new_job(steps=20, pause=0.2, dies_at=12))
    assert (job.state, job.attempt, job.crashes) == (State.QUEUED, 2, 1) and "SIGSEGV" in job.message
    with zipfile.ZipFile(JobFolder(tmp_path, job.id).checkpoint) as kept:
        step_kept = json.loads(kept.read("state.json"))["dict"]["step"]
    done = run(job)
    assert done.state is State.SUCCEEDED and done.attempt == 2
    events = read_events(JobFolder(tmp_path, job.id).events, 0, 100)
    first = [e["step"] for e in events if e["stage"] == "level" and e["attempt"] == 1]
    second = [e["step"] for e in events if e["stage"] == "level" and e["attempt"] == 2]
    assert first == list(range(13)) and second == list(range(second[0], 20))
    assert 1 <= second[0] <= 13 and second[0] == step_kept
    assert any("Going on from the checkpoint" in e["message"] for e in events)


def test_the_kernel_s_word_tells_want_of_memory_from_a_crash(
    run: Run, new_job: NewJob, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("worker.supervise.OomWatch.killed", lambda _self: True)
    job = run(new_job(end="killed"))
    assert (job.state, job.error_kind) == (State.FAILED, ErrorKind.OUT_OF_MEMORY)
    assert "memory" in (job.error_message or "")


def test_an_engine_that_takes_too_much_memory_is_told_so(
    settings: WorkerSettings, ledger: Ledger, new_job: NewJob
) -> None:
    job = new_job(allocate_mib=6000)
    supervise(settings.model_copy(update={"engine_memory_mib": 512}), ledger, job.id, 1)
    ended = ledger.get(job.id)
    assert ended is not None and (ended.state, ended.error_kind) == (State.FAILED, ErrorKind.OUT_OF_MEMORY)
    assert ended.attempt == 1


def test_the_engine_knows_no_secrets(
    run: Run, new_job: NewJob, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("SPLATCT_REDIS_URL", "redis://:password@host/0")
    monkeypatch.setenv("DATABASE_PASSWORD", "password")
    job = run(new_job())
    told = JobFolder(tmp_path, job.id).log.read_text()
    assert "environment: " in told and "PATH" in told
    assert "SPLATCT_" not in told and "DATABASE" not in told and "password" not in told


def test_cancel_between_events(run: Run, ledger: Ledger, new_job: NewJob, tmp_path: Path) -> None:
    job = new_job(steps=2000, pause=0.05)
    thread = when_running(ledger, job, lambda: ledger.ask_cancel(job.id))
    started = time.monotonic()
    ended = run(job)
    thread.join()
    assert ended.state is State.CANCELLED and time.monotonic() - started < 15
    folder = JobFolder(tmp_path, job.id)
    assert not folder.published() and ended.partial and "partial" in ended.message
    assert json.loads((folder.partial / "manifest.json").read_text())["partial"] is True
    assert sorted(path.name for path in folder.path.iterdir()) == [
        ".lock", "events.jsonl", "job.json", "log.txt", "partial", "run.checkpoint"
    ]  # fmt: skip


def test_cancel_an_engine_that_does_not_listen(run: Run, ledger: Ledger, new_job: NewJob) -> None:
    job = new_job(deaf=True)
    thread = when_running(ledger, job, lambda: ledger.ask_cancel(job.id))
    ended = run(job)
    assert ended.state is State.CANCELLED and not ended.partial
    thread.join()


def test_sigterm_hands_the_job_back(run: Run, ledger: Ledger, new_job: NewJob, tmp_path: Path) -> None:
    job = new_job(steps=2000, pause=0.05)
    thread = when_running(ledger, job, lambda: os.kill(os.getpid(), signal.SIGTERM))
    ended = run(job)
    thread.join()
    assert (ended.state, ended.attempt, ended.crashes) == (State.QUEUED, 2, 0)
    assert JobFolder(tmp_path, job.id).checkpoint.exists()


def test_an_engine_that_cannot_be_drained_is_killed_in_time(
    settings: WorkerSettings, ledger: Ledger, new_job: NewJob
) -> None:
    job = new_job(native=True)
    thread = when_running(ledger, job, lambda: os.kill(os.getpid(), signal.SIGTERM))
    started = time.monotonic()
    supervise(settings.model_copy(update={"drain_grace_s": 0.5}), ledger, job.id, 1)
    thread.join()
    ended = ledger.get(job.id)
    assert ended is not None and (ended.state, ended.crashes) == (State.QUEUED, 0)
    assert time.monotonic() - started < 15


@pytest.mark.parametrize("plan", [{"steps": 2000, "pause": 0.05}, {"native": True}])
def test_time_limit(ledger: Ledger, new_job: NewJob, settings: WorkerSettings, plan: dict[str, Any]) -> None:
    """Also deep inside native code, where no signal handler runs."""
    job = new_job(**plan)
    started = time.monotonic()
    supervise(settings.model_copy(update={"job_seconds": 2.0}), ledger, job.id, 1)
    ended = ledger.get(job.id)
    assert ended is not None and (ended.state, ended.error_kind) == (State.FAILED, ErrorKind.TIMEOUT)
    assert ended.partial == ("native" not in plan) and time.monotonic() - started < 15


def test_a_job_that_was_taken_away_is_dropped(run: Run, ledger: Ledger, new_job: NewJob, tmp_path: Path) -> None:
    job = new_job(steps=2000, pause=0.05)
    claimed = []

    def take_away() -> None:
        found = ledger.get(job.id)
        assert found is not None
        claimed.append(ledger.crashed(found, "The worker died"))

    thread = when_running(ledger, job, take_away)
    ended = run(job)
    thread.join()
    assert claimed == [State.QUEUED]
    assert (ended.state, ended.attempt) == (State.QUEUED, 2)
    assert not JobFolder(tmp_path, job.id).published()


def test_a_locked_job_is_left_alone(run: Run, new_job: NewJob, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("worker.supervise.LOCK_WAIT_S", 0.2)
    job = new_job()
    with JobFolder(tmp_path, job.id).lock() as lock:
        assert lock is not None
        assert run(job).state is State.QUEUED


def test_delivered_twice_runs_once(run: Run, new_job: NewJob, tmp_path: Path) -> None:
    job = new_job()
    done = run(job)
    inode = JobFolder(tmp_path, job.id).results.stat().st_ino
    assert run(job) == done
    assert JobFolder(tmp_path, job.id).results.stat().st_ino == inode


def test_published_but_not_recorded_is_recorded_without_running_again(
    run: Run, ledger: Ledger, new_job: NewJob, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    class Killed(BaseException):
        pass

    def die(*_: object) -> bool:
        raise Killed

    job = new_job()
    with monkeypatch.context() as patch:
        patch.setattr(Ledger, "succeed", die)
        with pytest.raises(Killed):
            run(job)
    folder = JobFolder(tmp_path, job.id)
    left = ledger.get(job.id)
    assert left is not None and left.state is State.RUNNING and folder.published()
    inode = folder.results.stat().st_ino
    assert ledger.crashed(left, "The worker died")  # as if the reconcile loop had not looked at the results
    again = ledger.get(job.id)
    assert again is not None and run(again).state is State.SUCCEEDED
    assert folder.results.stat().st_ino == inode


def test_cancelled_after_the_rename_has_them_as_a_partial_result(
    run: Run, ledger: Ledger, new_job: NewJob, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    publish = JobFolder.publish

    def publish_then_cancel(self: JobFolder, number: int) -> None:
        publish(self, number)
        ledger.ask_cancel(self.path.name)

    monkeypatch.setattr(JobFolder, "publish", publish_then_cancel)
    job = run(new_job())
    folder = JobFolder(tmp_path, job.id)
    assert job.state is State.CANCELLED and job.partial
    assert not folder.results.exists() and (folder.partial / "manifest.json").is_file()
