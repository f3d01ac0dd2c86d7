"""A disk that is full to the last byte: what is said, that things can be deleted, that all goes on afterwards.

The disk is a real one, a tmpfs of 24 MiB with everything on it: uploads, jobs, the database, Redis.
"""

from __future__ import annotations

import base64
import hashlib
import os
import time
from collections.abc import Iterator
from pathlib import Path

import httpx
import pytest

from bench.faults.tinydisk import MIB, NoMount, TinyDisk, tiny_disk
from worker.jobfolder import JobFolder

from .stack import Stack, announce, commit, scan_files, send, submit

pytestmark = pytest.mark.system

CHUNK = {"Content-Type": "application/offset+octet-stream", "Tus-Resumable": "1.0.0"}
BIG = os.urandom(4 * MIB)


@pytest.fixture
def disk(tmp_path: Path) -> Iterator[TinyDisk]:
    try:
        with tiny_disk(tmp_path / "disk", 24) as disk:
            yield disk
    except NoMount as reason:
        pytest.skip(str(reason))


@pytest.fixture
def tight(disk: TinyDisk) -> Iterator[Stack]:
    stack = Stack(disk.path)
    stack.environment |= {"SPLATCT_DISK_FLOOR_MIB": "0", "SPLATCT_DISK_RESERVE_MIB": "1"}
    with stack:
        yield stack


def says_full(answer: httpx.Response) -> bool:
    problem = answer.json()
    hint = problem["errors"][0]["hint"]
    return (answer.status_code, problem["type"]) == (507, "urn:splatct:problem:no-room") and "delete" in hint


def test_a_put_is_told_and_can_be_repeated(tight: Stack, disk: TinyDisk) -> None:
    upload = announce(tight.http, {"scan.json": BIG})["id"]
    url = f"/v1/uploads/{upload}/files/scan.json"
    disk.fill(leave=2 * MIB)
    assert says_full(tight.http.put(url, content=BIG))
    assert not list((tight.data / "uploads" / upload / "parts").iterdir()), "what arrived in vain takes no room"
    assert tight.http.get(f"/v1/uploads/{upload}").json()["files"][0]["received"] == 0
    disk.empty()
    again = tight.http.put(url, content=BIG)
    assert again.status_code == 200 and again.json()["sha256"] == hashlib.sha256(BIG).hexdigest()


@pytest.mark.parametrize("digest", [False, True])
def test_a_patch_is_told_where_it_stands_and_goes_on_from_there(tight: Stack, disk: TinyDisk, digest: bool) -> None:
    upload = announce(tight.http, {"scan.json": BIG})["id"]
    url = f"/v1/uploads/{upload}/files/scan.json"
    first, rest = BIG[:MIB], BIG[MIB:]
    tight.http.patch(url, content=first, headers=CHUNK | {"Upload-Offset": "0"}).raise_for_status()
    disk.fill(leave=MIB)
    more = CHUNK | {"Upload-Offset": str(MIB)}
    if digest:
        more["Content-Digest"] = f"sha-256=:{base64.b64encode(hashlib.sha256(rest).digest()).decode()}:"
    refused = tight.http.patch(url, content=rest, headers=more)
    assert says_full(refused) and refused.headers["upload-offset"] == str(MIB), refused.text
    assert refused.headers["tus-resumable"] == "1.0.0"
    assert tight.http.head(url).headers["upload-offset"] == str(MIB), "what was acknowledged still counts"
    disk.empty()
    done = tight.http.patch(url, content=rest, headers=more)
    assert (done.status_code, done.headers["upload-offset"]) == (204, str(len(BIG)))
    assert tight.http.get(f"/v1/uploads/{upload}").json()["files"][0]["sha256"] == hashlib.sha256(BIG).hexdigest()


def test_with_no_byte_left_nothing_new_is_taken_and_everything_can_be_deleted(tight: Stack, disk: TinyDisk) -> None:
    scans = [commit(tight.http, scan_files()) for _ in range(3)]
    jobs = [submit(tight.http, scans[0]) for _ in range(2)]
    for job in jobs:
        tight.http.post(f"/v1/jobs/{job}/cancel").raise_for_status()
    uploads = [send(tight.http, scan_files()) for _ in range(2)]
    _use_up_the_log(tight, disk)
    assert disk.free == 0
    assert says_full(tight.http.post(f"/v1/jobs/{jobs[0]}/restart"))
    full = tight.http.post("/v1/uploads", json={"name": "x", "files": [{"name": "scan.json", "size": 10}]})
    assert (full.status_code, full.json()["type"]) == (507, "urn:splatct:problem:no-room")
    assert not list((tight.data / "jobs").glob(".new-*"))
    gone = [f"/v1/uploads/{upload}" for upload in uploads] + [f"/v1/jobs/{job}" for job in jobs]
    gone += [f"/v1/scans/{scan}" for scan in scans]
    for url in gone:
        answer = tight.http.delete(url)
        assert answer.status_code == 204, f"{url}: {answer.text}"
        assert tight.http.get(url).status_code == 404
    assert tight.http.get("/v1/scans").json() == {"scans": []}
    for kind in ("uploads", "scans", "jobs"):
        assert not list((tight.data / kind).iterdir())
    disk.empty()
    submit(tight.http, commit(tight.http, scan_files()))


def _use_up_the_log(stack: Stack, disk: TinyDisk) -> None:
    """Fill the disk, and what the database's own log still holds: it is used again from its start, so a few entries
    would fit where nothing else does."""
    disk.fill()
    for _ in range(2000):
        upload = stack.http.post("/v1/webhooks", json={"url": "https://lab.example.org/done"})
        if upload.status_code == 507:
            disk.fill()
            return
        if upload.status_code == 409:  # a tenant may have ten
            stack.http.delete(f"/v1/webhooks/{stack.http.get('/v1/webhooks').json()['webhooks'][0]['id']}")
    raise AssertionError("the database never met the full disk")


def test_below_the_floor_uploads_are_refused_and_deletions_are_not(disk: TinyDisk) -> None:
    stack = Stack(disk.path)
    stack.environment |= {"SPLATCT_DISK_FLOOR_MIB": "4", "SPLATCT_DISK_RESERVE_MIB": "1"}
    with stack:
        scan = commit(stack.http, scan_files())
        disk.fill(leave=3 * MIB)
        answer = stack.http.post("/v1/uploads", json={"name": "x", "files": [{"name": "scan.json", "size": 10}]})
        assert answer.status_code == 507 and "delete" in answer.json()["errors"][0]["hint"]
        assert stack.http.get("/readyz").json()["disk"] is False
        assert stack.http.delete(f"/v1/scans/{scan}").status_code == 204
        disk.empty()
        stack.until(lambda: stack.http.get("/readyz").json()["disk"] is True, 3, "room again")
        commit(stack.http, scan_files())


def test_a_run_goes_on_where_its_state_cannot_be_kept(tight: Stack, disk: TinyDisk) -> None:
    """The checkpoint needs 2 MiB that are not there; the run does not, and the older checkpoint stays."""
    scan = commit(tight.http, scan_files(steps=60, pause=0.1, state_bytes=2 * MIB))
    job = submit(tight.http, scan)
    tight.start_worker()
    checkpoint = JobFolder(tight.data, job).checkpoint
    tight.until(checkpoint.exists, what="a first checkpoint")
    disk.fill()
    kept = checkpoint.stat().st_mtime_ns
    at = tight.job(job)["progress"]
    tight.until(lambda: not tight.engine_pids() or checkpoint.stat().st_mtime_ns == kept, 1)
    time.sleep(1.5)  # several checkpoints would have been due
    assert tight.engine_pids(), "the run has not ended"
    assert checkpoint.stat().st_mtime_ns == kept and not list(checkpoint.parent.glob(".run.checkpoint*"))
    disk.empty()
    tight.until(lambda: not checkpoint.exists() or checkpoint.stat().st_mtime_ns != kept, what="checkpoints again")
    done = tight.wait(job, "succeeded", "failed")
    assert done["state"] == "succeeded" and done["progress"] > at, done["error"]
    events = tight.http.get(f"/v1/jobs/{job}/events").json()["events"]
    assert [event["number"] for event in events] == list(range(1, len(events) + 1)), "numbers without a gap"


def test_a_result_without_room_fails_the_job_and_a_restart_goes_on(tight: Stack, disk: TinyDisk) -> None:
    scan = commit(tight.http, scan_files(steps=12, pause=0.1, result_bytes=6 * MIB))
    job = submit(tight.http, scan)
    tight.start_worker()
    tight.until(JobFolder(tight.data, job).checkpoint.exists, what="a first checkpoint")
    disk.fill(leave=3 * MIB)
    failed = tight.wait(job, "failed", "succeeded")
    assert failed["error"]["kind"] == "disk_full" and "Make room and restart" in failed["error"]["message"]
    folder = JobFolder(tight.data, job)
    assert not list(folder.path.glob("attempt-*")), "the half result takes no room"
    assert tight.http.get(f"/v1/jobs/{job}/results").status_code == 409
    disk.empty()
    again = tight.http.post(f"/v1/jobs/{job}/restart").json()["id"]
    assert tight.wait(again, "succeeded", "failed")["state"] == "succeeded"
    events = tight.http.get(f"/v1/jobs/{again}/events").json()["events"]
    assert [event["message"] for event in events[:2]] == ["Reading the scan", "Going on from the checkpoint"]
    assert tight.http.delete(f"/v1/jobs/{job}").status_code == 204
