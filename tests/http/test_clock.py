"""The machine's clock jumps while jobs run: whether a worker lives is told by clocks that cannot."""

from __future__ import annotations

import os
from collections.abc import Iterator
from pathlib import Path

import pytest

from .stack import Stack, commit, kill, scan_files, submit

HOUR_S = 3600.0

pytestmark = pytest.mark.slow


class Clock:
    def __init__(self, file: Path) -> None:
        self.file = file
        self.set(0.0)

    def set(self, offset_s: float) -> None:
        part = self.file.with_suffix(".part")
        part.write_text(str(offset_s))
        part.replace(self.file)


@pytest.fixture
def clock(tmp_path: Path) -> Clock:
    return Clock(tmp_path / "clock")


@pytest.fixture
def timed(tmp_path: Path, clock: Clock) -> Iterator[Stack]:
    stack = Stack(tmp_path / "stack")
    shim = Path(__file__).with_name("clock")
    stack.environment["PYTHONPATH"] = os.pathsep.join([str(shim), stack.environment["PYTHONPATH"]])
    stack.environment["CLOCK_OFFSET_FILE"] = str(clock.file)
    with stack:
        yield stack


@pytest.mark.parametrize("jump_s", [-HOUR_S, HOUR_S], ids=["back", "forward"])
def test_a_clock_that_jumps_takes_no_job_from_its_worker(timed: Stack, clock: Clock, jump_s: float) -> None:
    timed.start_worker()
    running = submit(timed.http, commit(timed.http, scan_files(steps=40, pause=0.1)))
    timed.until(lambda: timed.job(running)["stage"] == "level", what="the engine is at work")
    before = timed.job(running)
    timed.http.get("/metrics")  # counts from where it looked last
    clock.set(jump_s)
    timed.http.get("/metrics")
    later = submit(timed.http, before["scan_id"])
    done = timed.wait(running, "succeeded", "failed")
    assert (done["state"], done["attempt"]) == ("succeeded", 1)
    assert timed.wait(later, "succeeded", "failed")["attempt"] == 1
    jumped = timed.job(later)["created_at"]
    assert (jumped < before["created_at"]) == (jump_s < 0), "the clock of the server did jump"
    assert 'splatct_jobs_finished_total{error="",outcome="succeeded"} 2.0' in timed.http.get("/metrics").text
    assert timed.http.get("/readyz").json()["workers"] == 1


@pytest.mark.parametrize("jump_s", [-HOUR_S, HOUR_S], ids=["back", "forward"])
def test_a_dead_worker_is_found_by_a_clock_that_jumps(timed: Stack, clock: Clock, jump_s: float) -> None:
    worker = timed.start_worker()
    job = submit(timed.http, commit(timed.http, scan_files(steps=20, pause=0.1)))
    timed.until(lambda: timed.job(job)["stage"] == "level", what="the engine is at work")
    clock.set(jump_s)
    kill(worker)
    timed.start_worker()
    done = timed.wait(job, "succeeded", "failed", seconds=20)
    assert (done["state"], done["attempt"]) == ("succeeded", 2)
