"""Any part may die at any moment; every job still ends once, and as it should."""

from __future__ import annotations

import hashlib
import json
import os
import signal
import subprocess
import sys
import time
import zipfile
from pathlib import Path

import numpy as np
import pytest
from redis import Redis

from splatcore.simulate import Simulation, simulate

from .stack import Stack, commit, kill, scan_files, submit


def long_job(stack: Stack, steps: int = 24) -> str:
    return submit(stack.http, commit(stack.http, scan_files(steps=steps, pause=0.05)))


def mid_job(stack: Stack, job_id: str) -> None:
    stack.until(lambda: stack.job(job_id)["stage"] == "level", what="the engine is at work")


def publications(stack: Stack, job_id: str) -> int:
    log = (stack.data.parent / "log.txt").read_text()
    return sum(job_id in line and "published its results" in line for line in log.splitlines())


def test_a_killed_worker_takes_its_engine_along_and_the_job_runs_again_once(stack: Stack) -> None:
    worker = stack.start_worker()
    job_id = long_job(stack)
    mid_job(stack, job_id)
    assert len(stack.engine_pids()) == 1
    kill(worker)
    stack.until(lambda: not stack.engine_pids(), 5, "the engine died with its worker")
    again = stack.wait(job_id, "queued", seconds=10)
    assert again["attempt"] == 2
    stack.start_worker()
    stack.start_worker()
    done = stack.wait(job_id, "succeeded", "failed")
    assert (done["state"], done["attempt"]) == ("succeeded", 2)
    events = stack.http.get(f"/v1/jobs/{job_id}/events").json()["events"]
    assert sorted({event.get("attempt", 2) for event in events}) == [1, 2]
    assert sum(event["stage"] == "read" for event in events) == 2
    time.sleep(1.0)  # room for a second run, if there were one
    assert publications(stack, job_id) == 1 and not stack.engine_pids()


def test_a_killed_engine_is_started_again(stack: Stack) -> None:
    stack.start_worker()
    job_id = long_job(stack)
    mid_job(stack, job_id)
    os.kill(stack.engine_pids()[0], signal.SIGKILL)
    done = stack.wait(job_id, "succeeded", "failed")
    assert (done["state"], done["attempt"]) == ("succeeded", 2)
    assert publications(stack, job_id) == 1


def steps(stack: Stack, job_id: str, attempt: int) -> list[int]:
    events = stack.http.get(f"/v1/jobs/{job_id}/events").json()["events"]
    return [e["step"] for e in events if e.get("attempt") == attempt and e["stage"] == "level"]


def step_kept(stack: Stack, job_id: str) -> int:
    """What the checkpoint says, once its writer is gone."""
    stack.until(lambda: not stack.engine_pids(), 5, "the engine died with its worker")
    with zipfile.ZipFile(stack.data / "jobs" / job_id / "run.checkpoint") as file:
        return int(json.loads(file.read("state.json"))["dict"]["step"])


@pytest.mark.slow
def test_no_more_than_one_checkpoint_of_work_is_lost(stack: Stack) -> None:
    """Worker killed, then everything but the data folder killed: the next attempt begins where the last state was
    kept, and nothing before that is done twice."""
    worker = stack.start_worker()
    job_id = long_job(stack, steps=120)
    stack.until(lambda: len(steps(stack, job_id, 1)) > 30, what="thirty steps")
    kill(worker)
    kept = [step_kept(stack, job_id)]
    worker = stack.start_worker()
    stack.until(lambda: len(steps(stack, job_id, 2)) > 30, what="thirty more steps")
    kill(worker)
    kept.append(step_kept(stack, job_id))
    kill(stack.server)
    stack.redis.kill()
    stack.redis.start()
    stack.start_server()
    stack.start_worker()
    done = stack.wait(job_id, "succeeded", "failed")
    assert (done["state"], done["attempt"]) == ("succeeded", 3)
    ran = [steps(stack, job_id, attempt) for attempt in (1, 2, 3)]
    assert all(part == list(range(part[0], part[-1] + 1)) for part in ran)
    assert [ran[1][0], ran[2][0]] == kept and kept[0] > 0
    assert ran[2][-1] == 119
    events = stack.http.get(f"/v1/jobs/{job_id}/events").json()["events"]
    assert sum("Going on from the checkpoint" in event["message"] for event in events) == 2


@pytest.mark.slow
def test_the_real_engine_killed_twice_gives_the_bits_of_one_that_was_not(stack: Stack) -> None:
    z, y, x = np.mgrid[-1:1:24j, -1:1:24j, -1:1:24j]
    body = 0.5 * (x**2 + (y / 0.7) ** 2 + z**2 < 0.6) + 0.4 * (abs(x + 0.3) + abs(y) + abs(z) < 0.25)
    folder = stack.data.parent / "real"
    simulate(body.astype(np.float32), folder, Simulation(views=16, det=48, sigma_rot=0.02, seed=1), 1, name="real")
    scan_id = commit(
        stack.http, {file.name: file.read_bytes() for file in folder.iterdir() if file.name != "truth.tif"}
    )
    stack.environment |= {"SPLATCT_ENGINE": "splatcore", "SPLATCT_TEST_MODE": "1", "SPLATCT_TEST_STEP_S": "0.002"}
    worker = stack.start_worker()
    options = {"quality": "preview", "splats": 1500, "threads": 1}
    plain = stack.wait(submit(stack.http, scan_id, **options), "succeeded", "failed", seconds=120)
    job_id = submit(stack.http, scan_id, **options)
    for attempt, share in ((1, 0.3), (2, 0.6)):
        stack.until(lambda share=share: stack.job(job_id)["progress"] > share, 60, f"{share} of attempt {attempt}")  # type: ignore[misc]
        if attempt == 1:
            os.kill(stack.engine_pids()[0], signal.SIGKILL)
        else:
            kill(worker)
            stack.start_worker()
        stack.until(lambda attempt=attempt: stack.job(job_id)["attempt"] > attempt, 20, "another attempt")  # type: ignore[misc]
    done = stack.wait(job_id, "succeeded", "failed", seconds=120)
    assert (plain["state"], done["state"], done["attempt"]) == ("succeeded", "succeeded", 3)
    for name in ("volume.tif", "splats.npz", "report.json"):
        got = [stack.http.get(f"/v1/jobs/{job['id']}/results/{name}").content for job in (plain, done)]
        assert got[0] == got[1], name


@pytest.mark.slow
def test_a_drained_worker_loses_no_work(stack: Stack) -> None:
    worker = stack.start_worker()
    job_id = long_job(stack, steps=100)
    stack.until(lambda: len(steps(stack, job_id, 1)) > 30, what="thirty steps")
    worker.terminate()
    assert worker.wait(20) == 0
    stack.start_worker()
    assert stack.wait(job_id, "succeeded", "failed")["state"] == "succeeded"
    assert steps(stack, job_id, 2)[0] in (steps(stack, job_id, 1)[-1], steps(stack, job_id, 1)[-1] + 1)


def test_what_a_cancelled_job_had_can_be_fetched(stack: Stack) -> None:
    stack.start_worker()
    job_id = long_job(stack, steps=400)
    mid_job(stack, job_id)
    stack.http.post(f"/v1/jobs/{job_id}/cancel")
    job = stack.wait(job_id, "cancelled")
    assert "partial" in job["message"] and stack.http.get(f"/v1/jobs/{job_id}/results").status_code == 409
    manifest = stack.http.get(job["links"]["partial"]).json()
    for file in manifest["files"]:
        got = stack.http.get(f"/v1/jobs/{job_id}/partial/{file['name']}").raise_for_status().content
        assert hashlib.sha256(got).hexdigest() == file["sha256"]
    command = [sys.executable, "-m", "splatct_client", "fetch", job_id, "--server", str(stack.http.base_url)]
    for more, code in ([], 1), (["--partial"], 0):
        out = ["-o", str(stack.data.parent / "fetched")]
        assert subprocess.run([*command, *more, *out], capture_output=True, check=False).returncode == code
    assert (stack.data.parent / "fetched" / "manifest.json").exists()
    assert stack.http.get(f"/v1/jobs/{job_id}/slices/z/2.png").headers["content-type"] == "image/png"
    assert stack.http.get(job["links"]["report"]).status_code == 200


def test_a_stopped_worker_hands_its_job_back(stack: Stack) -> None:
    worker = stack.start_worker()
    job_id = long_job(stack, steps=400)
    mid_job(stack, job_id)
    started = time.monotonic()
    worker.terminate()
    assert worker.wait(20) == 0
    assert time.monotonic() - started < 10
    job = stack.job(job_id)
    assert (job["state"], job["attempt"]) == ("queued", 2) and not stack.engine_pids()
    assert stack.http.get("/readyz").json()["workers"] == 0


def test_wiping_redis_loses_no_queued_job(stack: Stack) -> None:
    scan_id = commit(stack.http, scan_files())
    ids = [submit(stack.http, scan_id) for _ in range(6)]
    redis = Redis.from_url(stack.redis.url)
    stack.until(lambda: redis.llen("rq:queue:splatct") == 6, what="six on the queue")
    redis.flushall()
    stack.until(lambda: redis.llen("rq:queue:splatct") == 6, what="six on the queue again")
    redis.flushall()
    redis.close()
    stack.start_worker()
    for job_id in ids:
        done = stack.wait(job_id, "succeeded", "failed")
        assert (done["state"], done["attempt"]) == ("succeeded", 1)
        assert publications(stack, job_id) == 1


def test_wiping_redis_does_not_disturb_a_running_job(stack: Stack) -> None:
    stack.start_worker()
    job_id = long_job(stack, steps=36)
    mid_job(stack, job_id)
    with Redis.from_url(stack.redis.url) as redis:
        redis.flushall()
    done = stack.wait(job_id, "succeeded", "failed")
    assert (done["state"], done["attempt"]) == ("succeeded", 1)
    after = submit(stack.http, commit(stack.http, scan_files()))  # and the worker goes on
    assert stack.wait(after, "succeeded", "failed")["state"] == "succeeded"


def test_jobs_are_accepted_without_redis_and_run_when_it_is_back(stack: Stack) -> None:
    stack.redis.kill()
    job_id = submit(stack.http, commit(stack.http, scan_files()))
    assert stack.http.get("/readyz").json()["redis"] is False
    assert stack.job(job_id)["state"] == "queued"
    stack.redis.start()
    stack.start_worker()
    assert stack.wait(job_id, "succeeded", "failed")["state"] == "succeeded"


@pytest.mark.slow
def test_a_worker_is_seen_again_after_redis_was_wiped(stack: Stack) -> None:
    stack.start_worker()
    stack.until(lambda: stack.http.get("/readyz").status_code == 200, what="a worker")
    with Redis.from_url(stack.redis.url) as redis:
        redis.flushall()
    stack.until(lambda: stack.http.get("/readyz").status_code == 503, 3, "the worker out of sight")
    stack.until(lambda: stack.http.get("/readyz").status_code == 200, 30, "the worker again")


@pytest.mark.slow
def test_redis_dying_under_a_running_job_costs_it_nothing(stack: Stack) -> None:
    stack.start_worker()
    job_id = long_job(stack, steps=500)
    mid_job(stack, job_id)
    stack.redis.kill()
    time.sleep(15)  # past the worker's heartbeats and retries
    stack.redis.start()
    done = stack.wait(job_id, "succeeded", "failed", seconds=60)
    assert (done["state"], done["attempt"]) == ("succeeded", 1)
    after = submit(stack.http, commit(stack.http, scan_files()))
    assert stack.wait(after, "succeeded", "failed", seconds=60)["state"] == "succeeded"


def test_a_killed_server_forgets_nothing(stack: Stack) -> None:
    stack.start_worker()
    running = long_job(stack)
    scan_id = commit(stack.http, scan_files())
    queued = submit(stack.http, scan_id)
    mid_job(stack, running)
    kill(stack.server)
    stack.start_server()
    for job_id in (running, queued):
        done = stack.wait(job_id, "succeeded", "failed")
        assert (done["state"], done["attempt"]) == ("succeeded", 1)


def test_a_server_killed_between_commit_steps_commits_on_the_next_call(stack: Stack) -> None:
    from .stack import send

    upload_id = send(stack.http, scan_files())
    # As if it had died after the files were moved and before the database knew.
    (stack.data / "uploads" / upload_id / "scan").rename(stack.data / "scans" / upload_id)
    answer = stack.http.post(f"/v1/uploads/{upload_id}/commit")
    assert answer.status_code == 201
    assert submit(stack.http, answer.json()["id"])
    assert not (stack.data / "uploads" / upload_id).exists()


def test_a_cancelled_job_whose_worker_died_ends(stack: Stack) -> None:
    worker = stack.start_worker()
    job_id = submit(stack.http, commit(stack.http, scan_files(deaf=True)))
    stack.until(lambda: stack.job(job_id)["message"] == "At work", what="the engine is at work")
    os.kill(worker.pid, signal.SIGSTOP)  # it cannot see the request
    stack.http.post(f"/v1/jobs/{job_id}/cancel")
    kill(worker)
    stack.wait(job_id, "cancelled")
    assert not list(Path(stack.data / "jobs" / job_id).glob("attempt-*"))


@pytest.mark.slow
@pytest.mark.parametrize("delay_s", [0.05, 0.1, 0.2, 0.3, 0.4, 0.6, 0.8, 1.0, 1.3])
def test_a_worker_killed_at_any_moment_costs_one_attempt_at_most(stack: Stack, delay_s: float) -> None:
    worker = stack.start_worker()
    stack.until(lambda: stack.http.get("/readyz").status_code == 200, what="a worker")
    job_id = submit(stack.http, commit(stack.http, scan_files(steps=5, pause=0.05)))
    time.sleep(delay_s)
    kill(worker)
    stack.start_worker()
    done = stack.wait(job_id, "succeeded", "failed", seconds=40)
    assert done["state"] == "succeeded" and done["attempt"] <= 2
    assert publications(stack, job_id) <= 1  # 0 if it was killed between the rename and the log line
    assert stack.http.get(f"/v1/jobs/{job_id}/results").status_code == 200
    assert sorted(p.name for p in (stack.data / "jobs" / job_id).glob("*-*")) == []


@pytest.mark.slow
def test_a_large_upload_needs_little_memory(stack: Stack) -> None:
    size, chunk = 300 << 20, b"x" * (1 << 20)
    files = [{"name": "scan.json", "size": size}]
    upload_id = stack.http.post("/v1/uploads", json={"name": "large", "files": files}).json()["id"]

    def peak_kib() -> int:
        status = Path(f"/proc/{stack.server.pid}/status").read_text()
        return int(next(line for line in status.splitlines() if line.startswith("VmHWM")).split()[1])

    before = peak_kib()
    body = (chunk for _ in range(300))
    answer = stack.http.put(f"/v1/uploads/{upload_id}/files/scan.json", content=body, timeout=120)
    assert answer.status_code == 200
    assert peak_kib() - before < 40 << 10
