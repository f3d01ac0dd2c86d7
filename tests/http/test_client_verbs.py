"""The client's smaller verbs against the real server, as commands."""

from __future__ import annotations

import json
import os
import shutil
import subprocess
import sys
from collections.abc import Iterator
from typing import Any

import pytest

from .stack import PYTHONPATH, Stack, commit, scan_files, submit


@pytest.fixture(scope="module")
def served(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Stack]:
    """With a folder to import from, and no worker."""
    folder = tmp_path_factory.mktemp("verbs")
    stack = Stack(folder)
    (folder / "scanner3" / "monday").mkdir(parents=True)
    for name, data in scan_files().items():
        (folder / "scanner3" / "monday" / name).write_bytes(data)
    stack.environment["SPLATCT_IMPORT_FROM"] = f"local={folder / 'scanner3'}"
    with stack:
        yield stack


@pytest.fixture(scope="module")
def scan_id(served: Stack) -> str:
    return commit(served.http, scan_files())


def told(served: Stack, *arguments: str, code: int = 0) -> Any:
    """What the command prints with --json."""
    done = splatct(served, *arguments, "--json")
    assert done.returncode == code, done.stderr
    return json.loads(done.stdout)


def said(served: Stack, *arguments: str) -> str:
    done = splatct(served, *arguments)
    assert done.returncode == 0, done.stderr
    return done.stdout


def splatct(served: Stack, *arguments: str) -> subprocess.CompletedProcess[str]:
    environment = {name: value for name, value in os.environ.items() if not name.startswith("SPLATCT_")}
    environment |= {"PYTHONPATH": PYTHONPATH, "SPLATCT_SERVER": str(served.http.base_url)}
    command = [sys.executable, "-m", "splatct_client", *arguments]
    return subprocess.run(command, env=environment, capture_output=True, text=True, check=False, timeout=60)


def test_pins(served: Stack, scan_id: str) -> None:
    job = submit(served.http, scan_id)
    assert said(served, "pin", job, "--scan", scan_id) == f"job {job} is pinned\nscan {scan_id} is pinned\n"
    assert served.job(job)["pinned"] and served.http.get(f"/v1/scans/{scan_id}").json()["pinned"]
    assert "pinned    yes" in said(served, "jobs", job)
    answer = told(served, "unpin", job, "--scan", scan_id)
    assert not answer["jobs"][0]["pinned"] and not answer["scans"][0]["pinned"]
    assert not served.job(job)["pinned"]
    assert "expected ids of jobs" in told(served, "pin", code=2)["error"]["message"].lower()


def test_priority(served: Stack, scan_id: str) -> None:
    job = submit(served.http, scan_id)
    assert said(served, "priority", "high", job) == f"job {job} has priority high, number 1 in line\n"
    assert served.job(job)["priority"] == "high"
    served.http.post(f"/v1/jobs/{job}/cancel")
    assert "The job is cancelled" in told(served, "priority", "low", job, code=2)["error"]["message"]


def test_restart_with_changed_options(served: Stack, scan_id: str) -> None:
    job = submit(served.http, scan_id, seed=3)
    assert told(served, "restart", job, code=2)["error"]["kind"] == "ServerProblem", "it has not finished"
    served.http.post(f"/v1/jobs/{job}/cancel")
    again = told(served, "restart", job, "--calibrate", "none", "--priority", "low", "--name", "again")["job"]
    assert (again["restart_of"], again["name"], again["priority"]) == (job, "again", "low")
    assert again["options"]["calibrate"] == "none" and again["options"]["seed"] == 3
    assert "unknown option" in told(served, "restart", job, "--option", "colour=red", code=2)["error"]["message"]


def test_validate_and_scans(served: Stack, scan_id: str) -> None:
    estimate = told(served, "validate", scan_id, "--calibrate", "none")["estimate"]
    assert estimate["seconds"] > 0 and estimate["options"]["calibrate"] == "none"
    lines = said(served, "validate", scan_id).splitlines()
    assert [line.split()[0] for line in lines[:3]] == ["memory", "disk", "time"]
    assert scan_id in said(served, "scans") and scan_id in {scan["id"] for scan in told(served, "scans")["scans"]}


def test_import(served: Stack) -> None:
    job = told(served, "import", "scanner3/monday", "--priority", "high", "--option", "seed=9")["job"]
    assert (job["scan_name"], job["priority"], job["options"]["seed"]) == ("small", "high", 9)
    refused = told(served, "import", "scanner3/nowhere", code=2)["error"]
    assert "no such folder" in refused["message"]
    folder = served.data.parent / "scanner3"
    shutil.copytree(folder / "monday", folder / "torn")
    (folder / "torn" / "projections.tif").write_bytes(b"no TIFF at all")
    before = set((served.data / "uploads").iterdir())
    assert "projections.tif" in told(served, "import", "scanner3/torn", code=2)["error"]["message"]
    assert set((served.data / "uploads").iterdir()) == before, "what is refused holds no room"


def test_webhooks(served: Stack) -> None:
    url = "https://lab.example.org/done"
    made = told(served, "webhooks", "add", url, "--event", "job.failed")["webhook"]
    assert made["secret"].startswith("whsec_") and made["events"] == ["job.failed"]
    listed = said(served, "webhooks", "list")
    assert made["id"] in listed and url in listed and made["secret"] not in listed
    assert told(served, "webhooks", "deliveries", made["id"]) == {"deliveries": []}
    assert said(served, "webhooks", "remove", made["id"]) == f"webhook {made['id']} is removed\n"
    assert told(served, "webhooks", "list") == {"webhooks": []}
    assert "secret, shown this once: whsec_" in said(served, "webhooks", "add", url)
