"""From files to results over HTTP, with the real server, queue and worker around a fake engine."""

from __future__ import annotations

import hashlib
import io

import numpy as np
from PIL import Image

from .stack import Stack, commit, scan_files, submit


def test_a_scan_becomes_results(shared: Stack) -> None:
    job_id = submit(shared.http, commit(shared.http, scan_files(steps=3)), quality="preview")
    job = shared.wait(job_id, "succeeded", "failed")
    assert job["state"] == "succeeded", job
    assert (job["progress"], job["attempt"], job["error"], job["eta_s"]) == (1.0, 1, None, None)
    assert job["options"]["quality"] == "preview"
    assert job["created_at"] <= job["started_at"] <= job["finished_at"]
    base = f"/v1/jobs/{job_id}"
    manifest = shared.http.get(f"{base}/results").json()
    assert {f["name"] for f in manifest["files"]} == {"volume.tif", "poses.json", "report.json", "report.html"}
    for file in manifest["files"]:
        content = shared.http.get(f"{base}/results/{file['name']}").content
        assert hashlib.sha256(content).hexdigest() == file["sha256"]
    assert shared.http.get(f"{base}/report").json() == {"findings": []}
