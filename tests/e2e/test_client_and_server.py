"""The client's verbs against the real server; the test is the worker. Also the pages' headers."""

from __future__ import annotations

import argparse
import functools
import hashlib
import json
import threading
import time
import types
from pathlib import Path
from typing import Any

import httpx
import numpy as np
import pytest
import tifffile
from splatct_client import Client, ServerProblem
from splatct_client.retry import Patience
from splatct_client.verbs import cancel, fetch, jobs, submit

from worker.contract import State

from .stage import Stage, progress_events, wait_until


def run(verb: types.ModuleType, *arguments: str) -> int:
    parser = argparse.ArgumentParser()
    verb.configure(parser)
    parser.add_argument("--json", action="store_true")
    return int(verb.run(parser.parse_args(arguments)))


@pytest.fixture(autouse=True)
def state(tmp_path_factory: pytest.TempPathFactory, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("XDG_STATE_HOME", str(tmp_path_factory.mktemp("state")))


@pytest.fixture
def scan(tmp_path: Path) -> Path:
    folder = tmp_path / "Prüfling 7"
    (folder / "frames").mkdir(parents=True)
    described: dict[str, Any] = {
        "format": "splatct-scan/1",
        "name": "Prüfling 7",
        "projections": {"files": [f"frames/{k}.tif" for k in range(12)], "kind": "line_integrals", "scale": 1.0},
        "geometry": {
            "beam": "cone", "dso_mm": 500.0, "dsd_mm": 700.0,
            "detector": {"rows": 16, "cols": 16, "pixel_mm": [2.0, 2.0], "offset_mm": [0.0, 0.0]},
            "angles_deg": [30.0 * k for k in range(12)],
        },
        "volume": {"shape": [8, 8, 8], "voxel_mm": [2.0, 2.0, 2.0]},
        "simulation": {"volume_file": "truth.tif", "attenuation_unit": 0.01},
    }  # fmt: skip
    (folder / "scan.json").write_text(json.dumps(described), encoding="utf-8")
    r, c = np.mgrid[:16, :16] - 7.5
    pixels = np.maximum(0, 1 - (r**2 + c**2) / 30).astype(np.float32)
    for k in range(12):
        tifffile.imwrite(folder / f"frames/{k}.tif", pixels * (1 + k / 100), photometric="minisblack")
    return folder


def test_submit_waits_and_fetches_what_the_worker_made(
    stage: Stage, scan: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    hasty = functools.partial(Client, patience=Patience(sleep=lambda seconds: time.sleep(min(seconds, 0.05))))
    monkeypatch.setattr("splatct_client.client.Client", hasty)

    def work() -> None:
        wait_until(lambda: bool(stage.ledger.in_states([State.QUEUED])))
        (job,) = stage.ledger.in_states([State.QUEUED])
        stage.start(job.id)
        for event in list(progress_events())[:3]:
            stage.say(job.id, **event)
        stage.finish(job.id)

    worker = threading.Thread(target=work)
    worker.start()
    out = tmp_path / "out"
    assert run(submit, str(scan), "--server", stage.url, "--option", "seed=7", "-o", str(out)) == 0
    worker.join()
    manifest = json.loads((out / "manifest.json").read_bytes())
    assert {f["name"] for f in manifest["files"]} | {"manifest.json"} == {p.name for p in out.iterdir()}
    for file in manifest["files"]:
        assert hashlib.sha256((out / file["name"]).read_bytes()).hexdigest() == file["sha256"]
    (job,) = stage.ledger.in_states([State.SUCCEEDED])
    assert job.options["seed"] == 7 and job.name == "Prüfling 7"

    again = tmp_path / "again"
    assert run(fetch, job.id, "--server", stage.url, "-o", str(again), "--only", "poses.json") == 0
    assert [p.name for p in again.iterdir()] == ["poses.json"]


def test_a_scan_that_the_server_refuses_is_told_in_full(stage: Stage, scan: Path) -> None:
    (scan / "frames/3.tif").write_bytes(b"II*\0")
    (scan / "frames/5.tif").write_bytes(b"not a TIFF")
    with pytest.raises(ServerProblem) as caught:
        run(submit, str(scan), "--server", stage.url)
    assert caught.value.status == 422
    text = str(caught.value)
    assert "frames_3.tif" in text and "frames_5.tif" in text
    assert stage.ledger.page(None, 10, None) == []


def test_jobs_and_cancel(stage: Stage, capsys: pytest.CaptureFixture[str]) -> None:
    job = stage.job("teapot")
    assert run(jobs, "--server", stage.url) == 0
    assert job in capsys.readouterr().out
    assert run(cancel, job, "--server", stage.url) == 0
    assert capsys.readouterr().out == f"job {job} is cancelled\n"
    assert run(jobs, job, "--server", stage.url, "--json") == 0
    assert json.loads(capsys.readouterr().out)["job"]["state"] == "cancelled"


def test_the_client_reads_what_the_server_says_of_a_failure(stage: Stage) -> None:
    job = stage.job("teapot", State.FAILED, error_kind="crashed", error_message="The worker died")
    with Client(stage.url) as client:
        found = client.wait(job)
        assert found.error is not None and found.error.message == "The worker died"
        assert "calibrate" in {option["name"] for option in client.options()}
        with pytest.raises(ServerProblem, match="no results"):
            client.results(job)


@pytest.mark.parametrize("path", ["/", "/jobs/6a1f6f0e-0000-4000-8000-000000000001", "/jobs/%3Cscript%3E"])
def test_pages_allow_no_inline_code(stage: Stage, path: str) -> None:
    page = httpx.get(stage.url + path, trust_env=False)
    assert page.status_code == 200 and page.headers["content-type"].startswith("text/html")
    policy = page.headers["content-security-policy"]
    assert "default-src 'none'" in policy and "unsafe" not in policy
    assert "<script>" not in page.text and "style=" not in page.text and "http://" not in page.text
    for file in ("page.css", "favicon.svg", "job.js", "jobs.js"):
        assert httpx.get(f"{stage.url}/static/{file}", trust_env=False).status_code == 200
