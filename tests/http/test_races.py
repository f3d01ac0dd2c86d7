"""Two things at the same moment: whoever comes second learns so, and nothing is left half done."""

from __future__ import annotations

import hashlib
import os
import signal
import threading
import time
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path
from uuid import uuid4

import httpx
import pytest
from redis import Redis
from rq import Queue
from rq.serializers import JSONSerializer

from splatcore.estimate import estimate
from splatcore.options import Options
from worker.contract import QUEUE, TASK, queue_id

from .stack import SCAN, Stack, commit, kill, scan_files, submit

FILES = scan_files()
SIZE = sum(map(len, FILES.values()))


def publications(stack: Stack, job_id: str) -> int:
    log = (stack.data.parent / "log.txt").read_text()
    return sum(job_id in line and "published its results" in line for line in log.splitlines())


# Cancelling while something dies


@pytest.mark.slow
@pytest.mark.parametrize("victim", ["worker", "engine", "server"])
def test_a_cancellation_that_was_accepted_is_one_whatever_dies(stack: Stack, victim: str) -> None:
    worker, server = stack.start_worker(), stack.server
    scan_id = commit(stack.http, scan_files(steps=6, pause=0.1))
    for turn in range(8):
        job_id = submit(stack.http, scan_id)
        stack.until(lambda job_id=job_id: stack.job(job_id)["stage"] == "level", what="the engine is at work")
        ahead_s = (turn % 4) * 0.04  # the death comes up to so much before the request, or after it
        answers: list[int] = []

        def cancel(job_id: str = job_id, ahead_s: float = ahead_s, turn: int = turn, to: list[int] = answers) -> None:
            time.sleep(ahead_s if turn < 4 else 0)
            try:
                to.append(stack.http.post(f"/v1/jobs/{job_id}/cancel").status_code)
            except httpx.TransportError:
                to.append(0)  # the server died under the request

        asking = threading.Thread(target=cancel)
        asking.start()
        time.sleep(ahead_s if turn >= 4 else 0)
        if victim == "worker":
            kill(worker)
            worker = stack.start_worker()
        elif victim == "server":
            kill(server)
            server = stack.start_server()
        else:
            for pid in stack.engine_pids():
                os.kill(pid, signal.SIGKILL)
        asking.join()
        done = stack.wait(job_id, "cancelled", "succeeded", "failed", seconds=40)
        assert done["state"] == "cancelled" or (answers == [0] and done["state"] == "succeeded"), (turn, answers, done)
        stack.until(lambda: not stack.engine_pids(), 10, "no engine is left at work")
        folder = stack.data / "jobs" / job_id
        stack.until(lambda folder=folder: not list(folder.glob("attempt-*")), 5, "no half result is left")
        assert stack.http.get(f"/v1/jobs/{job_id}/results").status_code == (
            409 if done["state"] == "cancelled" else 200
        )


def test_a_job_cancelled_in_the_queue_holds_on_to_no_scan(stack: Stack) -> None:
    """Its links to the scan's files would keep the disk that deleting the scan should give back."""
    scan_id = commit(stack.http, FILES)
    job_id = submit(stack.http, scan_id)
    files = list((stack.data / "scans" / scan_id).iterdir())
    assert {file.stat().st_nlink for file in files} == {2}
    assert stack.http.post(f"/v1/jobs/{job_id}/cancel").json()["state"] == "cancelled"
    assert {file.stat().st_nlink for file in files} == {1}
    assert not (stack.data / "jobs" / job_id / "scan").exists()


# Deleting while something is going on


@pytest.mark.slow
def test_a_job_at_work_is_not_deleted_and_one_that_just_ended_is_whole_or_gone(stack: Stack) -> None:
    stack.start_worker()
    scan_id = commit(stack.http, scan_files(steps=3, pause=0.05))
    for _ in range(6):
        job_id, answers = submit(stack.http, scan_id), []
        while not answers or answers[-1] == 409:
            before = stack.job(job_id)["state"]
            answers.append(stack.http.delete(f"/v1/jobs/{job_id}").status_code)
            assert answers[-1] == 409 or before in ("running", "succeeded"), before
        assert answers[-1] == 204 and len(answers) > 3, "it was asked for all the time, and granted at the end"
        assert stack.http.get(f"/v1/jobs/{job_id}").status_code == 404
        time.sleep(0.2)  # the worker may still be tidying up
        assert not list((stack.data / "jobs").iterdir()), "nothing comes back"
    assert "Traceback" not in (stack.data.parent / "log.txt").read_text()


def test_a_scan_that_a_job_is_at_is_not_deleted(stack: Stack) -> None:
    stack.start_worker()
    scan_id = commit(stack.http, scan_files(steps=5, pause=0.05))
    job_id = submit(stack.http, scan_id)
    while stack.job(job_id)["state"] in ("queued", "running"):
        answer = stack.http.delete(f"/v1/scans/{scan_id}").status_code
        if answer == 204:  # it ended between the two
            break
        assert answer == 409
    assert stack.wait(job_id, "succeeded", "failed")["state"] == "succeeded"


def test_a_download_of_what_is_deleted_ends_whole(stack: Stack) -> None:
    """Who reads has the file open; taking its name away does not cut it."""
    stack.start_worker()
    job_id = submit(stack.http, commit(stack.http, scan_files(result_bytes=32 << 20)))
    stack.wait(job_id, "succeeded")
    listed = stack.http.get(f"/v1/jobs/{job_id}/results").json()["files"]
    largest = max(listed, key=lambda file: file["size"])
    digest, seen = hashlib.sha256(), 0
    with stack.http.stream("GET", f"/v1/jobs/{job_id}/results/{largest['name']}") as answer:
        assert answer.status_code == 200
        for chunk in answer.iter_raw(1 << 20):
            if not seen:
                with stack.client() as other:
                    assert other.delete(f"/v1/jobs/{job_id}").status_code == 204
            digest.update(chunk)
            seen += len(chunk)
    assert (seen, digest.hexdigest()) == (largest["size"], largest["sha256"])
    assert stack.http.get(f"/v1/jobs/{job_id}/results/{largest['name']}").status_code == 404
    assert not list((stack.data / "jobs").iterdir())


# Many at once


@pytest.mark.slow
def test_of_several_workers_one_runs_a_job_that_the_queue_names_many_times(stack: Stack) -> None:
    for _ in range(4):
        stack.start_worker()
    stack.until(lambda: stack.http.get("/readyz").json()["workers"] == 4, what="four workers")
    job_id = submit(stack.http, commit(stack.http, scan_files(steps=20, pause=0.05)))
    with Redis.from_url(stack.redis.url) as redis:
        queue, most = Queue(QUEUE, connection=redis, serializer=JSONSerializer), 0
        while stack.job(job_id)["state"] in ("queued", "running"):
            for number in range(4):
                queue.enqueue_call(TASK, args=(job_id, 1), job_id=f"{queue_id(job_id, 1)}-{number}", timeout=-1)
            most = max(most, len(stack.engine_pids()))
    done = stack.job(job_id)
    assert (done["state"], done["attempt"], most) == ("succeeded", 1, 1)
    assert publications(stack, job_id) == 1
    events = stack.http.get(f"/v1/jobs/{job_id}/events").json()["events"]
    assert sum(event["stage"] == "read" for event in events) == 1


@pytest.mark.slow
def test_at_the_edge_of_a_quota_none_is_ever_over_it(tmp_path: Path) -> None:
    """Uploads that begin whole, that grow and that go; jobs of every kind of submission, and cancelled ones. The bytes
    are enough for three jobs, or for an upload less with each."""
    stack, most_jobs = Stack(tmp_path), 3
    job_bytes = estimate(12, 16, 16, SCAN["volume"]["shape"], Options()).disk_bytes
    limit = round(3.5 * job_bytes)
    stack.environment |= {"SPLATCT_TENANT_GIB": str(limit / (1 << 30)), "SPLATCT_TENANT_JOBS": str(most_jobs)}
    stack.environment |= {"SPLATCT_RATE_PER_S": "0"}
    with stack:
        scan_id = commit(stack.http, FILES)
        cost = stack.http.post("/v1/jobs/validate", json={"scan_id": scan_id}).raise_for_status().json()
        assert cost["disk_bytes"] == job_bytes
        listed = [{"name": "scan.json", "size": 1000}, {"name": "projections.tif", "size": round(0.8 * job_bytes)}]
        began, over, taken = time.monotonic(), [], {"upload": 0, "grown": 0, "job": 0}

        def going_on() -> bool:
            seconds = time.monotonic() - began
            return seconds < 6 or (seconds < 60 and min(taken.values()) < 10)

        def watch() -> None:
            with stack.client() as http:
                while going_on():
                    usage = http.get("/v1/usage").json()
                    if usage["bytes"]["used"] > limit or usage["active_jobs"]["used"] > most_jobs:
                        over.append(usage)

        def upload(grows: bool) -> None:
            with stack.client() as http:
                while going_on():
                    body = {"name": "s", "files": [] if grows else listed, "growing": grows}
                    made = http.post("/v1/uploads", json=body)
                    if made.status_code == 201 and grows:
                        more = http.post(f"/v1/uploads/{made.json()['id']}/files", json={"files": listed})
                        assert more.status_code in (200, 201, 507), more.text
                        taken["grown"] += more.status_code != 507
                    assert made.status_code in (201, 507), made.text
                    if made.status_code == 201:
                        taken["upload"] += 1
                        assert http.delete(f"/v1/uploads/{made.json()['id']}").status_code == 204

        def job(put: bool) -> None:
            with stack.client() as http:
                while going_on():
                    body = {"scan_id": scan_id}
                    made = http.put(f"/v1/jobs/{uuid4()}", json=body) if put else http.post("/v1/jobs", json=body)
                    assert made.status_code in (202, 429, 507), made.text
                    if made.status_code == 202:
                        taken["job"] += 1
                        http.post(f"/v1/jobs/{made.json()['id']}/cancel").raise_for_status()

        with ThreadPoolExecutor(17) as pool:
            tasks = [pool.submit(watch)]
            tasks += [pool.submit(upload, number % 2 == 0) for number in range(8)]
            tasks += [pool.submit(job, number % 2 == 0) for number in range(8)]
            for task in tasks:
                task.result()
        assert over == []
        assert min(taken.values()) >= 10, taken
        # The last of the cancelled jobs is measured by the next round of the reconciler.
        stack.until(
            lambda: stack.http.get("/v1/usage").json()["bytes"]["used"] == SIZE, 20, "all that was taken is given back"
        )
        # And at rest exactly as many as fit are taken.
        with ThreadPoolExecutor(12) as pool:
            answers = list(pool.map(lambda _: stack.http.post("/v1/jobs", json={"scan_id": scan_id}), range(12)))
        assert sorted(a.status_code for a in answers) == [202] * most_jobs + [429] * (12 - most_jobs)
        assert stack.http.post("/v1/uploads", json={"name": "s", "files": listed}).status_code == 507
