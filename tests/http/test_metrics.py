"""/metrics over HTTP, and counting of jobs that end."""

from __future__ import annotations

import time
from collections.abc import Iterator
from pathlib import Path
from uuid import uuid4

import pytest
import sqlalchemy as sa
from prometheus_client.parser import text_string_to_metric_families

from server.census import OVERLAP_S, Outcomes
from server.migrations import prepare
from worker.contract import State
from worker.database import Database
from worker.ledger import Ledger, jobs

from .stack import Stack, commit, kill, scan_files, send, submit

Samples = dict[tuple[str, tuple[tuple[str, str], ...]], float]


def scrape(stack: Stack) -> Samples:
    answer = stack.http.get("/metrics")
    assert answer.status_code == 200 and answer.headers["content-type"].startswith("text/plain; version=")
    return {
        (sample.name, tuple(sorted(sample.labels.items()))): sample.value
        for family in text_string_to_metric_families(answer.text)
        for sample in family.samples
    }


def value(samples: Samples, name: str, **labels: str) -> float:
    return samples.get((name, tuple(sorted(labels.items()))), 0.0)


@pytest.mark.slow
def test_jobs_their_ends_and_the_queue(stack: Stack) -> None:
    scan_id = commit(stack.http, scan_files())
    ids = [submit(stack.http, scan_id) for _ in range(3)]
    time.sleep(1.2)
    before = scrape(stack)
    assert value(before, "splatct_jobs", state="queued") == 3 and value(before, "splatct_jobs", state="running") == 0
    assert 1 < value(before, "splatct_queue_age_seconds") < 60
    assert value(before, "splatct_jobs_finished_total", outcome="cancelled", error="") == 0
    stack.http.post(f"/v1/jobs/{ids[2]}/cancel")
    stack.http.delete(f"/v1/jobs/{ids[2]}")
    stack.start_worker()
    for job_id in ids[:2]:
        stack.wait(job_id, "succeeded")
    failing = submit(stack.http, commit(stack.http, scan_files(end="diverged")))
    stack.wait(failing, "failed")
    for _ in range(2):  # nothing is counted twice
        after = scrape(stack)
        assert value(after, "splatct_jobs_finished_total", outcome="succeeded", error="") == 2
        assert value(after, "splatct_jobs_finished_total", outcome="failed", error="cannot_reconstruct") == 1
        assert value(after, "splatct_jobs_finished_total", outcome="cancelled", error="") == 1, "deleted, yet counted"
        assert (
            value(after, "splatct_jobs", state="succeeded") == 2 and value(after, "splatct_jobs", state="queued") == 0
        )
        assert value(after, "splatct_queue_age_seconds") == 0


def test_recoveries_are_counted(stack: Stack) -> None:
    worker = stack.start_worker()
    job_id = submit(stack.http, commit(stack.http, scan_files(steps=100, pause=0.05)))
    stack.until(lambda: stack.job(job_id)["stage"] == "level", what="the engine is at work")
    assert value(scrape(stack), "splatct_recoveries_total") == 0
    kill(worker)
    stack.wait(job_id, "queued")
    assert value(scrape(stack), "splatct_recoveries_total") == 1


def test_requests_are_counted_by_route_and_no_id_is_a_label(shared: Stack) -> None:
    before = scrape(shared)
    files = scan_files()
    upload_id = send(shared.http, files)
    shared.http.post(f"/v1/uploads/{upload_id}/commit")
    job_id = submit(shared.http, upload_id)
    missing = uuid4()
    shared.http.get(f"/v1/jobs/{missing}")
    shared.http.get(f"/v1/jobs/{job_id}?wait=0.1")
    shared.http.get("/v1/no/such/path")
    shared.http.get("/healthz", headers={"host": "elsewhere.example"})
    shared.http.get("/static/job.js")
    static = {"method": "GET", "route": "/static", "status": "200"}
    was = value(before, "splatct_requests_total", **static)
    # A file's last byte may be here before its request has ended over there.
    shared.until(lambda: value(scrape(shared), "splatct_requests_total", **static) > was, what="the file is counted")
    after = scrape(shared)

    def more(name: str, **labels: str) -> float:
        return value(after, name, **labels) - value(before, name, **labels)

    put = "/v1/uploads/{upload_id}/files/{name}"
    assert more("splatct_requests_total", method="PUT", route=put, status="200") == 2
    assert more("splatct_request_seconds_count", method="PUT", route=put) == 2
    assert more("splatct_upload_bytes_total") == sum(map(len, files.values()))
    assert more("splatct_requests_total", method="GET", route="/v1/jobs/{job_id}", status="404") == 1
    assert more("splatct_request_seconds_count", method="GET", route="/v1/jobs/{job_id}?wait") == 1
    assert more("splatct_requests_total", method="GET", route="none", status="404") == 1
    assert more("splatct_requests_total", method="GET", route="none", status="421") == 1
    assert more("splatct_requests_total", **static) == 1
    text = shared.http.get("/metrics").text
    assert not any(word in text for word in (job_id, upload_id, str(missing), "no/such"))
    assert value(after, "splatct_disk_free_bytes") > 0 and value(after, "splatct_database_up") == 1


@pytest.fixture
def database(tmp_path: Path) -> Iterator[Database]:
    opened = Database(f"sqlite:///{tmp_path / 'test.db'}")
    prepare(opened)
    yield opened
    opened.close()


def end(database: Database, at: float) -> None:
    """A job that was cancelled at that time."""
    job_id = str(uuid4())
    with database.writing() as write:
        Ledger(database).add(write, job_id, "job", ("scan", "scan"), {})
        write.execute(sa.update(jobs).where(jobs.c.id == job_id).values(state=State.CANCELLED, finished_at=at))


def test_ends_are_counted_once_even_if_committed_late(database: Database) -> None:
    end(database, time.time() - 1)
    outcomes = Outcomes(database)
    assert outcomes.counts.total() == 0, "it ended before the count began"
    end(database, time.time())
    outcomes.catch_up()
    end(database, time.time() - OVERLAP_S / 2)  # written after the last look, with a time before it
    outcomes.catch_up()
    outcomes.catch_up()
    assert outcomes.counts == {(State.CANCELLED, ""): 2}
