"""A submission that is repeated, at once or later, makes one job."""

from __future__ import annotations

import threading
import time
from collections.abc import Callable, Iterator
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path
from typing import Any
from uuid import uuid4

import httpx
import pytest
import sqlalchemy as sa

from server.migrations import prepare
from server.store import File, NewJob, Store
from server.submissions import KEPT_S, Claim, Kind, submissions
from worker.database import Database

from .stack import Stack, commit, scan_files, submit


@pytest.fixture(scope="module")
def idle(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Stack]:
    """A service without a worker."""
    with Stack(tmp_path_factory.mktemp("idle")) as running:
        yield running


@pytest.fixture
def http(idle: Stack) -> httpx.Client:
    return idle.http


Send = Callable[..., httpx.Response]


def by_key(http: httpx.Client) -> Send:
    headers = {"Idempotency-Key": f"order {uuid4()}".replace(" ", "-")}
    return lambda body: http.post("/v1/jobs", json=body, headers=headers)


def by_id(http: httpx.Client) -> Send:
    url = f"/v1/jobs/{uuid4()}"
    return lambda body: http.put(url, json=body)


BOTH = pytest.mark.parametrize("way", [by_key, by_id])


def jobs_of(http: httpx.Client, scan_id: str) -> list[dict[str, Any]]:
    listed = http.get("/v1/jobs?limit=500").json()["jobs"]
    return [job for job in listed if job["scan_id"] == scan_id]


@BOTH
def test_a_repeated_submission_is_the_same_job(http: httpx.Client, way: Callable[[httpx.Client], Send]) -> None:
    send, scan_id = way(http), commit(http, scan_files())
    first = send({"scan_id": scan_id, "options": {"seed": 3, "calibrate": "none"}})
    assert first.status_code == 202 and "idempotency-replayed" not in first.headers
    again = send({"options": {"calibrate": "none", "seed": 3}, "scan_id": scan_id, "name": None})
    assert again.status_code == 202 and again.headers["idempotency-replayed"] == "true"
    assert again.json() == first.json() and again.headers["location"] == first.headers["location"]
    assert len(jobs_of(http, scan_id)) == 1
    http.post(f"/v1/jobs/{first.json()['id']}/cancel")
    http.delete(f"/v1/scans/{scan_id}")
    late = send({"scan_id": scan_id, "options": {"seed": 3, "calibrate": "none"}})
    assert late.status_code == 202 and late.json()["state"] == "cancelled", "the job as it is now, its scan long gone"


def test_another_body_is_refused(http: httpx.Client) -> None:
    scan_id = commit(http, scan_files())
    for way, status, name in ((by_key, 422, "idempotency-key-reused"), (by_id, 409, "job-exists")):
        send = way(http)
        send({"scan_id": scan_id})
        answer = send({"scan_id": scan_id, "name": "another"})
        assert answer.status_code == status and answer.json()["type"] == f"urn:splatct:problem:{name}"
        assert answer.json()["errors"][0]["hint"]
    assert len(jobs_of(http, scan_id)) == 2


@BOTH
def test_a_refused_submission_is_not_remembered(http: httpx.Client, way: Callable[[httpx.Client], Send]) -> None:
    send, scan_id = way(http), commit(http, scan_files())
    assert send({"scan_id": str(uuid4())}).status_code == 422
    assert send({"scan_id": scan_id, "options": {"colour": 1}}).status_code == 422
    assert send({"scan_id": scan_id}).status_code == 202


@BOTH
def test_of_submissions_at_once_one_makes_the_job(
    http: httpx.Client, idle: Stack, way: Callable[[httpx.Client], Send]
) -> None:
    scan_id = commit(http, scan_files())
    for _ in range(10):
        send, together = way(http), threading.Barrier(8)

        def one(send: Send = send, together: threading.Barrier = together) -> httpx.Response:
            together.wait()
            return send({"scan_id": scan_id})

        before = len(jobs_of(http, scan_id))
        with ThreadPoolExecutor(8) as pool:
            answers = [future.result() for future in [pool.submit(one) for _ in range(8)]]
        assert {answer.status_code for answer in answers} == {202}
        assert len({answer.json()["id"] for answer in answers}) == 1
        assert sum("idempotency-replayed" not in answer.headers for answer in answers) == 1
        assert len(jobs_of(http, scan_id)) == before + 1
        scan = idle.data / "jobs" / answers[0].json()["id"] / "scan"
        assert {file.name for file in scan.iterdir()} == {"scan.json", "projections.tif"}
    assert not list((idle.data / "jobs").glob(".*")), "the losers cleaned up after themselves"


def test_the_clients_id_is_the_jobs(http: httpx.Client) -> None:
    scan_id, job_id = commit(http, scan_files()), uuid4()
    answer = http.put(f"/v1/jobs/{str(job_id).upper()}", json={"scan_id": scan_id})
    assert answer.json()["id"] == str(job_id) and answer.headers["location"] == f"/v1/jobs/{job_id}"
    assert http.get(f"/v1/jobs/{job_id}").status_code == 200
    assert http.put("/v1/jobs/not-a-uuid", json={"scan_id": scan_id}).status_code == 422


def test_an_id_that_the_server_gave_is_taken(http: httpx.Client) -> None:
    scan_id = commit(http, scan_files())
    job_id = submit(http, scan_id)
    assert http.put(f"/v1/jobs/{job_id}", json={"scan_id": scan_id}).status_code == 409
    assert http.get(f"/v1/jobs/{job_id}").json()["state"] == "queued"


@BOTH
def test_a_late_repeat_does_not_revive_a_deleted_job(http: httpx.Client, way: Callable[[httpx.Client], Send]) -> None:
    send, body = way(http), {"scan_id": commit(http, scan_files())}
    job_id = send(body).json()["id"]
    http.post(f"/v1/jobs/{job_id}/cancel")
    assert http.delete(f"/v1/jobs/{job_id}").status_code == 204
    assert send(body).status_code == 410


@pytest.mark.parametrize("key", ["", "a b", "x" * 256, "naïve"])
def test_keys_that_are_none(http: httpx.Client, key: str) -> None:
    body = {"scan_id": commit(http, scan_files())}
    assert http.post("/v1/jobs", json=body, headers={"Idempotency-Key": key.encode()}).status_code == 422


def test_what_a_cut_off_submission_left_is_replaced(http: httpx.Client, idle: Stack) -> None:
    """The server died between moving the folder and committing the row: the repeat must not trip over it."""
    scan_id, job_id = commit(http, scan_files()), str(uuid4())
    left = idle.data / "jobs" / job_id
    left.mkdir()
    (left / "events.jsonl").write_text("half of something")
    assert http.put(f"/v1/jobs/{job_id}", json={"scan_id": scan_id}).status_code == 202
    assert not (left / "events.jsonl").exists() and (left / "scan" / "scan.json").exists()


def test_keys_are_forgotten_after_a_day_and_ids_with_their_jobs(tmp_path: Path) -> None:
    database = Database(f"sqlite:///{tmp_path / 'test.db'}")
    prepare(database)
    store = Store(database)
    upload = store.add_upload("scan", [File("scan.json", 1, None, None)])
    scan = store.commit(upload, {})
    names = {"key": Claim(Kind.KEY, "a", "d"), "kept": Claim(Kind.ID, "b", "d"), "gone": Claim(Kind.ID, "c", "d")}
    for job_id, claim in names.items():
        assert store.add_job(NewJob(job_id, job_id, {}, claim), scan, lambda: None)
    store.jobs.ask_cancel("gone")
    store.jobs.forget("gone")
    found = {job_id: store.submissions.find(claim) is not None for job_id, claim in names.items()}
    assert found == {"key": True, "kept": True, "gone": True}
    with database.writing() as write:
        write.execute(sa.update(submissions).values(created_at=time.time() - KEPT_S - 1))
    found = {job_id: store.submissions.find(claim) is not None for job_id, claim in names.items()}
    assert found == {"key": False, "kept": True, "gone": False}
    assert store.add_job(NewJob("new", "new", {}, Claim(Kind.KEY, "a", "e")), scan, lambda: None)
    store.submissions.purge()
    with database.reading() as read:
        assert sorted(read.execute(sa.select(submissions.c.name)).scalars()) == ["a", "b"]
    database.close()
