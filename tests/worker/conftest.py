from __future__ import annotations

import json
import signal
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any
from uuid import uuid4

import pytest

from server.migrations import prepare
from worker.database import Database
from worker.jobfolder import JobFolder
from worker.ledger import Job, Ledger
from worker.settings import WorkerSettings

FAKES = Path(__file__).parent / "fakes"


@pytest.fixture
def database(tmp_path: Path) -> Iterator[Database]:
    opened = Database(f"sqlite:///{tmp_path / 'test.db'}")
    prepare(opened)
    yield opened
    opened.close()


@pytest.fixture
def ledger(database: Database) -> Ledger:
    return Ledger(database)


@pytest.fixture
def settings(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> WorkerSettings:
    monkeypatch.setenv("PYTHONPATH", str(FAKES))
    return WorkerSettings(data=tmp_path, engine="fake_engine", cancel_grace_s=1.0, checkpoint_s=0.2)


@pytest.fixture
def new_job(ledger: Ledger, database: Database, tmp_path: Path) -> Callable[..., Job]:
    """Makes a queued job with its folder; `plan` tells the fake engine how to behave."""

    def make(**plan: Any) -> Job:
        job_id, scan = str(uuid4()), tmp_path / "scans" / str(uuid4())
        scan.mkdir(parents=True)
        (scan / "scan.json").write_text(json.dumps({"name": "fake " + json.dumps(plan)}))
        JobFolder(tmp_path, job_id).create(scan)
        with database.writing() as write:
            ledger.add(write, job_id, "a job", (scan.name, "a scan"), {"quality": "preview"})
        job = ledger.get(job_id)
        assert job is not None
        return job

    return make


@pytest.fixture
def keep_sigterm() -> Iterator[None]:
    """The supervisor takes SIGTERM for itself; give it back to pytest."""
    kept = signal.getsignal(signal.SIGTERM)
    yield
    signal.signal(signal.SIGTERM, kept)
