"""From files to results over HTTP, with the real server, queue and worker around a fake engine."""

from __future__ import annotations

import hashlib
import io
from collections.abc import Callable
from typing import Any

import numpy as np
import pytest
from PIL import Image

from .stack import Stack, commit, scan_files, submit


@pytest.fixture(scope="module")
def finished(shared: Stack) -> str:
    """The id of a job that succeeded."""
    job_id = submit(shared.http, commit(shared.http, scan_files(steps=3)), quality="preview")
    job = shared.wait(job_id, "succeeded", "failed")
    assert job["state"] == "succeeded", job
    return job_id


def test_a_scan_becomes_results(shared: Stack, finished: str) -> None:
    job = shared.job(finished)
    assert (job["progress"], job["attempt"], job["error"], job["eta_s"]) == (1.0, 1, None, None)
    assert job["options"]["quality"] == "preview"
    assert job["created_at"] <= job["started_at"] <= job["finished_at"]
    manifest = shared.http.get(job["links"]["results"]).json()
    names = {"volume.tif", "poses.json", "report.json", "report.html", "splats.npz"}
    assert {f["name"] for f in manifest["files"]} == names
    for file in manifest["files"]:
        content = shared.http.get(f"/v1/jobs/{finished}/results/{file['name']}").content
        assert hashlib.sha256(content).hexdigest() == file["sha256"]
    assert shared.http.get(job["links"]["report"]).json() == {"findings": []}


def test_events_and_log(shared: Stack, finished: str) -> None:
    answer = shared.http.get(f"/v1/jobs/{finished}/events").json()
    assert [event["number"] for event in answer["events"]] == [1, 2, 3, 4, 5]
    assert answer["events"][0]["stage"] == "read"  # said by the engine's process before it loads what it needs
    assert answer["last"] == 5 and answer["events"][-1]["stage"] == "level"
    rest = shared.http.get(f"/v1/jobs/{finished}/events?after=4").json()
    assert [event["number"] for event in rest["events"]] == [5]
    log = shared.http.get(f"/v1/jobs/{finished}/log")
    assert log.headers["content-type"].startswith("text/plain") and "stray print" in log.text


def test_ranges_resume_a_download(shared: Stack, finished: str) -> None:
    url = f"/v1/jobs/{finished}/results/volume.tif"
    whole = shared.http.get(url)
    assert whole.headers["accept-ranges"] == "bytes"
    head = shared.http.get(url, headers={"Range": "bytes=0-99"})
    tail = shared.http.get(url, headers={"Range": "bytes=100-", "If-Range": whole.headers["etag"]})
    assert (head.status_code, tail.status_code) == (206, 206)
    assert head.content + tail.content == whole.content
    assert tail.headers["content-range"] == f"bytes 100-{len(whole.content) - 1}/{len(whole.content)}"
    stale = shared.http.get(url, headers={"Range": "bytes=100-", "If-Range": '"other"'})
    assert stale.status_code == 200 and stale.content == whole.content


# The fake volume is 100·z + 10·y + x, shape (z, y, x) = (5, 6, 7). Pictures have their second axis upward.
PLANES: dict[str, tuple[int, Callable[[Any, Any], Any], tuple[int, int]]] = {
    "z": (5, lambda row, col: 200 + 10 * (5 - row) + col, (6, 7)),
    "y": (6, lambda row, col: 100 * (4 - row) + 20 + col, (5, 7)),
    "x": (7, lambda row, col: 100 * (4 - row) + 10 * col + 2, (5, 6)),
}


@pytest.mark.parametrize("axis", PLANES)
def test_slices_show_the_right_voxels(shared: Stack, finished: str, axis: str) -> None:
    count, expected, shape = PLANES[axis]
    base = f"/v1/jobs/{finished}/slices/{axis}"
    answer = shared.http.get(f"{base}/2.png?low=0&high=510")
    assert answer.headers["content-type"] == "image/png"
    picture = np.asarray(Image.open(io.BytesIO(answer.content)))
    assert picture.shape == shape and picture.dtype == np.uint8
    np.testing.assert_array_equal(picture, np.floor(np.fromfunction(expected, shape) / 2))
    assert shared.http.get(f"{base}/{count - 1}.png").status_code == 200
    assert shared.http.get(f"{base}/{count}.png").status_code == 404


def test_the_default_window_covers_the_volume(shared: Stack, finished: str) -> None:
    answer = shared.http.get(f"/v1/jobs/{finished}/slices/z/4.png")
    assert np.asarray(Image.open(io.BytesIO(answer.content))).max() == 255
    upside_down = shared.http.get(f"/v1/jobs/{finished}/slices/z/4.png?low=2&high=1")
    assert upside_down.status_code == 422


@pytest.mark.parametrize("file", ["..%2fjob.json", "%2e%2e%2fjob.json", "job.json", ".lock", "nul", "volume.tif%00"])
def test_only_result_files_are_handed_out(shared: Stack, finished: str, file: str) -> None:
    assert shared.http.get(f"/v1/jobs/{finished}/results/{file}").status_code == 404


def test_the_html_report_is_shown_in_a_sandbox(shared: Stack, finished: str) -> None:
    report = shared.http.get(f"/v1/jobs/{finished}/results/report.html")
    assert report.headers["content-type"].startswith("text/html")
    assert "sandbox" in report.headers["content-security-policy"]
    assert "content-disposition" not in report.headers


def test_a_failed_job_says_why_and_has_no_results(shared: Stack) -> None:
    job_id = submit(shared.http, commit(shared.http, scan_files(end="diverged")))
    job = shared.wait(job_id, "failed", "succeeded")
    assert job["error"]["kind"] == "cannot_reconstruct" and "mirrored" in job["error"]["message"]
    answer = shared.http.get(f"/v1/jobs/{job_id}/results")
    assert answer.status_code == 409 and answer.json()["type"] == "urn:splatct:problem:no-results"


def test_the_volume_so_far(shared: Stack) -> None:
    job_id = submit(shared.http, commit(shared.http, scan_files(steps=1000, pause=0.05, draft_at=2)))
    url = f"/v1/jobs/{job_id}/slices/y/2.png?low=0&high=0.2"
    assert shared.http.get(url).status_code == 409  # nothing to be seen yet
    shared.until(
        lambda: any("draft" in e for e in shared.http.get(f"/v1/jobs/{job_id}/events").json()["events"]), 20, "draft"
    )
    answer = shared.http.get(url)
    assert answer.status_code == 200 and "immutable" not in answer.headers["cache-control"]
    picture = np.asarray(Image.open(io.BytesIO(answer.content)))
    assert picture.shape == (2, 4) and (picture == 127).all()
    assert shared.http.get(f"/v1/jobs/{job_id}/slices/z/2.png").status_code == 404
    shared.http.post(f"/v1/jobs/{job_id}/cancel")
    job = shared.wait(job_id, "cancelled")
    assert not (shared.data / "jobs" / job_id / "draft.tif").exists()
    assert "partial" in job["links"]  # which has its own volume
    assert np.asarray(Image.open(io.BytesIO(shared.http.get(url).content))).shape == (5, 7)


def test_cancel_a_running_job(shared: Stack) -> None:
    job_id = submit(shared.http, commit(shared.http, scan_files(steps=5000, pause=0.05)))
    shared.wait(job_id, "running")
    asked = shared.http.post(f"/v1/jobs/{job_id}/cancel")
    assert asked.status_code == 202 and asked.json()["state"] in ("cancelling", "cancelled")
    shared.wait(job_id, "cancelled")
    assert shared.http.post(f"/v1/jobs/{job_id}/cancel").json()["state"] == "cancelled"
    shared.until(lambda: not shared.engine_pids(), what="no engine is left")


def test_forgetting_a_job_and_its_scan(shared: Stack) -> None:
    scan_id = commit(shared.http, scan_files())
    job_id = submit(shared.http, scan_id)
    shared.wait(job_id, "succeeded")
    assert shared.http.delete(f"/v1/scans/{scan_id}").status_code == 204
    assert shared.http.get(f"/v1/jobs/{job_id}/results").status_code == 200
    assert shared.http.delete(f"/v1/jobs/{job_id}").status_code == 204
    assert shared.http.get(f"/v1/jobs/{job_id}").status_code == 404
    assert not (shared.data / "jobs" / job_id).exists() and not (shared.data / "scans" / scan_id).exists()


def test_ready_with_a_worker(shared: Stack) -> None:
    shared.until(lambda: shared.http.get("/readyz").status_code == 200, what="ready")
    assert shared.http.get("/readyz").json()["workers"] == 1
