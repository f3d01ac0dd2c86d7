"""The engine process by itself."""

from __future__ import annotations

import json
import os
import subprocess
import sys
from collections.abc import Callable
from pathlib import Path

import pytest

from splatcore.errors import ResultError
from worker.contract import Exit
from worker.engine import _classify
from worker.jobfolder import JobFolder
from worker.ledger import Job
from worker.process import clean_environment
from worker.settings import WorkerSettings

NewJob = Callable[..., Job]


def engine(folder: JobFolder, parent: int) -> subprocess.CompletedProcess[str]:
    command = [sys.executable, "-P", "-m", "worker.engine", str(folder.path), "--attempt", "1"]
    command += ["--parent", str(parent), "--engine", "fake_engine"]
    return subprocess.run(command, env=clean_environment(), capture_output=True, text=True, check=False)


@pytest.fixture
def folder(new_job: NewJob, settings: WorkerSettings, tmp_path: Path) -> JobFolder:
    folder = JobFolder(tmp_path, new_job(steps=3).id)
    folder.prepare({"options": {"quality": "fine"}}, 1)
    return folder


def test_events_go_to_stdout_and_nothing_else(folder: JobFolder) -> None:
    done = engine(folder, os.getpid())
    assert done.returncode == Exit.OK
    assert [json.loads(line)["stage"] for line in done.stdout.splitlines()] == [
        "read",
        "start",
        "level",
        "level",
        "level",
    ]
    manifest = json.loads((folder.attempt(1) / "manifest.json").read_text())
    assert manifest["options"]["quality"] == "fine"


def test_it_does_nothing_for_a_parent_that_is_gone(folder: JobFolder) -> None:
    done = engine(folder, os.getpid() + 1)
    assert (done.returncode, done.stdout) == (1, "")
    assert list(folder.attempt(1).iterdir()) == []


def test_a_cancel_file_stops_it_before_the_first_step(folder: JobFolder) -> None:
    folder.cancel.touch()
    assert engine(folder, os.getpid()).returncode == Exit.CANCELLED
    assert list(folder.attempt(1).iterdir()) == []


def test_bad_options_are_bad_input(folder: JobFolder) -> None:
    folder.spec.write_text(json.dumps({"options": {"quality": "divine"}}))
    done = engine(folder, os.getpid())
    assert done.returncode == Exit.BAD_INPUT and "quality" in json.loads(done.stdout)["error"]


def test_a_full_disk_is_seen_through_the_result_writers_error() -> None:
    error = ResultError("cannot be written to")
    error.__cause__ = OSError(28, "No space left on device")
    assert _classify(error)[0] is Exit.DISK_FULL
    assert _classify(ResultError("other"))[0] is Exit.BUG


def test_torch_out_of_memory_is_recognised_without_torch() -> None:
    assert _classify(RuntimeError("[enforce fail] DefaultCPUAllocator: can't allocate memory"))[0] is Exit.OUT_OF_MEMORY
    assert _classify(type("OutOfMemoryError", (RuntimeError,), {})("CUDA"))[0] is Exit.OUT_OF_MEMORY
    assert _classify(RuntimeError("shape mismatch"))[0] is Exit.BUG
